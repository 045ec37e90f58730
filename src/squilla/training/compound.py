"""Training of the compound model: many cameras, many scenes, every noise."""

import copy
import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor
from torch.nn import functional

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.files.disk import replacing
from squilla.reconstruction.back_end import BackEnd
from squilla.reconstruction.compound import ZONES, Compound
from squilla.reconstruction.evidence import (
    CORRECTED,
    LEVELS,
    Camera,
    Evidence,
    gather_evidence,
    noise_factor,
)
from squilla.reconstruction.prior import Prior, fit_prior
from squilla.spectra import grid
from squilla.training.cameras import random_response
from squilla.training.fit import read_checkpoint, shown
from squilla.training.scenes import Palette, Scenes, draw_scenes

SIZE = 64
"""Side of a training scene, px."""

PIXELS = 768
"""Pixels of each scene that are compared with the truth."""

SINGLE = 64
"""Pixels of each scene that are also reconstructed alone."""

NOISE = (10.0, 45.0)
"""Signal-to-noise ratios of scenes, dB."""

CHECKPOINT_EVERY = 50
"""Steps between two checkpoints."""

AVERAGED = 0.998
"""What the averaged weights keep of themselves in every step."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a training; the defaults take half an hour of two cores.

    steps : of the optimiser.
    scenes : in each step.  cameras : that see them.
    arrays : random cameras to choose from.
    learning_rate : at its highest; it rises over 100 steps and falls along half a cosine.
    """

    steps: int = 1500
    scenes: int = 8
    cameras: int = 4
    arrays: int = 400
    learning_rate: float = 2e-3
    seed: int = 0


def learn_prior(wavelength: np.ndarray, *, count: int = 60_000, seed: int = 0) -> Prior:
    """Learn the prior of `Compound` on a grid, from spectra that the palette paints with."""
    palette = Palette(wavelength, seed=seed, count=round(0.25 * count))
    generator = Generator().manual_seed(seed)
    lamp = (torch.rand(round(0.6 * count), generator=generator) * len(palette.lamp)).long()
    natural = palette.natural(lamp, generator)
    families = {
        "natural": (natural / natural.amax(-1, keepdim=True), 28),
        "gaussian": (palette.gaussian, 10),
        "line": (palette.line[: round(0.15 * count)], 10),
    }
    return fit_prior(families, wavelength)


class Studio:
    """Takes random scenes with random cameras, without end.

    Parameters
    ----------
    prior : Prior
    responses : (M, K) each
        Of the cameras, on the prior's wavelengths.
    held_out : bool
        Paint with the spectra that training never sees.
    """

    def __init__(
        self,
        prior: Prior,
        responses: Sequence[Tensor],
        *,
        seed: int = 0,
        held_out: bool = False,
        device: torch.device | str = "cpu",
    ):
        self.prior, self.responses, self.device = prior, responses, device
        self.seed = seed + 2**32 * held_out
        self.palette = Palette(prior.wavelength, held_out=held_out, seed=seed, device=device)
        self._cameras: dict[int, tuple[Tensor, Camera]] = {}

    def camera(self, number: int) -> tuple[Tensor, Camera]:
        """Return a response and its front end, made when first asked for."""
        if number not in self._cameras:
            camera = Camera(self.responses[number][None], self.prior).to(self.device)
            self._cameras[number] = self.responses[number].to(self.device), camera
        return self._cameras[number]

    @torch.no_grad()
    def take(self, step: int, count: int, cameras: int) -> tuple[Scenes, Evidence, Evidence]:
        """Return scenes, what the front end makes of them, and of single pixels of them.

        Every step has random numbers of its own, whether others were drawn before or not.
        """
        state = np.random.SeedSequence([self.seed, step]).generate_state(1, np.uint64)
        generator = Generator(device=self.device).manual_seed(int(state[0] >> np.uint64(1)))
        scenes = draw_scenes(count, SIZE, self.palette, generator)
        chosen = torch.rand(cameras, generator=generator, device=self.device)
        pictures, pixels = [], []
        for part, number in zip(
            torch.arange(count).chunk(cameras), (chosen * len(self.responses)).tolist(), strict=True
        ):
            response, camera = self.camera(int(number))
            some = Scenes(*(getattr(scenes, field.name)[part] for field in fields(Scenes)))
            shaken = torch.rand(len(part), 1, 1, generator=generator, device=self.device) < 0.3
            y = misaligned(some.measured(response), 0.25 * shaken, generator)
            y, ratio = self._noisy(y, generator)
            wrong = torch.randn(len(y), 1, 1, generator=generator, device=y.device)
            stated = ratio * 10 ** (0.2 * wrong)
            stated = stated * noise_factor(y, stated, camera)
            pictures.append(gather_evidence(y, stated, camera, LEVELS))
            few = slice(0, SIZE * SIZE // SINGLE * SINGLE, SIZE * SIZE // SINGLE)
            alone = y.flatten(1, 2)[:, few].reshape(-1, 1, 1, y.shape[-1])
            pixels.append(
                gather_evidence(alone, ratio.flatten(1)[:, few].reshape(-1, 1, 1), camera, 0)
            )
        return scenes, _joined(pictures), _joined(pixels)

    def _noisy(self, y: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Add noise: half of the pictures at one ratio for all pixels, half as light makes it."""

        def random(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=y.device)

        count = len(y)
        snr = NOISE[0] + (NOISE[1] - NOISE[0]) * random(count, 1, 1)
        power = y.square().mean(-1)
        mean = power.mean((1, 2), keepdim=True)
        photons = (power / mean).clamp_min(1e-4).rsqrt()
        ratio = 10 ** (-snr / 10) * torch.where(random(count, 1, 1) < 0.5, photons, 1.0)
        noise = torch.randn(y.shape, generator=generator, device=y.device)
        return y + (ratio * power).sqrt()[..., None] * noise, ratio.clamp_max(10.0)


def misaligned(y: Tensor, deviation: float | Tensor, generator: Generator) -> Tensor:
    """Displace every channel of pictures, (B, H, W, M), by a random fraction of a pixel.

    deviation : standard deviation along rows and columns, px; one for all, or (B, 1, 1).
    """
    count, _, _, m = y.shape
    device = y.device
    by = deviation * torch.randn(count, m, 2, generator=generator, device=device)
    by = by.clamp(-1, 1)
    grid = torch.arange(-1, 2, device=device)
    taps = (1 - (grid - by[..., None]).abs()).clamp_min(0)  # (count, M, 2, 3), bilinear
    kernel = taps[:, :, 0, :, None] * taps[:, :, 1, None, :]
    kernel = kernel / kernel.sum((-1, -2), keepdim=True)
    wide = functional.pad(y.permute(0, 3, 1, 2), (1, 1, 1, 1), mode="replicate")
    moved = functional.conv2d(
        wide.reshape(1, -1, *wide.shape[2:]), kernel.reshape(-1, 1, 3, 3), groups=count * m
    )
    return moved.view(count, m, *moved.shape[2:]).permute(0, 2, 3, 1)


def _joined(parts: Sequence[Evidence]) -> Evidence:
    """Put the evidence of several cameras into one batch."""

    def join(values: list[Any]) -> Any:
        if isinstance(values[0], list):
            return [torch.cat(level) for level in zip(*values, strict=True)]
        return torch.cat(values)

    return Evidence(*(join([getattr(part, f.name) for part in parts]) for f in fields(Evidence)))


# --- the loss -----------------------------------------------------------------------------------


def losses(
    back: BackEnd, basis: Tensor, hats: Tensor, scenes: Scenes, seen: Evidence, pixels: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compare with the truth at some pixels, (B, P) flat indices.

    Returns
    -------
    error : (B,) mean squared error of each scene, every spectrum divided by its true peak.
    score : (B,) interval score at 90 % (Gneiting and Raftery, JASA 102, 359 (2007), eq. 43), with
        the estimate held still.
    cover : (B,) share of bands within the interval.
    """
    coefficients, amplitude, width = back(seen, interval=True)
    truth = scenes.cubes(pixels)

    def at(values: Tensor) -> Tensor:
        flat = values.reshape(len(truth), -1, values.shape[-1])
        if flat.shape[1] == truth.shape[1]:
            return flat
        return flat.gather(1, pixels[..., None].expand(-1, -1, flat.shape[-1]))

    peak = truth.amax(-1, keepdim=True).clamp_min(1e-6)
    factor = at(amplitude[..., None]) / peak
    apart = torch.relu(at(coefficients) @ basis) * factor - truth / peak
    half = (at(width) @ hats) * factor.detach()
    away = apart.detach().abs()
    score = (2 * half + 20 * torch.relu(away - half)).mean((1, 2))
    cover = (away <= half).float().mean((1, 2))
    return apart.square().mean((1, 2)), score, cover


_PARTS = ("recipe", "cameras", "step", "history", "back", "averaged", "optimiser")
"""Of a checkpoint."""


class _Run:
    """The state of a training."""

    def __init__(self, prior: Prior, responses: Sequence[Tensor], recipe: Recipe, device):
        self.recipe, self.device = recipe, device
        digest = hashlib.sha256(prior.basis.double().cpu().numpy().tobytes())
        for response in responses:
            digest.update(response.double().cpu().numpy().tobytes())
        self.cameras = digest.hexdigest()
        flat = Calibration.from_sensitivity(responses[0].numpy(), prior.wavelength)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            self.model = Compound(flat, prior).to(device)
        self.averaged = copy.deepcopy(self.model.back)
        self.studio = Studio(prior, responses, seed=recipe.seed, device=device)
        self.optimiser = torch.optim.AdamW(
            self.model.back.parameters(), lr=recipe.learning_rate, weight_decay=1e-3
        )
        self.held_out = Studio(
            prior, responses[: recipe.cameras], seed=recipe.seed, held_out=True, device=device
        ).take(0, 8, recipe.cameras)
        self.step, self.history = 0, []

    def train(self) -> dict[str, float]:
        """Take one step; return what it showed."""
        recipe = self.recipe
        rise = min(1.0, (self.step + 1) / 100)
        rate = recipe.learning_rate * rise * (1 + math.cos(math.pi * self.step / recipe.steps)) / 2
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        scenes, seen, alone = self.studio.take(self.step, recipe.scenes, recipe.cameras)
        generator = Generator(device=self.device).manual_seed(self.step)
        pixels = torch.rand(recipe.scenes, PIXELS, generator=generator, device=self.device)
        pixels = (pixels * SIZE * SIZE).long()
        basis, hats = self.model.basis, self.model.hats
        self.model.back.train()
        error, score, cover = losses(self.model.back, basis, hats, scenes, seen, pixels)
        few = torch.arange(SINGLE, device=self.device) * (SIZE * SIZE // SINGLE)
        few = few.expand(recipe.scenes, -1)
        single, single_score, _ = losses(self.model.back, basis, hats, scenes, alone, few)
        # By the logarithm every scene counts alike, however hard it is.
        loss = (error + 2e-5).log().mean() + 0.2 * (single + 2e-5).log().mean()
        loss = loss + 0.1 * (score / (error.detach() + 1e-5).sqrt()).mean()
        loss = loss + 0.02 * (single_score / (single.detach() + 1e-5).sqrt()).mean()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.back.parameters(), 1.0)
        self.optimiser.step()
        keep = min(AVERAGED, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for mean, value in zip(
                self.averaged.parameters(), self.model.back.parameters(), strict=True
            ):
                mean.lerp_(value, 1 - keep)
        self.step += 1
        return {
            "loss": float(loss.detach()),
            "log_error": float((error + 2e-5).log().mean().detach()),
            "cover": float(cover.mean()),
        }

    @torch.no_grad()
    def validate(self) -> float:
        """Return the geometric mean error of 8 scenes of spectra that training never sees."""
        scenes, seen, _ = self.held_out
        pixels = torch.arange(0, SIZE * SIZE, 8, device=self.device).expand(len(scenes.fade), -1)
        error, _, _ = losses(self.averaged, self.model.basis, self.model.hats, scenes, seen, pixels)
        return float(error.log().mean().exp())

    def write(self, path: Path) -> None:
        """Write everything from which `resume` goes on."""
        state = {
            "recipe": vars(self.recipe) | {},
            "cameras": self.cameras,
            "step": self.step,
            "history": self.history,
            "back": self.model.back.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        with replacing(path) as temporary, temporary.open("wb") as file:
            torch.save(state, file)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same training."""
        state = read_checkpoint(path, _PARTS)
        if (state["recipe"], state["cameras"]) != (vars(self.recipe), self.cameras):
            raise InputError(
                f"{path} is the checkpoint of another training; remove it or name another file."
            )
        self.step, self.history = state["step"], state["history"]
        self.model.back.load_state_dict(state["back"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimiser.load_state_dict(state["optimiser"])

    def finished(self) -> Compound:
        """Return the model with averaged weights, on the CPU."""
        model = self.model.cpu().eval()
        model.back.load_state_dict({k: v.cpu() for k, v in self.averaged.state_dict().items()})
        model.provenance = {**vars(self.recipe), "trained_steps": self.step}
        if self.history:
            model.provenance["validation"] = self.history[-1]["validation"]
        return model


def from_checkpoint(path: Path, prior: Prior) -> Compound:
    """Return the model that a training has come to, with the averaged weights."""
    state = read_checkpoint(path, _PARTS)
    flat = Calibration.from_sensitivity(np.ones((1, len(prior.wavelength))), prior.wavelength)
    model = Compound(flat, prior).eval()
    model.back.load_state_dict(state["averaged"])
    last = state["history"][-1]
    model.provenance = {**state["recipe"], "trained_steps": state["step"]}
    model.provenance |= {"validation": last["validation"]} if "validation" in last else {}
    return model


def train_compound(
    calibration: Calibration | None = None,
    recipe: Recipe | None = None,
    *,
    prior: Prior | None = None,
    device: torch.device | str = "cpu",
    log: str | Path | None = None,
    checkpoint: str | Path | None = None,
    seconds: float = math.inf,
    progress: bool = True,
) -> Compound:
    """Train the compound model.

    Parameters
    ----------
    calibration : Calibration, optional
        Camera to train for, at its field angles and with gains that vary by 2 %; default: random
        arrays of filters on 500-750 nm.
    recipe : Recipe, optional
    prior : Prior, optional
        Default: learnt first, on the wavelengths.
    device : "cpu", "cuda", ...
    log : path, optional
        One line of JSON for every `CHECKPOINT_EVERY` steps.
    checkpoint : path, optional
        Written every `CHECKPOINT_EVERY` steps; if it exists, training goes on from there.
    seconds : float
        Stop after this time, with a checkpoint to go on from.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Compound
        On the CPU, in evaluation mode, with the weights averaged over the last steps.

    Raises
    ------
    InputError
        If the camera has too few bands, the checkpoint is of another training, or it diverges.
    """
    if calibration is not None and len(calibration.wavelength) < CORRECTED[-1]:
        raise InputError(
            f"`compound` needs {CORRECTED[-1]} bands or more, not {len(calibration.wavelength)}; "
            "train one of the networks instead."
        )
    recipe = Recipe() if recipe is None else recipe
    generator = Generator().manual_seed(recipe.seed)
    if calibration is None:
        wavelength = grid()
        responses = [random_response(wavelength, generator) for _ in range(recipe.arrays)]
    else:
        wavelength = calibration.wavelength
        gains = 1 + 0.02 * torch.randn(ZONES, calibration.filters, 1, generator=generator)
        least, most = (float(end) ** 2 for end in calibration.angle[[0, -1]])
        angles = torch.linspace(least, most, ZONES).sqrt()
        zones = torch.einsum(
            "za,amk->zmk", calibration.angle_weights(angles), calibration.sensitivities
        )
        responses = list(zones * gains)
    prior = learn_prior(wavelength) if prior is None else prior
    run = _Run(prior, responses, recipe, device)
    if checkpoint is not None and Path(checkpoint).exists():
        run.resume(Path(checkpoint))
    began, entries = time.perf_counter(), []
    # Processor time says what a training costs also where other programs run beside it.
    worked = run.history[-1].get("cpu_seconds", 0.0) if run.history else 0.0
    worked -= time.process_time()
    for _ in shown(range(run.step, recipe.steps), "compound", run.history, progress):
        if time.perf_counter() - began > seconds:
            break
        entries.append(run.train())
        if run.step % CHECKPOINT_EVERY and run.step < recipe.steps:
            continue
        entry = {key: float(np.mean([one[key] for one in entries])) for key in entries[0]}
        if not math.isfinite(entry["loss"]):
            raise InputError(f"The training diverged before step {run.step}.")
        entry |= {"step": run.step, "validation": run.validate()}
        entry |= {"seconds": round(time.perf_counter() - began, 1)}
        run.history.append(entry | {"cpu_seconds": round(worked + time.process_time(), 1)})
        entries = []
        if log is not None:
            with replacing(log) as temporary:
                temporary.write_text("".join(json.dumps(one) + "\n" for one in run.history))
        if checkpoint is not None:
            run.write(Path(checkpoint))
    return run.finished()
