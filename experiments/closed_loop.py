"""The closed loop at full size: what calibration and alignment find of the twin's planted truth.

    python experiments/closed_loop.py

Everything is learnt from simulated frames of the thesis' camera, 3000 x 4000, and compared with the
truth afterwards. Writes experiments/results/closed_loop.json.
"""

import json
from pathlib import Path

import numpy as np
import torch

import squilla
from squilla.calibration.rehearsal import Rehearsal, poster
from squilla.demo import alignment_error


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    camera = squilla.Camera("thesis")
    calibration = Rehearsal(camera, step=5.0, bandwidth=5.0).calibrate()
    lattice, pixels = calibration.lattice, calibration.pixels
    assert lattice is not None
    assert pixels is not None
    truth = camera.sensitivity(calibration.angle)
    found = {
        "centres_rms_px": rms(lattice.centre - camera.design.centres),
        "sensitivity_rms_percent": 100 * rms(calibration.sensitivity - truth) / rms(truth),
        "gain_error_percent": 100 * (pixels.gain / camera.design.sensor.gain - 1),
        "read_noise_error_percent": 100 * (pixels.read_noise / camera.design.sensor.read_noise - 1),
    }
    scene = poster(350, camera.design.wavelength, seed=9)
    for distance in (100.0, 300.0, 1000.0):
        for snr in (20.0, 30.0):
            raw = camera.capture(
                scene, distance=distance, snr=snr, generator=torch.Generator().manual_seed(1)
            )
            measurement = squilla.measure(raw, calibration)
            error = alignment_error(
                calibration, measurement, camera.truth(scene, distance=distance)
            )
            found[f"alignment_rms_px_{distance:g}mm_{snr:g}dB"] = error
            found[f"snr_error_db_{distance:g}mm_{snr:g}dB"] = measurement.provenance["snr"] - snr
    results = Path(__file__).parent / "results" / "closed_loop.json"
    results.write_text(json.dumps(found, indent=2) + "\n")
    for name, value in found.items():
        print(f"{name:<36} {value:.4f}")


if __name__ == "__main__":
    main()
