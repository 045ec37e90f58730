"""What it costs to judge every pixel of a cube, beside making the cube.

Usage: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/judgement.py

The thesis' camera photographs the chart at 25 dB; `ridge` makes 250 x 250 x 251 numbers of it, and
`judge` gives residual and flags of each pixel. Writes experiments/results/judgement.json.
"""

import json
import os
import platform
from pathlib import Path

import torch
from timing import seconds

from squilla.calibration.alignment import measure
from squilla.calibration.rehearsal import ideal_calibration
from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.reconstruction.judgement import judge
from squilla.reconstruction.models import load_model

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "judgement.json"


def main() -> None:
    camera = Camera("thesis")
    calibration = ideal_calibration(camera)
    scene = load_scene("chart", camera.design.wavelength)
    raw = camera.capture(scene, snr=25, generator=torch.Generator().manual_seed(0))
    measurement = measure(raw, calibration)
    model = load_model("ridge", calibration)
    cube = model.reconstruct(measurement)
    taken = {
        "measure": seconds(lambda: measure(raw, calibration)),
        "ridge": seconds(lambda: model.reconstruct(measurement)),
        "judge": seconds(lambda: judge(cube, measurement, calibration)),
    }
    results = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "threads": torch.get_num_threads(),
        "seconds": taken,
        "judge_over_ridge": taken["judge"] / taken["ridge"],
        "judge_over_both": taken["judge"] / (taken["measure"] + taken["ridge"]),
    }
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
