"""How long `compound` takes from the measurement to the whole cube, beside other methods.

    OMP_NUM_THREADS=2 python benchmarks/compound.py

One picture of 250 x 250 x 36 to 250 x 250 x 251, float32; medians after warm-up. `floor` is one
product of the coefficients with the basis and its clipping: what any network with 64 coefficients
must do at last.
"""

import os
import statistics
import time
from collections.abc import Callable

import torch

from squilla.calibration.calibration import Calibration
from squilla.optics.filters import StencilRecipe
from squilla.reconstruction.reconstructor import load_model
from squilla.spectra import grid

SIDE = 250
REPEATS = 15


def main() -> None:
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)))
    angle = torch.linspace(0, 0.162, 5).numpy()
    response = StencilRecipe().draw(0).transmittance(grid(), angle).numpy()
    flat = Calibration.from_sensitivity(response[0], grid())
    tilted = Calibration.from_sensitivity(response, grid(), angle)
    y = flat.project(torch.rand(SIDE, SIDE, 251, generator=torch.Generator().manual_seed(0)))
    field = torch.linspace(0, 0.16, SIDE).expand(SIDE, SIDE).contiguous()
    coefficients, basis = torch.rand(SIDE * SIDE, 64), torch.rand(64, 251)
    print(f"{torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}")
    print("| method | ms | least |")
    print("|---|---|---|")
    with torch.inference_mode():
        row("floor", lambda: (coefficients @ basis).relu_())
        for name in ("compound", "ridge"):
            model, angular = load_model(name, flat), load_model(name, tilted)
            row(name, lambda model=model: model(y, snr=25.0))
            row(f"{name}, by field angle", lambda model=angular: model(y, field, 25.0))


def row(name: str, function: Callable[[], object]) -> None:
    """Print the median and the least time of a call, ms."""
    for _ in range(3):
        function()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        function()
        times.append(1000 * (time.perf_counter() - start))
    print(f"| {name} | {statistics.median(times):.0f} | {min(times):.0f} |", flush=True)


if __name__ == "__main__":
    main()
