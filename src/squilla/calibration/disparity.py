"""How far sub-images are shifted against each other: one plane for all units at once.

The array is rigid, so three numbers move all sub-images of a plane scene: the disparity in the
middle of the field and its slopes, for the disparity of a plane is an affine function of image
position. They are found from the edges of all units together: first by the highest sum of all
pairs' correlations, then by Gauss-Newton steps that leave least of the edges unexplained by a few
pictures, of which each unit sees its own mixture (the pictures and mixtures are profiled out).
"""

from dataclasses import dataclass

import numpy as np
import torch

from squilla.calibration.calibration import Lattice
from squilla.calibration.edges import Edges
from squilla.calibration.mixture import Aligned, points_of, unmix
from squilla.calibration.residual import relief, score, single_shifts

_STEEP = 0.1
"""Slope that planes are expected to have, of their disparity: 40 degrees in the thesis' camera."""

_RANK = 6
"""Most pictures that the gradients of all units are taken to be mixed from.

Through other filters other parts of a colourful scene show. Were they all taken as one picture,
such differences would look like shifts.
"""

_NEAR = 0.02
"""Last change of a shift from which on Gauss-Newton steps end, px; each leaves some 5 % of it."""

_ROUGHLY = 0.2
"""The same where the steps go on with finer edges, px."""


@dataclass(frozen=True)
class Placement:
    """Where the units see the scene.

    plane : (3,) px per pitch; disparity in the middle of the field, and what it grows by from
        there to the last row's and the last column's middle.
    covariance : (3, 3) of `plane`, by the noise of the edges, were the units' places known.
    offset : (M, 2) px, by which each unit lies beside its place in the lattice.
    leftover : (4, M, 2) px, by which each unit would still move by each quarter of the field, were
        it free.
    uncertainty : (4, M, 2) px, standard deviation of `leftover` by the noise.
    relief : (B, B) px per pitch, by which parts of the field lie beside the plane.
    flatness : (B, B) px per pitch, standard deviation of `relief` by the noise.
    score : mean correlation of each unit's edges with those of the others; 0 for noise.
    """

    plane: np.ndarray
    covariance: np.ndarray
    offset: np.ndarray
    leftover: np.ndarray
    uncertainty: np.ndarray
    relief: np.ndarray
    flatness: np.ndarray
    score: float


def find_plane(
    edges: Edges,
    lattice: Lattice,
    first: np.ndarray,
    span: tuple[float, float],
    *,
    start: np.ndarray | None = None,
    free: float = 0.0,
) -> Placement:
    """Find the plane of the scene, and where asked every unit's own offset.

    Parameters
    ----------
    edges : Edges
    lattice : Lattice
    first : array, (M, 2)
        Where in its window each unit sees the reference's first pixel at infinity, px.
    span : (float, float)
        Least and largest disparity looked for, px per pitch.
    start : array, (3,), optional
        A plane within about 2 px at the outermost units; spares the search.
    free : float
        How far units may lie beside their places, px (standard deviation).

    Returns
    -------
    Placement
    """
    stages = [(edges, _RANK, _NEAR)]
    if start is None:
        coarse = edges.directions()
        plane = np.array([_search(coarse, lattice, first, span), 0.0, 0.0])
        stages = [(coarse, 1, _ROUGHLY), *stages]
    else:
        plane = np.array(start, float)
    offset = np.zeros(first.shape)
    for level, rank, near in stages:
        for _ in range(8):
            guess = plane_map(plane, lattice, level.step)
            found = unmix(level, lattice, first + offset, guess, rank)
            step, moved, covariance = _solve(found, plane, offset, free)
            plane, offset = plane + step, offset + moved
            change = max(np.abs(step).max() * _reach(lattice), np.abs(moved).max())
            if change < near:
                break
    return Placement(plane, covariance, offset, *single_shifts(found), *relief(found), score(found))


def fit_plane(disparity: np.ndarray) -> np.ndarray:
    """Return the plane that fits a disparity map best, (3,) as in `Placement`."""
    terms = points_of(disparity.shape, 1)[1][:3].reshape(3, -1)  # at right angles to each other
    return terms @ disparity.ravel() / np.square(terms).sum(1)


def plane_map(plane: np.ndarray, lattice: Lattice, step: int = 1) -> np.ndarray:
    """Return the disparity of a plane at every `step`-th point of the field, (h, w)."""
    return np.tensordot(plane, points_of(lattice.field, step)[1][:3], 1)


def _solve(aligned: Aligned, plane: np.ndarray, offset: np.ndarray, free: float):
    """Return the most likely change of the plane and of the offsets, and the plane's covariance."""
    units, steep = len(offset), _STEEP * max(abs(plane[0]), 0.1)
    doubt, known = np.array([1e5, steep, steep]), np.array([0, *plane[1:]])
    if free:
        pull, precision = _free_units(aligned)
        doubt = np.append(doubt, np.full(2 * units, free))
        known = np.append(known, offset)
    else:
        terms = aligned.grid[:3].reshape(3, -1)
        pull, precision = (each.ravel() for each in aligned.of_disparity)
        pull, precision = terms @ pull, terms * precision @ terms.T
    precision = precision + np.diag(doubt**-2.0)
    step = np.linalg.solve(precision, pull - known / doubt**2)
    moved = step[3:].reshape(units, 2) if free else np.zeros_like(offset)
    return step[:3], moved, np.linalg.inv(precision[:3, :3])


def _free_units(aligned: Aligned) -> tuple[np.ndarray, np.ndarray]:
    """Return what edges say of the plane and every unit's own place, (3 + 2 M)."""
    baseline, units = aligned.baseline, len(aligned.baseline)
    pull, precision = aligned.of_units(3)
    along = np.einsum("mc,kl->mckl", baseline, np.eye(3)).reshape(-1, 3)
    own = np.einsum("mn,cd,k->mcknd", np.eye(units), np.eye(2), np.eye(3)[0])
    along = np.hstack([along, own.reshape(len(along), -1)])
    precision = along.T @ precision.reshape(len(along), -1) @ along
    # A shift of all units together is none, and one along all baselines is disparity.
    none = np.stack([baseline, np.ones((units, 2)) * [1, 0], np.ones((units, 2)) * [0, 1]])
    none = none.reshape(3, -1) / np.linalg.norm(none.reshape(3, -1), axis=1)[:, None]
    precision[3:, 3:] += 100 * precision.max() * none.T @ none
    return along.T @ pull.ravel(), precision


def _search(edges: Edges, lattice: Lattice, first: np.ndarray, span: tuple[float, float]) -> float:
    """Return the disparity at which all pairs of units together agree best, px per pitch."""
    reach = _reach(lattice)
    room = int(np.ceil(max(map(abs, span)) * reach / edges.step))  # or what leaves comes back
    taper = _taper(edges.values.shape[2])[:, None] * _taper(edges.values.shape[3])
    values = (edges.values - edges.values.mean((2, 3), keepdims=True)) * taper
    size = [length + room for length in taper.shape]
    whole = torch.fft.fft2(torch.complex(*torch.from_numpy(values)), s=size)
    rows, columns = _low(whole.shape[1]), _low(whole.shape[2])
    spectra = whole[:, rows[:, None], columns]
    angle_y = 2j * np.pi / edges.step * torch.fft.fftfreq(whole.shape[1])[rows]
    angle_x = 2j * np.pi / edges.step * torch.fft.fftfreq(whole.shape[2])[columns]

    def phase(shift: np.ndarray) -> torch.Tensor:
        y, x = torch.from_numpy(shift).float().split(1, dim=1)
        return torch.exp(y * angle_y)[:, :, None] * torch.exp(x * angle_x)[:, None]

    # The outermost unit moves by 2 px from one to the next.
    candidates = np.arange(span[0] * reach - 2, span[1] * reach + 3, 2) / reach
    spectra = spectra * phase(first + candidates[0] * lattice.baseline)
    step, total = phase(2 / reach * lattice.baseline), []
    for _ in candidates:
        total.append(float(spectra.sum(0).abs().square().sum()))
        spectra *= step
    return float(candidates[int(np.argmax(total))])


def _low(size: int):
    """Return the indices of the frequencies below a quarter of the sampling rate."""
    return torch.cat([torch.arange(size // 4), torch.arange(size - size // 4, size)])


def _taper(size: int, share: float = 0.1) -> np.ndarray:
    """Return a window that is one inside and falls to zero like a cosine at both ends."""
    edge = max(2, round(share * size))
    ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(edge) + 0.5) / edge)
    return np.concatenate([ramp, np.ones(size - 2 * edge), ramp[::-1]]).astype(np.float32)


def _reach(lattice: Lattice) -> float:
    return max(float(np.abs(lattice.baseline).max()), 1e-9)
