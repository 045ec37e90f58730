"""What sub-images have in common whatever their filters do to the contrast: their edges.

Filters change intensities from one sub-image to the next and may even invert them. The directions
of edges they leave alone: the double-angle gradient (gx + i gy)^2 / |g| is the same for a step up
and a step down, and finds sub-images wherever they lie. The gradient itself is what mixes linearly:
each filter sees another mixture of the same few pictures, and that tells hundredths of a pixel.
"""

from dataclasses import dataclass

import numba
import numpy as np

_SMOOTHING = (2, 4, 8)
"""Standard deviations of the smoothing before the gradient to choose from, px."""

_BELL_WIDTH = 2
"""What is left of it for the gradient, in means over so many pixels that this is enough."""

_REACH = 3 * _BELL_WIDTH


def _half_taps() -> tuple[np.ndarray, np.ndarray]:
    """Return the taps of a Gaussian and of its slope from the middle on, both of unit response."""
    tap = np.arange(_REACH + 1)
    bell = np.exp(-((tap / _BELL_WIDTH) ** 2) / 2)
    slope = tap * bell / (2 * tap**2 @ bell)
    return (bell / (2 * bell.sum() - 1)).astype(np.float32), slope.astype(np.float32)


_BELL, _SLOPE = _half_taps()

_CLEAR = 100.0
"""Power of gradients over that of their noise from which on more smoothing only loses detail."""


@dataclass(frozen=True)
class Edges:
    """Edges of every unit's window: two numbers at each of a grid of points.

    values : (2, M, h, w) float32; of unit mean square for each unit, zero where bad.
    bad : (M, h, w) bool; where dead or saturated areas or the window's end make edges of their own.
    step : distance of the points, px.
    corner : where the first of them lies, down and across from the window's first pixel, px.
    smooth : standard deviation of the smoothing, px.
    """

    values: np.ndarray
    bad: np.ndarray
    step: int
    corner: float
    smooth: float

    @property
    def shared(self) -> float:
        """Number of points that share their noise.

        Half a Gaussian's noise-equivalent area; agrees with the scatter of shifts in noise.
        """
        return max(1.0, 2 * np.pi * (self.smooth / self.step) ** 2)

    def directions(self) -> "Edges":
        """Return the double-angle gradient of gradients, at half their resolution."""
        # The weakest edges are noise: their direction is shrunk to nothing.
        few = self.values[:, :, ::4, ::4]
        floor = np.sqrt(np.median(np.square(few).sum(0), (1, 2))) + np.float32(1e-20)
        _, units, height, width = self.values.shape
        shape = (units, -(-height // 2), -(-width // 2))
        values, wrong = np.empty((2, *shape), np.float32), np.empty(shape, bool)
        _double_angle(self.values, self.bad, floor, values, wrong)
        return Edges(values, wrong, 2 * self.step, self.corner, self.smooth)


def find_edges(
    images: np.ndarray,
    bad: np.ndarray | None = None,
    noise: np.ndarray | None = None,
    *,
    step: int = 2,
) -> Edges:
    """Return the gradients of pictures along x and y.

    Parameters
    ----------
    images : array, (M, H, W) float32
    bad : array, (M, H, W) bool, optional
        Pixels not to be believed. Single ones are taken as filled.
    noise : array, (M,), optional
        Variance of each picture's white noise. Pictures are smoothed just enough that in half of
        them the gradients stand well above its noise; without it, as little as may be.
    step : int
        Distance of the points, 2 or 4 px, and the least smoothing; 4 is four times as fast.

    Returns
    -------
    Edges
    """
    images = np.ascontiguousarray(images, np.float32)
    bad = np.zeros(images.shape, bool) if bad is None else bad
    # Small pictures would be smoothed away.
    choice = [s for s in _SMOOTHING if s >= step and 30 * s < min(images.shape[1:])]
    choice = choice or [_SMOOTHING[0]]
    smooth = choice[0] if noise is None else _enough(images, bad, noise, choice)
    step = max(min(step, smooth), smooth // 2)
    values, wrong = _gradients(images, bad, smooth, step)
    _scale(values, wrong)
    return Edges(values, wrong, step, (smooth // _BELL_WIDTH - 1) / 2, smooth)


def _enough(images: np.ndarray, bad: np.ndarray, noise: np.ndarray, choice: list[int]) -> int:
    """Return the least smoothing that lifts half of the pictures' gradients well above noise."""
    few = slice(None, None, max(1, len(images) // 6))
    some, bad, noise = images[few].copy(), bad[few].copy(), noise[few]
    above = []
    for smooth in choice:
        values, wrong = _gradients(some, bad, smooth, 2 * smooth)
        power = np.einsum("cmhw,cmhw->m", values, values) / (np.sum(~wrong, (1, 2)) + 1e-9)
        bell, slope = 2 * np.sum(_BELL[1:] ** 2) + _BELL[0] ** 2, 2 * np.sum(_SLOPE**2)
        of_noise = 2 * noise * (_BELL_WIDTH / smooth) ** 2 * bell * slope
        above.append(float(np.median(power / of_noise)))
        if above[-1] > _CLEAR:
            return smooth
    return choice[int(np.argmax(above))]


def _gradients(
    images: np.ndarray, bad: np.ndarray, smooth: int, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smoothed gradient along x and y, (2, M, h, w), and where it is wrong."""
    flaws, size = bad.view(np.uint8), smooth // _BELL_WIDTH
    for _ in range(size.bit_length() - 1):
        images, flaws = _halved(images, flaws)
    every = step // size
    shape = (len(images), *(-(-length // every) for length in images.shape[1:]))
    values, wrong = np.empty((2, *shape), np.float32), np.empty(shape, bool)
    _gradient(images, flaws, every, values, wrong)
    return values, wrong


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _halved(images, flaws):
    """Return the means over two by two pixels, and how many of them are bad."""
    units, rows, columns = images.shape
    height, width = rows // 2, columns // 2
    means = np.empty((units, height, width), np.float32)
    counts = np.empty((units, height, width), np.uint8)
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        upper, lower = images[unit, 2 * row], images[unit, 2 * row + 1]
        more, still = flaws[unit, 2 * row], flaws[unit, 2 * row + 1]
        pair, flawed = np.empty(2 * width, np.float32), np.empty(2 * width, np.uint8)
        for column in range(2 * width):
            pair[column] = np.float32(0.25) * (upper[column] + lower[column])
            flawed[column] = more[column] + still[column]
        mean, count = means[unit, row], counts[unit, row]
        for column in range(np.uint32(width)):  # never negative, or it were no vector loop
            mean[column] = pair[2 * column] + pair[2 * column + 1]
            count[column] = flawed[2 * column] + flawed[2 * column + 1]
    return means, counts


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _gradient(images, flaws, step, values, wrong):
    """Fill in the gradient at every `step`-th point, and where more than a few flaws spoil it."""
    units, rows, columns = images.shape
    _, _, height, _width = values.shape
    count = columns - 2 * _REACH
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        middle = row * step
        values[:, unit, row], wrong[unit, row] = 0, True
        if middle < _REACH or middle >= rows - _REACH:
            continue
        smooth, steep = _BELL[0] * images[unit, middle], np.zeros(columns, np.float32)
        for k in range(1, _REACH + 1):
            above, below = images[unit, middle - k], images[unit, middle + k]
            for column in range(columns):
                smooth[column] += _BELL[k] * (above[column] + below[column])
                steep[column] += _SLOPE[k] * (below[column] - above[column])
        x, y = np.zeros(count, np.float32), _BELL[0] * steep[_REACH : _REACH + count]
        for k in range(1, _REACH + 1):
            left, right = smooth[_REACH - k :], smooth[_REACH + k :]
            near, far = steep[_REACH - k :], steep[_REACH + k :]
            for n in range(count):
                x[n] += _SLOPE[k] * (right[n] - left[n])
                y[n] += _BELL[k] * (near[n] + far[n])
        first, last = -(-_REACH // step), (columns - _REACH - 1) // step + 1
        across, down = values[0, unit, row, first:last], values[1, unit, row, first:last]
        flags, start = wrong[unit, row, first:last], first * step - _REACH
        for n in range(last - first):
            across[n], down[n], flags[n] = x[start + n * step], y[start + n * step], False
        spoilt, some = np.zeros(columns, np.uint8), False
        for near in range(middle - _REACH, middle + _REACH + 1):
            flawed = flaws[unit, near]
            for column in range(columns):
                spoilt[column] += flawed[column]
        for column in range(columns):  # most often nothing is wrong, which a vector loop tells
            some |= spoilt[column] > 0
        if some:
            for n in range(last - first):
                middle = start + n * step
                # Single pixels were filled; more are an area with its own edges.
                if spoilt[middle : middle + 2 * _REACH + 1].sum() > 4:
                    across[n], down[n], flags[n] = 0, 0, True


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _scale(values, wrong):
    """Scale every unit to unit mean square over its good points."""
    _, units, rows, columns = values.shape
    for unit in numba.prange(units):
        energy, count = 0.0, 1e-9
        for row in range(rows):
            across, down, flags = values[0, unit, row], values[1, unit, row], wrong[unit, row]
            power, flawed = np.float32(0), np.uint32(0)
            for column in range(columns):
                power += across[column] * across[column] + down[column] * down[column]
            for column in range(columns):
                flawed += flags[column]
            energy += power
            count += columns - flawed
        values[:, unit] *= np.float32(1 / np.sqrt(energy / count + 1e-30))


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _double_angle(gradients, bad, floor, values, wrong):
    """Fill in means of the double angle over 3 x 3 points around every second point."""
    _, units, rows, columns = gradients.shape
    _, _, height, width = values.shape
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        real, imaginary = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
        spoilt = np.zeros(columns, np.float32)
        for k in range(-1, 2):
            near = min(max(2 * row + k, 0), rows - 1)
            share = np.float32(0.5 if k == 0 else 0.25)
            across, down = gradients[0, unit, near], gradients[1, unit, near]
            for column in range(columns):
                x, y = across[column], down[column]
                part = share / (np.sqrt(x * x + y * y) + floor[unit])
                real[column] += part * (x * x - y * y)
                imaginary[column] += part * (x + x) * y
                spoilt[column] += share * bad[unit, near, column]
        for column in range(width):
            left, middle = max(2 * column - 1, 0), 2 * column
            right = min(2 * column + 1, columns - 1)
            values[0, unit, row, column] = 0.25 * (real[left] + real[right]) + 0.5 * real[middle]
            values[1, unit, row, column] = (
                0.25 * (imaginary[left] + imaginary[right]) + 0.5 * imaginary[middle]
            )
            mean = 0.25 * (spoilt[left] + spoilt[right]) + 0.5 * spoilt[middle]
            wrong[unit, row, column] = mean > 0.5
