"""How long it takes from a measurement, or a raw frame, to spectra, beside what it must take.

    OMP_NUM_THREADS=2 python benchmarks/speed.py [--camera camera.nc] [--network] [--only TEXT]

A picture of 250 x 250 pixels, 36 channels, becomes 250 x 250 x 251 float32. `wall` is the median
and the least after warm-up, `cpu` the least processor time of all threads, which other programs on
the machine hardly move. Rows are run by turns, so that a busy moment hurts all alike.

Floors: the products that a row needs, in float32 at the rate that BLAS reaches here in this run on
large matrices, or writing its result once into memory that is there already; the larger counts.
--camera adds the way from a raw frame of 12 megapixels (a calibration of the thesis' camera, as
`squilla rehearse` and `calibrate` make it); --network adds the parameter-matched ReSpecNN, half a
minute a run. Writes experiments/results/speed.json.
"""

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.camera.scenes import load_scene
from squilla.optics.filters import StencilRecipe
from squilla.reconstruction.models import load_model, model_class
from squilla.spectra import grid
from squilla.training.noise import add_noise

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "speed.json"
PIXELS, BANDS = 250 * 250, 251
RESPECNN = 10.3e6
"""Multiply-adds of ReSpecNN for a pixel."""

BATCH = 4096
"""Pixels that a user of PyTorch may give a network at once; squilla's pieces fit the caches."""


def cameras() -> tuple[Calibration, Calibration]:
    """Return a camera with one field angle, and the same with five."""
    angle = np.linspace(0, 0.162, 5)
    response = StencilRecipe().draw(0).transmittance(grid(), angle).numpy()
    return (
        Calibration.from_sensitivity(response[0], grid()),
        Calibration.from_sensitivity(response, grid(), angle),
    )


def measured(calibration: Calibration) -> Measurement:
    """Return the chart as a camera measures it at 25 dB."""
    truth = torch.from_numpy(load_scene("chart", grid()).values)
    y = add_noise(calibration.project(truth), 25.0, torch.Generator().manual_seed(0))
    field = torch.linspace(0, 0.16, 250).expand(250, 250).contiguous()
    valid = torch.ones(y.shape, dtype=torch.bool)
    return Measurement(y, valid, field, torch.zeros(250, 250), torch.full((250, 250), 25.0))


def compound_products(model) -> float:
    """Return the multiply-adds that `compound` needs for a picture."""
    total = PIXELS * 36 * 33 + PIXELS / 2 * 36 * 18  # projections, and the noise
    total += PIXELS * 32 * (32 + 16) + PIXELS / 4 * 32 * (32 + 32)  # linear estimates
    learnt, pieces = model.prior.learnt, len(model.prior.share) - model.prior.learnt
    # The mixture, one cluster taken up, and how near the pieces of the sheet of lines are.
    total += PIXELS / 16 * (32 * (32 * learnt + pieces) + 32 * 64)
    # Spectra at 2 px, mixed from four, changed in 16 coefficients.
    return total + PIXELS / 4 * 64 * BANDS + PIXELS * (4 + 16) * BANDS


def rate() -> float:
    """Return the multiply-adds a second of BLAS on large float32 matrices."""
    a, b = np.ones((2048, 2048), np.float32), np.ones((2048, 2048), np.float32)
    return 2048**3 / min(clocked(lambda: a @ b)[0] for _ in range(6))


def clocked(function: Callable[[], object]) -> tuple[float, float]:
    """Return seconds of wall and of processor time."""
    wall, cpu = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - cpu


def rows(options: argparse.Namespace) -> dict[str, tuple[Callable[[], object], float, float]]:
    """Return what is run, its multiply-adds and the bytes of its result, by name."""
    flat, tilted = cameras()
    whole = PIXELS * BANDS * 4
    seen = measured(flat)
    model, angular = load_model("compound", flat), load_model("compound", tilted)
    products = compound_products(model)
    fewer = products - PIXELS / 4 * 64 * BANDS - PIXELS * 20 * BANDS
    colours = np.random.default_rng(0).random((BANDS, 3))
    few = list(range(100))
    result = {
        "compound": (lambda: model.reconstruct(seen), products, whole),
        "compound by field angle": (lambda: angular.reconstruct(seen), products, whole),
        "only three bands": (lambda: model.look(seen).bands([50, 125, 200]), fewer, PIXELS * 12.0),
        "only a colour": (lambda: model.look(seen).mixed(colours), fewer, PIXELS * 12.0),
        "only 100 spectra": (lambda: model.look(seen).spectra(few, few), fewer, BANDS * 400.0),
    }
    if options.camera:
        result |= from_raw(options.camera, products, whole)
    ridge = load_model("ridge", flat)
    result["ridge"] = lambda: ridge.reconstruct(seen), PIXELS * 36 * (36 + BANDS), whole
    if options.network:
        torch.manual_seed(0)
        plain = model_class("respecnn")(flat).eval().for_engines()
        inputs = seen.y.flatten(0, 1) / seen.y.flatten(0, 1).amax(-1, keepdim=True)

        @torch.inference_mode()
        def batches() -> None:
            torch.cat([plain(batch) for batch in inputs.split(BATCH)])

        result[f"respecnn, plain PyTorch, {BATCH} pixels at once"] = (
            batches, PIXELS * RESPECNN, whole,
        )  # fmt: skip
        for engine in ["torch", *(["openvino", "openvino-bf16"] if find_spec("openvino") else [])]:
            network = model_class("respecnn")(flat).eval().with_engine(engine)
            print(f"respecnn, {engine}: {network.provenance['engine_error']:.1e} from torch")
            result[f"respecnn, {engine}"] = (
                lambda network=network: network.reconstruct(seen),
                PIXELS * RESPECNN,
                whole,
            )
    return result


def from_raw(path: Path, products: float, whole: float):
    """Return the rows that begin with a raw frame."""
    import squilla
    from squilla.camera.twin import Camera

    calibration = squilla.load_calibration(path)
    generator = torch.Generator().manual_seed(0)
    raw = Camera("thesis").capture(load_scene("chart", grid()), snr=30, generator=generator)
    model = load_model("compound", calibration)
    before = squilla.measure(raw, calibration)

    def live() -> None:
        model.reconstruct(squilla.measure(raw, calibration, start=before))

    return {
        "raw frame to cube": (
            lambda: model.reconstruct(squilla.measure(raw, calibration)), products, whole,
        ),
        "raw frame to cube, one before known": (live, products, whole),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed beside its floors.")
    parser.add_argument("--camera", type=Path, help="calibration of the thesis' camera")
    parser.add_argument("--network", action="store_true", help="ReSpecNN too")
    parser.add_argument("--only", default="", help="rows whose name holds this text")
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    threads = int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1))
    torch.set_num_threads(threads)
    chosen = {name: row for name, row in rows(options).items() if options.only in name}
    speed, new = rate(), np.empty(PIXELS * BANDS, np.float32)
    writing = min(clocked(lambda: new.fill(1))[0] for _ in range(6))
    load = os.getloadavg()[0]
    print(f"{threads} threads, load {load:.1f}, {2e-9 * speed:.0f} GFLOP/s float32, the cube")
    print(f"written in {1000 * writing:.1f} ms")
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in chosen}
    for turn in range(options.repeats + 1):
        for name, (function, _, _) in chosen.items():
            if name.startswith("respecnn") and turn > 1:
                continue
            once = clocked(function)
            if turn > 0 or name.startswith("respecnn"):
                times[name].append(once)
    print("| row | median ms | least ms | least cpu ms | floor: products | floor: bytes |")
    print("|---" * 6 + "|")
    table = []
    for name, (_, products, size) in chosen.items():
        wall, cpu = zip(*times[name], strict=True)
        row = {
            "row": name,
            "median": statistics.median(wall),
            "least": min(wall),
            "cpu": min(cpu),
            "floor_products": products / speed,
            "floor_bytes": writing * size / (PIXELS * BANDS * 4),
        }
        table.append(row)
        print(
            "| " + " | ".join([name, *(f"{1000 * row[key]:.1f}" for key in list(row)[1:])]) + " |"
        )
    told = {"threads": threads, "load": load, "machine": platform.machine()}
    told |= {"multiply_adds_per_second": speed, "seconds": table}
    names = {row["row"] for row in table}
    before = json.loads(RESULTS.read_text())["seconds"] if RESULTS.exists() else []
    told["seconds"] = [row for row in before if row["row"] not in names] + table
    RESULTS.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
