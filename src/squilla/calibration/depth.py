"""Depth for every pixel: planes swept through all sub-images at once.

The array is rigid, so the 35 disparities of a point are one number, its inverse depth, times the
calibrated baselines. Planes of inverse depth are swept through the scene; at each the gradients of
all sub-images are laid over each other. Where the plane is right they add up, where it is wrong they
scatter; that needs no two filters to see the same brightness.
"""

from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

from squilla.calibration.alignment import SubImages, align
from squilla.calibration.calibration import Lattice
from squilla.calibration.disparity import gradients

_STEP = 0.45
"""Shift of the farthest unit from one plane to the next, px: a third of the features' width."""

_SMOOTH = 1.2
"""Standard deviation of the smoothing before the gradient, px."""

_WINDOW = 1.0
"""Standard deviation of the window over which evidence is gathered, px."""

_HALF = 0.06
"""What it costs to believe one half of the array alone, as a share of unexplained energy."""

_SLANT, _JUMP = 0.05, 1.0
"""Costs of a step by one plane and of a jump, in units of the typical spread of the evidence."""


@dataclass(frozen=True)
class Depth:
    """What the sweep found for every point of the reference view.

    disparity : (H, W) float32, px per lens pitch.
    deviation : (H, W) float32, expected standard deviation of it by the noise, px per lens pitch.
    seen : (H, W, M) bool; False where something nearer hides the point from a unit.
    """

    disparity: np.ndarray
    deviation: np.ndarray
    seen: np.ndarray


def find_depth(
    views: SubImages, lattice: Lattice, noise: np.ndarray, nearest: float, farthest: float = 0.0
) -> Depth:
    """Find the disparity of every point of the reference view.

    Parameters
    ----------
    views : SubImages
        With a margin that holds the shifts of the nearest plane.
    lattice : Lattice
    noise : array, (M,)
        Variance of each sub-image's noise, DN^2.
    nearest, farthest : float
        Largest and smallest disparity looked for, px per lens pitch.

    Returns
    -------
    Depth

    Notes
    -----
    Sources: R. Collins, "A space-sweep approach to true multi-image matching" (CVPR 1996), for the
    sweep; H. Hirschmueller, "Stereo processing by semiglobal matching" (PAMI 30, 2008), for the
    smoothing of the evidence; D. Min et al., "Fast global image smoothing" (TIP 23, 2014), for the
    filling.
    """
    image = views.image.numpy()
    reach = float(np.abs(lattice.baseline).max())
    count = 1 + max(4, int(np.ceil((nearest - farthest) * reach / _STEP)))
    planes = np.linspace(farthest, nearest, count)
    feature, steepness = _features(image, noise)
    middle = [slice(None)] + [slice(views.margin, -views.margin)] * 2
    level = image[tuple(middle)].mean((1, 2))
    weight = np.maximum(level, 0) / np.sqrt(noise)  # edges grow with the light behind a filter
    cost = np.empty((*lattice.field, count), np.float32)
    evidence = np.empty(lattice.field, np.float32)
    _sweep(
        feature, weight.astype(np.float32), views.margin + views.offset, lattice.baseline,
        _quadrants(lattice), planes, _bell(_WINDOW), np.float32(_HALF), cost, evidence,
    )  # fmt: skip
    spread = float(np.percentile(np.ptp(cost, -1), 90))
    total = np.zeros((2, *cost.shape), np.float32)
    strength = np.sqrt(np.maximum(evidence - 2, 0))
    jump = np.exp(-strength / (3 * np.median(strength) + 1e-6))
    _semi_global(
        cost, np.float32(_SLANT * spread), (spread * (_JUMP * jump + 2 * _SLANT)).astype(np.float32),
        total,
    )  # fmt: skip
    rough = _lowest(total[0] + total[1], planes)
    disparity = _settle(rough, evidence, _picture(views, lattice, level, rough))
    deviation = 1 / np.sqrt(np.maximum(evidence - 2, 1e-3)) * steepness
    return Depth(disparity, deviation.astype(np.float32), seen(disparity, lattice.baseline))
