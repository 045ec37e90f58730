"""Depth for every point: planes swept through all sub-images at once.

The array is rigid, so the disparities of a point in all units are one number, its inverse depth,
times the calibrated baselines. Planes of inverse depth are swept through the scene, and at each the
gradients of all sub-images are laid over each other: where the plane is right they add up, where it
is wrong they scatter. No two filters need to see the same brightness for that.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor

from squilla.calibration.calibration import Lattice
from squilla.calibration.plain import fill_plain, plain_areas
from squilla.calibration.resample import CUBIC, SINC, resample
from squilla.calibration.surfaces import is_relief, lowest, settled, smoothed, trusted, unhidden

if TYPE_CHECKING:
    from xarray import DataArray

    from squilla.calibration.views import SubImages

_STEP = 0.45
"""Shift of the farthest unit from one plane to the next, px: well within the width of an edge."""

_SMOOTH, _WINDOW = 1.2, 1.0
"""Standard deviations, px: of the smoothing before the gradient, and of the window that gathers."""

_FLOOR = 8.0
"""Energy, in that of the noise, at which unexplained gradients count half."""

_HALF = 0.06
"""Price of believing one half of the array alone, as a share of unexplained energy."""

_SURE = 0.1
"""Expected standard deviation of the disparity, px per pitch, up to which a point is believed."""

_LIMIT = 0.03
"""Deviation that is left without noise, px per pitch, as benchmarks/depth.py finds it."""


@dataclass(frozen=True)
class Depth:
    """How far away every point of the reference view is.

    distance : (H, W) mm.
    error : (H, W) mm, its standard deviation as the noise and the texture around let expect.
    confident : (H, W) bool; False where there is too little texture: there the distance is filled
        in from the neighbours.
    """

    distance: Tensor
    error: Tensor
    confident: Tensor

    @classmethod
    def of(cls, disparity: np.ndarray, deviation: np.ndarray, lattice: Lattice) -> "Depth":
        """Turn disparities and their standard deviations, (H, W) px per pitch, into distances.

        A distance z = f B / d is uncertain by z^2 / (f B) times what d is.
        """
        scale = lattice.distance(1.0)
        distance = torch.from_numpy(scale / np.maximum(disparity, 0.01))
        error = distance**2 / scale * torch.from_numpy(deviation)
        return cls(distance, error, torch.from_numpy(deviation <= _SURE))

    def arrays(self) -> "dict[str, DataArray]":
        """Return what is saved beside a cube: depth, depth_error and depth_confident, (y, x)."""
        from xarray import DataArray

        told = {
            "depth": (self.distance, {"units": "mm", "long_name": "distance"}),
            "depth_error": (self.error, {"units": "mm", "long_name": "standard deviation"}),
            "depth_confident": (
                self.confident.to(torch.uint8), {"long_name": "1 where the texture suffices"}
            ),
        }  # fmt: skip
        return {
            name: DataArray(values.numpy(), dims=("y", "x"), name=name, attrs=facts)
            for name, (values, facts) in told.items()
        }


def find_depth(
    views: "SubImages", lattice: Lattice, noise: np.ndarray, nearest: float, usual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the disparity of every point of the reference view.

    Parameters
    ----------
    views : SubImages
        With a margin that holds the shifts of the nearest plane.
    lattice : Lattice
    noise : array, (M,)
        Variance of each sub-image's noise, DN^2.
    nearest : float
        Largest disparity looked for, px per lens pitch.
    usual : array, (H, W)
        Disparity to assume where nothing is to be seen anywhere around, px per pitch.

    Returns
    -------
    disparity : array, (H, W) float32
        px per lens pitch.
    deviation : array, (H, W) float32
        Its standard deviation, px per pitch: the Cramer-Rao bound of the texture in the window with
        what slant and blur add; or, if that is more, what the settling moved it by, and beside a
        jump 0.7 of it.
    seen : array, (H, W, M) bool
        False where something nearer hides the point from a unit.

    Notes
    -----
    With the gradients g_i of the units, in units of their noise, and weights w_i that grow with
    the light behind a filter, a plane leaves unexplained

        cost = (T - E) / (T + floor),   T = <sum_i |g_i|^2>,   E = <|sum_i w_i g_i|^2> / sum_i w_i^2

    with <> a mean over a small window. The lowest cost of all units or of one half of the array
    counts, for at an edge a half sees past what is in front.

    Sources: R. Collins, CVPR 1996, for the sweep; S. B. Kang et al., CVPR 2001, for the halves;
    H. Hirschmueller, PAMI 30 (2008), for the smoothing; D. Min et al., TIP 23 (2014), for the
    settling.
    """
    image = views.image.numpy()
    count = 1 + max(4, int(np.ceil(nearest * float(np.abs(lattice.baseline).max()) / _STEP)))
    planes = np.linspace(0, nearest, count)
    inner = slice(views.margin, -views.margin)
    level = np.maximum(image[:, inner, inner].mean((1, 2)), 0) + 1e-6
    weight = (level / np.sqrt(noise)).astype(np.float32)
    feature, gain = _gradients(_unbent(views, lattice), noise)
    cost = np.empty((*lattice.field, count), np.float32)
    evidence = np.empty(lattice.field, np.float32)
    bell = _bell(_WINDOW)
    _sweep(
        feature, weight, views.margin + views.offset, lattice.baseline, _quadrants(lattice), planes,
        bell, np.float32(_FLOOR), np.float32(_HALF), cost, evidence,
    )  # fmt: skip
    evidence -= 2  # what noise alone gives: two components of variance one
    rough = lowest(smoothed(cost, evidence), planes)
    if is_relief(cost, planes, rough, usual):
        believed = trusted(rough, evidence)
        picture, grain = _picture(views, lattice, noise, level, rough)
        areas = plain_areas(picture, grain, evidence)
        rough, believed, filled = fill_plain(
            rough, believed, cost, planes, usual, areas, lattice.focal
        )
        disparity = settled(rough, believed, picture, filled)
        evidence[filled > 0] = 0  # whose rims show the edge around, not themselves
    else:
        rough = disparity = usual.astype(np.float32)
    # Cramer-Rao: a unit tells of a shift by its slope across the noise, of disparity by its
    # baseline against the mean of all.
    share = weight**2 / (weight**2).sum()
    spread = (share @ (lattice.baseline - share @ lattice.baseline) ** 2).mean()
    pixels = 4 * np.pi * (_SMOOTH**2 + _WINDOW**2)
    deviation = 1 / np.sqrt(np.maximum(evidence, 1e-3) * gain * spread * pixels)
    # Beside a jump a point is right or wrong by all of it, at even chances.
    jump = (maximum_filter(disparity, 5) - minimum_filter(disparity, 5)) / np.sqrt(2)
    deviation = np.maximum.reduce(
        [np.hypot(deviation, _LIMIT), np.abs(rough - disparity), jump]
    ).astype(np.float32)
    return disparity, deviation, unhidden(disparity, lattice.baseline)


# --- evidence ---------------------------------------------------------------------------------


def _unbent(views: "SubImages", lattice: Lattice) -> Tensor:
    """Return the sub-images as they were if all lenses imaged alike, so that planes only shift."""
    if lattice.bend is None:
        return views.image
    size = views.image.shape[1:]
    # The polynomial's y and x, -1..1 over the field, on pictures with their margin.
    y, x = ((whole - 1) / (inner - 1) for whole, inner in zip(size, lattice.field, strict=True))
    stretch = [y ** (order - b) * x**b for order in range(4) for b in range(order + 1)]
    unbent = np.empty((1, *views.image.shape), np.float32)
    resample(
        views.image.numpy()[None], views.bad.numpy(),
        lattice.places(np.zeros((len(lattice.bend), 2))) * stretch, 0 * lattice.baseline,
        np.zeros(size, np.float32), SINC, unbent, np.empty(unbent.shape[1:], bool),
    )  # fmt: skip
    return torch.from_numpy(unbent[0])


def _gradients(image: Tensor, noise: np.ndarray) -> tuple[np.ndarray, float]:
    """Return gradients in units of their noise and their squared length, (M, 3, H, W) float32.

    Also how much the noise variance of a pixel shrinks in them.
    """
    reach = int(np.ceil(3 * _SMOOTH))
    tap = torch.arange(-reach, reach + 1).float()
    bell = torch.exp(-(tap**2) / (2 * _SMOOTH**2))
    bell = bell / bell.sum()
    slope = tap * bell / (tap**2 * bell).sum()
    gain = float(bell.square().sum() * slope.square().sum())
    scale = torch.from_numpy(1 / np.sqrt(noise * gain)).float()[:, None, None, None]
    padded = torch.nn.functional.pad(image[:, None], [reach] * 4, mode="replicate") * scale
    feature = torch.empty(len(image), 3, *image.shape[1:])
    for channel, (down, across) in enumerate(((slope, bell), (bell, slope))):
        lines = torch.nn.functional.conv2d(padded, down[None, None, :, None])
        feature[:, channel] = torch.nn.functional.conv2d(lines, across[None, None, None, :])[:, 0]
    feature[:, 2] = feature[:, 0] ** 2 + feature[:, 1] ** 2
    return feature.numpy(), gain


def _bell(deviation: float) -> np.ndarray:
    reach = int(np.ceil(2 * deviation))
    bell = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * deviation**2))
    return (bell / bell.sum()).astype(np.float32)


def _quadrants(lattice: Lattice) -> np.ndarray:
    """Return which quarter of the array each unit is in: 0, 1 above, 2, 3 below; odd is right."""
    from_middle = lattice.baseline - (lattice.baseline.max(0) + lattice.baseline.min(0)) / 2
    return 2 * (from_middle[:, 0] > 0) + (from_middle[:, 1] > 0)


_SETS = np.array(  # all units; left, right, upper, lower half
    [[1, 1, 1, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 1, 0, 0], [0, 0, 1, 1]], np.float32
)


@numba.njit(fastmath=True, cache=True, error_model="numpy")
def _add(upper, lower, a, b, c, d, total):
    for x in range(len(total)):
        total[x] += a * upper[x] + b * upper[x + 1] + c * lower[x] + d * lower[x + 1]


@numba.njit(fastmath=True, cache=True)
def _blur(field, bell, lines, out):
    width = lines.shape[1]
    lines[:] = 0
    for row in range(len(field)):
        for k in range(len(bell)):
            part = field[row, k : k + width]
            for x in range(width):
                lines[row, x] += bell[k] * part[x]
    out[:] = 0
    for row in range(len(out)):
        for k in range(len(bell)):
            for x in range(width):
                out[row, x] += bell[k] * lines[row + k, x]


@numba.njit(parallel=True, fastmath=True, cache=True, error_model="numpy")
def _sweep(
    feature, weight, start, baseline, quadrant, planes, bell, floor, half, cost, evidence, tall=32
):
    """Fill in the cost of every plane, (H, W, D), and the energy E of the best, (H, W)."""
    units = len(feature)
    height, width, count = cost.shape
    reach = len(bell) // 2
    power, members = np.zeros(4, np.float32), np.zeros(4, np.float32)
    for unit in range(units):
        power[quadrant[unit]] += weight[unit] ** 2
        members[quadrant[unit]] += 1
    for block in numba.prange((height + tall - 1) // tall):
        top, bottom = block * tall, min((block + 1) * tall, height)
        rows, columns = bottom - top + 2 * reach, width + 2 * reach
        sums = np.empty((4, 3, rows, columns), np.float32)
        field = np.empty((rows, columns), np.float32)
        lines = np.empty((rows, width), np.float32)
        shared = np.empty((bottom - top, width), np.float32)
        whole = np.empty((bottom - top, width), np.float32)
        best = np.full((bottom - top, width), np.float32(np.inf))
        for plane in range(count):
            sums[:] = 0
            for unit in range(units):
                v = start[unit, 0] + planes[plane] * baseline[unit, 0] + top - reach
                u = start[unit, 1] + planes[plane] * baseline[unit, 1] - reach
                i, j = int(np.floor(v)), int(np.floor(u))
                y, x = np.float32(v - i), np.float32(u - j)
                for channel in range(3):
                    w = weight[unit] if channel < 2 else np.float32(1)
                    a, b = w * (1 - y) * (1 - x), w * (1 - y) * x
                    c, d = w * y * (1 - x), w * y * x
                    for row in range(rows):
                        _add(
                            feature[unit, channel, i + row, j : j + columns + 1],
                            feature[unit, channel, i + row + 1, j : j + columns + 1],
                            a, b, c, d, sums[quadrant[unit], channel, row],
                        )  # fmt: skip
            for number in range(len(_SETS)):
                some = _SETS[number]
                field[:] = 0
                for channel in range(2):
                    for row in range(rows):
                        for x in range(columns):
                            z = np.float32(0)
                            for q in range(4):
                                z += some[q] * sums[q, channel, row, x]
                            field[row, x] += z * z
                _blur(field, bell, lines, shared)
                field[:] = 0
                for q in range(4):
                    if some[q] > 0:
                        field += sums[q, 2]
                _blur(field, bell, lines, whole)
                strength, least = np.float32(1e-20), np.float32(0)
                for q in range(4):
                    strength += some[q] * power[q]
                    least += some[q] * members[q] * floor
                for row in range(bottom - top):
                    for x in range(width):
                        e = shared[row, x] / strength
                        z = (whole[row, x] - e) / (whole[row, x] + least)
                        if number == 0:
                            cost[top + row, x, plane] = z
                            if z < best[row, x]:
                                best[row, x] = z
                                evidence[top + row, x] = e
                        elif z + half < cost[top + row, x, plane]:
                            cost[top + row, x, plane] = z + half


def _picture(
    views: "SubImages", lattice: Lattice, noise: np.ndarray, level: np.ndarray, rough: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return what the units nearest to the reference see together, (H, W), about 1.

    Also the standard deviation of its noise.
    """
    near = np.abs(lattice.baseline).max(1) < 1.5
    values = np.empty((1, near.sum(), *lattice.field), np.float32)
    resample(
        views.image.numpy()[None, near], views.bad.numpy()[near],
        lattice.places(views.margin + views.offset)[near], lattice.baseline[near], rough, CUBIC,
        values, np.empty(values.shape[1:], bool),
    )  # fmt: skip
    light = level[near].sum()
    return values[0].sum(0) / light, float(np.sqrt(noise[near].sum()) / light)
