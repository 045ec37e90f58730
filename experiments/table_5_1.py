"""Table 5.1: the error of every network after every training noise, on the chart at 20 dB.

    python experiments/table_5_1.py --epochs 50                 # the thesis' recipe, on the CPU
    python experiments/table_5_1.py --prior broad             # the broader prior instead
    python experiments/table_5_1.py --render                    # only the tables, from what exists

Each cell (network, noise, prior, seed, epochs) is trained on its own and kept as one JSON file in
experiments/results/table_5_1. Finished cells are never trained again; an interrupted one goes on
from its checkpoint. Several processes may run at once (`--jobs`, or simply start it again): each
takes the next cell that nobody holds.

The recipe is the thesis': 8 000 sums of Gaussians, one set, batches of 1024, Adam at 1e-4, one
sensitivity for the whole field, and 500 epochs, unless --epochs says otherwise.
"""

import argparse
import fcntl
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from thesis import NETWORKS, RESULTS, WORK, camera, capture, judge, machine, one_matrix, picture
from thesis import write_json as write

import squilla
from squilla.cli.train import parse_noise
from squilla.files.disk import replacing

CELLS = RESULTS / "table_5_1"
NOISES = ("none", "20", "15:20", "10:20", "15", "25", "30", "10:25", "15:25")
"""What most wants to be known comes first."""

SOLVERS = {"ridge": "ridge", "sparse": "sparse recovery"}


@dataclass(frozen=True)
class Cell:
    """One number of the table; a solver has only a model."""

    model: str
    noise: str = ""
    prior: str = ""
    epochs: int = 0
    seed: int = 0

    @property
    def name(self) -> str:
        if not self.noise:
            return self.model
        noise = self.noise.replace(":", "-")
        return f"{self.model}_{noise}_{self.prior}_{self.epochs}e_{self.seed}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Table 5.1 of the thesis.")
    parser.add_argument("--networks", default="mlp,cnn,respecnn,rescnn")
    parser.add_argument("--noise", default=",".join(NOISES))
    parser.add_argument("--prior", default="gaussian", help="gaussian (the thesis) or broad")
    parser.add_argument("--epochs", type=int, default=50, help="the thesis: 500")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--bf16", action="store_true", help="products in bfloat16")
    parser.add_argument("--pictures", action="store_true", help="reconstruct the whole chart too")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the work")
    parser.add_argument("--render", action="store_true", help="only write the tables")
    options = parser.parse_args()

    if not options.render:
        one, chart = one_matrix(camera()), capture("chart")
        others = [
            subprocess.Popen([sys.executable, *sys.argv, "--jobs", "1"])
            for _ in range(options.jobs - 1)
        ]
        for cell in wanted(options):
            with claimed(cell) as free:
                if free:
                    run(cell, one, chart, options)
        for other in others:
            other.wait()


def wanted(options: argparse.Namespace) -> Iterator[Cell]:
    """Yield the cells in the order in which they are worth having."""
    yield from map(Cell, SOLVERS)
    for seed in range(options.seeds):
        for noise in options.noise.split(","):
            for network in options.networks.split(","):
                yield Cell(network, noise, options.prior, options.epochs, seed)


@contextmanager
def claimed(cell: Cell) -> Iterator[bool]:
    """Hold a cell, and say whether it is free and still to do; a killed process lets go of it."""
    with open(WORK / f"{cell.name}.lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield not (CELLS / f"{cell.name}.json").exists()


def run(cell: Cell, calibration, chart, options: argparse.Namespace) -> None:
    """Train, judge and keep one cell."""
    began = time.perf_counter()
    record = asdict(cell) | machine(options.device)
    if not cell.noise:
        model = squilla.load_model(cell.model, calibration)
    else:
        log, checkpoint = (WORK / f"{cell.name}.{end}" for end in ("jsonl", "checkpoint"))
        model = squilla.train(
            cell.model,
            calibration,
            noise=parse_noise(cell.noise),
            spectra=cell.prior,
            fresh=cell.prior != "gaussian",
            epochs=cell.epochs,
            seed=cell.seed,
            device=options.device,
            precision="bfloat16" if options.bf16 else "float32",
            log=log,
            checkpoint=checkpoint,
            progress=False,
        )
        epochs = [json.loads(line) for line in log.read_text().splitlines()]
        record |= {
            "precision": model.provenance["precision"],
            "seconds": round(sum(epoch["seconds"] for epoch in epochs), 1),
            "loss": epochs[-1]["loss"],
            "validation": epochs[-1]["validation"],
        }
        model.save(WORK / f"{cell.name}.safetensors", half=True)
        model.to(options.device)
    if options.pictures:
        with replacing(WORK / f"{cell.name}.npz") as temporary, open(temporary, "wb") as file:
            bands = picture(model, chart, options.device).astype(np.float16)
            np.savez_compressed(file, bands=bands)
    device = options.device if cell.noise else "cpu"
    write(CELLS / f"{cell.name}.json", record | judge(model, chart, device))
    if cell.noise:
        checkpoint.unlink(missing_ok=True)
    print(f"{cell.name}: {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
