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

_CLEAR = 100.0
"""Power of gradients over that of their noise from which on more smoothing only loses detail."""


@dataclass(frozen=True)
class Edges:
    """Edges of every unit's window: two numbers at each of a grid of points.

    values : (2, M, h, w) float32; of unit mean square for each unit, zero where bad.
    bad : (M, h, w) bool; where dead or saturated areas or the window's end make edges of their own.
    step : distance of the points, px; the first lies on the window's first pixel.
    smooth : standard deviation of the smoothing, px.
    """

    values: np.ndarray
    bad: np.ndarray
    step: int
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
        return Edges(values, wrong, 2 * self.step, self.smooth)


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
    return Edges(values, wrong, step, smooth)


def _enough(images: np.ndarray, bad: np.ndarray, noise: np.ndarray, choice: list[int]) -> int:
    """Return the least smoothing that lifts half of the pictures' gradients well above noise."""
    some, above = slice(None, None, max(1, len(images) // 6)), []
    for smooth in choice:
        values, wrong = _gradients(images[some], bad[some], smooth, smooth)
        power = np.einsum("cmhw,cmhw->m", values, values) / (np.sum(~wrong, (1, 2)) + 1e-9)
        bell, slope = _derivative(smooth)
        of_noise = 2 * noise[some] * (bell**2).sum() * (slope**2).sum()
        above.append(float(np.median(power / of_noise)))
        if above[-1] > _CLEAR:
            return smooth
    return choice[int(np.argmax(above))]


def _gradients(
    images: np.ndarray, bad: np.ndarray, smooth: int, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smoothed gradient along x and y, (2, M, h, w), and where it is wrong."""
    units, rows, columns = images.shape
    shape = (units, -(-rows // step), -(-columns // step))
    values, wrong = np.empty((2, *shape), np.float32), np.empty(shape, bool)
    _gradient(images, bad, step, *_derivative(smooth), values, wrong)
    return values, wrong


def _derivative(smooth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the taps of a Gaussian and of its slope, both of unit response."""
    tap = np.arange(-int(np.ceil(3 * smooth)), int(np.ceil(3 * smooth)) + 1)
    bell = np.exp(-(tap**2) / (2 * smooth**2))
    bell /= bell.sum()
    slope = tap * bell / (tap**2 * bell).sum()
    return bell.astype(np.float32), slope.astype(np.float32)


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _gradient(images, bad, step, bell, slope, values, wrong):
    units, rows, columns = images.shape
    _, _, height, _width = values.shape
    reach = len(bell) // 2
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        middle = row * step
        values[:, unit, row], wrong[unit, row] = 0, True
        if middle < reach or middle >= rows - reach:
            continue
        smooth, steep = bell[reach] * images[unit, middle], np.zeros(columns, np.float32)
        for k in range(1, reach + 1):
            above, below = images[unit, middle - k], images[unit, middle + k]
            a, b = bell[reach + k], slope[reach + k]
            for column in range(columns):
                smooth[column] += a * (above[column] + below[column])
                steep[column] += b * (below[column] - above[column])
        spoilt = np.zeros(columns, np.uint8)
        for near in range(middle - reach, middle + reach + 1):
            flags = bad[unit, near]
            for column in range(columns):
                spoilt[column] += flags[column]
        # Every step-th sample together, so that the compiler makes vector loops of what follows.
        length = columns // step
        parts = np.empty((2, step, length), np.float32)
        flags = np.empty((step, length), np.uint8)
        for phase in range(step):
            for n in range(length):
                parts[0, phase, n] = smooth[n * step + phase]
                parts[1, phase, n] = steep[n * step + phase]
                flags[phase, n] = spoilt[n * step + phase]
        first = -(-reach // step)
        count = (step * length - reach - 1) // step + 1 - first
        x, y = (
            values[0, unit, row, first : first + count],
            values[1, unit, row, first : first + count],
        )
        flawed = np.zeros(count, np.int32)
        for k in range(len(bell)):
            at, phase = (first * step + k - reach) // step, (first * step + k - reach) % step
            a, b = parts[0, phase, at : at + count], parts[1, phase, at : at + count]
            c, along, beside = flags[phase, at : at + count], slope[k], bell[k]
            for n in range(count):
                x[n] += along * a[n]
                y[n] += beside * b[n]
                flawed[n] += c[n]
        for n in range(count):
            good = flawed[n] <= 4  # single pixels, filled; more are an area with its own edges
            wrong[unit, row, first + n] = not good
            x[n], y[n] = x[n] * good, y[n] * good


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _scale(values, wrong):
    """Scale every unit to unit mean square over its good points."""
    _, units, rows, columns = values.shape
    for unit in numba.prange(units):
        energy, count = 0.0, 1e-9
        for row in range(rows):
            across, down, flags = values[0, unit, row], values[1, unit, row], wrong[unit, row]
            for column in range(columns):
                energy += across[column] ** 2 + down[column] ** 2
                count += not flags[column]
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
