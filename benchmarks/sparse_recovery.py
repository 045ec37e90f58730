"""Sparse recovery of one image, beside scikit-learn's Lasso in a loop and TwIST.

All solve the same problems: 36 broadband filters, 339 atoms, 20 dB. scikit-learn and TwIST are
timed on a few hundred pixels of the image and stated per pixel. Writes
experiments/results/sparse.json.
"""

import json
import os
import warnings
from pathlib import Path

import numpy as np
import torch
from sklearn.linear_model import Lasso
from timing import seconds

from squilla.calibration.calibration import Calibration
from squilla.priors import broad_spectra
from squilla.reconstruction.sparse import Sparse, two_step
from squilla.spectra import grid
from squilla.training.noise import add_noise

SIDE = 250
SAMPLE = 300
RESULT = Path(__file__).parent.parent / "experiments" / "results" / "sparse.json"


def main() -> None:
    threads = int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1))
    torch.set_num_threads(threads)
    calibration = broadband_camera()
    generator = torch.Generator().manual_seed(0)
    spectra = broad_spectra(SIDE**2, calibration.wavelength, generator=generator)
    y = add_noise(calibration.project(spectra), 20, generator).reshape(SIDE, SIDE, -1)
    model = Sparse(calibration)
    matrix = model.rows[-1]
    pixels = y.reshape(SIDE**2, -1)[:SAMPLE]
    heights, gap = model.heights(pixels)
    target = pixels.double().numpy()
    ratio = float(model.ratio(None, 1)[0])
    weight = ratio * (target @ matrix).max(-1)

    def objective(heights: np.ndarray) -> np.ndarray:
        rest = target - heights @ matrix.T
        return np.square(rest).sum(-1) / 2 + weight * heights.sum(-1)

    lowest = objective(heights.numpy())
    print(f"{threads} threads, {SIDE} x {SIDE} pixels, {len(model.atoms)} atoms, {ratio:.1e}")
    print("| solver | us/pixel | one image, s | above the minimum, median | worst |")
    print("|---|---|---|---|---|")
    worst = float(model.heights(y.reshape(SIDE**2, -1))[1].max())
    own = seconds(lambda: model(y)) / SIDE**2
    row("squilla sparse", own, gap.numpy())
    lasso_time = {}
    for tolerance in (1e-2, 1e-4):
        found = np.empty_like(heights.numpy())

        def loop(tolerance: float = tolerance, found: np.ndarray = found) -> None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # it stops at max_iter for some pixels
                for index, (one, alpha) in enumerate(zip(target, weight / 36, strict=True)):
                    lasso = Lasso(alpha=alpha, positive=True, fit_intercept=False, tol=tolerance)
                    found[index] = lasso.fit(matrix, one).coef_

        lasso_time[tolerance] = seconds(loop, 1) / SAMPLE
        row(f"scikit-learn Lasso, tol {tolerance:g}", lasso_time[tolerance],
            objective(found) / lowest - 1)  # fmt: skip
    two = two_step(torch.from_numpy(matrix), pixels, ratio, 1e-2)[0].numpy()
    time_two = seconds(lambda: two_step(torch.from_numpy(matrix), pixels, ratio, 1e-2), 1)
    row("TwIST, to a gap of 1 %", time_two / SAMPLE, objective(two) / lowest - 1)
    print(f"scikit-learn (tol 1e-4) / squilla: {lasso_time[1e-4] / own:.0f}")
    print(f"largest relative duality gap of the image: {worst:.1e}")
    found = {
        "threads": threads,
        "load": round(os.getloadavg()[0], 1),
        "atoms": len(model.atoms),
        "seconds": own * SIDE**2,
        "largest_gap": worst,
        "scikit_learn_seconds": lasso_time[1e-4] * SIDE**2,
        "twist_seconds": time_two / SAMPLE * SIDE**2,
    }
    RESULT.write_text(json.dumps(found, indent=2) + "\n")


def row(name: str, each: float, excess: np.ndarray) -> None:
    print(
        f"| {name} | {1e6 * each:.1f} | {each * SIDE**2:.2f} "
        f"| {np.median(excess):.1e} | {excess.max():.1e} |"
    )


def broadband_camera() -> Calibration:
    """Return 36 random smooth filters: sums of sinusoids in 1/wavelength, as thin films have."""
    random = np.random.default_rng(0)
    wavelength = grid()
    position = (1 / wavelength - 1 / 750) / (1 / 500 - 1 / 750)
    order = random.uniform(0.3, 10, (36, 6, 1))
    wave = np.cos(2 * np.pi * (order * position + random.uniform(size=order.shape)))
    return Calibration.from_sensitivity(0.5 + 0.45 * wave.mean(1), wavelength)


if __name__ == "__main__":
    main()
