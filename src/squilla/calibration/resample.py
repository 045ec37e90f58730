"""Reading many pictures between their pixels, each at its own places, once."""

import numba
import numpy as np


def sinc_kernel(fraction: np.ndarray) -> np.ndarray:
    """Return a windowed sinc of 8 taps (Kaiser, beta 4.5), the filter that shifts pictures.

    At every shift its response is within 0.6 % of one up to 0.3 cycles per px.

    Parameters
    ----------
    fraction : array, (...)
        Place between the fourth and the fifth tap, 0..1 px.

    Returns
    -------
    array, (..., 8), summing to 1
    """
    position = np.arange(8) - 3 - np.asarray(fraction, float)[..., None]
    window = np.i0(4.5 * np.sqrt(np.maximum(1 - (position / 4) ** 2, 0)))
    kernel = np.sinc(position) * window
    return kernel / kernel.sum(-1, keepdims=True)


def _polynomials(kernel, degree: int) -> np.ndarray:
    """Return each tap of a kernel as a polynomial of the fraction - 1/2, (taps, degree + 1)."""
    fraction = np.linspace(0, 1, 201)
    return np.polynomial.polynomial.polyfit(fraction - 0.5, kernel(fraction), degree).T


SINC = _polynomials(sinc_kernel, 5).astype(np.float32)
"""The windowed sinc, to 4e-5: taps x powers of the fraction - 1/2."""

CUBIC = np.array(  # through four points; exact for cubics
    [
        [-0.0625, 1 / 24, 0.25, -1 / 6, 0, 0],
        [0.5625, -1.125, -0.25, 0.5, 0, 0],
        [0.5625, 1.125, -0.25, -0.5, 0, 0],
        [-0.0625, -1 / 24, 0.25, 1 / 6, 0, 0],
    ],
    np.float32,
)
"""Lagrange's cubic of four points, for what is smooth already; written like `SINC`."""


def resample(
    images: np.ndarray,
    bad: np.ndarray,
    place: np.ndarray,
    baseline: np.ndarray,
    disparity: np.ndarray,
    kernel: np.ndarray,
    values: np.ndarray,
    valid: np.ndarray,
) -> None:
    """Read every unit's pictures where the unit sees the points p of the reference view.

    That is at ``p + place(p) + disparity(p) * baseline``.

    Parameters
    ----------
    images : array, (C, M, rows, columns) float32
        C pictures for each unit.
    bad : array, (M, rows, columns) bool
    place : array, (M, 2, 10)
        px; polynomial of the position, see `monomials`.
    baseline : array, (M, 2)
    disparity : array, (H, W)
    kernel : array, (taps, powers)
        `SINC` or `CUBIC`.
    values : array, (C, M, H, W) float32, filled; in any order of memory
    valid : array, (M, H, W) bool, filled
        True where the four pixels around a place are good and the kernel lies inside.
    """
    _resample(
        images,
        bad,
        np.ascontiguousarray(place, np.float32),
        np.ascontiguousarray(baseline, np.float32),
        np.ascontiguousarray(disparity, np.float32),
        kernel,
        values,
        valid,
    )


def monomials(height: int, width: int) -> np.ndarray:
    """Return 1, y, x, y^2, y x, x^2, y^3, y^2 x, y x^2, x^3 over a field, (10, H, W).

    y and x run from -1 to 1 from the first pixel's middle to the last's.
    """
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None, :]
    powers = [(a - b, b) for a in range(4) for b in range(a + 1)]
    return np.stack([y**i * x**j for i, j in powers])


@numba.njit(cache=True, fastmath=True)
def _weigh(kernel, fraction, weights):
    """Fill in the weights (taps, n) of a kernel at n fractions."""
    for tap in range(len(kernel)):
        a, b, c = kernel[tap, 0], kernel[tap, 1], kernel[tap, 2]
        d, e, f = kernel[tap, 3], kernel[tap, 4], kernel[tap, 5]
        weight = weights[tap]
        for k in range(len(fraction)):
            t = fraction[k]
            weight[k] = a + t * (b + t * (c + t * (d + t * (e + t * f))))


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True, error_model="numpy")
def _resample(images, bad, place, baseline, disparity, kernel, values, valid):
    channels, units, rows, columns = images.shape
    height, width = disparity.shape
    taps = len(kernel)
    before = taps // 2 - 1
    for row in numba.prange(height):
        top, left = np.empty(width, np.int32), np.empty(width, np.int32)
        down, right = np.empty(width, np.float32), np.empty(width, np.float32)
        along, across = np.empty((taps, width), np.float32), np.empty((taps, width), np.float32)
        line, good = np.empty((channels, width), np.float32), np.empty(width, np.bool_)
        y = np.float32(2 * row / max(height - 1, 1) - 1)
        for unit in range(units):
            # The polynomial of the position, gathered by powers of x.
            p, q = place[unit, 0], place[unit, 1]
            p0, q0 = (
                p[0] + y * (p[1] + y * (p[3] + y * p[6])),
                q[0] + y * (q[1] + y * (q[3] + y * q[6])),
            )
            p1, q1 = p[2] + y * (p[4] + y * p[7]), q[2] + y * (q[4] + y * q[7])
            p2, q2 = p[5] + y * p[8], q[5] + y * q[8]
            p3, q3 = p[9], q[9]
            step = np.float32(2 / max(width - 1, 1))
            for column in range(width):
                x = column * step - np.float32(1)
                d = disparity[row, column]
                v = row + p0 + x * (p1 + x * (p2 + x * p3)) + d * baseline[unit, 0]
                u = q0 + x * (q1 + x * (q2 + x * q3)) + d * baseline[unit, 1]
                i, j = np.floor(v), np.floor(u)
                top[column], left[column] = np.int32(i), np.int32(j)
                down[column], right[column] = v - i - np.float32(0.5), u - j - np.float32(0.5)
                good[column] = False
            _weigh(kernel, down, along)
            _weigh(kernel, right, across)
            line[:] = 0
            # Along a run of points with the same whole shift everything is read in order.
            first = 0
            while first < width:
                i, j = top[first], left[first]
                last = first + 1
                while last < width and top[last] == i and left[last] == j:
                    last += 1
                start, stop = max(first, before - j), min(last, columns - taps + before + 1 - j)
                if before <= i <= rows - taps + before and start < stop:
                    for channel in range(channels):
                        _read(
                            images[channel, unit], i - before, j - before,
                            along, across, start, stop, line[channel],
                        )  # fmt: skip
                    upper = bad[unit, i, start + j : stop + j + 1]
                    lower = bad[unit, i + 1, start + j : stop + j + 1]
                    for k in range(stop - start):
                        good[start + k] = not (upper[k] | upper[k + 1] | lower[k] | lower[k + 1])
                first = last
            for column in range(width):
                valid[unit, row, column] = good[column]
            for channel in range(channels):
                for column in range(width):
                    values[channel, unit, row, column] = line[channel, column]


@numba.njit(cache=True, fastmath=True)
def _read(image, top, left, along, across, start, stop, line):
    """Fill in a run of points with what a kernel, other weights at each point, sees."""
    taps = len(along)
    here = line[start:stop]
    here[:] = 0
    a, b = across[0, start:stop], across[1, start:stop]
    c, d = across[2, start:stop], across[3, start:stop]
    for k in range(0, taps, 2):  # two rows at a time, for the weights across serve both
        p, q = along[k, start:stop], along[k + 1, start:stop]
        v = image[top + k, left + start : left + stop + taps - 1]
        w = image[top + k + 1, left + start : left + stop + taps - 1]
        # Written out, for the compiler makes one vector loop of it.
        if taps == 4:
            for n in range(len(here)):
                here[n] += (
                    a[n] * (p[n] * v[n] + q[n] * w[n])
                    + b[n] * (p[n] * v[n + 1] + q[n] * w[n + 1])
                    + c[n] * (p[n] * v[n + 2] + q[n] * w[n + 2])
                    + d[n] * (p[n] * v[n + 3] + q[n] * w[n + 3])
                )
            continue
        e, f = across[4, start:stop], across[5, start:stop]
        g, h = across[6, start:stop], across[7, start:stop]
        for n in range(len(here)):
            here[n] += (
                a[n] * (p[n] * v[n] + q[n] * w[n])
                + b[n] * (p[n] * v[n + 1] + q[n] * w[n + 1])
                + c[n] * (p[n] * v[n + 2] + q[n] * w[n + 2])
                + d[n] * (p[n] * v[n + 3] + q[n] * w[n + 3])
                + e[n] * (p[n] * v[n + 4] + q[n] * w[n + 4])
                + f[n] * (p[n] * v[n + 5] + q[n] * w[n + 5])
                + g[n] * (p[n] * v[n + 6] + q[n] * w[n + 6])
                + h[n] * (p[n] * v[n + 7] + q[n] * w[n + 7])
            )
