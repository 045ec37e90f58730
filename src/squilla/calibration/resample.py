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


_BAND = 32
"""Rows of the field that are worked on together: what lies between two steps stays in the cache."""

_EXACT = 1e-4
"""What places may be wrong by, px."""


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


def resample_smoothly(
    images: np.ndarray, bad: np.ndarray, place: np.ndarray, values: np.ndarray, valid: np.ndarray
) -> bool:
    """Do what `resample` does with `SINC`, at places that polynomials tell, in half the time.

    Pictures are shifted along their rows first, then along their columns. What a point is shifted
    by along its row depends on the row it is seen in, and so needs a polynomial of that row.

    Parameters
    ----------
    images, bad, values, valid
        See `resample`; `images` (M, rows, columns) and `values` (M, H, W).
    place : array, (M, 2, 10)
        px; disparity and all.

    Returns
    -------
    bool
        Whether such polynomials exist, to 1e-4 px; nothing is filled in otherwise.
    """
    units, height, _ = valid.shape
    y, x = np.meshgrid(np.linspace(-1.1, 1.1, 9), np.linspace(-1, 1, 9), indexing="ij")
    down, right = np.einsum("mcp,pyx->cmyx", place, _powers(y, x)).reshape(2, units, -1)
    seen = y.ravel() + (down - place[:, :1, 0]) * 2 / max(height - 1, 1)
    terms = np.moveaxis(_powers(seen, x.ravel()), 0, -1)
    sheared = np.linalg.solve(terms.mT @ terms, terms.mT @ right[..., None])
    if np.abs((terms @ sheared)[..., 0] - right).max() > _EXACT:
        return False
    reach = np.stack([down.min(1) - 0.25, down.max(1) + 0.25], -1)  # more than between the nodes
    reach = np.floor(reach).astype(np.int32)
    place, sheared = place.astype(np.float32), sheared[..., 0].astype(np.float32)
    _resample_smoothly(images, bad, place, sheared, reach, values, valid)
    return True


def _powers(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.stack([y ** (a - b) * x**b for a in range(4) for b in range(a + 1)])


def monomials(height: int, width: int) -> np.ndarray:
    """Return 1, y, x, y^2, y x, x^2, y^3, y^2 x, y x^2, x^3 over a field, (10, H, W).

    y and x run from -1 to 1 from the first pixel's middle to the last's.
    """
    return _powers(np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width))


@numba.njit(cache=True, fastmath=True)
def _places(place, y, out):
    """Fill in the polynomial of the position along the row at y, gathered by powers of x."""
    a = place[0] + y * (place[1] + y * (place[3] + y * place[6]))
    b, c = place[2] + y * (place[4] + y * place[7]), place[5] + y * place[8]
    step = np.float32(2 / max(len(out) - 1, 1))
    for column in range(len(out)):
        x = column * step - np.float32(1)
        out[column] = a + x * (b + x * (c + x * place[9]))


@numba.njit(cache=True, fastmath=True)
def _split(place, whole, fraction):
    """Fill in the whole part of places, and the rest - 1/2."""
    for n in range(len(place)):
        floor = np.floor(place[n])
        whole[n], fraction[n] = np.int32(floor), place[n] - floor - np.float32(0.5)


@numba.njit(cache=True)
def _run(whole, first):
    """Return where the run of equal numbers that begins at `first` ends."""
    rest, other = whole[first:], False
    for n in range(len(rest)):  # most often all are equal, which a vector loop tells at once
        other |= rest[n] != rest[0]
    if not other:
        return len(whole)
    last = first + 1
    while last < len(whole) and whole[last] == whole[first]:
        last += 1
    return last


@numba.njit(cache=True)
def _see(bad, i, j, start, stop, good):
    """Fill in whether the four pixels around each place of a run are good."""
    upper, lower = bad[i, start + j : stop + j + 1], bad[i + 1, start + j : stop + j + 1]
    here = good[start:stop]
    for k in range(stop - start):
        here[k] = not (upper[k] | upper[k + 1] | lower[k] | lower[k + 1])


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
        v, u = np.empty(width, np.float32), np.empty(width, np.float32)
        y = np.float32(2 * row / max(height - 1, 1) - 1)
        for unit in range(units):
            _places(place[unit, 0], y, v)
            _places(place[unit, 1], y, u)
            for column in range(width):
                v[column] += row + disparity[row, column] * baseline[unit, 0]
                u[column] += disparity[row, column] * baseline[unit, 1]
            _split(v, top, down)
            _split(u, left, right)
            good[:] = False
            _weigh(kernel, down, along)
            _weigh(kernel, right, across)
            line[:] = 0
            # Along a run of points with the same whole shift everything is read in order.
            first = 0
            while first < width:
                i, j = top[first], left[first]
                last = min(_run(top, first), _run(left, first))
                start, stop = max(first, before - j), min(last, columns - taps + before + 1 - j)
                if before <= i <= rows - taps + before and start < stop:
                    for channel in range(channels):
                        _read(
                            images[channel, unit], i - before, j - before,
                            along, across, start, stop, line[channel],
                        )  # fmt: skip
                    _see(bad[unit], i, j, start, stop, good)
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


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True, error_model="numpy")
def _resample_smoothly(images, bad, place, sheared, reach, values, valid):
    units, rows, columns = images.shape
    _, height, width = valid.shape
    scale = np.float32(2 / max(height - 1, 1))
    for band in numba.prange(-(-height // _BAND)):
        first, last = band * _BAND, min((band + 1) * _BAND, height)
        deepest = _BAND + 7 + (reach[:, 1] - reach[:, 0]).max()
        between = np.empty((units, deepest, width), np.float32)
        top, left = np.empty(width, np.int32), np.empty(width, np.int32)
        down, right = np.empty(width, np.float32), np.empty(width, np.float32)
        line, good = np.empty(width, np.float32), np.empty(width, np.bool_)
        for unit in range(units):
            origin = first + reach[unit, 0] - 3
            for row in range(max(origin, 0), min(last + reach[unit, 1] + 4, rows)):
                _places(sheared[unit], scale * (row - place[unit, 0, 0]) - np.float32(1), line)
                _split(line, left, right)
                source, start = images[unit, row], 0
                between[unit, row - origin] = 0
                while start < width:
                    stop, j = _run(left, start), left[start]
                    begin, end = max(start, 3 - j), min(stop, columns - 4 - j)
                    if begin < end:
                        here = between[unit, row - origin, begin:end]
                        for k in range(4):
                            one, other = source[begin + j - 3 + k :], source[begin + j + 4 - k :]
                            _blend(k, right[begin:end], one, other, here)
                    start = stop
        for row in range(first, last):
            y = scale * row - np.float32(1)
            for unit in range(units):
                _places(place[unit, 0], y, line)
                _split(line, top, down)
                _places(place[unit, 1], y, line)
                _split(line, left, right)
                line[:], good[:] = 0, False
                start = 0
                while start < width:
                    stop, i, j = min(_run(top, start), _run(left, start)), top[start], left[start]
                    begin, end = max(start, 3 - j), min(stop, columns - 4 - j)
                    k = i - reach[unit, 0] + row - first
                    if 3 <= row + i < rows - 4 and 0 <= k <= deepest - 8 and begin < end:
                        for tap in range(4):
                            one = between[unit, k + tap, begin:end]
                            other = between[unit, k + 7 - tap, begin:end]
                            _blend(tap, down[begin:end], one, other, line[begin:end])
                        _see(bad[unit], row + i, j, begin, end, good)
                    start = stop
                for column in range(width):
                    values[unit, row, column] = line[column]
                    valid[unit, row, column] = good[column]


@numba.njit(cache=True, fastmath=True)
def _blend(tap, fraction, one, other, out):
    """Add two lines to one, weighted by a tap of the windowed sinc and the one that mirrors it."""
    a, b, c = SINC[tap, 0], SINC[tap, 1], SINC[tap, 2]
    d, e, f = SINC[tap, 3], SINC[tap, 4], SINC[tap, 5]
    for n in range(len(out)):
        t = fraction[n]
        s = t * t
        even, odd = a + s * (c + s * e), t * (b + s * (d + s * f))
        out[n] += (even + odd) * one[n] + (even - odd) * other[n]
