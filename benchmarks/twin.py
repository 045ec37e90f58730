"""Time the twin and the way back at the real size: 250 x 250 x 251 scene, 3000 x 4000 raw frame.

    python benchmarks/twin.py

Prints the median of five runs after one to warm up, and the peak memory of the process.
"""

import resource

import numpy as np
import torch
from timing import seconds

import squilla
from squilla.calibration.rehearsal import Rehearsal
from squilla.camera.scenes import load_scene
from squilla.reconstruction.models import model_class


def peak() -> float:
    """Return the largest memory that the process has held, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main() -> None:
    print(
        f"{torch.get_num_threads()} threads\n\n| step | s | peak memory so far, GB |\n|---|---|---|"
    )
    camera = squilla.Camera("thesis")
    scene = load_scene("chart", camera.design.wavelength)
    generator = torch.Generator().manual_seed(0)
    relief = 220 + 20 * np.sin(np.linspace(0, 9, 250))[:, None] * np.ones(250)
    raw = camera.capture(scene, snr=20, generator=generator)
    rows = {
        "capture of a plane": lambda: camera.capture(scene, snr=20, generator=generator),
        "capture with depth": lambda: camera.capture(
            scene, depth=relief, snr=20, generator=generator
        ),
    }
    for name, call in rows.items():
        print(f"| {name} | {seconds(call):.2f} | {peak():.2f} |")
    calibration = Rehearsal(camera, frames=2, step=25.0, bandwidth=25.0).calibrate()
    measurement = squilla.measure(raw, calibration)
    rows = {"measure: raw frame to measurement": lambda: squilla.measure(raw, calibration)}
    for name in ("ridge", "sparse", "mlp"):
        model = model_class(name)(calibration)
        rows[f"reconstruct: {name}"] = lambda model=model: model.reconstruct(measurement)
    for name, call in rows.items():
        print(f"| {name} | {seconds(call):.2f} | {peak():.2f} |")


if __name__ == "__main__":
    main()
