"""What it would bring to give all sub-images one sharpness before they become a spectrum.

Usage: python experiments/lens_colour.py

The lens is sharp at one wavelength, so filters that pass other light see edges blurred otherwise,
and a spectrum at an edge is mixed of unlike pictures. Knowing the lens, every sub-image can be
brought to the transfer function that is the mean of all, by a filter that follows Wiener where the
noise is strong. The chart is seen by the thesis' array and by an array of band-pass filters, with
and without this step. Writes experiments/results/lens_colour.json; five minutes on one core.
"""

import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from squilla.calibration.alignment import Measurement, measure
from squilla.calibration.calibration import Calibration
from squilla.calibration.rehearsal import ideal_calibration
from squilla.camera import lens
from squilla.camera.design import CameraDesign
from squilla.camera.scenes import chart_layout, load_scene
from squilla.camera.twin import Camera
from squilla.evaluation.chart import inner
from squilla.evaluation.metrics import evaluate
from squilla.reconstruction.models import load_model

RESULTS = Path(__file__).parent / "results" / "lens_colour.json"
DISTANCE = 300.0


def camera_of(name: str) -> Camera:
    tree = CameraDesign.load(name).model_dump()
    tree["band"] |= {"step": 5.0}
    return Camera(CameraDesign.model_validate(tree))


def transfers(camera: Camera, calibration: Calibration, frequency: np.ndarray) -> np.ndarray:
    """Return the transfer function of every unit at every field angle, (A, M, F)."""
    flat = frequency.ravel()
    table = np.linspace(0, 0.75, 96)
    blur = lens.transfer_function(camera.design, calibration.angle, DISTANCE, table)
    weight = calibration.sensitivity / calibration.sensitivity.sum(-1, keepdims=True)
    of_units = weight @ blur  # (A, M, F)
    rows = [np.interp(flat, table, row) for row in of_units.reshape(-1, len(table))]
    return np.reshape(rows, (*of_units.shape[:2], *frequency.shape))


def equalised(
    measurement: Measurement, camera: Camera, calibration: Calibration, noise: float
) -> tuple[Tensor, float]:
    """Return the measurement at one sharpness, and by how much that amplifies white noise.

    noise : power of the noise against that of the detail, per frequency.
    """
    height, width, _ = measurement.y.shape
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    own = transfers(camera, calibration, frequency)
    common = own.mean(1, keepdims=True)
    filters = (common * own + noise) / (own**2 + noise)  # one where there is only noise
    spectrum = torch.fft.rfft2(measurement.y.permute(2, 0, 1))
    weights = calibration.angle_weights(measurement.angle).permute(2, 0, 1)
    total = torch.zeros_like(measurement.y)
    for weight, one in zip(weights, filters, strict=True):
        sharp = torch.fft.irfft2(spectrum * torch.from_numpy(one).float(), s=(height, width))
        total += (weight * sharp).permute(1, 2, 0)
    return total, float(np.sqrt((filters**2).mean((2, 3)).mean()))


def main() -> None:
    found = {}
    for name in ("thesis", "band-pass"):
        camera = camera_of(name)
        calibration = ideal_calibration(camera)
        model = load_model("ridge", calibration)
        scene = load_scene("chart", camera.design.wavelength)
        truth = camera.truth(scene).cube.values
        labels = chart_layout(*truth.shape[:2])
        flat = inner(labels, 5) >= 0
        near = (labels >= 0) & (inner(labels, 3) < 0)  # the outermost 3 px of each patch
        rate = camera.rate(scene, distance=DISTANCE)
        for snr in (20.0, 30.0, 34.0):
            exposure = camera.sensor.exposure_for(camera.fields(rate), snr)
            raw = camera.expose(rate, exposure, torch.Generator().manual_seed(1))
            measurement = measure(raw, calibration, distance=DISTANCE)
            noise = 10 ** (-snr / 10) * 30  # detail holds a small part of the power
            y, gain = equalised(measurement, camera, calibration, noise)
            plain = model(measurement.y, measurement.angle, measurement.snr).numpy()
            equal = model(y, measurement.angle, measurement.snr).numpy()
            row = {"noise_gain": gain}
            for label, cube in (("plain", plain), ("equalised", equal)):
                for place, mask in (("edges", near), ("patches", flat)):
                    score = evaluate(cube, truth, mask=mask)
                    row |= {
                        f"{label}_{place}_rmse": score["rmse"],
                        f"{label}_{place}_sam": score["sam_deg"],
                    }
            found[f"{name} {snr:g} dB"] = row
            print(name, snr, {key: round(value, 5) for key, value in row.items()}, flush=True)
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
