"""The colour chart as the thesis judges it: one mean spectrum a patch."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter, minimum_filter

from squilla.errors import InputError
from squilla.evaluation.metrics import mse

COLOURS = 18
"""The thesis averages over the first 18 patches: the colours without the row of greys."""


def inner(labels: np.ndarray, margin: int = 3) -> np.ndarray:
    """Return labels, (H, W), with -1 also for pixels within `margin` px of a patch's border."""
    window = 2 * margin + 1
    alike = minimum_filter(labels, window) == maximum_filter(labels, window)
    return np.where(alike, labels, -1)


def patch_means(cube: ArrayLike, labels: np.ndarray, margin: int = 3) -> np.ndarray:
    """Return the mean spectrum of each patch.

    Parameters
    ----------
    cube : array, (H, W, K)
    labels : array, (H, W), int
        Number of the patch that a pixel belongs to, from 0; -1 for none (`chart_layout`).
    margin : int
        Pixels this near to the border of a patch are left out, px.

    Returns
    -------
    array, (patches, K), float64

    Raises
    ------
    InputError
        If the shapes do not fit or the margin leaves nothing of a patch.
    """
    cube, labels = np.asarray(cube), np.asarray(labels)
    if cube.shape[:2] != labels.shape:
        raise InputError(f"The cube is {cube.shape[:2]} px, but its labels are {labels.shape}.")
    inside, means = inner(labels, margin), []
    for patch in range(labels.max() + 1):
        chosen = inside == patch
        if not chosen.any():
            raise InputError(f"A margin of {margin} px leaves nothing of patch {patch}.")
        means.append(np.nanmean(cube[chosen], axis=0, dtype=np.float64))
    return np.stack(means)


def patch_errors(
    cube: ArrayLike, reference: ArrayLike, labels: np.ndarray, margin: int = 3
) -> np.ndarray:
    """Return the mean squared error of each patch's mean spectrum.

    Both spectra are divided by the maximum of the true one. The mean of the first `COLOURS` is the
    number in the thesis' table 5.1.

    Parameters
    ----------
    cube, reference : array, (H, W, K)
    labels, margin : as in `patch_means`

    Returns
    -------
    array, (patches,)

    Source: thesis, table 5.1.
    """
    estimate, truth = (patch_means(each, labels, margin) for each in (cube, reference))
    peak = truth.max(-1, keepdims=True)
    return mse(estimate / peak, truth / peak)
