"""What sub-images have in common whatever their filters do to the contrast: their edges.

Filters change intensities from one sub-image to the next and may even invert them. The directions
of edges they leave alone: the double-angle gradient (gx + i gy)^2 / |g| is the same for a step up
and a step down, and finds sub-images wherever they lie. The gradient itself is what mixes linearly:
each filter sees another mixture of the same few pictures, and that tells hundredths of a pixel.
"""

from dataclasses import dataclass

import numba
import numpy as np

_SMOOTHING = (2.0, 4.0, 8.0)
"""Standard deviations of the smoothing before the gradient to choose from, px."""

_CLEAR = 100.0
"""Power of gradients over that of their noise from which on more smoothing only loses detail."""

_STEP = 2
"""Distance of the points at which edges are looked at, px; they are smooth enough for that."""


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
        """Number of points that share their noise: half a Gaussian's noise-equivalent area."""
        return max(1.0, 2 * np.pi * (self.smooth / self.step) ** 2)

    def directions(self) -> "Edges":
        """Return the double-angle gradient of gradients, at half their resolution."""
        # The weakest edges are noise: their direction is shrunk to nothing.
        few = self.values[:, :, ::4, ::4]
        floor = np.sqrt(np.median(np.square(few).sum(0), (1, 2)))
        values = np.empty_like(self.values)
        _double_angle(self.values, floor, values)
        bad = self.bad.astype(np.float32)
        for axis in (-2, -1):
            values, bad = _halved(values, axis), _halved(bad, axis)
        return Edges(np.ascontiguousarray(values), bad > 0.5, 2 * self.step, self.smooth)


def find_edges(
    images: np.ndarray, bad: np.ndarray | None = None, noise: np.ndarray | None = None
) -> Edges:
    """Return the gradients of pictures along x and y.

    Parameters
    ----------
    images : array, (M, H, W) float32
    bad : array, (M, H, W) bool, optional
        Pixels not to be believed. Single ones are taken as filled.
    noise : array, (M,), optional
        Variance of each picture's white noise. Pictures are smoothed just enough that in half of
        them the gradients stand well above its noise; without it, by 2 px.

    Returns
    -------
    Edges
    """
    images = np.ascontiguousarray(images, np.float32)
    bad = np.zeros(images.shape, bool) if bad is None else bad
    smooth = _SMOOTHING[0] if noise is None else _enough(images, bad, noise)
    values, wrong = _gradients(images, bad, smooth)
    _remove_shading(values, ~wrong)
    energy = np.einsum("cmhw,cmhw->m", values, values) / (np.sum(~wrong, (1, 2)) + 1e-9)
    values /= np.sqrt(energy + 1e-30)[:, None, None]
    return Edges(values, wrong, _STEP, smooth)


def _remove_shading(values: np.ndarray, good: np.ndarray) -> None:
    """Take from each unit's gradients what grows from the middle of its window outwards.

    So filters shade their sub-images, for they pass less or more at larger field angles. It stays
    with the unit when the scene moves, and would hold it where it is.
    """
    _, units, height, width = values.shape
    y, x = np.arange(height) - (height - 1) / 2, np.arange(width) - (width - 1) / 2
    outwards = np.stack(np.broadcast_arrays(x, y[:, None])).astype(np.float32)
    power = good.reshape(units, -1).astype(np.float32) @ np.square(outwards).sum(0).ravel()
    share = np.einsum("cmhw,chw->m", values, outwards) / (power + 1e-9)
    values -= share[:, None, None] * outwards[:, None] * good


def _enough(images: np.ndarray, bad: np.ndarray, noise: np.ndarray) -> float:
    """Return the least smoothing that lifts half of the pictures' gradients well above noise."""
    some, above = slice(None, None, max(1, len(images) // 6)), []
    # Small pictures would be smoothed away.
    choice = [each for each in _SMOOTHING if 30 * each < min(images.shape[1:])] or _SMOOTHING[:1]
    for smooth in choice:
        values, wrong = _gradients(images[some], bad[some], smooth)
        power = np.einsum("cmhw,cmhw->m", values, values) / (np.sum(~wrong, (1, 2)) + 1e-9)
        bell, slope = _derivative(smooth)
        of_noise = 2 * noise[some] * (bell**2).sum() * (slope**2).sum()
        above.append(float(np.median(power / of_noise)))
        if above[-1] > _CLEAR:
            return smooth
    return choice[int(np.argmax(above))]


def _gradients(images: np.ndarray, bad: np.ndarray, smooth: float) -> tuple[np.ndarray, ...]:
    """Return the smoothed gradient along x and y, (2, M, h, w), and where it is wrong."""
    units, rows, columns = images.shape
    shape = (units, -(-rows // _STEP), -(-columns // _STEP))
    values, wrong = np.empty((2, *shape), np.float32), np.empty(shape, bool)
    _gradient(images, bad, *_derivative(smooth), values, wrong)
    return values, wrong


def _derivative(smooth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the taps of a Gaussian and of its slope, both of unit response."""
    tap = np.arange(-int(np.ceil(3 * smooth)), int(np.ceil(3 * smooth)) + 1)
    bell = np.exp(-(tap**2) / (2 * smooth**2))
    bell /= bell.sum()
    slope = tap * bell / (tap**2 * bell).sum()
    return bell.astype(np.float32), slope.astype(np.float32)


@numba.njit(parallel=True, cache=True, fastmath=True)
def _gradient(images, bad, bell, slope, values, wrong):
    units, rows, columns = images.shape
    _, _, height, _width = values.shape
    reach = len(bell) // 2
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        middle = row * _STEP
        values[:, unit, row], wrong[unit, row] = 0, True
        if middle < reach or middle >= rows - reach:
            continue
        smooth, steep = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
        spoilt = np.zeros(columns, np.uint8)
        for k in range(len(bell)):
            source, flags = images[unit, middle + k - reach], bad[unit, middle + k - reach]
            a, b = bell[k], slope[k]
            for column in range(columns):
                smooth[column] += a * source[column]
                steep[column] += b * source[column]
                spoilt[column] += flags[column]
        for column in range(-(-reach // _STEP), (columns - reach - 1) // _STEP + 1):
            first = column * _STEP - reach
            x, y, count = np.float32(0), np.float32(0), 0
            for k in range(len(bell)):
                x += slope[k] * smooth[first + k]
                y += bell[k] * steep[first + k]
                count += spoilt[first + k]
            if count <= 4:  # single pixels, filled; more are an area with edges of its own
                values[0, unit, row, column], values[1, unit, row, column] = x, y
                wrong[unit, row, column] = False


@numba.njit(parallel=True, cache=True, fastmath=True)
def _double_angle(gradients, floor, values):
    _, units, rows, columns = gradients.shape
    for unit in numba.prange(units):
        for row in range(rows):
            for column in range(columns):
                x, y = gradients[0, unit, row, column], gradients[1, unit, row, column]
                size = np.sqrt(x * x + y * y) + floor[unit] + np.float32(1e-20)
                values[0, unit, row, column] = (x * x - y * y) / size
                values[1, unit, row, column] = (x + x) * y / size


def _halved(values: np.ndarray, axis: int) -> np.ndarray:
    """Return every second sample of an axis, each the mean of itself and its neighbours."""
    values = np.moveaxis(values, axis, 0)
    padded = np.concatenate([values[:1], values, values[-1:]])
    mean = 0.25 * padded[:-2:2] + 0.5 * padded[1:-1:2] + 0.25 * padded[2::2]
    return np.moveaxis(mean, 0, axis)
