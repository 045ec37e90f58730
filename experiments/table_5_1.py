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
from thesis import (
    NETWORKS,
    RESULTS,
    WORK,
    Capture,
    camera,
    capture,
    embed,
    judge,
    keep_picture,
    machine,
    one_matrix,
    picture,
    quality,
    table,
    write_json,
)

import squilla
from squilla.calibration.calibration import Calibration
from squilla.cli.train import parse_noise

CELLS = RESULTS / "table_5_1"
NOISES = ("none", "20", "15:20", "10:20", "15", "25", "30", "10:25", "15:25")
"""What most wants to be known comes first."""

PRIORS = {"gaussian": "Gaussians alone, as the thesis", "broad": "Broad prior"}

READY = {
    "ridge": "ridge, which knows the broad prior's second moment",
    "sparse": "sparse recovery",
    "mlp": "BEST MLP as it ships: broad prior, 5–40 dB, 150 epochs of 32 768 new spectra, cosine",
}
"""What needs no training here."""

PUBLISHED = {
    "none": {"cnn": 0.22742, "rescnn": 0.15252, "unet": 0.02924, "respecnn": 0.01532},
    "15": {"cnn": 0.01867, "rescnn": 0.06079, "unet": 0.01776, "respecnn": 0.0096},
    "20": {"cnn": 0.01284, "rescnn": 0.02989, "unet": 0.01427, "respecnn": 0.00994},
    "25": {"cnn": 0.01875, "rescnn": 0.0341, "unet": 0.01493, "respecnn": 0.00878},
    "30": {"cnn": 0.02517, "rescnn": 0.03482, "unet": 0.01343, "respecnn": 0.0117},
    "10:20": {"cnn": 0.00904, "rescnn": 0.03396, "unet": 0.00823, "respecnn": 0.00685},
    "10:25": {"cnn": 0.01138, "rescnn": 0.02897, "unet": 0.0073, "respecnn": 0.00878},
    "15:20": {"cnn": 0.01505, "rescnn": 0.0327, "unet": 0.01373, "respecnn": 0.00658},
    "15:25": {"cnn": 0.01158, "rescnn": 0.03242, "unet": 0.00983, "respecnn": 0.00733},
}
"""The thesis' table 5.1: real captures with its own camera, never mixed with ours."""

PLACES = {
    "patch": "patch means",
    "averaged": "mean measurement",
    "single": "single pixels",
    "model": "20 dB of model error",
}
"""Errors as `judge` takes them."""

KINDS = {
    "none": ("none",),
    "fixed": ("15", "20", "25", "30"),
    "uniform": ("10:20", "10:25", "15:20", "15:25"),
}


@dataclass(frozen=True)
class Cell:
    """One number of the table; what needs no training has only a model."""

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
    render()


def wanted(options: argparse.Namespace) -> Iterator[Cell]:
    """Yield the cells in the order in which they are worth having."""
    yield from map(Cell, READY)
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


def run(cell: Cell, calibration: Calibration, chart: Capture, options: argparse.Namespace) -> None:
    """Train, judge and keep one cell."""
    began = time.perf_counter()
    record = asdict(cell)
    if not cell.noise:
        model = squilla.load_model(cell.model, calibration)
        record |= {"quality": quality(chart, calibration)}
    else:
        weights, log = (WORK / f"{cell.name}.{end}" for end in ("safetensors", "jsonl"))
        if not weights.exists():
            train(cell, calibration, weights, log, options)
        model = squilla.load_model(weights, calibration).to(options.device)
        epochs = [json.loads(line) for line in log.read_text().splitlines()]
        record |= {key: model.provenance[key] for key in ("device", "load", "precision")}
        record |= {
            "seconds": round(sum(epoch["seconds"] for epoch in epochs), 1),
            "loss": epochs[-1]["loss"],
            "validation": epochs[-1]["validation"],
        }
    if options.pictures:
        keep_picture(f"{cell.name}_chart", picture(model, chart, options.device))
    device = options.device if cell.noise else "cpu"
    write_json(CELLS / f"{cell.name}.json", record | judge(model, chart, device))
    print(f"{cell.name}: {time.perf_counter() - began:.0f} s", flush=True)


def train(
    cell: Cell, calibration: Calibration, weights: Path, log: Path, options: argparse.Namespace
) -> None:
    """Train a network, or go on training it, and write its weights."""
    checkpoint = WORK / f"{cell.name}.checkpoint"
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
    model.provenance |= machine(options.device)
    model.save(weights)
    checkpoint.unlink()


# --- the tables ---------------------------------------------------------------------------------


def render() -> None:
    """Write every table that the finished cells allow."""
    cells = [json.loads(path.read_text()) for path in sorted(CELLS.glob("*.json"))]
    trained = [cell for cell in cells if cell["noise"]]
    recipes = sorted({(cell["prior"], cell["epochs"]) for cell in trained}, reverse=True)
    parts = []
    for prior, epochs in recipes:
        some = [cell for cell in trained if (cell["prior"], cell["epochs"]) == (prior, epochs)]
        parts.append(f"**{PRIORS[prior]}, {epochs} epochs**\n\n{recipe_table(some)}")
    embed("table_5_1", "\n\n".join(parts))
    embed("table_5_1_ready", ready_table([cell for cell in cells if not cell["noise"]]))
    embed("table_5_1_kinds", kinds_table(trained, recipes))
    embed("table_5_1_priors", priors_table(trained))


def errors(cells: list[dict], network: str, noise: str, place: str = "patch") -> list[float]:
    """Return the errors of a network, one for each seed; `place` as in `judge`."""
    chosen = [cell for cell in cells if (cell["model"], cell["noise"]) == (network, noise)]
    return [cell["mse"][place] for cell in chosen]


def shown(values: list[float]) -> str:
    """Return the mean, and with several seeds their number and half their range."""
    if not values:
        return "–"
    half = (max(values) - min(values)) / 2
    spread = f" ± {half:.4f} ({len(values)})" if len(values) > 1 else ""
    return f"{np.mean(values):.4f}{spread}"


def recipe_table(cells: list[dict]) -> str:
    """Return the tables of one prior and number of epochs.

    The published figures stand beside those of the thesis' prior.
    """
    networks = [name for name in NETWORKS if any(cell["model"] == name for cell in cells)]
    beside = PUBLISHED if cells[0]["prior"] == "gaussian" else {noise: {} for noise in PUBLISHED}
    parts = []
    for place, name in PLACES.items():
        head = [f"{name}: noise (dB)"]
        for network in networks:
            head += [NETWORKS[network]] + ["*thesis*"] * (network in beside["none"])
        rows = []
        for noise, published in beside.items():
            row = [noise.replace(":", "–")]
            for network in networks:
                row.append(shown(errors(cells, network, noise, place)))
                row += [f"*{published[network]:.4f}*"] if network in published else []
            if set(row[1:]) != {"–"}:
                rows.append(row)
        parts.append(table(head, rows))
    return "\n\n".join(parts)


def ready_table(cells: list[dict]) -> str:
    """Return the errors of the methods without training, and how good the measurement is."""
    rows = [
        [READY[cell["model"]], *(f"{cell['mse'][place]:.4f}" for place in PLACES)] for cell in cells
    ]
    quality = cells[0]["quality"]
    note = (
        f"Single pixels of the patches scatter at {quality['noise']:.0f} dB (median of the "
        f"patches); the means of 100 of them agree with R times the true spectrum to "
        f"{quality['mean']:.0f} dB."
    )
    return f"{table(['', *PLACES.values()], rows)}\n\n{note}"


def kinds_table(cells: list[dict], recipes: list[tuple[str, int]]) -> str:
    """Return the mean error of each kind of noise, over the settings that are finished."""
    rows = []
    for network in NETWORKS:
        if network in PUBLISHED["none"]:
            means = {
                kind: [PUBLISHED[noise][network] for noise in noises]
                for kind, noises in KINDS.items()
            }
            rows.append([NETWORKS[network], "*thesis, 500 epochs*", "", *_verdict(means)])
        for prior, epochs in recipes:
            some = [c for c in cells if (c["prior"], c["epochs"]) == (prior, epochs)]
            for place, name in PLACES.items():
                means = {
                    kind: [
                        float(np.mean(each))
                        for each in (errors(some, network, noise, place) for noise in noises)
                        if each
                    ]
                    for kind, noises in KINDS.items()
                }
                if all(means.values()):
                    recipe = f"{prior}, {epochs} epochs"
                    rows.append([NETWORKS[network], recipe, name, *_verdict(means)])
    head = ["network", "recipe", "", "none", "fixed", "uniform", "fixed < none", "uniform < fixed"]
    return table(head, rows)


def _verdict(means: dict[str, list[float]]) -> list[str]:
    none, fixed, uniform = (float(np.mean(values)) for values in means.values())
    counts = [f" ({len(values)})" if len(values) > 1 else "" for values in means.values()]
    numbers = [
        f"{mean:.4f}{count}" for mean, count in zip((none, fixed, uniform), counts, strict=True)
    ]
    return [*numbers, "yes" if fixed < none else "no", "yes" if uniform < fixed else "no"]


def priors_table(cells: list[dict]) -> str:
    """Return the thesis' prior beside the broader one, wherever both are finished."""
    rows = []
    for network in NETWORKS:
        for noise in PUBLISHED:
            for epochs in sorted({cell["epochs"] for cell in cells}):
                pair = [
                    [c for c in cells if (c["prior"], c["epochs"]) == (prior, epochs)]
                    for prior in ("gaussian", "broad")
                ]
                found = [
                    shown(errors(some, network, noise, place)) for place in PLACES for some in pair
                ]
                if "–" not in found:
                    rows.append([NETWORKS[network], noise.replace(":", "–"), str(epochs), *found])
    head = ["network", "noise (dB)", "epochs"]
    for name in PLACES.values():
        head += [f"{name}: Gaussians", "broad"]
    return table(head, rows)


if __name__ == "__main__":
    main()
