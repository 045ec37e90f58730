"""Training: from a camera's calibration to a network that reconstructs for it."""

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.files.disk import replacing
from squilla.reconstruction.models import model_class
from squilla.reconstruction.reconstructor import Reconstructor
from squilla.reconstruction.weights import fingerprint
from squilla.training.data import Samples
from squilla.training.noise import Noise, SensorNoise
from squilla.training.prior import LEARNT, learn_prior
from squilla.training.processes import Processes, joined

Precision = Literal["float32", "tf32", "bfloat16"]

EPOCH = 8000
"""Spectra in an epoch."""

CHECKPOINTING = 0.02
"""Part of the time that may go into writing checkpoints."""

VALIDATION = 1000
"""Spectra that the network never trains on, to judge it by after every epoch."""

LOOKED_AT = 6
"""Spectra of those that are shown while it trains."""

LOOK_EVERY = 10
"""Epochs between two looks at them."""


def train(
    name: str,
    calibration: Calibration,
    *,
    noise: Noise = (15.0, 20.0),
    gain_error: float = 0.0,
    dropped: float = 0.0,
    spectra: str = "broad",
    count: int | None = None,
    fresh: bool = True,
    epochs: int = 500,
    batch: int = 1024,
    learning_rate: float = 1e-4,
    schedule: Literal["constant", "cosine"] = "constant",
    seed: int = 0,
    device: str | None = None,
    precision: Precision = "float32",
    log: str | Path | None = None,
    checkpoint: str | Path | None = None,
    look: Callable[[int, Tensor, Tensor], None] | None = None,
    progress: bool = True,
) -> Reconstructor:
    """Train a network for one camera: Adam on the mean squared error over the wavelengths.

    Started by torchrun, the processes share every batch.

    Parameters
    ----------
    name : str
        A network of `models`: "mlp", "cnn", "rescnn", "unet", "respecnn"; or "compound", which
        learns its prior anew on the camera's wavelengths (`training.prior`) from `count` spectra:
        it takes `seed` and `device` too, and refuses what shapes a training.
    calibration : Calibration
        With several field angles, every sample gets one at random.
    noise : None, float, (float, float) or SensorNoise
        Of the training measurements: none, a fixed signal-to-noise ratio in dB, one drawn
        uniformly between two for every sample (the thesis' contribution), or a sensor's.
    gain_error : float
        Standard deviation of factors by which the sensitivity of each channel is wrong, new for
        every sample: teaches a network not to trust R beyond what it was calibrated to.
    dropped : float
        Probability that a channel is lost and, as in `Reconstructor.reconstruct`, filled from the
        others.
    spectra : str
        What to train on, a key of spectra.PRIORS: "broad" (default), or "gaussian" as the thesis.
    count : int, optional
        Spectra in an epoch, 8000 unless told; "compound" learns from 60 000 unless told.
    fresh : bool
        Draw new spectra for every epoch; the thesis keeps one set (False).
    epochs, batch : int
    learning_rate : float
    schedule : "constant" or "cosine"
        Whether the learning rate stays (the thesis) or falls to zero along half a cosine.
    seed : int
        0 or more; of the first weights, the spectra, the noise and the order. The same seed gives
        the same weights to the bit, on one machine's CPU with one number of threads.
    device : str, optional
        "cpu", "cuda" or "cuda:1"; default: CUDA where there is one.
    precision : "float32", "tf32" or "bfloat16"
        Of the products in the network; weights, loss and optimiser stay in float32. bfloat16
        trains convolutions three times as fast on processors that have it; tf32 is CUDA's.
    log : path, optional
        Gets one line of JSON for each epoch.
    checkpoint : path, optional
        Written after the first epoch, then as often as takes 2 % of the time; if it exists,
        training goes on from there, to the same result as if it had never stopped.
    look : callable, optional
        Called every ten epochs with the epoch, six spectra that the network never trained on,
        (6, K), and what it makes of them.
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
    if count is None:
        count = LEARNT if kind.universal else EPOCH
    sensible = min(count, epochs, batch) >= 1 and 0 < learning_rate < math.inf
    if not (sensible or kind.universal):
        raise InputError(
            f"{epochs} epochs of {count} spectra in batches of {batch} at a learning rate of "
            f"{learning_rate:g} are no training; all four must be positive."
        )
    if schedule not in ("constant", "cosine"):
        raise InputError(f"There is no schedule {schedule!r}; there are constant and cosine.")
    for file in (log, checkpoint):
        if file is not None and not Path(file).resolve().parent.is_dir():
            raise InputError(f"{file} cannot be written: there is no such folder; make it first.")
    if kind.universal:
        from squilla.reconstruction.compound import Compound

        own = {
            "noise": noise, "gain_error": gain_error, "dropped": dropped, "spectra": spectra,
            "fresh": fresh, "epochs": epochs, "batch": batch, "learning_rate": learning_rate,
            "schedule": schedule, "precision": precision, "log": log, "checkpoint": checkpoint,
            "look": look,
        }  # fmt: skip
        usual = signature(train).parameters
        if useless := [key for key, value in own.items() if value != usual[key].default]:
            raise InputError(
                f"`{name}` learns what spectra look like and nothing of cameras and noise; leave "
                f"out {', '.join(useless)}."
            )
        with joined(device) as processes:
            if processes.count > 1:
                raise InputError(f"`{name}` is learnt by one process; start it without torchrun.")
            prior = learn_prior(
                calibration.wavelength, count=count, seed=seed, device=processes.device
            )
        model = Compound(calibration, prior).eval()
        model.provenance = {"count": count, "seed": seed, "clusters": prior.learnt}
        return model
    samples = Samples(calibration, spectra, count, noise, gain_error, dropped, fresh, seed)
    settings = {
        "noise": _named(noise),
        "gain_error": gain_error,
        "dropped": dropped,
        "spectra": spectra if fresh else f"{spectra}, one set",
        "count": count,
        "epochs": epochs,
        "batch": batch,
        "learning_rate": learning_rate,
        "schedule": schedule,
        "seed": seed,
        "precision": precision,
    }
    with joined(device) as processes, _products(precision):
        run = _Run(kind, samples, settings, processes)
        if checkpoint is not None and Path(checkpoint).exists():
            run.resume(Path(checkpoint))
        if processes.rank:  # the first process speaks and writes for all
            log, checkpoint, look, progress = None, None, None, False
        if log is not None:
            with replacing(log) as temporary:
                temporary.write_text("".join(json.dumps(entry) + "\n" for entry in run.history))
        free = 0.0  # when the next checkpoint may be written
        for epoch in shown(range(len(run.history), epochs), name, run.history, progress):
            run.epoch(epoch)
            last, now = epoch + 1 == epochs, time.monotonic()
            if log is not None:
                with open(log, "a") as file:
                    file.write(json.dumps(run.history[-1]) + "\n")
            if checkpoint is not None and (last or now > free):
                run.write(Path(checkpoint))
                written = time.monotonic()
                free = written + (written - now) / CHECKPOINTING
            if look is not None and (last or (epoch + 1) % LOOK_EVERY == 0):
                look(epoch, *run.looked_at())
        return run.finished()


class _Run:
    """The state of a training: weights, optimiser, and what happened so far."""

    def __init__(
        self,
        kind: type[Reconstructor],
        samples: Samples,
        settings: dict[str, Any],
        processes: Processes,
    ):
        with torch.random.fork_rng(devices=[]):  # the caller's random numbers stay as they are
            torch.manual_seed(settings["seed"])
            self.model = kind(samples.calibration).to(processes.device)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=settings["learning_rate"])
        self.samples, self.settings, self.processes = samples, settings, processes
        self.device = processes.device
        # On the processor a batch goes through in pieces that stay in the cache: the same gradient,
        # sooner. Batch normalisation needs the batch whole.
        normed = any(isinstance(part, nn.BatchNorm1d) for part in self.model.modules())
        self.piece = self.model.piece if self.device.type == "cpu" and not normed else None
        self.history: list[dict[str, float]] = []
        held_out = replace(samples, count=VALIDATION, seed=samples.seed + 2**32)
        self.validation = list(held_out.batches(0, self.model.piece, self.device))

    def epoch(self, epoch: int) -> None:
        """Train for one epoch, judge the result, and note both."""
        began = time.perf_counter()
        size, epochs = self.settings["batch"], self.settings["epochs"]
        steps = math.ceil(self.samples.count / size)
        total = torch.zeros((), device=self.device)
        self.model.train()
        for step, sample in enumerate(self.samples.batches(epoch, size, self.device)):
            rate = self._rate((epoch + step / steps) / epochs)
            total += self._step(rate, *sample)
        self.processes.sum([total])
        self.model.eval()
        entry = {
            "epoch": epoch,
            "loss": float(total) / self.samples.count,
            "validation": self._validate(),
            "learning_rate": rate,
            "seconds": round(time.perf_counter() - began, 3),
        }
        if not math.isfinite(entry["loss"] + entry["validation"]):
            raise InputError(f"The training diverged in epoch {epoch}; lower the learning rate.")
        self.history.append(entry)

    def _step(self, rate: float, y: Tensor, angle: Tensor, x: Tensor) -> Tensor:
        """Take one step down the mean squared error; return this process's sum over its samples."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad()
        total, whole = torch.zeros((), device=self.device), len(x)
        parts = self.processes.share(y, angle, x)
        pieces = zip(*(part.split(self.piece or whole) for part in parts), strict=True)
        for some_y, some_angle, some_x in pieces:
            loss = (self._estimate(some_y, some_angle) - some_x).square().mean(-1).sum()
            (loss / whole).backward()
            total += loss.detach()
        self.processes.sum(weight.grad for weight in self.model.parameters())
        self.optimiser.step()
        return total

    def _estimate(self, y: Tensor, angle: Tensor) -> Tensor:
        half = self.settings["precision"] == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
            return self.model.estimate(self.model.levelled(y, angle), angle).float()

    def _rate(self, share: float) -> float:
        """Return the learning rate after this share of the training."""
        rate = self.settings["learning_rate"]
        if self.settings["schedule"] == "cosine":
            return rate * (1 + math.cos(math.pi * share)) / 2
        return rate

    @torch.inference_mode()
    def _validate(self) -> float:
        total = sum(
            float((self._estimate(y, angle) - x).square().mean()) * len(x)
            for y, angle, x in self.validation
        )
        return total / VALIDATION

    @torch.inference_mode()
    def looked_at(self) -> tuple[Tensor, Tensor]:
        """Return some spectra never trained on, and what the network makes of them."""
        y, angle, x = (part[:LOOKED_AT] for part in self.validation[0])
        return x.cpu(), self._estimate(y, angle).cpu()

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
        with replacing(path) as temporary, temporary.open("wb") as file:
            torch.save(state, file)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same training."""
        state = read_checkpoint(path, ("identity", "history", "model", "optimiser"))
        identity, own = state["identity"], self._identity()
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


def _named(noise: Noise) -> str:
    """Say what a noise is; InputError if it is none."""
    match noise:
        case None:
            return "none"
        case SensorNoise():
            return str(noise)
        case (int() | float() as low, int() | float() as high) if isinstance(noise, tuple):
            return f"{low:g}-{high:g} dB"
        case int() | float():
            return f"{noise:g} dB"
    raise InputError(
        f"The noise {noise!r} is none; give None, a number of dB, a pair such as (15, 20), or a "
        "SensorNoise."
    )


@contextmanager
def _products(precision: Precision) -> Iterator[None]:
    """Let CUDA round the factors of float32 products as asked, and put its setting back."""
    if precision not in ("float32", "tf32", "bfloat16"):
        raise InputError(
            f"There is no precision {precision!r}; there are float32, tf32 and bfloat16."
        )
    allowed, before = precision != "float32", torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if allowed else "highest")
    try:
        with torch.backends.cudnn.flags(enabled=True, benchmark=True, allow_tf32=allowed):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


def read_checkpoint(path: Path, parts: Sequence[str]) -> dict[str, Any]:
    """Read the parts of a checkpoint onto the CPU; InputError if it is damaged or none at all."""
    try:
        # weights_only: nothing in the file is executed.
        state = torch.load(path, map_location="cpu", weights_only=True)
        return {part: state[part] for part in parts}
    except Exception as error:  # torch raises whatever its reader stumbles over
        raise InputError(f"{path} is not a checkpoint of a training; remove it.") from error


def shown(
    steps: range, name: str, history: list[dict[str, float]], progress: bool
) -> Iterable[int]:
    """Yield the steps, with a progress bar that shows the last error in the growing history."""
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
        task = bar.add_task(f"train {name}", total=steps.stop, completed=steps.start, loss="")
        for step in steps:
            yield step
            loss = f"validation error {history[-1]['validation']:.5f}" if history else ""
            bar.update(task, completed=step + 1, loss=loss)
