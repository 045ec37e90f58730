"""How far every reconstructor is from the truth, in one table.

    python benchmarks/accuracy.py [--weights FILE] [--networks FOLDER] [--quick]
    python benchmarks/accuracy.py --render      # only the table of docs/compound.md

Every row is a scene before a simulated camera, y = R x + noise; no row has a spectrum, a scene or a
random array that any method was trained on. The networks that know one camera stand only in that
camera's rows: `mlp` was trained on the broad prior; --networks adds every model file of a folder,
such as those of the thesis' recipe that experiments/table_5_1.py leaves in experiments/work.
Methods that treat every pixel alone are judged on 3000 pixels of each scene, the others on all.
The whole table, with --networks, goes into experiments/results/accuracy.json and docs/compound.md.
"""

import argparse
import json
import os
import platform
import time
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from dead_leaves import dead_leaves
from scipy.io import loadmat
from torch import Generator, Tensor
from torch.nn import functional

import squilla
from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.camera.scenes import load_scene
from squilla.evaluation.metrics import DARKEST, evaluate
from squilla.optics.filters import StencilRecipe
from squilla.reconstruction.compound import Compound
from squilla.reconstruction.models import load_model
from squilla.reconstruction.reconstructor import Reconstructor
from squilla.spectra import grid
from squilla.training.noise import add_noise
from squilla.training.prior import Palette

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "accuracy.json"
WAVELENGTH = grid()
PAGE = Path(__file__).parents[1] / "docs" / "compound.md"
SAMPLE = 3000
PICTURES = ("indian-pines", "corn-kernel")
ANGLES = np.radians([0.0, 4.64, 6.57, 8.04, 9.29])


@dataclass
class Case:
    """A measurement whose truth is known."""

    name: str
    calibration: Calibration
    truth: Tensor
    y: Tensor
    snr: float
    angle: Tensor | None = None
    dead: tuple[int, ...] = ()

    def measurement(self) -> Measurement:
        valid = torch.ones(self.y.shape, dtype=torch.bool)
        valid[..., list(self.dead)] = False
        flat = torch.zeros(self.y.shape[:2])
        angle = flat if self.angle is None else self.angle
        return Measurement(self.y, valid, angle, flat, torch.full_like(flat, self.snr))


# --- cameras ------------------------------------------------------------------------------------


def sensor() -> np.ndarray:
    """Return the quantum efficiency of the simulated sensor, (K,)."""
    knots = [500, 525, 550, 600, 650, 700, 750], [0.78, 0.79, 0.77, 0.70, 0.60, 0.48, 0.37]
    return np.interp(WAVELENGTH, *knots)


def random_array(seed: int, filters: int = 36, angle: np.ndarray | None = None) -> Calibration:
    """Return a stencil array of the thesis' recipe on the simulated sensor."""
    array = StencilRecipe(filters).draw(seed)
    response = array.transmittance(WAVELENGTH, 0.0 if angle is None else angle).numpy() * sensor()
    return Calibration.from_sensitivity(response, WAVELENGTH, angle)


def trained_array() -> Calibration:
    """Return the camera that the shipped `mlp` was trained for: the thesis' camera, calibrated."""
    from safetensors import safe_open

    path = files("squilla") / "data" / "weights" / "mlp.safetensors"
    with safe_open(str(path), "pt") as file:
        response, wavelength = file.get_tensor("sensitivity"), file.get_tensor("wavelength")
    return Calibration.from_sensitivity(response.numpy(), wavelength.numpy())


def mosaic(name: str) -> Calibration:
    """Return a measured mosaic camera within 500-750 nm."""
    path = files("squilla") / "data" / "responses" / f"spectral_responses_{name}.mat"
    profiles = loadmat(str(path))["SpectralProfiles"]
    return Calibration.from_sensitivity(profiles[:, 100:351], WAVELENGTH)


# --- scenes -------------------------------------------------------------------------------------


def scene(name: str) -> Tensor:
    return torch.from_numpy(load_scene(name, WAVELENGTH).values)


def line_chart(size: int = 250) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray]:
    """Return 36 patches that each show one line on a dark ground, FWHM 1 to 30 nm.

    Returns
    -------
    cube (size, size, K), label (size, size), centre (36,) nm, fwhm (36,) nm
    """
    random = np.random.default_rng(20_26)
    fwhm = np.repeat([1.0, 2.0, 5.0, 10.0, 20.0, 30.0], 6)
    centre = random.uniform(515, 735, 36)
    spectra = np.exp(-4 * np.log(2) * ((WAVELENGTH - centre[:, None]) / fwhm[:, None]) ** 2)
    cell = np.arange(size) * 6 // size
    label = torch.from_numpy(cell[:, None] * 6 + cell)
    return torch.from_numpy(spectra).float()[label], label, centre, fwhm


def textures(seed: int, size: int = 250) -> Tensor:
    """Return a scene of leaves painted with reflectances and lamps that nobody trained on."""
    palette = Palette(WAVELENGTH, held_out=True, seed=99, count=2000)
    return dead_leaves(palette, size, Generator().manual_seed(seed))


def misaligned(y: Tensor, deviation: float, generator: Generator) -> Tensor:
    """Displace every channel of a picture, (H, W, M), by a random fraction of a pixel.

    deviation : standard deviation along rows and columns, px.
    """
    by = (deviation * torch.randn(1, y.shape[-1], 2, generator=generator)).clamp(-1, 1)[0]
    taps = (1 - (torch.arange(-1, 2) - by[..., None]).abs()).clamp_min(0)  # (M, 2, 3), bilinear
    kernel = taps[:, 0, :, None] * taps[:, 1, None, :]
    kernel = kernel / kernel.sum((-1, -2), keepdim=True)
    wide = functional.pad(y.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")
    return functional.conv2d(wide, kernel[:, None], groups=len(by))[0].permute(1, 2, 0)


def cases(quick: bool) -> list[Case]:
    """Return every row of the table."""
    generator = Generator().manual_seed(7)
    home = trained_array()
    chart = scene("chart")

    def case(name: str, calibration: Calibration, truth: Tensor, snr: float, **more) -> Case:
        y = add_noise(calibration.project(truth), snr, generator)
        return Case(name, calibration, truth, y, snr, **more)

    rows = [case(f"chart, {snr} dB", home, chart, snr) for snr in (15, 20, 30, 40)]
    lines = line_chart()[0]
    rows += [case(f"lines of 1-30 nm, {snr} dB", home, lines, snr) for snr in (20, 30)]
    rows += [case(f"{name}, 30 dB", home, scene(name), 30) for name in PICTURES]
    rows += [case(f"unseen textures {n}, 20 dB", home, textures(n), 20) for n in (1, 2, 3)]
    rows += [
        case(f"unseen array {n}, chart 20 dB", random_array(1000 + n), chart, 20)
        for n in range(2 if quick else 10)
    ]
    rows += [case(f"mosaic {n}, chart 20 dB", mosaic(n), chart, 20) for n in ("4x4", "5x5")]
    rows += [
        case(f"{m} random filters, chart 20 dB", random_array(2000 + m, m), chart, 20)
        for m in (16, 25, 64)
    ]
    rows += [
        case(f"{n} dead channels, chart 20 dB", home, chart, 20, dead=tuple(range(5, 5 + 7 * n, 7)))
        for n in (1, 2, 4)
    ]
    for wrong in (-5, 5):
        row = case(f"noise stated {wrong:+d} dB, chart 20 dB", home, chart, 20)
        rows.append(replace(row, snr=20.0 + wrong))
    y = misaligned(home.project(chart), 0.3, generator)
    y = add_noise(y, 20, generator)
    rows.append(Case("misaligned 0.3 px, chart 20 dB", home, chart, y, 20))
    tilted = random_array(13, angle=ANGLES)
    for place, field in (("centre", 0.0), ("corner", ANGLES[-1] - 0.001)):
        angle = torch.full(chart.shape[:2], field)
        y = add_noise(tilted.project(chart, angle), 30, generator)
        rows.append(Case(f"{place} of the field, chart 30 dB", tilted, chart, y, 30, angle))
    for wrong in (1, 3):
        off = torch.randn(home.filters, 1, 251, generator=generator)
        off = functional.avg_pool1d(off, 21, 1, 10)[:, 0]
        real = home.mean_sensitivity * (1 + wrong / 100 * off / off.std())
        y = add_noise(chart @ real.float().T, 30, generator)
        rows.append(Case(f"R wrong by {wrong} %, chart 30 dB", home, chart, y, 30))
    return rows


# --- judgement ----------------------------------------------------------------------------------


def judge(case: Case, weights: Path | None, networks: list[Path]) -> dict:
    """Return the metrics of every method for one row."""
    generator = Generator().manual_seed(1)
    truth = case.truth.reshape(-1, len(WAVELENGTH))
    bright = torch.nonzero(truth.amax(-1) >= DARKEST * truth.max())[:, 0]
    some = bright[torch.randperm(len(bright), generator=generator)[:SAMPLE]]
    result: dict = {"row": case.name}
    names: list[str | Path] = ["ridge", "sparse"]
    if case.calibration.filters == 36 and len(case.calibration.angle) == 1 and not case.dead:
        names += ["mlp", *networks]
    for name in names:
        try:
            model = load_model(name, case.calibration)
        except squilla.InputError:  # the network of another camera
            continue
        result[name if isinstance(name, str) else name.stem] = _metrics(
            pixel_wise(model, case, some), truth[some]
        )
    model = load_model("compound" if weights is None else weights, case.calibration)
    assert isinstance(model, Compound)
    began = time.perf_counter()
    cube, width = model.reconstruct_interval(case.measurement())
    result["seconds"] = round(time.perf_counter() - began, 2)
    result["compound"] = _metrics(cube.values, case.truth.numpy())
    judged = case.truth.amax(-1) >= DARKEST * case.truth.max()
    inside = np.abs(cube.values - case.truth.numpy()) <= width.values
    result["compound"]["cover"] = float(inside[judged.numpy()].mean())
    return result


def pixel_wise(model: Reconstructor, case: Case, some: Tensor) -> np.ndarray:
    """Reconstruct some pixels by a method that treats each alone."""
    whole = case.measurement()

    def chosen(values: Tensor) -> Tensor:
        return values.reshape(-1, *values.shape[2:])[some][None]

    assert whole.snr is not None
    part = Measurement(
        chosen(whole.y), chosen(whole.valid), chosen(whole.angle), chosen(whole.disparity),
        chosen(whole.snr),
    )  # fmt: skip
    return model.reconstruct(part).values[0]


def _metrics(estimate: np.ndarray, truth) -> dict[str, float]:
    found = evaluate(np.asarray(estimate), np.asarray(truth))
    return {key: found[key] for key in ("mse", "sam_deg", "psnr_db")}


# --- peaks and edges ----------------------------------------------------------------------------


def peaks(weights: Path | None) -> dict[str, float]:
    """Return how well lines are found at 20 dB, and how many are found where there are none."""
    home, generator = trained_array(), Generator().manual_seed(11)
    model = load_model("compound" if weights is None else weights, home)
    truth, label, centre, fwhm = line_chart()
    with torch.inference_mode():
        x = model(add_noise(home.project(truth), 20, generator), snr=20.0)
        chart = scene("chart")
        smooth = model(add_noise(home.project(chart), 20, generator), snr=20.0)
    found = torch.from_numpy(WAVELENGTH)[x.argmax(-1)] - torch.from_numpy(centre)[label]
    off = found.abs()[torch.from_numpy(fwhm)[label] >= 5]
    some = torch.randperm(250 * 250, generator=generator)[:2000]
    counts = [_peaks(each.reshape(-1, len(WAVELENGTH))[some].numpy()) for each in (smooth, chart)]
    return {
        "lines of 5 nm and more: off by, median nm": float(off.median()),
        "share within 1 nm": float((off <= 1).float().mean()),
        "peaks a spectrum of the chart, found": counts[0],
        "peaks a spectrum of the chart, true": counts[1],
    }


def _peaks(spectra: np.ndarray) -> float:
    """Return the mean number of maxima that stand out by 5 % of the highest."""
    from scipy.signal import find_peaks

    return float(np.mean([len(find_peaks(x, prominence=0.05 * x.max())[0]) for x in spectra]))


def sharpness(weights: Path | None, size: int = 128) -> dict[str, float]:
    """Return the MTF50 of bands over that of the measurement, at an edge tilted by 5 degrees."""
    from scipy.special import erf

    home, generator = trained_array(), Generator().manual_seed(12)
    model = load_model("compound" if weights is None else weights, home)
    row, column = np.mgrid[:size, :size] - (size - 1) / 2
    distance = column * np.cos(np.radians(5)) + row * np.sin(np.radians(5))
    cover = torch.from_numpy(0.5 + 0.5 * erf(distance / (0.7 * np.sqrt(2)))).float()[..., None]
    palette = Palette(WAVELENGTH, held_out=True, count=10)
    result = {}
    for snr in (20, 30):
        ratios = []
        for pair in range(4):
            surface = palette.surface[[3 + 7 * pair, 40 + 5 * pair]] * palette.lamp[10 * pair]
            truth = cover * surface[0] + (1 - cover) * surface[1]
            y = add_noise(home.project(truth), float(snr), generator)
            with torch.inference_mode():
                x = model(y, snr=float(snr))
            # Only bands in which the two sides differ have an edge.
            contrast = (surface[0] - surface[1]).abs() / surface.max()
            bands = [band for band in (25, 75, 125, 175, 225) if contrast[band] > 0.1]
            clean = mtf50(home.project(truth).mean(-1).numpy(), distance)
            ratios += [mtf50(x[..., band].numpy(), distance) / clean for band in bands]
        result[f"MTF50 of bands over the measurement's, {snr} dB"] = float(np.median(ratios))
    return result


def mtf50(picture: np.ndarray, distance: np.ndarray) -> float:
    """Return the spatial frequency at which an edge keeps half of its contrast, cycles/px.

    Source: ISO 12233, the slanted edge.
    """
    place = np.round(distance * 4).astype(int).ravel()
    near = np.abs(place) <= 40
    index = place[near] + 40
    edge = np.bincount(index, picture.ravel()[near]) / np.bincount(index)
    line = np.diff(edge) * np.hanning(80)
    spectrum = np.abs(np.fft.rfft(line, 4096))
    spectrum /= spectrum[0]
    first = int(np.argmax(spectrum < 0.5))
    return 4 * first / 4096


def render() -> None:
    """Write the table of docs/compound.md; the unseen arrays are one row."""
    rows = json.loads(RESULTS.read_text())["rows"]
    many = [row for row in rows if row["row"].startswith("unseen array ")]
    mean = {
        name: {key: float(np.mean([row[name][key] for row in many])) for key in many[0][name]}
        for name in many[0] if isinstance(many[0][name], dict)
    }  # fmt: skip
    at = rows.index(many[0])
    few = [row for row in rows if row not in many]
    few.insert(at, {"row": "ten unseen arrays, chart 20 dB, mean", **mean})
    own = [name for name in rows[0] if name.endswith("_0")]  # cells of table 5.1
    names = {"ridge": "ridge", "sparse": "sparse", "mlp": "mlp"}
    names |= {name: name.split("_")[0] + ", broad" * ("broad" in name) for name in own}
    names["compound"] = "compound"
    heads = [f"*{head}*" if name in own else head for name, head in names.items()]
    lines = [["row", *heads, "SAM", "PSNR", "cover"], ["---"] * (len(names) + 4)]
    for row in few:
        best = min(row[name]["mse"] for name in names if name in row)
        errors = [f"{row[name]['mse']:.5f}" if name in row else "" for name in names]
        errors = [f"**{each}**" if each == f"{best:.5f}" else each for each in errors]
        told = row["compound"]
        rest = [f"{told['sam_deg']:.1f}", f"{told['psnr_db']:.1f}", f"{told['cover']:.0%}"]
        lines.append([row["row"], *errors, *rest])
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    before, rest = PAGE.read_text().split("<!-- begin accuracy -->\n")
    after = rest.split("<!-- end accuracy -->")[1]
    PAGE.write_text(f"{before}<!-- begin accuracy -->\n{table}\n<!-- end accuracy -->{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description="The table of accuracy.")
    parser.add_argument("--render", action="store_true", help="only write the table of the docs")
    parser.add_argument("--weights", type=Path, help="compound weights; default: those that ship")
    parser.add_argument("--networks", type=Path, help="folder of models of the trained camera")
    parser.add_argument("--quick", action="store_true", help="two unseen arrays instead of ten")
    parser.add_argument("--only", help="rows whose name holds this text")
    options = parser.parse_args()
    if options.render:
        render()
        return
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)))
    networks = sorted(options.networks.glob("*.safetensors")) if options.networks else []
    names = ("ridge", "sparse", "mlp", *(path.stem for path in networks), "compound")
    print("| row | " + " | ".join(names) + " | SAM | PSNR | cover |")
    print("|---" * (len(names) + 4) + "|")
    rows = []
    for case in cases(options.quick):
        if options.only and options.only not in case.name:
            continue
        row = judge(case, options.weights, networks)
        rows.append(row)
        errors = [f"{row[name]['mse']:.5f}" if name in row else "" for name in names]
        own = row["compound"]
        print(
            f"| {row['row']} | {' | '.join(errors)} | {own['sam_deg']:.1f} | {own['psnr_db']:.1f} "
            f"| {own['cover']:.3f} |",
            flush=True,
        )
    proofs = peaks(options.weights) | sharpness(options.weights)
    for name, value in proofs.items():
        print(f"{name}: {value:.3f}")
    if options.networks and not (options.only or options.quick or options.weights):
        story = {"peaks and edges": proofs, "machine": platform.machine(), "rows": rows}
        RESULTS.write_text(json.dumps(story, indent=1) + "\n")
        render()


if __name__ == "__main__":
    main()
