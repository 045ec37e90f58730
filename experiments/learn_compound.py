"""Learn what the `compound` model that ships knows: a prior of spectra.

    python experiments/learn_compound.py                 # two cores, two minutes
    python experiments/learn_compound.py --device cuda --count 1000000

The basis and the clusters are those of seeded random spectra: measured reflectances under measured
lamps, Gaussian mixtures, lines. No camera and no scene takes part. Writes the weights, and how well
they hold spectra that were kept aside into results/learn_compound.json.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import numpy as np
import torch
from torch import Generator

import squilla
from squilla.reconstruction.compound import Compound
from squilla.spectra import grid
from squilla.training.prior import LEARNT, Palette, learn_prior

WEIGHTS = Path(squilla.__file__).parent / "data" / "weights" / "compound.safetensors"
RESULTS = Path(__file__).parent / "results" / "learn_compound.json"


def main() -> None:
    parser = argparse.ArgumentParser(description="Learn the prior of the compound model.")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--count", type=int, default=LEARNT, help="spectra to learn from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=WEIGHTS)
    options = parser.parse_args()

    began = time.perf_counter()
    told = {"count": options.count, "seed": options.seed}
    prior = learn_prior(grid(), device=options.device, **told)
    seconds = round(time.perf_counter() - began, 1)
    flat = squilla.Calibration.from_sensitivity(np.ones((1, len(grid()))), grid())
    model = Compound(flat, prior)
    model.provenance = told | {"clusters": prior.learnt}
    model.save(options.output)

    palette = Palette(grid(), held_out=True)
    generator = Generator().manual_seed(1)
    lamp = (torch.rand(2000, generator=generator) * len(palette.lamp)).long()
    spectra = palette.natural(lamp, generator).double()
    beyond = spectra - spectra @ prior.basis @ prior.basis.T
    story = model.provenance | {
        "seconds": seconds,
        "threads": torch.get_num_threads(),
        "device": options.device,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "not held of spectra kept aside, rms": float(beyond.norm() / spectra.norm()),
    }
    if options.output == WEIGHTS:
        RESULTS.write_text(json.dumps(story, indent=1) + "\n")
    print(f"{options.output}: {story}")


if __name__ == "__main__":
    main()
