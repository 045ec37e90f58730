"""How well sub-images were aligned, and what that costs in colour."""

import numpy as np
from torch import Tensor

from squilla.calibration.calibration import Lattice
from squilla.calibration.disparity import Placement
from squilla.calibration.resample import sinc_kernel

STALE = 0.1
"""Shifts of units across their baselines from which on a lattice is taken to have moved, px."""

_SURELY = 3.0
"""Standard deviations of chance beyond which units are believed to lie off."""

COSTLY = 0.02
"""Expected colour error from which on a person is warned."""


def misalignment(found: Placement, lattice: Lattice) -> float:
    """Return how far off the sub-images are expected to lie, RMS over units and field, px per axis.

    The uncertainty of the plane by the noise, what single parts of the field disagree with it
    beyond their noise, and how far single units lie off, if that is so far that it can be nothing
    else: smaller shifts are also seen where units mix colours.
    """
    length = float(np.mean(lattice.baseline**2))
    plane = length * float(np.diag(found.covariance) @ [1, 1 / 3, 1 / 3])  # y^2, x^2 over -1..1
    if found.offset.any():  # were single units free, they followed their noise
        units = looseness(found) ** 2
    else:
        units = _alike(found.leftover, found.uncertainty)
        units = units if units > STALE**2 else 0.0
    relief = length * float(np.median(found.relief**2 - found.flatness**2))
    return float(np.sqrt(plane + units + max(relief, 0)))


def looseness(found: Placement) -> float:
    """Return how uncertain single units' places are by the noise, RMS px per axis."""
    return float(np.sqrt(np.mean(np.sum(found.uncertainty**-2.0, 0) ** -1)))


def drift(found: Placement, lattice: Lattice) -> float:
    """Return how far units lie beside their places in the lattice, RMS px.

    Only across each unit's baseline, where no depth of the scene moves anything, and only as far as
    the quarters of the field agree: what is left is a lattice that has moved since its calibration.
    """
    length = np.hypot(*lattice.baseline.T)
    some = length > 0
    across = (lattice.baseline[some] / length[some, None])[:, ::-1] * [1, -1]
    shift = np.sum((found.leftover + found.offset)[:, some] * across, -1)
    noise = np.sqrt(np.sum((found.uncertainty[:, some] * across) ** 2, -1))
    return float(np.sqrt(max(_alike(shift, noise), 0.0)))


def _alike(shift: np.ndarray, noise: np.ndarray) -> float:
    """Return the mean square of shifts that the quarters of the field, first axis, agree on.

    By products of different quarters: noise, and what looks like a shift in one quarter because
    colours are mixed otherwise there, is not alike in another. Units count by how surely they tell,
    up to `STALE`.
    """
    precision = noise**-2.0
    total = np.sum(precision, 0)
    both = np.sum(precision * shift, 0) ** 2 - np.sum((precision * shift) ** 2, 0)
    square = both / (total**2 - np.sum(precision**2, 0))
    weight = (1 / total + STALE**2) ** -2.0
    # Of four quarters alike, each with four times the variance: what the noise alone may reach.
    by_chance = np.sqrt(np.sum((weight / total) ** 2 * 8 / 3)) / weight.sum()
    return float(np.average(square, weights=weight) - _SURELY * by_chance)


def colour_error(y: Tensor, noise: np.ndarray, shift: float) -> float:
    """Return the relative error of a measurement whose channels are misplaced.

    To first order a channel that lies off by d is wrong by d times its gradient.

    Parameters
    ----------
    y : Tensor, (H, W, M)
    noise : array, (M,)
        Variance of each channel's noise.
    shift : float
        RMS misplacement of the channels, px per axis.

    Returns
    -------
    float
        RMS error over RMS of `y`.
    """
    few = y[::5].numpy()
    across = float(np.mean((few[:, 2:] - few[:, :-2]) ** 2)) / 4
    few = y[:, ::5].numpy()
    down = float(np.mean((few[2:] - few[:-2]) ** 2)) / 4
    of_noise = float(np.mean(noise)) * _noise_in_slopes()
    slope = max(across - of_noise, 0) + max(down - of_noise, 0)
    return float(shift * np.sqrt(slope / max(float(y[::5].square().mean()), 1e-30)))


def _noise_in_slopes() -> float:
    """Return the noise of a central difference of resampled pictures over that of their pixels."""
    kernel = sinc_kernel(np.linspace(0, 1, 65))  # at all shifts alike
    same = np.mean(np.sum(kernel**2, 1))
    two_apart = np.mean(np.sum(kernel[:, 2:] * kernel[:, :-2], 1))
    return float(same * (same - two_apart) / 2)
