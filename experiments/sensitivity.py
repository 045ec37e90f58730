"""How well R is learnt: from sweeps with all their faults, and from a chart and lamps.

    python experiments/sensitivity.py [FOLDER]

The twin of the thesis' camera, 3000 x 4000 px, takes the frames of each case (those marked * with
pixels of twice the size, to save time); a calibration is learnt from them and kept in FOLDER
(default: build/sensitivity), so that an interrupted run goes on. Then each calibration is judged:
its error against the truth, how honest its own uncertainty is, and what spectra cost that are
reconstructed with it. Writes experiments/results/sensitivity.json and prints the tables.
"""

import json
import platform
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import squilla
from squilla.calibration.rehearsal import LAMPS, Rehearsal
from squilla.priors import natural_spectra
from squilla.reconstruction.models import load_model
from squilla.spectra import CHART_LIGHT, chart_reflectances, lights
from squilla.training.noise import add_noise

RESULTS = Path(__file__).parent / "results" / "sensitivity.json"
SWEEP = {"step": 5.0, "bandwidth": 5.0, "power_error": 0.01}
MISSING = (17, 34)
LEDS = ((505, 28), (525, 32), (560, 30), (590, 16), (617, 18), (635, 17), (660, 20), (690, 22),
        (735, 28))  # nm: centre and width, as catalogues have them  # fmt: skip
MODELS = ("ridge", "sparse")


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/sensitivity")
    folder.mkdir(parents=True, exist_ok=True)
    full = squilla.Camera("thesis")
    coarse = squilla.Camera(halved(full.design))
    results = {"machine": platform.processor() or platform.machine(), "cases": {}}
    for name, case in CASES.items():
        path = folder / f"{name.removesuffix(' *')}.nc"
        camera = coarse if "*" in name else full
        if not path.exists():
            print(f"{name}: taking frames", flush=True)
            learn(camera, case).save(path)
        calibration = squilla.load_calibration(path)
        truth = camera.sensitivity(calibration.angle)
        results["cases"][name] = {
            **accuracy(calibration, truth),
            **{key: calibration.provenance.get(key) for key in REPORTED},
            "error_of_spectra": costs(calibration, truth),
        }
        RESULTS.write_text(json.dumps(results, indent=2) + "\n")
    print(table(results["cases"]))


# --- the cases --------------------------------------------------------------------------------


def halved(design: squilla.CameraDesign) -> squilla.CameraDesign:
    """Return the design with half as many pixels across: the same lenses, filters and angles."""
    tree = design.model_dump()
    tree["sensor"] |= {"pixel": 3.7, "rows": 1500, "columns": 2000}
    tree["field"] |= {"size": 125}
    return squilla.CameraDesign.model_validate(tree)


def plain(rehearsal: Rehearsal) -> None:
    """Leave two steps out."""
    rehearsal.wavelengths = np.delete(rehearsal.wavelengths, MISSING)


def uneven(rehearsal: Rehearsal) -> None:
    """Space the steps by 3 to 7 nm."""
    middle = rehearsal.wavelengths[1:-1]
    middle += np.random.default_rng(3).uniform(-1, 1, len(middle))


def beyond(rehearsal: Rehearsal) -> None:
    """Leave two steps out, and add four outside the band."""
    plain(rehearsal)
    rehearsal.wavelengths = np.r_[485, 490, rehearsal.wavelengths, 760, 765]


def returning(rehearsal: Rehearsal) -> None:
    """Leave two steps out, and come back to 625 nm seven times."""
    plain(rehearsal)
    parts = [np.r_[625.0, part] for part in np.array_split(rehearsal.wavelengths, 6)]
    rehearsal.wavelengths = np.r_[np.concatenate(parts), 625.0]


def spoilt(steps, camera):
    """Yield the steps, one of them saturated and the power of another misread by 20 %."""
    for number, step in enumerate(steps):
        if number == 12:
            rate = (step.raw.frame.astype(np.float32) - 64) * camera.design.sensor.gain
            step = replace(step, raw=camera.expose(np.maximum(rate, 0), 2.5))
        yield replace(step, power=1.2 * step.power) if number == 30 else step


CASES = {
    "sweep, 5 nm steps": (SWEEP, plain),
    "sweep, 2.5 nm steps *": (SWEEP | {"step": 2.5}, plain),
    "chart and white lamps *": ({"power_error": 0.01}, False),
    "chart, white lamps and LEDs *": ({"power_error": 0.01}, True),
    "exact power *": (SWEEP | {"power_error": 0.0}, plain),
    "uneven steps *": (SWEEP, uneven),
    "saturated and misread step *": (SWEEP, plain),
    "stray light 0.3 % *": (SWEEP | {"stray_light": 0.003}, plain),
    "stray light 0.3 %, steps outside *": (SWEEP | {"stray_light": 0.003}, beyond),
    "drift 5 % *": (SWEEP | {"power_drift": 0.05}, plain),
    "drift 5 %, coming back *": (SWEEP | {"power_drift": 0.05}, returning),
}
REPORTED = ("power_noise", "power_drift", "stray_light", "saturated_steps", "doubted_steps",
            "effective_index")  # fmt: skip


def learn(camera: squilla.Camera, case) -> squilla.Calibration:
    """Return the calibration from the frames of a case."""
    settings, change = case
    rehearsal = Rehearsal(camera, seed=4, **settings)
    lessons: dict = {}
    if callable(change):
        change(rehearsal)
        if case is CASES["saturated and misread step *"]:
            lessons["sweep"] = spoilt(rehearsal.sweep(), camera)
    else:
        wavelength, table = camera.design.wavelength, lights()
        lamps = [table.one(name, wavelength) for name in LAMPS]
        if change:
            lamps += [np.exp(-4 * np.log(2) * ((wavelength - c) / w) ** 2) for c, w in LEDS]
        lessons |= {"sweep": None, "known": rehearsal.known(np.array(lamps))}
    return rehearsal.calibrate(**lessons)


# --- the verdict ------------------------------------------------------------------------------


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def accuracy(calibration: squilla.Calibration, truth: np.ndarray) -> dict:
    """Return the error of the sensitivity, all relative to the RMS of the truth."""
    error = calibration.sensitivity - truth
    share = (error * truth).sum((0, 1)) / (truth**2).sum((0, 1))  # of a common spectral factor
    assert calibration.uncertainty is not None
    each = [rms(error[:, unit]) / rms(truth[:, unit]) for unit in range(calibration.filters)]
    return {
        "error": rms(error) / rms(truth),
        "error_worst_filter": max(each),
        "error_in_zones": [rms(e) / rms(t) for e, t in zip(error, truth, strict=True)],
        "error_but_common_factor": rms(error - share * truth) / rms(truth),
        "own_uncertainty": rms(calibration.uncertainty) / rms(truth),
        "normalised_error": rms(error / calibration.uncertainty),
    }


@torch.no_grad()
def costs(calibration: squilla.Calibration, truth: np.ndarray) -> dict:
    """Return mean squared errors of spectra all over the field, with R true and as learnt."""
    wavelength = calibration.wavelength
    generator = torch.Generator().manual_seed(11)
    light = lights().one(CHART_LIGHT, wavelength)
    chart = torch.from_numpy(chart_reflectances().on(wavelength) * light).float()
    spectra = {
        "natural": natural_spectra(1200, wavelength, generator=generator),
        "chart": (chart / chart.amax(-1, keepdim=True)).repeat(50, 1),
    }
    cameras = {
        "true": replace(calibration, sensitivity=truth, deviations=None),
        "learnt": replace(calibration, deviations=None),
        "learnt, with its uncertainty": calibration,
    }
    found: dict = {}
    for kind, x in spectra.items():
        angle = float(calibration.angle[-1]) * torch.rand(len(x), generator=generator).sqrt()
        clean = cameras["true"].project(x, angle)
        for snr in (20.0, 30.0, 40.0):
            y = add_noise(clean, snr, generator)
            for name, camera in cameras.items():
                for model in MODELS:
                    estimate = load_model(model, camera)(y, angle, snr)
                    place = found.setdefault(kind, {}).setdefault(f"{snr:g} dB", {})
                    error = float((estimate - x).square().mean())
                    place.setdefault(model, {})[name] = error
    return found


def table(cases: dict) -> str:
    lines = [
        "| | error of R | worst filter | but a common factor | own uncertainty | normalised |",
        "|---|---|---|---|---|---|",
    ]
    for name, case in cases.items():
        cells = [case[key] for key in ("error", "error_worst_filter", "error_but_common_factor",
                                       "own_uncertainty")]  # fmt: skip
        text = " | ".join(f"{100 * cell:.2f} %" for cell in cells)
        lines.append(f"| {name} | {text} | {case['normalised_error']:.2f} |")
    lines += ["", "| natural spectra, MSE against that with the true R | 20 dB | 30 dB | 40 dB |",
              "|---|---|---|---|"]  # fmt: skip
    for name, case in cases.items():
        for model in MODELS:
            for how in ("learnt", "learnt, with its uncertainty"):
                errors = [row[model] for row in case["error_of_spectra"]["natural"].values()]
                text = " | ".join(f"{each[how] / each['true']:.3f}" for each in errors)
                lines.append(f"| {name}: {model}, {how} | {text} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
