"""Training samples: random spectra and what a camera measures of them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.spectra import PRIORS
from squilla.training.noise import Noise, add_noise


@dataclass(frozen=True)
class Samples:
    """A reproducible stream of training samples for one camera.

    calibration : the camera.
    spectra : name of the prior, a key of spectra.PRIORS; "gaussian" is the thesis' set.
    count : spectra in an epoch; the thesis has 8000.
    noise : none, dB, or a range of dB; drawn anew in every epoch.
    fresh : draw new spectra for every epoch, instead of one set for all.
    seed : every epoch of every seed has random numbers of its own, so that epoch 7 is the same
        whether the six before it were drawn or not.
    """

    calibration: Calibration
    spectra: str = "broad"
    count: int = 8000
    noise: Noise = (15.0, 20.0)
    fresh: bool = True
    seed: int = 0

    def __post_init__(self):
        if self.spectra not in PRIORS:
            raise InputError(
                f"There is no prior named {self.spectra!r}; there are {', '.join(PRIORS)}."
            )
        if self.count < 1:
            raise InputError(f"{self.count} spectra are not enough; give at least one.")

    def draw(self, epoch: int) -> Tensor:
        """Return the spectra of an epoch, (count, K), each with a maximum of 1."""
        generator = self._generator(epoch if self.fresh else 0, 0)
        return PRIORS[self.spectra](self.count, self.calibration.wavelength, generator=generator)

    def batches(self, epoch: int, size: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield the samples of an epoch in random order, `size` at a time.

        Yields
        ------
        y : Tensor, (size, M)
            Noisy measurements, each divided by its maximum.
        angle : Tensor, (size,)
            Field angle of each, rad, spread as evenly over the image area as pixels are.
        x : Tensor, (size, K)
            The spectra, each with a maximum of 1.
        """
        generator = self._generator(epoch, 1)
        spectra = self.draw(epoch)
        low, high = (float(end) ** 2 for end in self.calibration.angle[[0, -1]])
        for part in torch.randperm(self.count, generator=generator).split(size):
            x = spectra[part]
            angle = (low + (high - low) * torch.rand(len(x), generator=generator)).sqrt()
            y = add_noise(self.calibration.project(x, angle), self.noise, generator)
            yield y / y.amax(-1, keepdim=True).clamp_min(1e-12), angle, x

    def _generator(self, epoch: int, stream: int) -> torch.Generator:
        state = np.random.SeedSequence([self.seed, epoch, stream]).generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
