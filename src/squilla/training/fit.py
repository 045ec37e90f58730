"""Training: from a camera's calibration to a network that reconstructs for it."""

import hashlib
import json
import math
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.files.disk import replacing
from squilla.reconstruction.reconstructor import (
    Reconstructor,
    fingerprint,
    model_class,
)
from squilla.training.data import Samples
from squilla.training.noise import Noise

CHECKPOINT_EVERY = 10
"""Epochs between two checkpoints."""

VALIDATION = 1000
"""Spectra that the network never trains on, to judge it by after every epoch."""


def train(
    name: str,
    calibration: Calibration,
    *,
    noise: Noise = (15.0, 20.0),
    spectra: str = "broad",
    count: int = 8000,
    fresh: bool = True,
    epochs: int = 500,
    batch: int = 1024,
    learning_rate: float = 1e-4,
    schedule: Literal["constant", "cosine"] = "constant",
    seed: int = 0,
    device: str | None = None,
    log: str | Path | None = None,
    checkpoint: str | Path | None = None,
    progress: bool = True,
) -> Reconstructor:
    """Train a network for one camera: Adam on the mean squared error over the wavelengths.

    Parameters
    ----------
    name : str
        A network of `models`: "mlp", "cnn", "rescnn", "unet", "respecnn".
    calibration : Calibration
        With several field angles, every sample gets one at random.
    noise : None, float or (float, float)
        Signal-to-noise ratio of the training measurements, dB: none, fixed, or drawn uniformly
        between two for every sample (the thesis' contribution).
    spectra : str
        What to train on, a key of spectra.PRIORS: "broad" (default), or "gaussian" as the thesis.
    count : int
        Spectra in an epoch.
    fresh : bool
        Draw new spectra for every epoch; the thesis keeps one set (False).
    epochs, batch : int
    learning_rate : float
    schedule : "constant" or "cosine"
        Whether the learning rate stays (the thesis) or falls to zero along half a cosine.
    seed : int
        Of the first weights, the spectra, the noise and the order. The same seed gives the same
        weights to the bit, on one machine's CPU with one number of threads.
    device : str, optional
        "cpu", "cuda" or "cuda:1"; default: CUDA where there is one.
    log : path, optional
        Gets one line of JSON for each epoch.
    checkpoint : path, optional
        Written every ten epochs; if it exists, training goes on from there, to the same result
        as if it had never stopped.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Reconstructor
        On the CPU, in evaluation mode; `save` writes it to a file.

    Raises
    ------
    InputError
        If a setting makes no sense, the checkpoint belongs to another training, or the training
        diverges.

    Source: thesis, section on training.
    """
    kind = model_class(name)
    if not kind.trained:
        raise InputError(f"`{name}` is computed from the calibration and needs no training.")
    if epochs < 1 or batch < 1 or not learning_rate > 0:
        raise InputError("Epochs, batch and learning rate must be positive.")
    if schedule not in ("constant", "cosine"):
        raise InputError(f"There is no schedule {schedule!r}; there are constant and cosine.")
    samples = Samples(calibration, spectra, count, noise, fresh, seed)
    settings = {
        "noise": _named(noise),
        "spectra": spectra if fresh else f"{spectra}, one set",
        "count": count,
        "epochs": epochs,
        "batch": batch,
        "learning_rate": learning_rate,
        "schedule": schedule,
        "seed": seed,
    }
    run = _Run(kind, samples, settings, _device(device))
    if checkpoint is not None and Path(checkpoint).exists():
        run.resume(Path(checkpoint))
    if log is not None:
        with replacing(log) as temporary:
            temporary.write_text("".join(json.dumps(entry) + "\n" for entry in run.history))
    for epoch in _shown(range(len(run.history), epochs), name, epochs, run, progress):
        run.epoch(epoch)
        if log is not None:
            with open(log, "a") as file:
                file.write(json.dumps(run.history[-1]) + "\n")
        if checkpoint is not None and ((epoch + 1) % CHECKPOINT_EVERY == 0 or epoch + 1 == epochs):
            run.write(Path(checkpoint))
    return run.finished()


class _Run:
    """The state of a training: weights, optimiser, and what happened so far."""

    def __init__(
        self,
        kind: type[Reconstructor],
        samples: Samples,
        settings: dict[str, Any],
        device: torch.device,
    ):
        with torch.random.fork_rng(devices=[]):  # the caller's random numbers stay as they are
            torch.manual_seed(settings["seed"])
            self.model = kind(samples.calibration).to(device)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=settings["learning_rate"])
        self.samples, self.settings, self.device = samples, settings, device
        self.history: list[dict[str, float]] = []
        held_out = replace(samples, count=VALIDATION, seed=samples.seed + 2**32)
        self.validation = [
            tuple(part.to(device) for part in sample)
            for sample in held_out.batches(0, self.model.piece)
        ]

    def epoch(self, epoch: int) -> None:
        """Train for one epoch, judge the result, and note both."""
        began = time.perf_counter()
        size, epochs = self.settings["batch"], self.settings["epochs"]
        steps = math.ceil(self.samples.count / size)
        total = torch.zeros((), device=self.device)
        self.model.train()
        for step, sample in enumerate(self.samples.batches(epoch, size)):
            rate = self._rate((epoch + step / steps) / epochs)
            total += self._step(rate, *(part.to(self.device) for part in sample))
        self.model.eval()
        entry = {
            "epoch": epoch,
            "loss": float(total) / self.samples.count,
            "validation": self._validate(),
            "learning_rate": rate,
            "seconds": round(time.perf_counter() - began, 3),
        }
        if not math.isfinite(entry["loss"]):
            raise InputError(f"The training diverged in epoch {epoch}; lower the learning rate.")
        self.history.append(entry)

    def _step(self, rate: float, y: Tensor, angle: Tensor, x: Tensor) -> Tensor:
        """Take one step down the mean squared error; return its sum over the samples."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad()
        estimate = self.model.estimate(self.model.levelled(y, angle), angle)
        loss = nn.functional.mse_loss(estimate, x)
        loss.backward()
        self.optimiser.step()
        return loss.detach() * len(x)

    def _rate(self, share: float) -> float:
        """Return the learning rate after this share of the training."""
        rate = self.settings["learning_rate"]
        if self.settings["schedule"] == "cosine":
            return rate * (1 + math.cos(math.pi * share)) / 2
        return rate

    @torch.inference_mode()
    def _validate(self) -> float:
        total = sum(
            float((self.model.estimate(self.model.levelled(y, angle), angle) - x).square().mean())
            * len(x)
            for y, angle, x in self.validation
        )
        return total / VALIDATION

    def _identity(self) -> dict[str, Any]:
        camera = fingerprint(self.samples.calibration)
        return {"name": self.model.name, "calibration": camera, **self.settings}

    def write(self, path: Path) -> None:
        """Write everything from which `resume` goes on."""
        state = {
            "identity": self._identity(),
            "history": self.history,
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        with replacing(path) as temporary:
            torch.save(state, temporary)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same training."""
        try:
            # weights_only: nothing in the file is executed.
            state = torch.load(path, map_location=self.device, weights_only=True)
            identity = state["identity"]
        except Exception as error:  # torch raises whatever its reader stumbles over
            raise InputError(f"{path} is not a checkpoint of a training; remove it.") from error
        own = self._identity()
        if identity != own:
            other = sorted(key for key in own if identity.get(key) != own[key])
            raise InputError(
                f"{path} is the checkpoint of another training (it differs in {', '.join(other)}); "
                "remove it or name another file."
            )
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.history = state["history"]

    def finished(self) -> Reconstructor:
        """Return the model with the story of its training."""
        story = [(entry["epoch"], entry["loss"], entry["validation"]) for entry in self.history]
        model = self.model.cpu().eval()
        model.provenance = {
            **self.settings,
            "validation": self.history[-1]["validation"],
            "training": hashlib.sha256(json.dumps(story).encode()).hexdigest()[:12],
        }
        return model


def _device(name: str | None) -> torch.device:
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built with CUDA
        raise InputError(f"There is no device {name!r} here; use cpu.") from error


def _named(noise: Noise) -> str:
    if noise is None:
        return "none"
    if isinstance(noise, tuple):
        return f"{noise[0]:g}-{noise[1]:g} dB"
    return f"{noise:g} dB"


def _shown(steps: range, name: str, epochs: int, run: _Run, progress: bool) -> Iterable[int]:
    """Yield the epochs, with a progress bar that shows the loss."""
    if not progress:
        yield from steps
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[loss]}"),
    )
    with Progress(*columns) as bar:
        task = bar.add_task(f"train {name}", total=epochs, completed=steps.start, loss="")
        for epoch in steps:
            yield epoch
            loss = f"validation error {run.history[-1]['validation']:.5f}"
            bar.update(task, completed=epoch + 1, loss=loss)
