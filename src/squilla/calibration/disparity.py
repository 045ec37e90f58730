"""How far sub-images are shifted against each other: one plane for all units at once.

The array is rigid, so three numbers move all sub-images of a plane scene: the disparity in the
middle of the field and its slopes, for the disparity of a plane is an affine function of image
position. They are found from the edges of all units together: first by the highest sum of all
pairs' correlations, then by Gauss-Newton steps that leave least of the edges unexplained by a few
pictures, of which each unit sees its own mixture (the pictures and mixtures are profiled out).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from squilla.calibration.calibration import Lattice
from squilla.calibration.edges import Edges
from squilla.calibration.resample import CUBIC, monomials, resample

_STEEP = 0.1
"""Slope that planes are expected to have, of their disparity: 40 degrees in the thesis' camera."""


_RANK = 6
"""Most pictures that the gradients of all units are taken to be mixed from.

Through other filters other parts of a colourful scene show. Were they all taken as one picture,
such differences would look like shifts.
"""

_FAINT = 1.15
"""Variance in units of the noise's from which on a picture is taken to be one of the mixture."""

_ALIKE = 30.0
"""How much more alike the edges of two pictures are than chance, in power.

The edges of other colours lie where those of the first picture do, and look like its shifts.
"""

_NEAR = 0.02
"""Last change of a shift from which on Gauss-Newton steps end, px; they converge quadratically."""

_ROUGHLY = 0.2
"""The same where the steps go on with finer edges, px."""

_PARTS = 5
"""Rows and columns of parts of the field in which it is seen whether the scene is a plane."""


@dataclass(frozen=True)
class Evidence:
    """What edges say of how units must move still, about one guess of where they lie.

    Each unit's displacement is taken as a polynomial of K terms along y and along x; the misfit of
    all units together is quadratic in the coefficients.

    pull : (M, 2 K) slope of the log likelihood, 1/px.
    precision : (M, 2 K, M, 2 K) its curvature, 1/px^2; zero for a shift of all units together.
    aligned : what it was told by.
    """

    pull: np.ndarray
    precision: np.ndarray
    aligned: "Aligned"


@dataclass(frozen=True)
class Aligned:
    """Edges of all units, aligned by a guess, and the pictures they are mixed from.

    values : (M, 2 P) in units of the noise; along x, then along y.
    halves : two of (M, M), inner products of the units over each half of the field, not scaled.
    products : (M, M), inner products of `values`.
    share : (M, R), orthonormal: values are about share @ pictures.
    rest : (M, M), inverse covariance of the units' values about the first picture.
    slopes : (R, 2, 2 P) of the pictures along y and x, 1/px.
    shape : (h, w) of a picture.
    shared : number of points that share their noise.
    """

    values: np.ndarray
    halves: list[np.ndarray]
    products: np.ndarray
    share: np.ndarray
    rest: np.ndarray
    slopes: np.ndarray
    shape: tuple[int, int]
    shared: float


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
            found = compare(level, lattice, first + offset, guess, 3, rank)
            step, moved, covariance = _solve(found, lattice, plane, offset, free)
            plane, offset = plane + step, offset + moved
            change = max(np.abs(step).max() * _reach(lattice), np.abs(moved).max())
            if change < near:
                break
    pull, precision = _relief(found.aligned, lattice.baseline)
    return Placement(
        plane, covariance, offset, *_single(found.aligned),
        pull / precision, precision**-0.5, _score(found.aligned),
    )  # fmt: skip


def fit_plane(disparity: np.ndarray) -> np.ndarray:
    """Return the plane that fits a disparity map best, (3,) as in `Placement`."""
    terms = _grid(disparity.shape, 1)[1][:3].reshape(3, -1)  # at right angles to each other
    return terms @ disparity.ravel() / np.square(terms).sum(1)


def plane_map(plane: np.ndarray, lattice: Lattice, step: int = 1) -> np.ndarray:
    """Return the disparity of a plane at every `step`-th point of the field, (h, w)."""
    return np.tensordot(plane, _grid(lattice.field, step)[1][:3], 1)


def compare(
    edges: Edges,
    lattice: Lattice,
    first: np.ndarray,
    disparity: np.ndarray,
    terms: int,
    rank: int,
) -> Evidence:
    """Align edges by a guess, and see how each unit's should move to agree with all.

    Parameters
    ----------
    edges : Edges
    lattice : Lattice
    first : array, (M, 2)
        Where in its window each unit is taken to see the reference's first pixel at infinity, px.
    disparity : array, (h, w)
        At every `edges.step`-th point of the field.
    terms : int
        K, of the polynomial that each unit may move by: 1, 3 or 10.
    rank : int
        Most pictures that the units' edges are taken to be mixed from.

    Returns
    -------
    Evidence
    """
    shape, grid, corner, scale = _grid(lattice.field, edges.step)
    place = lattice.places(first)
    place[..., 0] += np.array(corner) - edges.corner
    place = place * scale / edges.step
    units, points = len(first), shape[0] * shape[1]
    values = np.empty((units, 2, *shape), np.float32)
    seen = np.empty((units, *shape), bool)
    baseline = lattice.baseline / edges.step
    into = values.swapaxes(0, 1)
    resample(edges.values, edges.bad, place, baseline, disparity, CUBIC, into, seen)
    values = values.reshape(units, 2 * points)
    _fill_in(values, seen.reshape(units, points))
    halves = _products(values)
    first, spread = _brightest(halves[0] + halves[1], 2 * points)
    values /= spread[:, None].astype(np.float32)
    slopes = _slopes(_product(first.T, values.T), shape) / np.float32(edges.step)
    moves = _moves(slopes, grid[:terms])
    moved, gram = _product(values, moves), _product(moves, moves).astype(float)
    products = (halves[0] + halves[1]) / np.outer(spread, spread)
    share, rest = _colours(first, products, moved, gram, 2 * points, rank)
    if share.shape[1] > 1:
        more = _slopes(_product(share[:, 1:].T, values.T), shape) / np.float32(edges.step)
        slopes, more = np.concatenate([slopes, more]), _moves(more, grid[:terms])
        moved = np.hstack([moved, _product(values, more)])
        moves = np.concatenate([moves, more])
        gram = _product(moves, moves).astype(float)
    rank = share.shape[1]
    misfit = (rest @ moved).reshape(units, rank, -1)
    pull = -np.einsum("mr,mra->ma", share, misfit)
    half = np.einsum("ir,rasb->iasb", share, gram.reshape(rank, 2 * terms, rank, 2 * terms))
    precision = np.einsum("ij,iasb,js->iajb", rest, half, share, optimize=True)
    aligned = Aligned(values, halves, products, share, rest, slopes, shape, edges.shared)
    return Evidence(pull / edges.shared, precision / edges.shared, aligned)


def _fill_in(values: np.ndarray, seen: np.ndarray) -> None:
    """Fill in what units do not see, (M, P), by the mean of the others: (M, 2 P), real first."""
    some = np.flatnonzero(~seen.all(0))
    if not len(some):
        return
    parts, there = values.reshape(len(values), 2, -1), seen[:, None, some]
    parts[..., some] *= there
    mean = parts.sum(0) / (seen.sum(0) + 1e-9).astype(np.float32)
    share = _product(parts.reshape(len(parts), -1), mean.reshape(1, -1))[:, 0]
    share /= seen.astype(np.float32) @ np.square(mean).sum(0) + np.float32(1e-9)
    parts[..., some] += np.where(there, 0, share[:, None, None] * mean[:, some])


def _products(values: np.ndarray) -> list[np.ndarray]:
    """Return the units' inner products over each half of the field, two of (M, M)."""
    parts = values.reshape(len(values), 2, -1)
    middle = parts.shape[2] // 2
    return [
        (_product(half[:, 0], half[:, 0]) + _product(half[:, 1], half[:, 1])).astype(float)
        for half in (parts[..., :middle], parts[..., middle:])
    ]


def _product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return one @ other.T, float32, by PyTorch, whose threads do not get in the way of Numba's."""
    pair = [torch.from_numpy(np.asarray(each, np.float32)) for each in (one, other)]
    return (pair[0] @ pair[1].T).numpy()


def _eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues, rising, and eigenvectors of a symmetric matrix."""
    values, vectors = torch.linalg.eigh(torch.from_numpy(matrix))
    return values.numpy(), vectors.numpy()


def _brightest(products: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how units show the one picture that explains most, and their noise.

    Parameters
    ----------
    products : array, (M, M)
        Inner products of the units' values.
    count : int
        Number of values of each unit.

    Returns
    -------
    share : array, (M, 1), of length one: values / spread is about share @ picture.
    spread : array, (M,), standard deviation of each unit's noise.
    """
    strength, vectors = _eigen(products)
    alone = np.diag(products) - strength[-1] * vectors[:, -1] ** 2  # what is left of each unit
    spread = np.sqrt(np.maximum(alone / count, 1e-5))
    return _eigen(products / np.outer(spread, spread))[1][:, -1:], spread


def _colours(
    first: np.ndarray,
    products: np.ndarray,
    moved: np.ndarray,
    moves: np.ndarray,
    count: int,
    rank: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return how units mix the first picture and others that no shift has made.

    A unit that lies off shows the first picture and some of its slopes, as if that were another
    colour. Whatever those slopes explain must therefore tell nothing of the other pictures, or
    these would explain what is still misplaced, and it would stay so.

    Parameters
    ----------
    first : array, (M, 1)
    products : array, (M, M)
        Inner products of the units' values, in units of the noise.
    moved : array, (M, 2 K)
        Products of the values with how the first picture changes when it moves.
    moves : array, (2 K, 2 K)
        Products of those changes.
    count : int
        Number of values of each unit.
    rank : int
        Most pictures.

    Returns
    -------
    share : array, (M, R), orthonormal
    rest : array, (M, M)
        Inverse covariance of what the units see beside the first picture, of which nothing is
        known beforehand: noise of variance one, and the other pictures as strong as they are.
    """
    rest = np.eye(len(first)) - first @ first.T
    most = min(rank, len(first) // 6)
    if most < 2:
        return first, rest
    moves = moves + 1e-6 * np.trace(moves) / len(moves) * np.eye(len(moves))
    moved = rest @ moved
    shifts = moved @ np.linalg.solve(moves, moved.T)
    strength, vectors = _eigen(rest @ products @ rest - shifts)
    # Slopes are differences, and do not explain all that a shift has made.
    least = max(_FAINT * count, 0.1 * _eigen(shifts)[0][-1])
    some = np.flatnonzero(strength > least)[::-1][: most - 1]
    others = vectors[:, some]
    weight = 1 - 1 / (1 + _ALIKE * (strength[some] / count - 1))
    return np.hstack([first, others]), rest - others * weight @ others.T


def _single(aligned: Aligned) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each unit alone would still move in each quarter of the field.

    Returns
    -------
    shift : array, (4, M, 2), px
    uncertainty : array, (4, M, 2), px
        Standard deviation by the noise.
    """
    first, rest, products = aligned.share[:, 0], aligned.rest, aligned.products
    values = aligned.values.reshape(-1, 2, *aligned.shape)
    slopes = aligned.slopes[0].reshape(2, 2, *aligned.shape)
    rows, columns = ((slice(0, size // 2), slice(size // 2, size)) for size in aligned.shape)
    left = np.diag(rest @ products @ rest) / np.diag(rest) / aligned.values.shape[1]
    scale = 1 / (aligned.shared * np.maximum(left, 1e-6))[:, None]  # other colours are no noise
    shifts, doubts = [], []
    for quarter in [(..., row, column) for row in rows for column in columns]:
        rise = slopes[quarter].reshape(2, -1)
        pull = -first[:, None] * (rest @ _product(values[quarter].reshape(len(first), -1), rise))
        precision = (first**2 * np.diag(rest))[:, None, None] * (rise @ rise.T)
        covariance = np.linalg.inv(precision * scale[..., None] + 1e-3 * np.eye(2))
        shifts.append(np.einsum("mab,mb->ma", covariance, pull * scale))
        doubts.append(np.sqrt(np.einsum("maa->ma", covariance)))
    return np.array(shifts), np.array(doubts)


def _score(aligned: Aligned) -> float:
    """Return the mean correlation of each unit's edges with those of the others; 0 for noise."""
    upper, lower = aligned.halves
    return (_agreement(upper, lower) + _agreement(lower, upper)) / 2


def _agreement(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean correlation of each unit with the others in half of the field, 0 for noise.

    How the units are weighted is learnt from the other half: what they have in common by chance
    then does not count. `one` and `other` hold the units' inner products there, (M, M).
    """
    share = _eigen(one)[1][:, -1]
    energy, shared = np.diag(other), other @ share
    rest = share @ shared - 2 * share * shared + share**2 * energy  # of the others' picture
    alike = (shared - share * energy) / np.sqrt(np.maximum(rest * energy, 1e-12))
    return float(np.mean(np.sign(share) * alike))  # some units may show the negative


def _relief(aligned: Aligned, baseline: np.ndarray) -> np.ndarray:
    """Return pull and precision of the disparity in each part of the field, (2, B, B)."""
    share, shape = aligned.share, aligned.shape
    rank, points = share.shape[1], shape[0] * shape[1]
    along = (baseline.T[None] * share.T[:, None]).reshape(2 * rank, -1)  # (rank axis, M)
    slopes = aligned.slopes.reshape(2 * rank, -1)
    along_rest = along @ aligned.rest
    misfit = _product(along_rest, aligned.values.T)
    pull = -(misfit * slopes).sum(0)
    precision = ((along_rest @ along.T).astype(np.float32) @ slopes * slopes).sum(0)
    rows, columns = (np.arange(size) * _PARTS // size for size in shape)
    part = (rows[:, None] * _PARTS + columns).ravel()
    sums = [
        np.bincount(part, each.reshape(2, points).sum(0), _PARTS**2) for each in (pull, precision)
    ]
    return np.stack([sums[0], sums[1] + 1e-6]).reshape(2, _PARTS, _PARTS) / aligned.shared


@lru_cache(maxsize=16)  # asked again for every frame
def _grid(field: tuple[int, int], step: int) -> tuple:
    """Return the shape, monomials, first pixel and scale of every `step`-th point of a field.

    The scale, (2, 10), is by what each coefficient of a polynomial over the whole field changes
    when the polynomial is stretched over these points.
    """
    shape = tuple(-(-size // step) for size in field)
    span = [(count - 1) * step / (size - 1) for count, size in zip(shape, field, strict=True)]
    corner = [(size - 1 - step * (count - 1)) / 2 for count, size in zip(shape, field, strict=True)]
    scale = np.array([span[0] ** (a - b) * span[1] ** b for a in range(4) for b in range(a + 1)])
    return shape, monomials(*shape) * scale[:, None, None], corner, scale


def _slopes(pictures: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return derivatives of pictures, (R, 2 P), along y and x, (R, 2, 2 P), zero at the border."""
    pictures = pictures.reshape(-1, *shape)
    slopes = np.zeros((2, *pictures.shape), np.float32)
    inner = slice(2, -2)
    for axis in (1, 2):
        p = np.moveaxis(pictures, axis, -1)
        rise = (8 * (p[..., 3:-1] - p[..., 1:-3]) - (p[..., 4:] - p[..., :-4])) / 12
        np.moveaxis(slopes[axis - 1], axis, -1)[..., inner] = rise
    slopes[..., :2, :], slopes[..., -2:, :], slopes[..., :2], slopes[..., -2:] = 0, 0, 0, 0
    return np.moveaxis(slopes.reshape(2, len(pictures) // 2, 2 * shape[0] * shape[1]), 0, 1)


def _moves(slopes: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return how pictures change by polynomial moves along y and x, (R 2 K, 2 P)."""
    terms = np.tile(grid.reshape(len(grid), -1), 2).astype(np.float32)
    return (slopes[:, :, None] * terms).reshape(-1, slopes.shape[-1])


def _solve(evidence: Evidence, lattice: Lattice, plane, offset, free: float):
    """Return the most likely change of the plane and of the offsets, and the plane's covariance."""
    terms, units = len(plane), len(offset)
    along = np.einsum("mc,kl->mckl", lattice.baseline, np.eye(terms)).reshape(-1, terms)
    if free:  # columns of the units' own shifts
        own = np.einsum("mn,cd,k->mcknd", np.eye(units), np.eye(2), np.eye(terms)[0])
        along = np.hstack([along, own.reshape(len(along), -1)])
    steep = _STEEP * max(abs(plane[0]), 0.1)
    doubt = np.array([1e5, *np.full(terms - 1, steep), *np.full(2 * units if free else 0, free)])
    known = np.array([0, *plane[1:], *(offset.ravel() if free else ())])
    precision = along.T @ evidence.precision.reshape(len(along), -1) @ along
    if free:  # a shift of all units together is none, and one along all baselines is disparity
        none = np.stack(
            [lattice.baseline, np.ones((units, 2)) * [1, 0], np.ones((units, 2)) * [0, 1]]
        )
        none = none.reshape(3, -1) / np.linalg.norm(none.reshape(3, -1), axis=1)[:, None]
        precision[terms:, terms:] += 100 * precision.max() * none.T @ none
    precision += np.diag(doubt**-2.0)
    step = np.linalg.solve(precision, along.T @ evidence.pull.ravel() - known / doubt**2)
    moved = step[terms:].reshape(units, 2) if free else np.zeros_like(offset)
    return step[:terms], moved, np.linalg.inv(precision[:terms, :terms])


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
