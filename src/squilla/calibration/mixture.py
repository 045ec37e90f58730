"""What the edges of all units are mixed from, and how units must move to agree about it.

What a filter sees is a mixture: unit i shows sum_r a_ir T_r(p), a few pictures T_r that all units
share, and so do its gradients. Whatever of the aligned gradients the pictures cannot explain is the
misfit; pictures and mixtures are profiled out (variable projection).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numba
import numpy as np
import torch

from squilla.calibration.calibration import Lattice
from squilla.calibration.edges import Edges
from squilla.calibration.resample import CUBIC, monomials, resample

_FAINT = 1.15
"""Variance in units of the noise's from which on a picture is taken to be one of the mixture."""

_ALIKE = 30.0
"""How much more alike the edges of two pictures are than chance, in power.

The edges of other colours lie where those of the first picture do, and look like its shifts.
"""

_BLOCK = 512
"""Points that are worked on together."""


@dataclass(frozen=True)
class Aligned:
    """Edges of all units, aligned by a guess, and the pictures they are mixed from.

    values : (M, 2 P); along x, then along y.
    spread : (M,), standard deviation of their noise.
    halves : two of (M, M), inner products of `values` over each half of the field.
    products : (M, M), inner products of values / spread.
    share : (M, R), orthonormal: values / spread are about share @ pictures.
    rest : (M, M), inverse covariance of values / spread about the first picture.
    slopes : (R, 2, 2 P) of the pictures along y and x, 1/px.
    grid : (10, h, w), monomials of the place in the field at each point.
    baseline : (M, 2), px by which each unit moves for a disparity of one.
    shared : number of points that share their noise.
    """

    values: np.ndarray
    spread: np.ndarray
    halves: list[np.ndarray]
    products: np.ndarray
    share: np.ndarray
    rest: np.ndarray
    slopes: np.ndarray
    grid: np.ndarray
    baseline: np.ndarray
    shared: float

    @cached_property
    def of_disparity(self) -> tuple[np.ndarray, np.ndarray]:
        """What each point says of its disparity: two of (h, w).

        The slope of the log likelihood, 1/(px per pitch), and its curvature, that squared.
        """
        rank = self.share.shape[1]
        along = (self.baseline.T[None] * self.share.T[:, None]).reshape(2 * rank, -1)
        weighted = along @ self.rest
        slopes = self.slopes.reshape(2 * rank, -1)
        misfit = product(weighted / self.spread, self.values.T)
        change = product(weighted @ along.T, slopes.T)

        def total(each: np.ndarray) -> np.ndarray:
            at_points = np.einsum("rp,rp->p", each, slopes) / np.float32(self.shared)
            return at_points.reshape(2, *self.grid.shape[1:]).sum(0)

        return -total(misfit), total(change)

    def of_units(self, terms: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what all points say of each unit's displacement.

        That is taken as a polynomial of K = 1, 3 or 10 terms along y and along x.

        Returns
        -------
        pull : array, (M, 2 K)
            Slope of the log likelihood, which is quadratic in the coefficients, 1/px.
        precision : array, (M, 2 K, M, 2 K)
            Its curvature, 1/px^2; zero for a shift of all units together.
        """
        units, rank = self.share.shape
        moves = _moves(self.slopes, self.grid[:terms])
        moved = product(self.values, moves) / self.spread[:, None]
        gram = product(moves, moves).astype(float).reshape(rank, 2 * terms, rank, 2 * terms)
        misfit = (self.rest @ moved).reshape(units, rank, -1)
        pull = -np.einsum("mr,mra->ma", self.share, misfit)
        half = np.einsum("ir,rasb->iasb", self.share, gram)
        precision = np.einsum("ij,iasb,js->iajb", self.rest, half, self.share, optimize=True)
        return pull / self.shared, precision / self.shared


def unmix(
    edges: Edges, lattice: Lattice, first: np.ndarray, disparity: np.ndarray, rank: int
) -> Aligned:
    """Align edges by a guess, and see what they are mixed from.

    Parameters
    ----------
    edges : Edges
    lattice : Lattice
    first : array, (M, 2)
        Where in its window each unit is taken to see the reference's first pixel at infinity, px.
    disparity : array, (h, w)
        At every `edges.step`-th point of the field.
    rank : int
        Most pictures.
    """
    shape, grid, corner, scale = points_of(lattice.field, edges.step)
    place = lattice.places(first)
    place[..., 0] += np.array(corner) - edges.corner
    units, count = len(first), 2 * shape[0] * shape[1]
    values, seen = np.empty((units, 2, *shape), np.float32), np.empty((units, *shape), bool)
    resample(
        edges.values, edges.bad, place * scale / edges.step, lattice.baseline / edges.step,
        disparity, CUBIC, values.swapaxes(0, 1), seen,
    )  # fmt: skip
    values, seen = values.reshape(units, 2, -1), seen.reshape(units, -1)
    if not seen.all():
        _fill_in(values, seen)
    halves = _products(values)
    values = values.reshape(units, count)
    share, spread, products = _brightest(halves[0] + halves[1], count)

    def slopes_of(share: np.ndarray) -> np.ndarray:
        pictures = product((share / spread[:, None]).T, values.T)
        slopes = _slopes(pictures.reshape(-1, 2, *shape), np.float32(edges.step))
        return slopes.reshape(-1, 2, count)

    slopes, rest = slopes_of(share), np.eye(units) - share @ share.T
    if min(rank, units // 6) > 1:
        moves = _moves(slopes, grid[:3])
        moved = product(values, moves) / spread[:, None]
        others, weight = _colours(rest, products, moved, product(moves, moves), count, rank)
        if len(weight):
            share, rest = np.hstack([share, others]), rest - others * weight @ others.T
            slopes = np.concatenate([slopes, slopes_of(others)])
    return Aligned(
        values, spread, halves, products, share, rest, slopes, grid, lattice.baseline, edges.shared
    )


@lru_cache(maxsize=16)  # asked again for every frame
def points_of(field: tuple[int, int], step: int) -> tuple:
    """Return the shape, monomials, first pixel and scale of every `step`-th point of a field.

    The scale, (2, 10), is by what each coefficient of a polynomial over the whole field changes
    when the polynomial is stretched over these points.
    """
    shape = tuple(-(-size // step) for size in field)
    span = [(count - 1) * step / (size - 1) for count, size in zip(shape, field, strict=True)]
    corner = [(size - 1 - step * (count - 1)) / 2 for count, size in zip(shape, field, strict=True)]
    scale = np.array([span[0] ** (a - b) * span[1] ** b for a in range(4) for b in range(a + 1)])
    return shape, monomials(*shape) * scale[:, None, None], corner, scale


def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return one @ other.T, float32, by PyTorch, whose threads do not get in the way of Numba's."""
    pair = [torch.from_numpy(np.asarray(each, np.float32)) for each in (one, other)]
    return (pair[0] @ pair[1].T).numpy()


def strongest(matrix: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest eigenvalues of a symmetric matrix, falling, and their eigenvectors."""
    from scipy.linalg import eigh

    some = [len(matrix) - count, len(matrix) - 1]
    values, vectors = eigh(matrix, subset_by_index=some, check_finite=False)
    return values[::-1], vectors[:, ::-1]


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _fill_in(values, seen):
    """Fill in what units, (M, 2, P), do not see, (M, P), by the mean of the others."""
    units, parts, points = values.shape
    mean = np.zeros((parts, points), np.float32)
    for block in numba.prange(-(-points // _BLOCK)):
        some = slice(block * _BLOCK, min((block + 1) * _BLOCK, points))
        count = np.zeros(some.stop - some.start, np.float32)
        for unit in range(units):
            good = seen[unit, some]
            for n in range(len(count)):
                count[n] += good[n]
            for part in range(parts):
                own, total = values[unit, part, some], mean[part, some]
                for n in range(len(count)):
                    own[n] *= good[n]
                    total[n] += own[n]
        for n in range(len(count)):
            count[n] = 1 / max(count[n], np.float32(1))
        mean[:, some] *= count
    for unit in numba.prange(units):
        shared, power = np.float32(0), np.float32(1e-9)
        good = seen[unit]
        for part in range(parts):
            own, other = values[unit, part], mean[part]
            for n in range(points):
                shared += own[n] * other[n]
                power += good[n] * other[n] * other[n]
        share = shared / power
        for part in range(parts):
            own, other = values[unit, part], mean[part]
            for n in range(points):
                own[n] += share * other[n] * (not good[n])


def _moves(slopes: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return how pictures change by polynomial moves along y and x, (R 2 K, 2 P)."""
    terms = np.tile(grid.reshape(len(grid), -1), 2).astype(np.float32)
    return (slopes[:, :, None] * terms).reshape(-1, slopes.shape[-1])


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _slopes(pictures, step):
    """Return slopes of pictures, (R, 2, h, w), along y and x, 1/px: (R, 2, 2, h, w).

    By differences over five points; zero at the border.
    """
    rank, parts, rows, columns = pictures.shape
    slopes = np.zeros((rank, 2, parts, rows, columns), np.float32)
    near, far = np.float32(8 / 12) / step, np.float32(1 / 12) / step
    for line in numba.prange(rank * parts * rows):
        picture, part, row = line // (parts * rows), line // rows % parts, line % rows
        if row < 2 or row >= rows - 2:
            continue
        here = pictures[picture, part]
        down, across = slopes[picture, 0, part, row, 2:], slopes[picture, 1, part, row, 2:]
        above, below = here[row - 1, 2:], here[row + 1, 2:]
        top, bottom = here[row - 2, 2:], here[row + 2, 2:]
        left, right = here[row, 1:], here[row, 3:]
        first, last = here[row], here[row, 4:]
        for n in range(columns - 4):
            down[n] = near * (below[n] - above[n]) - far * (bottom[n] - top[n])
            across[n] = near * (right[n] - left[n]) - far * (last[n] - first[n])
    return slopes


def _products(values: np.ndarray) -> list[np.ndarray]:
    """Return the inner products of units, (M, 2, P), over each half of the field, (M, M)."""
    middle = values.shape[2] // 2
    return [
        (product(half[:, 0], half[:, 0]) + product(half[:, 1], half[:, 1])).astype(float)
        for half in (values[..., :middle], values[..., middle:])
    ]


def _brightest(products: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    products : array, (M, M), in units of the noise.
    """
    strength, share = strongest(products)
    alone = np.diag(products) - strength * share[:, 0] ** 2  # what is left of each unit
    spread = np.sqrt(np.maximum(alone / count, 1e-5))
    products = products / np.outer(spread, spread)
    return strongest(products)[1], spread, products


def _colours(
    rest: np.ndarray,
    products: np.ndarray,
    moved: np.ndarray,
    moves: np.ndarray,
    count: int,
    rank: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return how units mix other pictures than the first, those that no shift has made.

    A unit that lies off shows the first picture and some of its slopes, as if that were another
    colour. Whatever those slopes explain must therefore tell nothing of the other pictures, or
    these would explain what is still misplaced, and it would stay so.

    Parameters
    ----------
    rest : array, (M, M)
        Takes the first picture out.
    products : array, (M, M)
        Inner products of the units' values, in units of the noise.
    moved : array, (M, 2 K)
        Products of the values with how the first picture changes when it moves.
    moves : array, (2 K, 2 K)
        Products of those changes.
    count : int
        Number of values of each unit.
    rank : int
        Most pictures, with the first.

    Returns
    -------
    share : array, (M, R - 1), orthonormal
    weight : array, (R - 1,)
        By how much less than noise they tell: nothing is known of them beforehand but that they
        are as strong as they are.
    """
    moved, moves = rest @ moved, moves.astype(float)
    moves += 1e-6 * np.trace(moves) / len(moves) * np.eye(len(moves))
    shifts = moved @ np.linalg.solve(moves, moved.T)
    strength, share = strongest(rest @ products @ rest - shifts, min(rank, len(rest) // 6) - 1)
    # Slopes are differences, and do not explain all that a shift has made.
    above = strength > max(_FAINT * count, 0.1 * strongest(shifts)[0][0])
    strength, share = strength[above], share[:, above]
    return share, 1 - 1 / (1 + _ALIKE * (strength / count - 1))
