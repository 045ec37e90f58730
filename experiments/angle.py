"""Corner of the field against its centre: what it costs to ignore the angle, and what mends it.

    python experiments/angle.py [FOLDER] [--frames]

Needs the calibration "sweep, 2.5 nm steps" that experiments/sensitivity.py left in FOLDER (default:
build/sensitivity), learnt from the twin of the thesis' camera with pixels of twice the size.

Point spectra are measured by the stack's exact response at the exact angle, averaged over the F/4
cone, with white noise. They are reconstructed with four sensitivities: that of the axis everywhere;
the same shifted by one effective index and averaged over the cone; what the calibration learnt in
each zone; the true one. All four know the vignetting. With --frames whole frames of the twin are
taken too, where blur has its share. Writes experiments/results/angle.json and
docs/images/angle.webp.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from sensitivity import halved

import squilla
from squilla.calibration.calibration import Calibration
from squilla.camera.design import Effects
from squilla.camera.lens import cone
from squilla.evaluation.style import COLOURS, INK, canvas, styled
from squilla.files.cube import labelled
from squilla.optics.angle import fit_effective_index
from squilla.optics.merit import Prior, WhiteNoise, estimator_error, wiener
from squilla.priors import PRIORS
from squilla.reconstruction.models import load_model
from squilla.spectra import CHART_LIGHT, chart_reflectances, lights
from squilla.training.noise import add_noise

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "angle.json"
PICTURE = HERE.parent / "docs" / "images" / "angle.webp"
SNRS = (20.0, 30.0, 40.0)
HOW = ("axis everywhere", "axis, shifted", "learnt in zones", "true")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default="build/sensitivity")
    parser.add_argument("--frames", action="store_true")
    options = parser.parse_args()
    camera = squilla.Camera(halved(squilla.CameraDesign.load("thesis")))
    learnt = squilla.load_calibration(options.folder / "sweep, 2.5 nm steps.nc")
    cameras = known(camera, learnt)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results |= {
        "effective_index": {
            "exact stack": exact_index(camera, learnt.angle),
            "learnt": learnt.provenance["effective_index"],
        },
        "difference_of_R": differences(cameras),
        "linear": linear(cameras),
        "spectra": spectra(cameras),
        "levelling": levelling(cameras["true"]),
    }
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")
    if options.frames:
        results["frames"] = frames(camera, learnt)
        RESULTS.write_text(json.dumps(results, indent=2) + "\n")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    picture(cameras, results).savefig(PICTURE, dpi=150)
    print(table(results))


def known(camera: squilla.Camera, learnt: Calibration) -> dict[str, Calibration]:
    """Return the calibrations to compare; only the third comes from frames."""
    truth = camera.sensitivity(learnt.angle)
    axis = replace(
        learnt, sensitivity=truth[:1], angle=np.zeros(1), deviations=None, lattice=None, pixels=None
    )
    falloff = np.cos(learnt.angle)[:, None, None] ** 4
    f_number = camera.design.lens.focal_length / camera.design.lens.diameter
    shifted = axis.tilted(
        learnt.provenance["effective_index"],
        f_number=f_number,
        corner=float(learnt.angle[-1]),
        measured_in_cone=True,
    )
    return {
        "axis everywhere": replace(axis, sensitivity=truth[:1] * falloff, angle=learnt.angle),
        "axis, shifted": shifted,
        "learnt in zones": replace(learnt, lattice=None, pixels=None),
        "true": replace(shifted, sensitivity=truth),
    }


def exact_index(camera: squilla.Camera, angle: np.ndarray) -> float:
    """Return the effective index that explains the exact stack best."""
    response = camera.response(angle)
    axis, *cones = (cone(camera.design, one) for one in angle)
    return fit_effective_index(
        response[0], response[1:], camera.design.wavelength, cones, measured_in=axis
    )


def differences(cameras: dict[str, Calibration]) -> dict:
    """Return how far each sensitivity is from the truth, relative RMS, in each zone."""
    truth = cameras["true"].sensitivity
    size = np.linalg.norm(truth, axis=(1, 2))
    return {
        name: (np.linalg.norm(camera.sensitivity - truth, axis=(1, 2)) / size).tolist()
        for name, camera in cameras.items()
    }


def linear(cameras: dict[str, Calibration]) -> dict:
    """Return errors of the best linear estimator in closed form, at the axis and in the corner."""
    found = {}
    for kind in ("natural", "broad"):
        prior = Prior.draw(kind, cameras["true"].wavelength)
        for snr in SNRS:
            noise = WhiteNoise(snr)
            found[f"{kind}, {snr:g} dB"] = {
                name: [
                    float(
                        estimator_error(
                            wiener(camera.sensitivities[zone].double(), prior, noise=noise),
                            cameras["true"].sensitivities[zone].double(),
                            prior,
                            noise=noise,
                        )
                    )
                    for zone in (0, -1)
                ]
                for name, camera in cameras.items()
            }
    return found


@torch.no_grad()
def spectra(cameras: dict[str, Calibration]) -> dict:
    """Return errors of point spectra at the axis and in the corner."""
    wavelength, corner = cameras["true"].wavelength, float(cameras["true"].angle[-1])
    light = lights().one(CHART_LIGHT, wavelength)
    chart = torch.from_numpy(chart_reflectances().on(wavelength) * light).float()
    sets = {
        "natural": PRIORS["natural"](1500, wavelength, generator=torch.Generator().manual_seed(2)),
        "chart": (chart / chart.amax(-1, keepdim=True)).repeat(60, 1),
        "lines": PRIORS["line"](1500, wavelength, generator=torch.Generator().manual_seed(2)),
    }
    models = {m: {n: load_model(m, c) for n, c in cameras.items()} for m in MODELS}
    found: dict = {}
    for kind, x in sets.items():
        for snr in SNRS:
            for place, angle in (("centre", 0.0), ("corner", corner)):
                y = cameras["true"].project(x, torch.full((len(x),), angle))
                y = add_noise(y, snr, torch.Generator().manual_seed(3))
                for model, each in models.items():
                    for name, reconstructor in each.items():
                        error = float((reconstructor(y, angle, snr) - x).square().mean())
                        row = found.setdefault(f"{kind}, {model}, {snr:g} dB", {})
                        row.setdefault(name, {})[place] = error
    return found


MODELS = ("ridge", "sparse", "nnls", "mlp")


@torch.no_grad()
def levelling(camera: Calibration) -> dict:
    """Return errors of the network that ships, natural spectra, with and without levelling."""
    x = PRIORS["natural"](3000, camera.wavelength, generator=torch.Generator().manual_seed(2))
    network, plain = load_model("mlp", camera), load_model("mlp", camera)
    plain.levelled = lambda y, angle: y
    found: dict = {}
    for snr in SNRS:
        for place, angle in (("centre", 0.0), ("corner", float(camera.angle[-1]))):
            y = camera.project(x, torch.full((len(x),), angle))
            y = add_noise(y, snr, torch.Generator().manual_seed(3))
            found[f"{snr:g} dB, {place}"] = {
                name: float((model(y, angle) - x).square().mean())
                for name, model in (("without", plain), ("with", network))
            }
    return found


# --- whole frames -----------------------------------------------------------------------------

VARIANTS = {
    "all effects": {},
    "no blur": dict.fromkeys(("diffraction", "chromatic_focus", "field_curvature"), False),
}
TILE, BORDER = 25, 6  # px


def frames(camera: squilla.Camera, learnt: Calibration) -> dict:
    """Return errors in the corners and in the middle of a frame, away from the borders of tiles."""
    scene = tiles(camera)
    assert learnt.lattice is not None
    angle = learnt.lattice.field_angle()
    inner = np.arange(learnt.lattice.field[0]) % TILE
    inner = (inner >= BORDER) & (inner < TILE - BORDER)
    inside = inner[:, None] & inner
    places = {
        "centre": inside & (angle < np.radians(3.3)),
        "corner": inside & (angle > np.radians(7.0)),
    }
    found: dict = {}
    for name, off in VARIANTS.items():
        design = camera.design.model_copy(update={"effects": Effects(**off)})
        twin = squilla.Camera(design)
        rate = twin.rate(scene, distance=300.0)
        truth = twin.truth(scene, distance=300.0).cube.values
        for wanted in SNRS:
            snr = min(wanted, 32.0)  # one exposure of this scene reaches no more
            count = round(10 ** ((wanted - snr) / 10))
            exposure = twin.sensor.exposure_for(twin.fields(rate), snr)
            y = 0.0
            for number in range(count):
                raw = twin.expose(rate, exposure, torch.Generator().manual_seed(50 + number))
                measurement = squilla.measure(raw, learnt, distance=300.0)
                y = y + measurement.y / count
            measurement = replace(measurement, y=y, snr=measurement.snr + 10 * np.log10(count))
            for how, calibration in known(twin, learnt).items():
                for model in ("ridge", "sparse"):
                    cube = load_model(model, calibration).reconstruct(measurement).values
                    error = np.square(cube - truth).mean(-1) / np.square(truth).mean()
                    row = found.setdefault(f"{name}, {model}, {wanted:g} dB", {})
                    row[how] = {
                        place: float(error[where].mean()) for place, where in places.items()
                    }
            print(name, wanted, found[f"{name}, ridge, {wanted:g} dB"], flush=True)
    return found


def tiles(camera: squilla.Camera):
    """Return a scene of 5 x 5 tiles of natural spectra, which the field shows whole."""
    wavelength, size = camera.design.wavelength, camera.design.field.size
    assert size == 5 * TILE
    pick = PRIORS["natural"](25, wavelength, generator=torch.Generator().manual_seed(8)).numpy()
    number = np.arange(size) // TILE
    return labelled(pick[5 * number[:, None] + number], wavelength)


# --- what is shown ----------------------------------------------------------------------------


def ratios(row: dict) -> list[float]:
    """Return the corner's error against the centre's."""
    return [row[how]["corner"] / row[how]["centre"] for how in HOW]


def table(results: dict) -> str:
    lines = [f"effective index {results['effective_index']}", ""]
    lines += ["| corner / centre | " + " | ".join(HOW) + " |", "|---" * 5 + "|"]
    for name, row in results["linear"].items():
        cells = " | ".join(f"{row[how][1] / row[how][0]:.2f}" for how in HOW)
        lines.append(f"| linear, closed form: {name} | {cells} |")
    for name, row in results["spectra"].items():
        cells = " | ".join(f"{ratio:.2f}" for ratio in ratios(row))
        lines.append(f"| spectra: {name} | {cells} |")
    lines += ["", "| mlp | without levelling | with |", "|---|---|---|"]
    for name, row in results["levelling"].items():
        lines.append(f"| {name} | {row['without']:.5f} | {row['with']:.5f} |")
    lines += ["", "| frames, corner: error / that with the true R | " + " | ".join(HOW[:3]) + " |"]
    lines += ["|---" * 4 + "|"]
    for name, row in results.get("frames", {}).items():
        true = row["true"]["corner"]
        cells = " | ".join(f"{row[how]['corner'] / true:.2f}" for how in HOW[:3])
        lines.append(f"| {name} (true R: {true:.5f}) | {cells} |")
    return "\n".join(lines)


@styled
def picture(cameras: dict[str, Calibration], results: dict):
    """Draw one filter at the axis and in the corner, and the ratios of corner to centre."""
    figure = canvas(9.6, 3.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    wavelength, unit = cameras["true"].wavelength, 7
    falloff = np.cos(cameras["true"].angle[-1]) ** 4
    true, shifted = cameras["true"].sensitivity, cameras["axis, shifted"].sensitivity
    scale = true[:, unit].max()
    left.plot(wavelength, true[0, unit] / scale, color=INK, lw=1, label="on the axis")
    left.plot(
        wavelength, true[-1, unit] / falloff / scale, color=COLOURS[0], label="corner, exact stack"
    )
    left.plot(
        wavelength, shifted[-1, unit] / falloff / scale, color=COLOURS[1], ls="--",
        label="corner, by one effective index",
    )  # fmt: skip
    left.set(xlim=(500, 750), ylim=(0, None), xlabel="wavelength (nm)")
    left.set_title("one filter's sensitivity, without the falloff", loc="left")
    left.legend(frameon=False)
    for number, how in enumerate(HOW):
        heights = [
            ratios(results["spectra"][f"natural, ridge, {snr:g} dB"])[number] for snr in SNRS
        ]
        place = np.arange(3) + 0.2 * (number - 1.5)
        excess = np.array(heights) - 1
        bars = right.bar(place, excess, 0.18, bottom=1, color=COLOURS[number], label=how)
        right.bar_label(bars, [f"{height:.2f}" for height in heights], padding=2, fontsize=6)
    right.axhline(1, color=INK, lw=0.8)
    right.set_ylim(0.98, 1.45)
    right.set_xticks(range(3), [f"{snr:g} dB" for snr in SNRS])
    right.set_title("error in the corner / error in the centre", loc="left")
    right.legend(frameon=False, loc="upper left", title="sensitivity")
    return figure


if __name__ == "__main__":
    main()
