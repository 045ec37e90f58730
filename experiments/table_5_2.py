"""Table 5.2: the time of one image, 250 x 250 pixels, 251 bands, by every method.

    python experiments/table_5_2.py                      # on the CPU, with as many threads as given
    python experiments/table_5_2.py --device cuda
    python experiments/table_5_2.py --render             # only the table, from what exists

Every method runs pixel by pixel, as the seconds of the thesis suggest that it did, and batched.
What would take too long runs on some of the pixels and is scaled up; the number of pixels is kept.
On a GPU the way there and back is counted. Weights do not matter for time and are random. One JSON
for each cell in experiments/results/table_5_2; delete one to have it measured again.
"""

import argparse
import json
import statistics
import time
import warnings
from collections.abc import Callable

import torch
from thesis import NETWORKS, RESULTS, camera, capture, embed, machine, one_matrix, table, write_json
from torch import Tensor

import squilla
from squilla.calibration.calibration import Calibration
from squilla.reconstruction.models import model_class

CELLS = RESULTS / "table_5_2"
IMAGE = 250 * 250

PUBLISHED = {
    "lasso": (450, None),
    "cnn": (87, 0.44),
    "rescnn": (125, 0.28),
    "unet": (123, 5.79),
    "respecnn": (27, 0.18),
}
"""Seconds in the thesis: an 8-core desktop CPU, and a TITAN RTX."""

METHODS = {
    "lasso": "sparse recovery, scikit-learn",
    "twist": "sparse recovery, TwIST (gap 1 %)",
    "sparse": "sparse recovery, active set",
    "ridge": "ridge",
    **NETWORKS,
}
WAYS = ("pixel", "batch", "bfloat16")

BATCHED = {"twist": 300, "unet": 512}
"""Pixels to time where the whole image would take many minutes on a CPU."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Table 5.2 of the thesis.")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--render", action="store_true", help="only write the table")
    options = parser.parse_args()
    if not options.render:
        measure(options.methods.split(","), options.device)
    render()


def measure(methods: list[str], device: str) -> None:
    calibration, y = one_matrix(camera()), capture("chart").y.flatten(0, 1)
    y = y[torch.randperm(IMAGE, generator=torch.Generator().manual_seed(0))]
    for method in methods:
        for way in WAYS:
            path = CELLS / f"{method}_{way}_{device}.json"
            done = None if path.exists() else seconds(method, way, device, calibration, y)
            if done is not None:
                cell = {"method": method, "way": way, "kind": device} | machine(device) | done
                write_json(path, cell)
                print(f"{method} {way} {device}: {done['seconds']:.3g} s", flush=True)


def seconds(method: str, way: str, device: str, calibration: Calibration, y: Tensor) -> dict | None:
    """Return the seconds of one image, and on how many pixels they were measured."""
    network = method in NETWORKS
    if (not network and device != "cpu") or (not network and way == "bfloat16"):
        return None
    if method == "lasso":
        return per_image(lasso(calibration, y), 60, 1) if way == "pixel" else None
    if method == "twist" and way == "pixel":
        return None
    model = model_class(method)(calibration).eval().to(device)

    @torch.inference_mode()
    def run(count: int) -> None:
        if way == "pixel":
            for pixel in y[:count]:
                model(pixel.to(device)).cpu()
        else:
            with torch.autocast(device, torch.bfloat16, enabled=way == "bfloat16"):
                model(y[:count].to(device)).cpu()

    if way == "pixel":
        return per_image(run, 50 if method == "unet" else 500, 3)
    return per_image(run, BATCHED.get(method, IMAGE) if device == "cpu" else IMAGE, 3)


def per_image(run: Callable[[int], None], count: int, repeats: int) -> dict:
    """Return the median time of `run(count)` after a shorter run that warms up, for one image."""
    run(min(count, 64))
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run(count)
        times.append(time.perf_counter() - began)
    return {"seconds": statistics.median(times) * IMAGE / count, "pixels": count}


def lasso(calibration: Calibration, y: Tensor) -> Callable[[int], None]:
    """Return what a user without this package would write for the problem of `sparse`."""
    from sklearn.linear_model import Lasso

    sparse = squilla.load_model("sparse", calibration)
    matrix, ratio = sparse.rows[-1], float(sparse.ratio(None, 1)[0])
    target = (y / y.amax(-1, keepdim=True)).double().numpy()
    weight = ratio * (target @ matrix).max(-1) / matrix.shape[0]

    def run(count: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it stops at max_iter for some pixels
            for pixel, alpha in zip(target[:count], weight, strict=False):
                one = Lasso(alpha=alpha, positive=True, fit_intercept=False, tol=1e-4)
                one.fit(matrix, pixel).coef_ @ sparse.atoms

    return run


def render() -> None:
    cells = [json.loads(path.read_text()) for path in sorted(CELLS.glob("*.json"))]
    found = {(cell["method"], cell["way"], cell["kind"]): cell for cell in cells}
    kinds = [kind for kind in ("cpu", "cuda") if any(cell["kind"] == kind for cell in cells)]
    head = ["method", "*thesis: 8-core CPU*", "*TITAN RTX*"]
    head += [
        f"{way}, {kind}" for kind in kinds for way in ("pixel by pixel", "batched", "bfloat16")
    ]
    rows = []
    for method, name in METHODS.items():
        row = [name, *(f"*{each}*" if each else "" for each in PUBLISHED.get(method, ("", "")))]
        for kind in kinds:
            for way in WAYS:
                cell = found.get((method, way, kind))
                part = "" if cell is None or cell["pixels"] == IMAGE else "~"
                row.append("" if cell is None else f"{part}{cell['seconds']:.3g}")
        rows.append(row)
    on = sorted({f"{cell['device']}" for cell in cells})
    loads = [cell["load"] for cell in cells if "load" in cell]
    busy = f" The load average was {min(loads):g} to {max(loads):g}." if loads else ""
    note = f"Seconds; ~ measured on some of the pixels. On {'; '.join(on)}.{busy}"
    embed("table_5_2", f"{table(head, rows)}\n\n{note}")


if __name__ == "__main__":
    main()
