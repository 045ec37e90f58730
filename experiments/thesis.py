"""What the thesis' experiments share: its camera, its captures, its networks, and their judge.

The twin takes the calibration frames and one exposure of each scene; everything that is trained or
reconstructed knows only those frames. Captures and calibration are made once, with fixed seeds, and
kept in experiments/work, which may be deleted at any time.
"""

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from machine import processor
from torch import Tensor

import squilla
from squilla.calibration.calibration import Calibration
from squilla.calibration.rehearsal import Rehearsal
from squilla.camera.scenes import chart_layout, load_scene
from squilla.camera.solid import solid_scene
from squilla.evaluation.chart import COLOURS, inner
from squilla.evaluation.metrics import evaluate, mse
from squilla.files.disk import replacing
from squilla.reconstruction.linear import complete

HERE = Path(__file__).parent
WORK = HERE / "work"
RESULTS = HERE / "results"
PAGE = HERE.parent / "docs" / "thesis.md"
SNR = 20.0
"""Of every capture, dB: what the thesis found for its camera."""

PIXELS = 100
"""Taken at random from the inside of every patch to judge by."""

BANDS = (500, 550, 600, 650, 700, 750)
"""Of the thesis' pictures, nm."""

NETWORKS = {
    "mlp": "BEST MLP (1.1M)",
    "cnn": "CNN (1M)",
    "rescnn": "ResCNN (3.5M)",
    "unet": "U-Net (18.5M)",
    "respecnn": "ReSpecNN (4M)",
}
"""Each with its name in the thesis' tables."""


def camera() -> Calibration:
    """Return the calibration of the thesis' camera, learnt from the twin's frames."""
    path = WORK / "camera.nc"
    if not path.exists():
        WORK.mkdir(exist_ok=True)
        rehearsal = Rehearsal(squilla.Camera("thesis"), step=5.0, bandwidth=5.0)
        rehearsal.calibrate().save(path)
    return squilla.load_calibration(path)


def one_matrix(calibration: Calibration) -> Calibration:
    """Return the calibration as the thesis has it: one sensitivity for the whole field."""
    return Calibration.from_sensitivity(
        calibration.mean_sensitivity.double().numpy(), calibration.wavelength
    )


@dataclass(frozen=True)
class Capture:
    """One exposure of a scene, aligned, with the truth.

    y : (H, W, M), DN per ms.  truth : (H, W, K), photon radiance.
    """

    y: Tensor
    truth: np.ndarray

    def patches(self) -> tuple[Tensor, np.ndarray]:
        """Return measurement and truth of some pixels of each patch, (24, PIXELS, M or K)."""
        random = np.random.default_rng(0)
        inside = inner(chart_layout(*self.truth.shape[:2])).ravel()
        pick = np.stack(
            [random.choice(np.flatnonzero(inside == patch), PIXELS, False) for patch in range(24)]
        )
        return self.y.flatten(0, 1)[pick], self.truth.reshape(-1, self.truth.shape[-1])[pick]


def capture(scene: str = "chart") -> Capture:
    """Return a scene, captured at 20 dB, measured by the calibrated camera.

    scene : "chart", 300 mm away, or "solid", the doll with depth, 200 mm away.
    """
    path = WORK / f"{scene}.npz"
    if not path.exists():
        calibration, twin = camera(), squilla.Camera("thesis")
        wavelength, size = twin.design.wavelength, twin.design.field.size
        if scene == "solid":
            picture, depth = solid_scene(wavelength, size, distance=200.0)
            place = {"distance": 200.0, "depth": depth}
        else:
            picture, place = load_scene(scene, wavelength, size), {"distance": 300.0}
        generator = torch.Generator().manual_seed(0)
        raw = twin.capture(picture, snr=SNR, generator=generator, **place)
        seen = squilla.measure(raw, calibration, depth="depth" in place)
        y = complete(seen.y, seen.valid, calibration, seen.angle, seen.snr)
        truth = twin.truth(picture, **place).cube.values
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, y=y.numpy(), truth=truth.astype(np.float32))
    with np.load(path) as file:
        return Capture(torch.from_numpy(file["y"]), file["truth"])


def quality(chart: Capture, calibration: Calibration) -> dict:
    """Return how good the measurement of the first 18 patches is, dB, the median over them.

    `noise` compares a patch's mean with what single pixels scatter around it; `mean` compares the
    mean with what R says of the true spectrum, which leaves the error of the model, and a tenth of
    the noise.
    """
    y, truth = (torch.as_tensor(part[:COLOURS]).double() for part in chart.patches())
    mean = y.mean(1)
    expected = truth.mean(1) @ calibration.mean_sensitivity.double().T
    factor = (expected * mean).sum(-1, keepdim=True) / expected.square().sum(-1, keepdim=True)
    ratios = {
        "noise": mean.square().mean(-1) / (y - mean[:, None]).square().mean((1, 2)),
        "mean": expected.square().sum(-1) / (mean / factor - expected).square().sum(-1),
    }
    return {name: round(float(10 * ratio.log10().median()), 1) for name, ratio in ratios.items()}


@torch.inference_mode()
def judge(model: squilla.Reconstructor, chart: Capture, device: str = "cpu") -> dict:
    """Return the errors of a reconstructor on the chart, and some of its spectra.

    Every error is a mean squared one over the first 18 patches, the true spectrum scaled to a
    maximum of 1: `single` of single pixels, `patch` of the mean of a patch's reconstructions,
    `averaged` of the reconstruction of a patch's mean measurement, `model` of noiseless
    measurements by 20 cameras whose every channel is off by a random factor, 10 % rms: 20 dB, too,
    but the same for all pixels, as errors of the model are. In `shape` the estimate, too, is
    scaled to a maximum of 1.
    """

    def reconstructed(y: Tensor) -> np.ndarray:
        return model(y.to(device)).cpu().double().numpy()

    y, truth = chart.patches()
    mean = truth.mean(1)
    factor = 1 + 0.1 * torch.randn(1, 20, y.shape[-1], generator=torch.Generator().manual_seed(0))
    wrong = model.calibration.project(torch.from_numpy(mean))[:, None] * factor
    truth, mean = truth.astype(np.float64), mean.astype(np.float64)
    found = reconstructed(y)
    pairs = {
        "single": (found, truth),
        "patch": (found.mean(1), mean),
        "averaged": (reconstructed(y.mean(1)), mean),
        "model": (reconstructed(wrong), mean[:, None].repeat(20, 1)),
    }
    result: dict = {"mse": {}, "shape": {}}
    for name, (estimate, true) in pairs.items():
        estimate, true = estimate[:COLOURS], true[:COLOURS]
        result["mse"][name] = evaluate(estimate, true)["mse"]
        result["shape"][name] = float(mse(_scaled(estimate), _scaled(true)).mean())
    peak = mean.max(-1, keepdims=True)
    result["patches"] = mse(found.mean(1) / peak, mean / peak).round(6).tolist()
    result["spectra"] = (found.mean(1) / peak)[:COLOURS, ::5].round(3).tolist()
    return result


def _scaled(spectra: np.ndarray) -> np.ndarray:
    return spectra / np.maximum(spectra.max(-1, keepdims=True), 1e-12)


@torch.inference_mode()
def picture(model: squilla.Reconstructor, seen: Capture, device: str = "cpu") -> np.ndarray:
    """Return the six bands of the thesis' pictures, (H, W, 6)."""
    nearest = [int(np.abs(model.wavelength - band).argmin()) for band in BANDS]
    rows = [model(row.to(device))[..., nearest].cpu() for row in seen.y]
    return torch.stack(rows).numpy()


def keep_picture(name: str, bands: np.ndarray) -> None:
    """Write a picture to the work folder, for `experiments/figures.py`."""
    with replacing(WORK / f"{name}.npz") as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, bands=bands.astype(np.float16))


def machine(device: str) -> dict:
    """Return on what a number was measured."""
    place = f"cpu, {torch.get_num_threads()} of {processor()}"
    if device != "cpu":
        place = torch.cuda.get_device_name(device)
    return {"device": place, "load": round(os.getloadavg()[0], 1)}


def write_json(path: Path, content: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content) + "\n")


def embed(name: str, text: str) -> None:
    """Write a table to results/NAME.md, and into the page of documentation where it is marked."""
    (RESULTS / f"{name}.md").write_text(text + "\n")
    page = PAGE.read_text()
    begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->"
    place = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    with replacing(PAGE) as temporary:
        temporary.write_text(place.sub(lambda _: f"{begin}{text}\n{end}", page))


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
