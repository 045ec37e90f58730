"""What each fault of the camera costs: unknown to the reconstruction, and inside a calibrated R.

Usage: python experiments/faults.py

First in numbers alone: spectra of the natural prior at 25 places of the field, seen with the fault,
estimated by the best linear estimator for the design without it and for R as narrow-band flats
show it, which is its mean around the axis at each field angle, corrected by a white flat. Then how
bright a lamp beside the field must be, the stop taken off, until it is reported. Last, for some
faults with frames: the chart is reconstructed with a calibration from frames of the camera itself,
and as if it were a sound one. The camera has the thesis' optics on pixels twice as wide. Writes
experiments/results/faults.json, part by part; about eight minutes on one core.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from xarray import DataArray

from squilla.calibration.alignment import measure
from squilla.calibration.calibration import Calibration
from squilla.calibration.rehearsal import Rehearsal, poster
from squilla.camera import lens
from squilla.camera.design import CameraDesign
from squilla.camera.scenes import chart_layout, load_scene
from squilla.camera.twin import Camera
from squilla.evaluation.chart import inner
from squilla.evaluation.metrics import evaluate
from squilla.files.raw import Raw
from squilla.optics.merit import Prior, WhiteNoise, wiener
from squilla.priors import natural_spectra
from squilla.reconstruction.models import load_model

RESULTS = Path(__file__).parent / "results" / "faults.json"

FAULTS = {
    "none": {},
    "opaque gap, filters 0.5 mm behind": {"distance": 500.0},
    "clear gap, filters at the lens": {"gap": 0.92},
    "clear gap, 0.5 mm behind": {"gap": 0.92, "distance": 500.0},
    "clear gap, 0.5 mm behind, 50 um decentred": {
        "gap": 0.92,
        "distance": 500.0,
        "decentre": (0.0, 50.0),
    },
    "opaque gap, 50 um decentred": {"decentre": (0.0, 50.0)},
}
LOOPS = (
    "clear gap, filters at the lens",
    "clear gap, 0.5 mm behind, 50 um decentred",
    "opaque gap, 50 um decentred",
)


def camera_of(**filters) -> Camera:
    tree = CameraDesign.load("thesis").model_dump()
    tree["band"] |= {"step": 5.0}
    tree["sensor"] |= {"pixel": 3.7, "rows": 1500, "columns": 2000}
    tree["field"] |= {"size": 124}
    tree["filters"] |= filters
    return Camera(CameraDesign.model_validate(tree))


def coarse_camera() -> Camera:
    """Return a camera of few pixels and bands, for scenes as wide as a hemisphere."""
    tree = CameraDesign.load("thesis").model_dump()
    tree["band"] |= {"step": 50.0}
    tree["sensor"] |= {"pixel": 7.4, "rows": 760, "columns": 760}
    tree["field"] |= {"size": 62}
    return Camera(CameraDesign.model_validate(tree))


# --- in numbers alone -----------------------------------------------------------------------------


def responses(camera: Camera, y: float, x: float) -> np.ndarray:
    """Return the response at one place of the field, px from the axis, (M, K)."""
    angle = np.arctan(np.hypot(y, x) / camera.design.focal)
    through = float(lens.through_filter(camera.design, np.array(y), np.array(x)))
    gap = (1 - through) * camera.design.filters.gap * camera.clear_response
    return (through * camera.response(angle)[0] + gap) * np.cos(angle) ** 4


def estimate_error(model: np.ndarray, y: Tensor, spectra: Tensor, snr: float) -> float:
    """Return the error of the Wiener estimator for a response `model` on measurements (N, M)."""
    prior = Prior.of(spectra, np.arange(spectra.shape[1]))
    estimator = wiener(torch.from_numpy(model), prior, noise=WhiteNoise(snr))
    return float((y @ estimator.mT - spectra).square().mean())


def in_numbers(kind: str) -> dict:
    """Return the mean squared errors over the field of a fault, unknown and calibrated."""
    sound = camera_of()
    generator = torch.Generator().manual_seed(0)
    spectra = natural_spectra(2000, sound.design.wavelength, generator=generator).double()
    other = spectra[torch.randperm(len(spectra), generator=generator)]
    faulty = camera_of(**FAULTS.get(kind, {}))
    half = sound.design.field.size / 2
    found: dict[str, list[float]] = {}
    loss = []
    for y in np.linspace(-0.9, 0.9, 5) * half:
        for x in np.linspace(-0.9, 0.9, 5) * half:
            angle = np.arctan(np.hypot(y, x) / sound.design.focal)
            nominal, true = responses(sound, y, x), responses(faulty, y, x)
            zone = faulty.sensitivity(angle)[0] * faulty.design.sensor.gain
            if kind == "films 1 % thicker":  # the response is that of shorter wavelengths
                wavelength = sound.design.wavelength
                true = np.stack([np.interp(wavelength / 1.01, wavelength, row) for row in nominal])
                zone = true
            clean = spectra @ torch.from_numpy(true).T
            if kind == "ghost of 10 %":
                ghost = torch.from_numpy(np.roll(true, 1, 0))
                clean = clean + 0.1 * other @ ghost.T
            loss.append(1 - true.sum() / nominal.sum())
            for snr in (20.0, 30.0):
                sigma = clean.square().mean().sqrt() * 10 ** (-snr / 20)
                seen = clean + sigma * torch.randn(
                    clean.shape, generator=torch.Generator().manual_seed(1), dtype=clean.dtype
                )
                level = float(nominal.sum() / true.sum())
                flat = torch.from_numpy(zone.sum(1) / true.sum(1))  # what a white flat corrects
                for name, value in (
                    ("unknown", estimate_error(nominal, seen * level, spectra, snr)),
                    ("calibrated", estimate_error(zone, seen * flat, spectra, snr)),
                    ("best", estimate_error(true, seen, spectra, snr)),
                ):
                    found.setdefault(f"{name}_{snr:g}", []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()} | {
        "light_lost_percent": 100 * float(np.mean(loss))
    }


# --- with frames ----------------------------------------------------------------------------------


def learnt(camera: Camera) -> Calibration:
    step = camera.design.band.step
    return Rehearsal(camera, step=step, bandwidth=step, frames=4).calibrate()


def with_frames(camera: Camera, own: Calibration, sound: Calibration) -> dict:
    """Return the chart's errors with a calibration of this camera, and with that of a sound one.

    The latter keeps geometry and flats of this camera: only its response is believed to be sound.
    """
    factor = own.sensitivity.mean() / sound.sensitivity.mean()
    believed = replace(own, sensitivity=sound.sensitivity * factor, angle=sound.angle)
    scene = load_scene("chart", camera.design.wavelength, camera.design.field.size)
    truth = camera.truth(scene).cube
    mask = inner(chart_layout(*truth.shape[:2]), 4) >= 0
    found = {}
    for snr in (20.0, 30.0):
        raw = camera.capture(scene, snr=snr, generator=torch.Generator().manual_seed(3))
        for name, calibration in (("unknown", believed), ("calibrated", own)):
            measurement = measure(raw, calibration, distance=300.0)
            cube = load_model("ridge", calibration).reconstruct(measurement)
            found[f"{name}_{snr:g}"] = evaluate(cube, truth, mask=mask)["mse"]
    return found


# --- ghosts ---------------------------------------------------------------------------------------


def ghosts() -> dict:
    """Return how much light a lamp puts into the sub-images, and whether it is noticed.

    A texture within 13 degrees and a lamp at 20, black beyond, at 20 dB. The stop that was there
    during the calibration is taken off.
    """
    sound = coarse_camera()
    calibration = learnt(sound)
    opened = Camera(sound.design.model_copy(update={"stop": None}))
    size, wavelength = 1240, sound.design.wavelength
    scene = DataArray(
        np.zeros((size, size, len(wavelength)), np.float32),
        dims=("y", "x", "wavelength"),
        coords={"wavelength": wavelength},
    )
    middle = slice(size // 2 - 44, size // 2 + 44)
    lamp = scene.copy(deep=True)
    scene.values[middle, middle] = poster(88, wavelength).values
    at = size // 2 + int(sound.design.focal * np.tan(np.radians(20)))
    lamp.values[size // 2 - 3 : size // 2 + 3, at - 3 : at + 3] = 1.0
    field, beside = (opened.rate(each, distance=2000.0) for each in (scene, lamp))
    hemisphere = opened.flat_rate(np.ones(len(wavelength)))
    own = sound.flat_rate(np.ones(len(wavelength)))
    signal, in_fields = (float(sound.fields(rate).mean()) for rate in (field, beside))
    exposure = sound.sensor.exposure_for(sound.fields(field), 20.0)
    found = {
        "hemisphere": {"ghost": float((sound.fields(hemisphere) / sound.fields(own)).mean() - 1)}
    }
    for share in (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3):
        rate = field + share * signal / in_fields * beside
        frame = opened.expose(rate, exposure, torch.Generator().manual_seed(5)).frame
        told = measure(Raw(frame, exposure), calibration, distance=2000.0).provenance
        found[f"lamp, ghost {share:g}"] = {
            key: told[key] for key in ("stray_share", "stray_peak", "stray_light")
        }
    frame = opened.expose(hemisphere, exposure / 10, torch.Generator().manual_seed(5)).frame
    told = measure(Raw(frame, exposure / 10), calibration, distance=2000.0).provenance
    found["hemisphere"] |= {"stray_share": told["stray_share"], "stray_light": told["stray_light"]}
    return found


def main() -> None:
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}

    def keep(name: str, work) -> None:
        if name not in results:
            results[name] = work()
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")
        print(name, results[name], flush=True)

    for kind in (*FAULTS, "films 1 % thicker", "ghost of 10 %"):
        keep(f"numbers: {kind}", lambda kind=kind: in_numbers(kind))
    keep("ghosts", ghosts)
    sound = learnt(camera_of())
    keep("frames: none", lambda: with_frames(camera_of(), sound, sound))
    for kind in LOOPS:
        camera = camera_of(**FAULTS[kind])
        keep(
            f"frames: {kind}",
            lambda camera=camera: with_frames(camera, learnt(camera), sound),
        )


if __name__ == "__main__":
    main()
