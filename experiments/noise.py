"""Noise of the camera: how it grows with light, and what a ratio of 20 dB means for each patch.

Usage: python experiments/noise.py

Takes two equal frames of the chart at several exposures with the thesis' camera and compares the
variance of their difference with the law of the sensor; then the signal-to-noise ratio that every
patch has when the picture as a whole has 20 dB, as the frames show it and as `measure` states it
without knowing. Writes experiments/results/noise.json and docs/images/noise.webp; two minutes.
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from squilla.calibration.alignment import measure
from squilla.calibration.rehearsal import ideal_calibration
from squilla.camera.scenes import chart_layout, load_scene
from squilla.camera.twin import Camera
from squilla.evaluation.chart import inner

RESULTS = Path(__file__).parent / "results" / "noise.json"
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "noise.webp"
EXPOSURES = (0.5, 2.0, 8.0, 32.0)
"""Of the transfer curve, as multiples of the exposure that gives 20 dB."""


def main() -> None:
    camera = Camera("thesis")
    generator = torch.Generator().manual_seed(0)
    design = camera.design
    scene = load_scene("chart", design.wavelength, design.field.size)
    calibration = ideal_calibration(camera)
    rate = camera.rate(scene)
    usual = camera.sensor.exposure_for(camera.fields(rate), 20.0)

    mean, variance = [], []
    for factor in EXPOSURES:
        pair = [camera.expose(rate, factor * usual, generator) for _ in range(2)]
        means, variances = transfer(*(each.frame.astype(float) for each in pair))
        mean.append(means - design.sensor.black_level)
        variance.append(variances)
    gain, read_noise = design.sensor.gain, design.sensor.read_noise
    mean, variance = np.concatenate(mean), np.concatenate(variance)
    law = mean / gain + (read_noise / gain) ** 2 + 1 / 12
    kept = mean > 3

    first, second = (
        measure(camera.expose(rate, usual, generator), calibration, distance=300.0)
        for _ in range(2)
    )
    layout = inner(chart_layout(design.field.size, design.field.size))
    patches = {}
    for patch in range(24):
        here = torch.from_numpy(layout == patch)
        both = (first.y[here] + second.y[here]) / 2
        noise = (first.y[here] - second.y[here]).square().mean() / 2
        found = 10 * torch.log10((both.square().mean() - noise / 2) / noise)
        assert first.snr is not None
        patches[patch] = {"found": float(found), "stated": float(first.snr[here].median())}
    ratios = np.geomspace(0.05, 40, 40) * usual
    reached = [ratio_of(camera, rate, exposure) for exposure in ratios]
    results = {
        "exposure_for_20_dB": usual,
        "law_against_frames": float(np.median(variance[kept] / law[kept])),
        "patches": patches,
        "worst_statement": max(abs(each["found"] - each["stated"]) for each in patches.values()),
    }
    RESULTS.write_text(json.dumps(results, indent=1))
    draw(mean, variance, law, ratios, reached, usual, patches)
    found = [each["found"] for each in patches.values()]
    print(f"20 dB needs {usual:.3g} ms; variance / law {results['law_against_frames']:.3f}")
    print(f"patches {min(found):.1f} to {max(found):.1f} dB, stated within "
          f"{results['worst_statement']:.1f} dB")  # fmt: skip


def transfer(first: np.ndarray, second: np.ndarray, bins: int = 24) -> tuple:
    """Return the mean and the variance of single frames in bins of equal brightness."""
    mean, difference = ((first + second) / 2).ravel(), (first - second).ravel()
    edges = np.quantile(mean[::7], np.linspace(0.02, 0.98, bins + 1))
    places = np.digitize(mean, edges)
    count = np.bincount(places, minlength=bins + 2)[1:-1]
    sums = np.bincount(places, mean, minlength=bins + 2)[1:-1]
    squares = np.bincount(places, difference**2, minlength=bins + 2)[1:-1]
    many = count > 1000
    return sums[many] / count[many], squares[many] / count[many] / 2


def ratio_of(camera: Camera, rate: np.ndarray, exposure: float) -> float:
    """Return the ratio of the whole picture at an exposure by the law of the sensor, dB."""
    fields = np.asarray(camera.fields(rate), float)
    sensor = camera.design.sensor
    signal = np.mean(fields**2) * exposure**2
    noise = fields.mean() * exposure + sensor.read_noise**2 + sensor.gain**2 / 12
    return float(10 * np.log10(signal / noise))


def draw(mean, variance, law, exposures, reached, usual, patches) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
    order = np.argsort(mean)
    axes[0].loglog(mean[order], law[order], color="black", lw=1, label="mean / gain + read noise")
    axes[0].loglog(mean, variance, "o", ms=3, color="#0f8b8d", label="two equal frames")
    axes[0].set(xlabel="mean, DN", title="variance, DN$^2$")
    axes[0].legend(frameon=False, fontsize="small")
    axes[1].semilogx(exposures, reached, color="#0f8b8d")
    axes[1].plot(usual, 20, "o", color="#d1495b")
    axes[1].set(xlabel="exposure, ms", title="ratio of the whole chart, dB")
    found = np.array([each["found"] for each in patches.values()])
    stated = np.array([each["stated"] for each in patches.values()])
    order = np.argsort(found)
    axes[2].plot(found[order], "o", color="#0f8b8d", label="of two captures")
    axes[2].plot(stated[order], "_", ms=12, color="black", label="as stated from one")
    axes[2].axhline(20, color="#d1495b", lw=1)
    axes[2].set(xlabel="patch, dark to bright", title="ratio of each patch, dB")
    axes[2].legend(frameon=False, fontsize="small")
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURE, dpi=130, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    main()
