"""How well the 90 % interval is kept, over many scenes: charts of 24 colours.

    python benchmarks/cover.py [--scenes 200]

Reflectances and lamps are those that the prior has never learnt from; every scene has a lamp, an
array of the thesis' recipe and 24 mixtures of reflectances of its own. One scene shows how far a
few spectra are off, which share a lamp, beside what is expected of all: so covers scatter. With a
lamp for each colour they scatter less. Writes experiments/results/cover.json.
"""

import argparse
import json
import os
import platform
from pathlib import Path

import numpy as np
import torch
from accuracy import WAVELENGTH, random_array
from torch import Generator, Tensor

from squilla.reconstruction.models import load_model
from squilla.training.noise import add_noise
from squilla.training.prior import Palette

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "cover.json"
SIDE = 32
"""Side of a patch, px."""
FIRST = 3000
"""Seed of the first array; those of the table of accuracy are others."""


def chart(palette: Palette, lamp: Tensor, generator: Generator) -> Tensor:
    """Return 4 x 6 patches of random colours, each under its lamp, (24,) -> (128, 192, K)."""
    colours = palette.natural(lamp, generator)
    label = torch.arange(24).view(4, 6).repeat_interleave(SIDE, 0).repeat_interleave(SIDE, 1)
    return colours[label]


def main() -> None:
    parser = argparse.ArgumentParser(description="The cover of the 90 % interval, scene by scene.")
    parser.add_argument("--scenes", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)))
    palette = Palette(WAVELENGTH, held_out=True, seed=5, count=10)
    generator = Generator().manual_seed(9)
    covers: dict[str, list[float]] = {}
    for scene in range(options.scenes):
        model = load_model("compound", random_array(FIRST + scene))
        lamps = torch.randint(len(palette.lamp), (24,), generator=generator)
        for name, lamp, snr in (
            ("one lamp, 20 dB", lamps[:1].expand(24), 20.0),
            ("one lamp, 30 dB", lamps[:1].expand(24), 30.0),
            ("one lamp, 40 dB", lamps[:1].expand(24), 40.0),
            ("a lamp for each colour, 30 dB", lamps, 30.0),
        ):
            truth = chart(palette, lamp, generator)
            y = add_noise(model.calibration.project(truth), snr, generator)
            with torch.inference_mode():
                x, width = model.with_interval(y, snr=snr)
            inside = (x - truth).abs() <= width
            covers.setdefault(name, []).append(float(inside.float().mean()))
    story: dict = {"machine": platform.machine(), "scenes": options.scenes}
    for name, found in covers.items():
        story[name] = {
            "mean": round(float(np.mean(found)), 4),
            "standard deviation": round(float(np.std(found)), 4),
            "nine in ten scenes": np.quantile(found, [0.05, 0.95]).round(3).tolist(),
            "from 87 to 93 %": float(np.mean([0.87 <= one <= 0.93 for one in found])),
        }
        print(f"{name}: {story[name]}")
    RESULTS.write_text(json.dumps(story, indent=1) + "\n")


if __name__ == "__main__":
    main()
