"""What a plane leaves open: single units that lie off, parts of the field that do, and doubt."""

import numpy as np

from squilla.calibration.mixture import Aligned, product, strongest

PARTS = 5
"""Rows and columns of parts of the field in which it is seen whether the scene is a plane."""


def single_shifts(aligned: Aligned) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each unit alone would still move in each quarter of the field.

    Returns
    -------
    shift : array, (4, M, 2), px
    uncertainty : array, (4, M, 2), px
        Standard deviation by the noise.
    """
    first, rest, products = aligned.share[:, 0], aligned.rest, aligned.products
    shape = aligned.grid.shape[1:]
    left = np.diag(rest @ products @ rest) / np.diag(rest) / aligned.values.shape[1]
    scale = 1 / (aligned.shared * np.maximum(left, 1e-6))[:, None]  # other colours are no noise
    rows, columns = ((slice(0, size // 2), slice(size // 2, size)) for size in shape)
    slopes = aligned.slopes[0].reshape(2, 2, *shape)
    rises = np.zeros((4, *slopes.shape), np.float32)
    for number, quarter in enumerate((row, column) for row in rows for column in columns):
        rises[(number, ..., *quarter)] = slopes[(..., *quarter)]
    rises = rises.reshape(4, 2, -1)
    moved = product(aligned.values, rises.reshape(8, -1)) / aligned.spread[:, None]
    pull = -first[:, None] * (rest @ moved) * scale
    pull = pull.reshape(-1, 4, 2).swapaxes(0, 1)[..., None]
    weight = (first**2 * np.diag(rest))[:, None] * scale
    precision = weight[..., None] * (rises @ rises.mT)[:, None].astype(float)
    covariance = np.linalg.inv(precision + 1e-3 * np.eye(2))
    return (covariance @ pull)[..., 0], np.sqrt(np.einsum("qmaa->qma", covariance))


def score(aligned: Aligned) -> float:
    """Return the mean correlation of each unit's edges with those of the others; 0 for noise."""
    upper, lower = aligned.halves
    return (_agreement(upper, lower) + _agreement(lower, upper)) / 2


def _agreement(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean correlation of each unit with the others in half of the field, 0 for noise.

    How the units are weighted is learnt from the other half: what they have in common by chance
    then does not count. `one` and `other` hold the units' inner products there, (M, M).
    """
    share = strongest(one)[1][:, 0]
    energy, shared = np.diag(other), other @ share
    rest = share @ shared - 2 * share * shared + share**2 * energy  # of the others' picture
    alike = (shared - share * energy) / np.sqrt(np.maximum(rest * energy, 1e-12))
    return float(np.mean(np.sign(share) * alike))  # some units may show the negative


def relief(aligned: Aligned) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each part of the field lies beside the guess, and how sure that is.

    Returns
    -------
    relief : array, (B, B), px per pitch
    flatness : array, (B, B), px per pitch
        Standard deviation by the noise.
    """
    rows, columns = (np.arange(size) * PARTS // size for size in aligned.grid.shape[1:])
    part = (rows[:, None] * PARTS + columns).ravel()
    pull, precision = (
        np.bincount(part, each.ravel(), PARTS**2).reshape(PARTS, PARTS)
        for each in aligned.of_disparity
    )
    precision += 1e-6
    return pull / precision, precision**-0.5
