"""Depth for every pixel: planes swept through all sub-images at once."""

import numba
import numpy as np


def features(image, noise, smooth=1.2):
    from squilla.calibration.disparity import _derivative, _gradient

    bell, slope = _derivative(smooth)
    across, down = np.empty_like(image), np.empty_like(image)
    _gradient(image, bell, slope, across, down)
    sigma = np.sqrt(noise * (bell**2).sum() * (slope**2).sum()).astype(np.float32)[:, None, None]
    gx, gy = across / sigma, down / sigma
    return np.stack([gx, gy, gx**2 + gy**2], 1)


def double_angle(f):
    size = np.sqrt(f[:, 2] + 2)
    a, b = (f[:, 0] ** 2 - f[:, 1] ** 2) / size, 2 * f[:, 0] * f[:, 1] / size
    return np.stack([a, b, a**2 + b**2], 1)


def gaussian(sigma):
    reach = int(np.ceil(2 * sigma))
    tap = np.arange(-reach, reach + 1)
    bell = np.exp(-(tap**2) / (2 * sigma**2))
    return (bell / bell.sum()).astype(np.float32)


@numba.njit(fastmath=True, cache=True, error_model="numpy")
def _add(up, down, a, b, c, d, w, s):
    for x in range(len(s)):
        s[x] += w * (a * up[x] + b * up[x + 1] + c * down[x] + d * down[x + 1])


@numba.njit(fastmath=True, cache=True)
def _smooth(field, bell, wide, out):
    n = len(bell)
    width = wide.shape[1]
    for r in range(field.shape[0]):
        wide[r] = 0
        for k in range(n):
            part = field[r, k : k + width]
            for x in range(width):
                wide[r, x] += bell[k] * part[x]
    for r in range(out.shape[0]):
        out[r] = 0
        for k in range(n):
            for x in range(width):
                out[r, x] += bell[k] * wide[r + k, x]


@numba.njit(parallel=True, fastmath=True, cache=True, error_model="numpy")
def sweep(feature, weight, start, baseline, group, planes, bell, floor, half_cost, tile, cost, edge):
    units = feature.shape[0]
    height, width, count = cost.shape
    reach = len(bell) // 2
    power = np.zeros(5, np.float32)
    for m in range(units):
        for subset in range(5):
            if _within(group[m], subset):
                power[subset] += weight[m] ** 2
    for block in numba.prange((height + tile - 1) // tile):
        top = block * tile
        bottom = min(top + tile, height)
        first = top - reach
        rows = bottom - top + 2 * reach
        columns = width + 2 * reach
        sums = np.empty((4, 3, rows, columns), np.float32)
        field = np.empty((rows, columns), np.float32)
        wide = np.empty((rows, width), np.float32)
        shared = np.empty((bottom - top, width), np.float32)
        whole = np.empty((bottom - top, width), np.float32)
        best = np.full((bottom - top, width), np.float32(1e9))
        for k in range(count):
            sums[:] = 0
            for m in range(units):
                v = start[m, 0] + planes[k] * baseline[m, 0] + first
                u = start[m, 1] + planes[k] * baseline[m, 1] - reach
                i, j = int(np.floor(v)), int(np.floor(u))
                fv, fu = np.float32(v - i), np.float32(u - j)
                one = np.float32(1)
                a, b = (one - fv) * (one - fu), (one - fv) * fu
                c, d = fv * (one - fu), fv * fu
                for channel in range(3):
                    w = weight[m] if channel < 2 else one
                    for r in range(rows):
                        _add(
                            feature[m, channel, i + r, j : j + columns + 1],
                            feature[m, channel, i + r + 1, j : j + columns + 1],
                            a, b, c, d, w, sums[group[m], channel, r],
                        )
            for subset in range(5):
                for part in range(2):
                    if part == 0:
                        field[:] = 0
                        for channel in range(2):
                            for r in range(rows):
                                for x in range(columns):
                                    z = np.float32(0)
                                    for q in range(4):
                                        if _within(q, subset):
                                            z += sums[q, channel, r, x]
                                    field[r, x] += z * z
                        _smooth(field, bell, wide, shared)
                    else:
                        field[:] = 0
                        for q in range(4):
                            if _within(q, subset):
                                field += sums[q, 2]
                        _smooth(field, bell, wide, whole)
                members = np.float32(units if subset == 0 else units / 2)
                for r in range(bottom - top):
                    for x in range(width):
                        e = shared[r, x] / power[subset]
                        z = (whole[r, x] - e) / (whole[r, x] + floor * members)
                        if subset == 0:
                            cost[top + r, x, k] = z
                            if z < best[r, x]:
                                best[r, x] = z
                                edge[top + r, x] = e
                        else:
                            cost[top + r, x, k] = min(cost[top + r, x, k], z + half_cost)


@numba.njit(cache=True)
def _within(q, subset):
    # quadrants: 0 upper left, 1 upper right, 2 lower left, 3 lower right
    if subset == 0:
        return True
    if subset == 1:
        return q % 2 == 0
    if subset == 2:
        return q % 2 == 1
    if subset == 3:
        return q < 2
    return q >= 2


@numba.njit(parallel=True, fastmath=True, cache=True)
def semi_global(cost, small, large, total):
    """Two passes of four directions; large (H, W) penalty of a jump. total (2, H, W, D)."""
    height, width, count = cost.shape
    for turn in numba.prange(2):
        last = np.empty((4, width + 2, count), np.float32)
        low = np.empty((4, width + 2), np.float32)
        new = np.empty((4, width + 2, count), np.float32)
        newlow = np.empty((4, width + 2), np.float32)
        last[:] = 0
        low[:] = 0
        for r0 in range(height):
            r = r0 if turn == 0 else height - 1 - r0
            new[:] = 0
            newlow[:] = 0
            for c0 in range(width):
                c = c0 if turn == 0 else width - 1 - c0
                jump = large[r, c]
                for way in range(4):
                    if way == 0:
                        before = new[0, c0]
                        least = newlow[0, c0]
                    else:
                        before = last[way, c0 + way - 1]
                        least = low[way, c0 + way - 1]
                    here = new[way, c0 + 1]
                    bottom = np.float32(1e9)
                    for k in range(count):
                        z = min(before[k], least + jump)
                        if k > 0:
                            z = min(z, before[k - 1] + small)
                        if k < count - 1:
                            z = min(z, before[k + 1] + small)
                        z += cost[r, c, k] - least
                        here[k] = z
                        bottom = min(bottom, z)
                        total[turn, r, c, k] += z
                    newlow[way, c0 + 1] = bottom
            last, new = new, last
            low, newlow = newlow, low
