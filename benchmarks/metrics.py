"""Time the judgement of one 250 x 250 x 251 cube beside scikit-image and SPy.

Usage: python benchmarks/metrics.py
"""

import numpy as np
import spectral
from skimage.metrics import structural_similarity
from timing import seconds

from squilla.camera.scenes import chart_scene
from squilla.evaluation.metrics import evaluate, sam, ssim


def main() -> None:
    truth = chart_scene().values
    noise = np.random.default_rng(0).standard_normal(truth.shape, dtype=np.float32)
    estimate = truth + 0.02 * noise

    def scikit_ssim():
        for x, y in zip(np.moveaxis(estimate, -1, 0), np.moveaxis(truth, -1, 0), strict=True):
            structural_similarity(y, x, data_range=float(y.max()))

    def spy_angles():  # SPy compares a cube with given spectra, not with another cube
        spectral.spectral_angles(estimate, truth[125, 125][None])

    rows = {
        "evaluate, all of it": lambda: evaluate(estimate, truth),
        "ssim": lambda: ssim(estimate, truth),
        "  scikit-image, band by band": scikit_ssim,
        "sam": lambda: sam(estimate, truth),
        "  SPy, one reference spectrum": spy_angles,
    }
    print("one cube of 250 x 250 x 251; median of 3, s\n")
    for name, call in rows.items():
        print(f"{name:32}{seconds(call, 3):8.3f}")


if __name__ == "__main__":
    main()
