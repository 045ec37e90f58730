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

_FINE = 2
"""Standard deviation up to which pictures are smoothed as they are; for more, halved before, px."""

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
    return Edges(values, wrong, step, (smooth // _FINE - 1) / 2, smooth)


def _enough(images: np.ndarray, bad: np.ndarray, noise: np.ndarray, choice: list[int]) -> int:
    """Return the least smoothing that lifts half of the pictures' gradients well above noise."""
    few = slice(None, None, max(1, len(images) // 6))
    some, bad, noise = images[few].copy(), bad[few].copy(), noise[few]
    above = []
    for smooth in choice:
        values, wrong = _gradients(some, bad, smooth, 2 * smooth)
        power = np.einsum("cmhw,cmhw->m", values, values) / (np.sum(~wrong, (1, 2)) + 1e-9)
        bell, slope = _half_taps(smooth)
        gain = (2 * np.sum(bell**2) - bell[0] ** 2) * 2 * np.sum(slope**2)
        of_noise = 2 * noise * gain * (smooth // _FINE) ** 2
        above.append(float(np.median(power / of_noise)))
        if above[-1] > _CLEAR:
            return smooth
    return choice[int(np.argmax(above))]


def _gradients(
    images: np.ndarray, bad: np.ndarray, smooth: int, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smoothed gradient along x and y, (2, M, h, w), and where it is wrong."""
    flaws, size, variance = bad.view(np.uint8), 1, float(smooth**2)
    while size * _FINE < smooth:
        images, flaws = _halved(images, flaws)
        variance -= 0.75 * size**2  # which halving has smoothed by
        size *= 2
    every = step // size
    shape = (len(images), *(-(-length // every) for length in images.shape[1:]))
    values, wrong = np.empty((2, *shape), np.float32), np.empty(shape, bool)
    _gradient(images, flaws, every, *_half_taps(np.sqrt(variance) / size), values, wrong)
    return values, wrong


def _half_taps(width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the taps of a Gaussian and of its slope from the middle on, both of unit response."""
    tap = np.arange(int(np.ceil(3 * width)) + 1)
    bell = np.exp(-((tap / width) ** 2) / 2)
    slope = tap * bell / (2 * tap**2 @ bell)
    return (bell / (2 * bell.sum() - 1)).astype(np.float32), slope.astype(np.float32)


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _halved(images, flaws):
    """Return pictures of half the size, smoothed by (1 3 3 1) / 8, and how much of them is bad."""
    units, rows, columns = images.shape
    height, width = rows // 2, columns // 2
    means = np.empty((units, height, width), np.float32)
    counts = np.empty((units, height, width), np.uint8)
    one, three = np.float32(1 / 8), np.float32(3 / 8)
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        upper, lower = images[unit, 2 * row], images[unit, 2 * row + 1]
        above, below = images[unit, max(2 * row - 1, 0)], images[unit, min(2 * row + 2, rows - 1)]
        more, still = flaws[unit, 2 * row], flaws[unit, 2 * row + 1]
        down, flawed = np.empty(2 * width + 2, np.float32), np.empty(2 * width, np.uint8)
        inner = down[1:]
        for column in range(2 * width):
            outer = one * (above[column] + below[column])
            inner[column] = outer + three * (upper[column] + lower[column])
            flawed[column] = more[column] + still[column]
        down[0], down[-1] = down[1], down[-2]
        mean, count = means[unit, row], counts[unit, row]
        for column in range(np.uint32(width)):  # never negative, or it were no vector loop
            outer = one * (down[2 * column] + down[2 * column + 3])
            mean[column] = outer + three * (down[2 * column + 1] + down[2 * column + 2])
            count[column] = flawed[2 * column] + flawed[2 * column + 1]
    return means, counts


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _gradient(images, flaws, step, bell, slope, values, wrong):
    """Fill in the gradient at every `step`-th point, and where more than a few flaws spoil it."""
    units, rows, columns = images.shape
    _, _, height, _width = values.shape
    reach = len(bell) - 1
    count = columns - 2 * reach
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        middle = row * step
        values[:, unit, row], wrong[unit, row] = 0, True
        if middle < reach or middle >= rows - reach:
            continue
        smooth, steep = bell[0] * images[unit, middle], np.zeros(columns, np.float32)
        for k in range(1, reach + 1):
            above, below = images[unit, middle - k], images[unit, middle + k]
            a, b = bell[k], slope[k]
            for column in range(columns):
                smooth[column] += a * (above[column] + below[column])
                steep[column] += b * (below[column] - above[column])
        x, y = np.zeros(count, np.float32), bell[0] * steep[reach : reach + count]
        for k in range(1, reach + 1):
            left, right = smooth[reach - k :], smooth[reach + k :]
            near, far = steep[reach - k :], steep[reach + k :]
            a, b = bell[k], slope[k]
            for n in range(count):
                x[n] += b * (right[n] - left[n])
                y[n] += a * (near[n] + far[n])
        first, last = -(-reach // step), (columns - reach - 1) // step + 1
        across, down = values[0, unit, row, first:last], values[1, unit, row, first:last]
        flags, start = wrong[unit, row, first:last], first * step - reach
        for n in range(last - first):
            across[n], down[n], flags[n] = x[start + n * step], y[start + n * step], False
        spoilt, some = np.zeros(columns, np.uint8), False
        for k in range(middle - reach, middle + reach + 1):
            flawed = flaws[unit, k]
            for column in range(columns):
                spoilt[column] += flawed[column]
        for column in range(columns):  # most often nothing is wrong, which a vector loop tells
            some |= spoilt[column] > 0
        if some:
            for n in range(last - first):
                at = start + n * step
                # Single pixels were filled; more are an area with its own edges.
                if spoilt[at : at + 2 * reach + 1].sum() > 4:
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
