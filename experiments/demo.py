"""Run the demo and keep what the README shows of it: the table and the picture.

    python experiments/demo.py [FOLDER]

Writes experiments/results/demo.json and docs/images/demo.webp, and prints the table.
"""

import json
import platform
import sys
import time
from pathlib import Path

import numpy as np
import torch
from machine import processor

from squilla.camera.scenes import chart_layout, load_scene
from squilla.colour import composite
from squilla.demo import MODELS, demo
from squilla.evaluation.chart import patch_errors, patch_means
from squilla.evaluation.style import COLOURS, INK, canvas, styled
from squilla.files.cube import load_cube
from squilla.files.raw import read_raw
from squilla.spectra import CHART_LIGHT, chart_reflectances, lights

HERE = Path(__file__).parent
PICTURE = HERE.parent / "docs" / "images" / "demo.webp"
PATCHES = ("light skin", "moderate red", "green", "yellow")


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")
    start = time.perf_counter()
    metrics = demo(folder)
    machine = {
        "seconds": round(time.perf_counter() - start, 1),
        "threads": torch.get_num_threads(),
        "processor": processor(),
        "python": platform.python_version(),
    }
    results = {"machine": machine, "metrics": metrics}
    (HERE / "results" / "demo.json").write_text(json.dumps(results, indent=2) + "\n")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    picture(folder).savefig(PICTURE, dpi=160)
    print(table(metrics))
    print(f"\nWhole demo {machine['seconds']} s, {machine['threads']} threads, {processor()}.")


def table(metrics: dict) -> str:
    """Return the README's table."""
    lines = [
        "| model | chart, patch means | chart, single pixels | Indian Pines | corn kernel "
        "| doll, median | doll, mean | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for model in MODELS:
        chart = metrics["chart"][model]
        cells = [
            chart["colours_mse"],
            chart["mse"],
            metrics["indian-pines"][model]["mse"],
            metrics["corn-kernel"][model]["mse"],
            metrics["doll"][model]["mse_median"],
            metrics["doll"][model]["mse"],
        ]
        seconds = np.median([scene[model]["seconds"] for scene in metrics.values()])
        numbers = " | ".join(f"{cell:.4f}" for cell in cells)
        lines.append(f"| `{model}` | {numbers} | {seconds:.2f} |")
    return "\n".join(lines)


@styled
def picture(folder: Path):
    """Draw a capture of the chart, what came of it, and four of its spectra."""
    raw = read_raw(folder / "raw.tiff").frame
    cube = load_cube(folder / "chart-compound.nc")
    truth = load_scene("chart", cube.wavelength.values)
    labels, names = chart_layout(250, 250), chart_reflectances().name
    white = lights()[CHART_LIGHT]

    figure = canvas(9.6, 3.3)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.25))
    lit = raw[300:2700, 800:3200].astype(float) - 64
    left.imshow(np.clip(lit / np.percentile(lit, 99.7), 0, 1) ** (1 / 2.2), cmap="gray")
    left.set_title("one exposure: 36 filters, 36 sub-images", loc="left")
    shown = composite(cube.values, cube.wavelength.values, white=white)
    middle.imshow(shown ** (1 / 2.2))
    middle.set_title("251 bands in every pixel (650, 550, 500 nm)", loc="left")
    for axes in (left, middle):
        axes.set_axis_off()
    found, true = (patch_means(each.values, labels) for each in (cube, truth))
    errors = patch_errors(cube.values, truth.values, labels)
    for number, name in enumerate(PATCHES):
        patch, offset = names.index(name), 1.15 * (len(PATCHES) - 1 - number)
        peak = true[patch].max()
        right.plot(cube.wavelength, true[patch] / peak + offset, color=INK, lw=1)
        right.plot(cube.wavelength, found[patch] / peak + offset, color=COLOURS[number])
        right.text(
            752, offset + 0.35, f"{name}\nMSE {errors[patch]:.4f}",
            color=COLOURS[number], va="center",
        )  # fmt: skip
    right.set_yticks([])
    right.spines["left"].set_visible(False)
    right.set(xlim=(500, 750), xlabel="wavelength (nm)")
    right.set_title("spectra of patches; black is the truth", loc="left")
    return figure


if __name__ == "__main__":
    main()
