"""The compound model on a processor: `evidence` in loops that pass memory once.

The functions of `evidence` say what is computed; these compute it for one picture at a time, in a
third of the time, and the tests hold both together.

A view is one array, (H, W, 2 + D): noise variance, amplitude, and the shape in D directions.
"""

import math
from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

from squilla.reconstruction.evidence import (
    ALIKE,
    CORRECTED,
    FEW,
    LEVELS,
    MISFITS,
    NOTHING,
    SAMPLE,
    SHADED,
    SPECTRAL,
    TEXTURE,
    TOLD,
    UNALIKE,
    Brightness,
    Evidence,
    View,
    likeliest,
)
from squilla.reconstruction.kernels import ONE, add_product, compiled, over_rows, sigmoid
from squilla.reconstruction.posteriors import CompiledCamera, mixture, wiener
from squilla.threads import single_threaded_products

_HALF, _ALIKE = np.float32(0.5), np.float32(ALIKE)
_SHADED, _UNALIKE = np.float32(SHADED), np.float32(UNALIKE)
_NOTHING = np.float32(NOTHING)
_AROUND, _ITSELF = np.float32(1 / TEXTURE[0]), np.float32(1 / TEXTURE[1])
_ROWS = 16
"""Rows of a picture that are worked on at a time where a step leaves something to the next."""


# --- sums over the channels of a cell -----------------------------------------------------------


@compiled
def _telling(noise, power, scale):
    """Write the scale of `evidence._telling` and return its constant."""
    against, product = np.float32(0), ONE
    for i in range(TOLD):
        share = 2 * power[i] / noise
        scale[i] = share / ((ONE + share) * 2 * noise)
        product *= ONE + share
        if i % 4 == 3:  # more of them would leave the range of float32
            against += math.log(product)
            product = ONE
    return _HALF * (against + math.log(product))


@compiled
def _difference(one, other, scale):
    total = np.float32(0)
    for i in range(TOLD):
        apart = one[2 + i] - other[2 + i]
        total += apart * apart * scale[i]
    return total


@compiled
def _alike_in_brightness(one, other):
    apart = 2 * (one[1] - other[1]) / (one[1] + other[1])
    apart *= apart
    return _SHADED / _UNALIKE * (_UNALIKE * _UNALIKE + apart) / (_SHADED * _SHADED + apart)


@compiled
def _probability(log_odds, odds):
    return odds / (odds + math.exp(-log_odds))


# --- from the measurement to views of every level -----------------------------------------------


@compiled
def _light(first, last, y, known):
    for row in range(first, last):
        for column in range(y.shape[1]):
            pixel, lit, total = y[row, column], 0, np.float32(0)
            for i in range(pixel.size):
                lit += pixel[i] > 0
                total += pixel[i] * 0  # NaN if anything is not finite
            known[row, column] = total + (ONE if lit else np.float32(0))


@compiled
def _quiet_steps(first, last, y, ratio, flat, quiet, expected, steps):
    """Write by how much neighbours differ, of what is expected; in every row of `FEW`."""
    width, channels = y.shape[1:]
    seen = np.empty((2, quiet.shape[1]), np.float32)
    for row in range(first, last):
        before = np.float32(np.inf)
        for column in range(width):
            pixel = y[FEW * row, column]
            now, then = seen[column % 2], seen[1 - column % 2]
            power = np.float32(0)
            for i in range(channels):
                power += pixel[i] * pixel[i]
            amplitude = max(_amplitude(pixel, flat), np.float32(1e-30))
            now[:] = 0
            add_product(pixel, quiet, now)
            for i in range(now.size):
                now[i] /= amplitude
            power = ratio[FEW * row, column] * (power / channels / amplitude / amplitude)
            if column > 0:
                total = np.float32(0)
                for i in range(now.size):
                    total += (now[i] - then[i]) * (now[i] - then[i])
                expected[row, column - 1] = power + before
                steps[row, column - 1] = total / now.size / (power + before)
            before = power


@compiled
def _amplitude(pixel, flat):
    total = np.float32(0)
    for i in range(flat.size):
        total += pixel[i] * flat[i]
    return total


@compiled
def _brightness(first, last, y, flat, total):
    for row in range(first, last):
        total[row] = 0
        for column in range(y.shape[1]):
            total[row] += abs(_amplitude(y[row, column], flat))


@compiled
def _normalised(first, last, projected, ratio, factor, floor, channels, view):
    """Write shape, amplitude and noise of pixels; beyond the picture nothing is known."""
    height, width = ratio.shape
    for row in range(first, last):
        for column in range(view.shape[1]):
            cell = view[row, column]
            cell[0], cell[1], cell[2:] = np.float32(1e6), floor, np.float32(0)
            if row >= height or column >= width:
                continue
            pixel = projected[row - first, column]
            cell[1] = max(pixel[-1], floor)
            power, unit = np.float32(0), ONE / cell[1]
            for i in range(pixel.size - 1):
                cell[2 + i] = pixel[i] * unit
                power += cell[2 + i] * cell[2 + i]
            noise = ratio[row, column] * factor * max(power / channels, np.float32(1e-6))
            cell[0] = min(max(noise, np.float32(1e-9)), np.float32(1e6))


def _viewed(first: int, last: int, y: np.ndarray, project: np.ndarray, *arguments) -> None:
    """Project pixels and write their view, a few rows at a time, which the caches hold."""
    for start in range(first, last, _ROWS):
        stop = min(start + _ROWS, last)
        _normalised(start, stop, y[start:stop] @ project, *arguments)


@compiled
def _coarser(first, last, fine, power, view):
    scale, share = np.empty(TOLD, np.float32), np.empty((4, 4), np.float32)
    for row in range(first, last):
        for column in range(view.shape[1]):
            parts = (
                fine[2 * row, 2 * column], fine[2 * row, 2 * column + 1],
                fine[2 * row + 1, 2 * column], fine[2 * row + 1, 2 * column + 1],
            )  # fmt: skip
            certainty = np.float32(0)
            for part in parts:
                certainty += ONE / part[0]
            against = _telling(8 / certainty + 2 * _ALIKE, power, scale)
            for i in range(4):
                share[i, i] = ONE / parts[i][0]
                for j in range(i):
                    apart = _difference(parts[i], parts[j], scale)
                    lit = _alike_in_brightness(parts[i], parts[j])
                    alike = _probability(against - apart, lit)
                    share[i, j], share[j, i] = alike / parts[j][0], alike / parts[i][0]
            most, certainty = 0, np.float32(0)
            for i in range(4):
                total = share[i, 0] + share[i, 1] + share[i, 2] + share[i, 3]
                if total > certainty:
                    most, certainty = i, total
            p, q, r, s = share[most] / certainty
            cell = view[row, column]
            for i in range(1, cell.size):
                cell[i] = p * parts[0][i] + q * parts[1][i] + r * parts[2][i] + s * parts[3][i]
            cell[0] = ONE / certainty


@compiled
def _among_neighbours(first, last, view, power, known):
    height, width, size = view.shape
    scale = np.empty(TOLD, np.float32)
    for row in range(first, last):
        for column in range(width):
            own, cell = view[row, column], known[row, column]
            against = _telling(2 * (own[0] + _ALIKE), power, scale)
            weight = ONE / own[0]
            for i in range(1, size):
                cell[i] = weight * own[i]
            for y in range(max(row - 1, 0), min(row + 2, height)):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    if y == row and x == column:
                        continue
                    other = view[y, x]
                    lit = _alike_in_brightness(own, other)
                    share = _probability(against - _difference(own, other, scale), lit) / other[0]
                    weight += share
                    for i in range(1, size):
                        cell[i] += share * other[i]
            for i in range(1, size):
                cell[i] /= weight
            cell[0] = ONE / weight


# --- what cells take from coarser ones ----------------------------------------------------------


@compiled
def _kinship(first, last, view, known, coarse, power, kin, alone):
    below, right = coarse.shape[0] - 1, coarse.shape[1] - 1
    scale = np.empty(TOLD, np.float32)
    for row in range(first, last):
        up, down = max((row - 1) // 2, 0), min((row + 1) // 2, below)
        for column in range(view.shape[1]):
            before, after = max((column - 1) // 2, 0), min((column + 1) // 2, right)
            own, shares = view[row, column], kin[row, column]
            around = (
                coarse[up, before], coarse[up, after], coarse[down, before], coarse[down, after]
            )  # fmt: skip
            mean = (around[0][0] + around[1][0] + around[2][0] + around[3][0]) / 4
            against = _telling(own[0] + mean + 2 * _ALIKE, power, scale)
            most = np.float32(-np.inf)
            for number in range(4):
                shares[number] = against - _difference(own, around[number], scale)
                most = max(most, shares[number])
            total = np.float32(0)
            for number in range(4):
                lit = _alike_in_brightness(own, around[number])
                shares[number] = (
                    math.exp(shares[number] - most) * lit / (around[number][0] + _ALIKE)
                )
                total += shares[number]
            for number in range(4):
                shares[number] /= total
            alone[row, column] = -math.log((known[row, column, 0] + _ALIKE) * total) - most


@compiled
def mix(kin, coarse, up, down, before, after, mixed, size):
    a, b = coarse[up, before], coarse[up, after]
    c, d = coarse[down, before], coarse[down, after]
    p, q, r, s = kin[0], kin[1], kin[2], kin[3]
    for i in range(size):
        mixed[i] = p * a[i] + q * b[i] + r * c[i] + s * d[i]


@compiled
def inherited(first, last, kin, coarse, mixed):
    """Mix the four coarse cells around each cell, as many of their numbers as `mixed` has."""
    below, right = coarse.shape[0] - 1, coarse.shape[1] - 1
    size = mixed.shape[2]
    for row in range(first, last):
        up, down = max((row - 1) // 2, 0), min((row + 1) // 2, below)
        for column in range(mixed.shape[1]):
            before, after = max((column - 1) // 2, 0), min((column + 1) // 2, right)
            mix(kin[row, column], coarse, up, down, before, after, mixed[row, column], size)


@compiled
def _besides_itself(first, last, alone, known, mixed):
    """Mix what a cell inherits with what it knows itself."""
    for row in range(first, last):
        for column in range(mixed.shape[1]):
            itself = sigmoid(alone[row, column])
            cell, own = mixed[row, column], known[row, column]
            for i in range(mixed.shape[2]):
                cell[i] += itself * (own[i] - cell[i])


# --- how bright pixels are ----------------------------------------------------------------------


@compiled
def _shaded(first, last, view, kin, coarse, channels, bright, square):
    """Write the brightness of kin, and by how much cells differ from it, squared over the noise.

    Of cells that have measured nothing the difference is -1.
    """
    below, right = coarse.shape[0] - 1, coarse.shape[1] - 1
    for row in range(first, last):
        up, down = max((row - 1) // 2, 0), min((row + 1) // 2, below)
        for column in range(view.shape[1]):
            before, after = max((column - 1) // 2, 0), min((column + 1) // 2, right)
            mix(kin[row, column], coarse, up, down, before, after, bright[row, column], 2)
            noise, own, smooth = view[row, column, 0], view[row, column, 1], bright[row, column, 0]
            apart = (own - smooth) / min(own, smooth)
            square[row, column] = apart * apart / min(noise / channels, ONE)
            if noise >= _NOTHING:
                square[row, column] = -ONE


@compiled
def _brightened(first, last, view, square, channels, bright):
    """Write what `evidence.brightened` returns over the brightness of kin."""
    height, width = square.shape
    for row in range(first, last):
        for column in range(width):
            own, cell = square[row, column], bright[row, column]
            if own < 0:
                continue
            around, count = np.float32(0), np.float32(0)
            for y in range(max(row - 1, 0), min(row + 2, height)):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    if square[y, x] >= 0:
                        around += square[y, x]
                        count += ONE
            around /= count
            kept = ONE - ONE / max(around * _AROUND, own * _ITSELF, ONE)
            noise = min(view[row, column, 0] / channels, ONE)
            cell[0] += kept * (view[row, column, 1] - cell[0])
            cell[1] = kept * noise + (ONE - kept) * (ONE - kept) * cell[1]


# --- all of it ----------------------------------------------------------------------------------


def light(y: np.ndarray, threads: int) -> np.ndarray:
    """Return 1 where something was measured, 0 where all was dark, NaN where y is not finite."""
    known = np.empty(y.shape[:2], np.float32)
    over_rows(_light, len(y), threads, y, known)
    return known


def noise_factor(y: np.ndarray, ratio: np.ndarray, camera: CompiledCamera, threads: int) -> float:
    """Return by how much a picture is noisier than it says, as `evidence.noise_factor` does."""
    rows = -(-len(y) // FEW)
    expected, steps = np.empty((2, rows, y.shape[1] - 1), np.float32)
    over_rows(_quiet_steps, rows, threads, y, ratio, camera.flat, camera.quiet, expected, steps)
    steps = steps[(expected < 1e6) & ~np.isnan(steps)]
    if not steps.size:
        return 1.0
    middle = (steps.size - 1) // 2
    factor = np.partition(steps, middle)[middle] / (1 - 2 / (9 * camera.quiet.shape[1])) ** 3
    return float(np.clip(factor, 0.05, 20.0))


@single_threaded_products()
def gather_evidence(
    y: np.ndarray,
    ratio: np.ndarray,
    factor: float,
    camera: CompiledCamera,
    zone: np.ndarray | None,
    threads: int,
    interval: bool = False,
) -> Evidence:
    """Do what `evidence.gather_evidence` does, for one picture.

    Parameters
    ----------
    y : array, (H, W, M), float32, finite
        Sides are filled up here.
    ratio : array, (H, W), float32
        Noise power over signal power as stated; infinite where nothing was measured.
    factor : float
        What `noise_factor` says of it.
    camera : CompiledCamera
    zone : array, (H, W), int, optional
    threads : int
    interval : bool
        Work out the variance too.
    """
    step = 2**LEVELS
    sides = tuple(side + -side % step for side in ratio.shape)
    size, basis = camera.vectors.shape[1], camera.basis

    def run(kernel: Callable[..., None], rows: int, *arguments) -> None:
        over_rows(kernel, rows, threads, *arguments)

    def empty(level: int, *last: int) -> np.ndarray:
        return np.empty((sides[0] >> level, sides[1] >> level, *last), np.float32)

    views = [empty(level, size + 2) for level in range(LEVELS + 1)]
    bright = np.empty(len(y), np.float32)
    run(_brightness, len(y), y, camera.flat, bright)
    floor = 1e-3 * bright.sum(dtype=float) / (sides[0] * sides[1])
    told = np.float32(factor), np.float32(max(floor, 1e-30)), camera.channels
    run(_viewed, sides[0], y, camera.project, ratio, *told, views[0])
    for level in range(1, LEVELS + 1):
        run(_coarser, len(views[level]), views[level - 1], camera.power, views[level])
    known = [views[0]]
    for view in views[1:]:
        known.append(np.empty_like(view))
        run(_among_neighbours, len(view), view, camera.power, known[-1])

    best = spectral = known[-1]
    noise = np.minimum(best[..., 0] / camera.channels, ONE)
    bright = np.stack([best[..., 1], noise], -1)
    kin, alone = {}, {}
    for level in reversed(range(LEVELS)):
        kin[level], alone[level] = empty(level, 4), empty(level)
        view, rows = views[level], len(views[level])
        run(_kinship, rows, view, known[level], best, camera.power, kin[level], alone[level])
        coarse, bright, square = bright, empty(level, 2), empty(level)
        run(_shaded, rows, view, kin[level], coarse, camera.channels, bright, square)
        run(_brightened, rows, view, square, camera.channels, bright)
        if level == 0:
            break
        mixed = empty(level, 2 + (size if level >= SPECTRAL else TOLD))
        run(inherited, rows, kin[level], best, mixed)
        run(_besides_itself, rows, alone[level], known[level], mixed)
        best = mixed
        if level == SPECTRAL:
            spectral = best

    places = [_zones(zone, sides, level) for level in range(SPECTRAL + 1)]

    def posterior(view: np.ndarray, place: np.ndarray, misfit: np.float32, knots: int):
        """Return mean, variance at the knots if there are any, and evidence."""
        found = np.empty((*place.shape, basis), np.float32)
        variance = np.empty((*place.shape, knots), np.float32)
        results = found, variance, np.empty(place.shape, np.float32)
        run(mixture, len(view), view, place, misfit, *camera.mixture, *results)
        return results

    # The same cells as often as there are misfits, below one another, each with its own.
    some = np.tile(spectral[::SAMPLE, ::SAMPLE], (len(MISFITS), 1, 1))
    there = np.tile(places[SPECTRAL][::SAMPLE, ::SAMPLE], (len(MISFITS), 1))
    some[..., 0] += np.repeat(MISFITS, len(some) // len(MISFITS))[:, None]
    _, _, likely = posterior(some, there, np.float32(0), 0)
    likely = torch.from_numpy(likely).view(len(MISFITS), -1).mean(1, keepdim=True)
    misfit = np.float32(MISFITS[int(likeliest(likely))])
    coefficients, variance, _ = posterior(
        spectral, places[SPECTRAL], misfit, camera.knots if interval else 0
    )
    own = [empty(level, CORRECTED[level]) for level in range(SPECTRAL)]
    for level, (view, place) in enumerate(zip(known[:SPECTRAL], places, strict=False)):
        matrices = camera.vectors, camera.spread, camera.gains[level]
        run(wiener, len(view), view, place, alone[level], misfit, *matrices, own[level])

    def pictures(values: Iterable[np.ndarray]) -> list[Tensor]:
        return [torch.from_numpy(value)[None] for value in values]

    def seen(view: np.ndarray) -> View:
        return View(*pictures((view[..., 2:], view[..., 0], view[..., 1])))

    finer = range(SPECTRAL)
    return Evidence(
        *pictures((coefficients, variance)),
        kin=pictures(kin[level] for level in finer),
        alone=pictures(alone[level] for level in finer),
        own=pictures(own),
        own_noise=pictures(known[level][..., 0] + misfit for level in finer if interval),
        pixels=seen(views[0]),
        cells=seen(views[SPECTRAL]),
        spectral=seen(spectral),
        bright=Brightness(*pictures((bright[..., 0], bright[..., 1]))),
    )


def _zones(zone: np.ndarray | None, sides: tuple[int, ...], level: int) -> np.ndarray:
    """Return the zone of each cell of a level."""
    if zone is None:
        return np.zeros([side >> level for side in sides], np.int64)
    filled = np.pad(zone, [(0, side - own) for side, own in zip(sides, zone.shape, strict=True)])
    return filled[2**level // 2 :: 2**level, 2**level // 2 :: 2**level]
