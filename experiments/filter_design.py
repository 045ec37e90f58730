"""What better filters gain: drawn, optimised, ideal; judged, confirmed, coated with faults.

Usage: python experiments/filter_design.py [results folder]

Every part writes its own file into the folder and is left out where that file exists, so that a run
that was broken off goes on where it was. The spectra are natural, with peak 1: the prior is made of
every second measured reflectance and light, the reconstructions are tried on the others.
"""

import json
import logging
import sys
import time
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from squilla.camera.design import CameraDesign
from squilla.camera.lens import cone
from squilla.optics.design import optimise, together
from squilla.optics.filters import (
    FabryPerotRecipe,
    FreeRecipe,
    StencilRecipe,
    linear_variable_filter,
    read_filters,
)
from squilla.optics.merit import (
    Noise,
    PhotonNoise,
    Prior,
    WhiteNoise,
    expected_error,
    wiener,
)
from squilla.optics.plots import plot_search, plot_tolerance
from squilla.optics.tables import band_pass
from squilla.optics.tolerance import ProcessErrors, tolerance
from squilla.priors import scaled
from squilla.spectra import CHART_LIGHT, grid, lights, reflectances

SEED = 0
BAND = grid(step=2.0)
CAMERA = CameraDesign.load("thesis")
EFFICIENCY = torch.from_numpy(np.interp(BAND, CAMERA.wavelength, CAMERA.quantum_efficiency))
RECIPES = {
    "stencil": (StencilRecipe(), {"draws": 1000, "starts": 6, "rounds": 10}),
    "free": (FreeRecipe(), {"draws": 1000, "starts": 3, "rounds": 6}),
    "fabry-perot": (FabryPerotRecipe(), {"draws": 300, "starts": 10, "rounds": 4}),
}


def photons(exposure: float) -> PhotonNoise:
    return PhotonNoise(exposure, CAMERA.sensor.read_noise, EFFICIENCY)


NOISES: dict[str, Noise] = {
    "20 dB": WhiteNoise(20),
    "30 dB": WhiteNoise(30),
    "100 e": photons(100),
    "1000 e": photons(1000),
    "10000 e": photons(10000),
}
FAULTS = ("scale", "deposition", "layer", "misalignment")
SIZES = (0.0, 0.001, 0.002, 0.005, 0.01, 0.015, 0.02)
LIMIT = 1.1  # error of the fixed estimator against the design's that counts as held

log = logging.getLogger("filter_design")


def natural(half: int, count: int, seed: int) -> torch.Tensor:
    """Draw reflectances under lights, (count, K), of every second sample, even or odd."""
    generator = torch.Generator().manual_seed(seed)
    table = lights()
    lamps = [i for i, name in enumerate(table.name) if name != CHART_LIGHT and i % 2 == half]
    surface = torch.from_numpy(reflectances().on(BAND)[half::2])
    lamp = torch.from_numpy(table.on(BAND)[lamps])
    picks = [t[torch.randint(len(t), (count,), generator=generator)] for t in (surface, lamp)]
    return scaled(picks[0] * picks[1])


PRIOR = Prior.of(natural(0, 20_000, SEED), BAND)


def response(array) -> torch.Tensor:
    return array.transmittance(BAND) * EFFICIENCY


def once(path: Path, work) -> dict:
    """Return what `path` holds, or do the work, write it there, and say how long it took."""
    if not path.exists():
        start = time.process_time()
        result = work() | {"cpu_seconds": round(time.process_time() - start, 1)}
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        log.info("%s: %.0f s of processor time", path.stem, result["cpu_seconds"])
    return json.loads(path.read_text(encoding="utf-8"))


# --- the parts ----------------------------------------------------------------------------------


def search(folder: Path, name: str, label: str) -> dict:
    """Search for the array of one recipe that is best under one noise."""
    recipe, how = RECIPES[name]
    found = optimise(
        recipe,
        lambda t: expected_error(t * EFFICIENCY, PRIOR, noise=NOISES[label]),
        BAND,
        seed=SEED,
        **how,
    )
    stem = f"{name}_{label.replace(' ', '')}"
    found.array.save(folder / f"{stem}.toml")
    if name == "stencil" and label in ("20 dB", "1000 e"):
        figure = plot_search(found, BAND, f"Expected error of the stencil process, {label}")
        figure.savefig(folder / f"{stem}.png")
    return {
        "median": float(found.drawn.median()),
        "best": float(found.drawn.min()),
        "optimised": found.merit,
        "throughput": float(found.array.transmittance(BAND).mean()),
        "throughput_best": float(found.first.transmittance(BAND).mean()),
    }


def arrays(folder: Path) -> dict:
    """Return the arrays to compare, by name."""
    chosen = {"thesis camera": StencilRecipe().draw(CAMERA.filters.seed)}
    for label in NOISES:
        for name in RECIPES:
            path = folder / f"{name}_{label.replace(' ', '')}.toml"
            chosen[f"{name}, for {label}"] = read_filters(path)
    chosen["linear variable filter"] = linear_variable_filter()
    chosen["ideal band-pass, 12 nm"] = band_pass(36, BAND)
    return chosen


def compare(folder: Path) -> dict:
    """Judge every array under every noise: foretold, and by spectra held out, noise and all."""
    held_out = natural(1, 20_000, SEED + 1)
    table: dict = {}
    for name, array in arrays(folder).items():
        sensitivity = response(array)
        rows: dict = {"throughput": float(array.transmittance(BAND).mean())}
        for label, noise in NOISES.items():
            estimator = wiener(sensitivity, PRIOR, noise=noise)
            rows[label] = {
                "expected": float(expected_error(sensitivity, PRIOR, noise=noise)),
                "reconstructed": reconstruct(held_out, sensitivity, estimator, noise),
            }
        table[name] = rows
    return table


def reconstruct(
    spectra: torch.Tensor, sensitivity: torch.Tensor, estimator: torch.Tensor, noise: Noise
) -> float:
    """Measure spectra, noise drawn as the physics has it, reconstruct them, return the error."""
    generator = torch.Generator().manual_seed(SEED + 2)
    y = spectra @ sensitivity.T
    unit = torch.randn(y.shape, generator=generator, dtype=torch.float64)
    if isinstance(noise, WhiteNoise):  # relative to each spectrum, as the thesis has it
        y = y + y.square().mean(-1, keepdim=True).sqrt() / 10 ** (noise.snr / 20) * unit
    elif isinstance(noise, PhotonNoise):
        electrons = noise.exposure / float((EFFICIENCY * PRIOR.mean).sum())
        counted = torch.poisson(y * electrons, generator=generator) + noise.read_noise * unit
        y = counted / electrons
    return float((y @ estimator.mT - spectra).square().mean())


def light(folder: Path) -> dict:
    """Judge arrays at exposures between very dim and very bright."""
    exposures = np.geomspace(10, 1e5, 17)
    random = response(together([StencilRecipe().draw(seed) for seed in range(200)]))
    known = arrays(folder)
    curves: dict = {"exposure": exposures.tolist(), "random": [], "random_best": []}
    for exposure in exposures:
        errors = expected_error(random, PRIOR, noise=photons(exposure))
        curves["random"].append(float(errors.median()))
        curves["random_best"].append(float(errors.min()))
    for name in (
        "stencil, for 20 dB", "stencil, for 100 e", "stencil, for 1000 e", "stencil, for 10000 e",
        "linear variable filter", "ideal band-pass, 12 nm",
    ):  # fmt: skip
        sensitivity = response(known[name])
        curves[name] = [
            float(expected_error(sensitivity, PRIOR, noise=photons(e))) for e in exposures
        ]
    return curves


def tilt(folder: Path) -> dict:
    """Judge arrays in the cone of light and at the field's corner, their response known there."""
    half = CAMERA.field.size / CAMERA.focal / 2
    table: dict = {}
    for name in ("thesis camera", "stencil, for 20 dB", "stencil, for 30 dB", "free, for 20 dB"):
        array = arrays(folder)[name]
        table[name] = {
            "collimated": float(expected_error(response(array), PRIOR, noise=NOISES["20 dB"]))
        }
        for where, angle in (("centre", 0.0), ("corner", float(np.arctan(2**0.5 * half)))):
            angles, weights = cone(CAMERA, angle)
            seen = array.transmittance(BAND, angles)
            seen = torch.einsum("a,amk->mk", torch.from_numpy(weights), seen) * EFFICIENCY
            table[name][where] = float(expected_error(seen, PRIOR, noise=NOISES["20 dB"]))
    return table


def faults(folder: Path, name: str, label: str) -> dict:
    """Coat one array with every fault at every size."""
    array, panels, held = arrays(folder)[name], {}, {}
    for fault in FAULTS:
        found = [
            tolerance(
                array, ProcessErrors(**{fault: size}), PRIOR, noise=NOISES[label],
                efficiency=EFFICIENCY, count=300, generator=torch.Generator().manual_seed(SEED),
            )
            for size in SIZES
        ]  # fmt: skip
        panels[fault] = (SIZES, found)
        held[fault] = {
            "change": [float(each.change.median()) for each in found],
            "fixed": [float(each.fixed.median()) / each.nominal for each in found],
            "fixed_95": [float(each.fixed.quantile(0.95)) / each.nominal for each in found],
            "recalibrated": [float(each.recalibrated.median()) / each.nominal for each in found],
        }
        held[fault]["limit"] = limit(held[fault]["fixed_95"])
        held[fault]["nominal"] = found[0].nominal
    stem = f"faults_{name.split(',')[0].replace(' ', '_')}_{label.replace(' ', '')}"
    title = f"{name[0].upper()}{name[1:]}: error at {label}, median and 5 to 95 % of arrays"
    plot_tolerance(panels, title).savefig(folder / f"{stem}.png")
    return held


def limit(factors: list[float]) -> float | None:
    """Return the size at which the error, in all but 5 % of cases, grows by LIMIT; None: never."""
    above = next((i for i, factor in enumerate(factors) if factor > LIMIT), None)
    if above is None:
        return None
    return float(np.interp(LIMIT, factors[above - 1 : above + 1], SIZES[above - 1 : above + 1]))


# --- the report ---------------------------------------------------------------------------------


def plot_light(curves: dict) -> Figure:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    exposure = curves["exposure"]
    axes.fill_between(exposure, curves["random_best"], curves["random"], color="0.8", linewidth=0,
                      label="stencil, drawn: best of 200 to median")  # fmt: skip
    styles = {"linear variable filter": "--", "ideal band-pass, 12 nm": "k--"}
    for name, values in curves.items():
        if name not in ("exposure", "random", "random_best", "cpu_seconds"):
            axes.plot(exposure, values, styles.get(name, "-"), label=name)
    axes.set(xscale="log", yscale="log", xlabel="exposure: electrons of a pixel without a filter",
             ylabel="expected error")  # fmt: skip
    axes.axvline(CAMERA.sensor.full_well, color="0.7", linestyle=":")
    axes.legend()
    return figure


def report(searches: dict, table: dict, curves: dict, tilted: dict, coated: dict) -> str:
    lines = [
        "# What better filters gain",
        "",
        "Mean squared error of the best linear estimate of natural spectra of peak 1, 36 filters,",
        "500-750 nm, the thesis camera's quantum efficiency. White noise is relative to the mean",
        "square of each array's own measurement; photon noise is at the same exposure for all, in",
        "electrons of a pixel without a filter, with 2.5 e- read noise. Made by",
        "`experiments/filter_design.py`, seed 0.",
        "",
        "## Drawn and optimised",
        "",
        "| process | noise | median drawn | best drawn | optimised | to the median | mean T |",
        "|---|---|---|---|---|---|---|",
    ]
    for (name, label), found in searches.items():
        lines.append(
            f"| {name} | {label} | {found['median']:.5f} | {found['best']:.5f} | "
            f"**{found['optimised']:.5f}** | {found['optimised'] / found['median']:.2f} | "
            f"{found['throughput']:.2f} |"
        )
    lines += [
        "",
        f"Drawn: {RECIPES['stencil'][1]['draws']} arrays of the stencil process and as many free",
        f"ones, {RECIPES['fabry-perot'][1]['draws']} Fabry-Perot arrays.",
        "",
        "## Every array under every noise: foretold / reconstructed from held-out spectra",
        "",
        "| array | mean T | " + " | ".join(NOISES) + " |",
        "|---|---|" + "---|" * len(NOISES),
    ]
    for name, rows in table.items():
        if name != "cpu_seconds":
            cells = [f"{rows[n]['expected']:.5f} / {rows[n]['reconstructed']:.5f}" for n in NOISES]
            lines.append(f"| {name} | {rows['throughput']:.2f} | " + " | ".join(cells) + " |")
    lines += ["", "![error against light](light.png)", "", "## In the cone of the lens, 20 dB", ""]
    lines += ["| array | collimated | centre | corner |", "|---|---|---|---|"]
    for name, row in tilted.items():
        if name != "cpu_seconds":
            lines.append(
                f"| {name} | {row['collimated']:.5f} | {row['centre']:.5f} | {row['corner']:.5f} |"
            )
    lines += [
        "",
        "## What a fab must hold",
        "",
        "Standard deviation of each fault, alone, up to which 95 % of arrays stay within 1.1 times",
        "the error of the design when the reconstruction is not calibrated anew; in brackets the",
        "error of the calibrated one at 2 %, against the design's.",
        "",
        "| array | noise | " + " | ".join(FAULTS) + " |",
        "|---|---|" + "---|" * len(FAULTS),
    ]
    for (name, label), held in coated.items():
        cells = []
        for fault in FAULTS:
            size = held[fault]["limit"]
            shown = f"above {100 * SIZES[-1]:g} %" if size is None else f"{100 * size:.2f} %"
            cells.append(f"{shown} (x{held[fault]['recalibrated'][-1]:.2f})")
        lines.append(f"| {name} | {label} | " + " | ".join(cells) + " |")
    random, best = coated["thesis camera", "20 dB"], coated["stencil, for 20 dB", "20 dB"]
    worst = max(max(best[fault]["recalibrated"]) for fault in FAULTS)
    still = best["scale"]["nominal"] * best["scale"]["fixed"][SIZES.index(0.01)]
    lines += [
        "",
        "At 20 dB and without a calibration of its own, an array must have all its thicknesses",
        f"right together to {100 * random['scale']['limit']:.2f} % and each deposition to "
        f"{100 * random['deposition']['limit']:.1f} % if it was drawn at random,",
        f"to {100 * best['scale']['limit']:.2f} % and {100 * best['deposition']['limit']:.1f} % if "
        "it was optimised; once calibrated, the optimised one loses",
        f"{100 * (worst - 1):.0f} % at most, in the median, at 2 % of any fault. Uncalibrated and "
        f"1 % off in scale it still has an error of {still:.4f}",
        f"in the median, against {random['scale']['nominal']:.4f} of the random one as designed.",
        "",
        "![faults](faults_thesis_camera_20dB.png)",
        "![faults](faults_stencil_20dB.png)",
        "",
        "The search, 20 dB and 1 000 electrons:",
        "",
        "![search](stencil_20dB.png)",
        "![search](stencil_1000e.png)",
        "",
    ]
    return "\n".join(lines)


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(
        level=logging.INFO,
        format="%(asctime)s %(message)s",
        handlers=[logging.StreamHandler(), logging.FileHandler(folder / "log.txt")],
    )
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    log.info("seed %d, torch %s, one thread", SEED, torch.__version__)
    searches = {
        (name, label): once(
            folder / f"search_{name}_{label.replace(' ', '')}.json",
            lambda name=name, label=label: search(folder, name, label),
        )
        for name in RECIPES
        for label in NOISES
    }
    table = once(folder / "compare.json", lambda: compare(folder))
    curves = once(folder / "light.json", lambda: light(folder))
    plot_light(curves).savefig(folder / "light.png", dpi=120)
    tilted = once(folder / "tilt.json", lambda: tilt(folder))
    coated = {
        (name, label): once(
            folder / f"faults_{name.split(',')[0].replace(' ', '_')}_{label.replace(' ', '')}.json",
            lambda name=name, label=label: faults(folder, name, label),
        )
        for label in ("20 dB", "30 dB")
        for name in ("thesis camera", f"stencil, for {label}")
    }
    text = report(searches, table, curves, tilted, coated)
    (folder / "README.md").write_text(text, encoding="utf-8")
    log.info("written README.md")


if __name__ == "__main__":
    here = Path(__file__).parent / "results" / "filter_design"
    main(Path(sys.argv[1]) if sys.argv[1:] else here)
