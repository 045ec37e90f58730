"""Several processes that train one network together, as torchrun starts them.

Every process draws the same batches from the same seed and works on its share of each; the sum of
their gradients is the gradient of the whole batch, so that the number of processes changes the
result only by rounding.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch import distributed as dist

from squilla.errors import InputError


@dataclass(frozen=True)
class Processes:
    """This process among those that train together.

    rank : its number, from 0; the first one writes the files.
    count : how many there are.
    device : on which this one works.
    """

    rank: int
    count: int
    device: torch.device

    def share(self, *parts: Tensor) -> list[Tensor]:
        """Return this process's part of a batch."""
        return [part[self.rank :: self.count] for part in parts]

    def sum(self, tensors: Iterable[Tensor | None]) -> None:
        """Replace tensors, in place, by their sums over the processes."""
        here = [tensor for tensor in tensors if tensor is not None]
        if self.count == 1 or not here:
            return
        together = torch.cat([tensor.flatten() for tensor in here])
        dist.all_reduce(together)
        parts = together.split([tensor.numel() for tensor in here])
        for tensor, part in zip(here, parts, strict=True):
            tensor.copy_(part.view_as(tensor))


@contextmanager
def joined(device: str | None) -> Iterator[Processes]:
    """Join the other processes that torchrun started, if it did.

    Parameters
    ----------
    device : str, optional
        "cpu", "cuda" or "cuda:1"; default: CUDA where there is one, a device for each process.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Processes(0, 1, _device(device))
        return
    if device in (None, "cuda") and torch.cuda.is_available():
        device = f"cuda:{os.environ['LOCAL_RANK']}"
    place = _device(device)
    if place.type == "cuda":
        torch.cuda.set_device(place)
    dist.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield Processes(dist.get_rank(), count, place)
    finally:
        dist.destroy_process_group()


def _device(name: str | None) -> torch.device:
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built with CUDA
        raise InputError(f"There is no device {name!r} here; use cpu.") from error
