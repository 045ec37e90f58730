"""The thesis' pictures: colours, bands and spectra after every training noise.

    python experiments/figures.py --epochs 50            # from the cells of table_5_1.py
    python experiments/figures.py --prior broad

Figures 5.1 to 5.5 of the thesis show colours composed of the bands at 650, 550 and 500 nm, and
spectra with the mean squared error above each, one row for each training noise; figures A.2 to A.4
show single bands. These show the same of the twin's captures: the chart, and a doll with 40 mm of
relief, a distance found for every point. Drawn from whatever cells are finished; spectra come from
their JSON, pictures from their weights in experiments/work. Writes docs/images/thesis_*.webp.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from table_5_1 import CELLS, KINDS, PUBLISHED, Cell, errors
from thesis import (
    BANDS,
    NETWORKS,
    WORK,
    Capture,
    camera,
    capture,
    keep_picture,
    one_matrix,
    picture,
)
from xarray import DataArray

import squilla
from squilla.camera.scenes import chart_layout
from squilla.colour import composite
from squilla.evaluation.chart import COLOURS as PATCHES
from squilla.evaluation.chart import patch_means
from squilla.evaluation.plots import band_figure
from squilla.evaluation.style import (
    COLOURS,
    INK,
    PALE,
    canvas,
    draw_picture,
    label_row,
    sheet,
    styled,
)
from squilla.spectra import CHART_LIGHT, chart_reflectances, grid, lights

IMAGES = Path(__file__).parent.parent / "docs" / "images"
ROWS = ("none", "20", "15:20")
"""Of the pictures: no noise, fixed, uniform."""

SHOWN = ("dark skin", "foliage", "orange", "moderate red", "yellow", "cyan")
"""Patches whose spectra are drawn."""


def main() -> None:
    parser = argparse.ArgumentParser(description="The thesis' pictures.")
    parser.add_argument("--epochs", type=int, default=50)
    parser.add_argument("--prior", default="gaussian")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    IMAGES.mkdir(parents=True, exist_ok=True)
    ending = "" if options.prior == "gaussian" else f"_{options.prior}"

    cells = [json.loads(path.read_text()) for path in sorted(CELLS.glob("*.json"))]
    cells = [
        cell for cell in cells
        if (cell["prior"], cell["epochs"]) == (options.prior, options.epochs)
    ]  # fmt: skip
    keep(error_figure(cells), f"errors{ending}")
    truth = patch_means(capture("chart").truth, chart_layout(250, 250))[:PATCHES]
    for network in sorted({cell["model"] for cell in cells}):
        of_network = [cell for cell in cells if cell["model"] == network and cell["seed"] == 0]
        keep(spectra_figure(of_network, truth), f"spectra_{network}{ending}")
    for scene in ("chart", "solid"):
        seen = capture(scene)
        pictures = {}
        for noise in ROWS:
            for network in NETWORKS:
                cell = Cell(network, noise, options.prior, options.epochs)
                bands = reconstructed(cell, scene, seen, options.device)
                if bands is not None:
                    pictures[noise, network] = bands
        keep(colour_figure(seen, pictures), f"{scene}_colours{ending}")
        keep(bands_figure(seen, pictures), f"{scene}_bands{ending}")


def keep(figure, name: str) -> None:
    figure.savefig(IMAGES / f"thesis_{name}.webp", dpi=160)
    print(f"docs/images/thesis_{name}.webp")


def reconstructed(cell: Cell, scene: str, seen: Capture, device: str) -> np.ndarray | None:
    """Return six bands of a scene as a finished cell sees it, (H, W, 6), or None."""
    path = WORK / f"{cell.name}_{scene}.npz"
    weights = WORK / f"{cell.name}.safetensors"
    if not path.exists() and weights.exists():
        model = squilla.load_model(weights, one_matrix(camera())).to(device)
        # The rounding of bfloat16 is far below what a picture shows.
        with torch.autocast(device, torch.bfloat16):
            keep_picture(path.stem, picture(model, seen, device))
    if not path.exists():
        return None
    with np.load(path) as file:
        return file["bands"].astype(np.float32)


def decibel(noise: str) -> str:
    return noise if noise == "none" else f"{noise.replace(':', '–')} dB"


def bands_of(truth: np.ndarray) -> np.ndarray:
    return truth[..., [int(np.abs(grid() - band).argmin()) for band in BANDS]]


@styled
def colour_figure(seen: Capture, pictures: dict[tuple[str, str], np.ndarray]):
    """Draw the colours of the bands at 650, 550 and 500 nm: a row for each training noise."""
    networks = [name for name in NETWORKS if any(name == column for _, column in pictures)]
    white = bands_of(lights().one(CHART_LIGHT, grid()))
    truth = bands_of(seen.truth)
    top = float(np.percentile((truth / white)[..., [3, 1, 0]], 99.5))
    figure = sheet(len(ROWS), 1 + len(networks), 1.0)
    panels = np.reshape(np.array(figure.axes, object), (len(ROWS), -1))
    for number, (row, noise) in enumerate(zip(panels, ROWS, strict=True)):
        label_row(row[0], f"training noise: {decibel(noise)}")
        columns = {"truth": truth} | {NETWORKS[n]: pictures.get((noise, n)) for n in networks}
        for panel, (name, bands) in zip(row, columns.items(), strict=True):
            shown = np.ones((*truth.shape[:2], 3))
            if bands is not None:
                shown = composite(bands, np.array(BANDS), white=white, scale=top) ** (1 / 2.2)
            draw_picture(panel, shown, "" if number else name)
    return figure


def bands_figure(seen: Capture, pictures: dict[tuple[str, str], np.ndarray]):
    """Draw single bands: the truth, and every network trained with uniform noise."""

    def labelled(bands: np.ndarray) -> DataArray:
        return DataArray(bands, dims=("y", "x", "wavelength"), coords={"wavelength": list(BANDS)})

    estimates = {
        NETWORKS[network].split(" (")[0]: labelled(bands)
        for (noise, network), bands in pictures.items()
        if noise == ROWS[-1]
    }
    return band_figure(labelled(bands_of(seen.truth)), estimates, BANDS)


@styled
def spectra_figure(cells: list[dict], truth: np.ndarray):
    """Draw spectra of patches, a row for each training noise, the error above each."""
    names = list(chart_reflectances().name)
    patches = [names.index(name) for name in SHOWN]
    noises = [noise for noise in PUBLISHED if any(cell["noise"] == noise for cell in cells)]
    figure = canvas(7.2, 0.4 + 0.85 * len(noises))
    panels = figure.subplots(len(noises), len(patches), sharex=True, sharey=True, squeeze=False)
    for number, (row, noise) in enumerate(zip(panels, noises, strict=True)):
        cell = next(cell for cell in cells if cell["noise"] == noise)
        for panel, patch in zip(row, patches, strict=True):
            peak = truth[patch].max()
            panel.fill_between(grid(), truth[patch] / peak, color="#e7e9ec", lw=0)
            panel.plot(grid(), truth[patch] / peak, color=INK, lw=0.8)
            panel.plot(grid()[::5], cell["spectra"][patch], color=COLOURS[0])
            name = "" if number else f"{names[patch]}\n"
            panel.set_title(f"{name}{cell['patches'][patch]:.4f}", loc="left", pad=2)
            panel.set(xlim=(500, 750), ylim=(0, 1.3), yticks=[0, 1])
        row[0].set_ylabel(decibel(noise))
    for panel in panels[-1]:
        panel.set_xlabel("nm")
    figure.suptitle(
        f"{NETWORKS[cells[0]['model']]}, {cells[0]['epochs']} epochs: reconstruction (blue), "
        "truth (black), mean squared error",
        x=0.01, ha="left", fontsize=7.5,
    )  # fmt: skip
    return figure


@styled
def error_figure(cells: list[dict]):
    """Draw table 5.1: ours and the thesis', each in a panel of its own."""
    figure = canvas(7.2, 2.6)
    ours, thesis = figure.subplots(1, 2, sharey=True)
    order = [noise for noises in KINDS.values() for noise in noises]
    for colour, (network, name) in zip(COLOURS, NETWORKS.items(), strict=False):
        found = [errors(cells, network, noise) for noise in order]
        mean = [np.mean(each) if each else np.nan for each in found]
        ours.plot(range(len(order)), mean, "o-", ms=3, lw=0.8, color=colour)
        published = [PUBLISHED[noise].get(network, np.nan) for noise in order]
        thesis.plot(range(len(order)), published, "o-", ms=3, lw=0.8, color=colour, label=name)
    for panel, title in ((ours, "ours: the twin's chart"), (thesis, "the thesis: real captures")):
        panel.set_title(title, loc="left")
        panel.set_yscale("log")
        panel.set_xticks(range(len(order)), [noise.replace(":", "–") for noise in order])
        panel.set_xlabel("training noise (dB)")
        for border in (0.5, 4.5):
            panel.axvline(border, color=PALE, lw=0.4)
    ours.set_ylabel("mean squared error")
    figure.legend(loc="outside lower center", ncols=len(NETWORKS))
    return figure


if __name__ == "__main__":
    main()
