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
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from torch import Tensor

from squilla.calibration.calibration import Lattice
from squilla.calibration.resample import CUBIC, SINC, resample

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

_SLANT, _JUMP = 0.02, 1.0
"""Prices of a step by one plane and of a jump, in the typical spread of the evidence."""

_CLEAR = 0.055
"""Share of the energy that a neighbourhood has to explain better to contradict a plane."""

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
        what slant and blur add; or, if that is more, what the smoothing moved it by, and beside a
        jump half of it.
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
    filling.
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
    rough = _lowest(_smoothed(cost, evidence), planes)
    if not _is_relief(cost, planes, rough, usual):
        rough = usual.astype(np.float32)
    disparity = _settled(rough, evidence, _picture(views, lattice, level, rough), usual)
    # Cramer-Rao: a unit tells of a shift by its slope across the noise, of disparity by its
    # baseline against the mean of all.
    share = weight**2 / (weight**2).sum()
    spread = (share @ (lattice.baseline - share @ lattice.baseline) ** 2).mean()
    pixels = 4 * np.pi * (_SMOOTH**2 + _WINDOW**2)
    deviation = 1 / np.sqrt(np.maximum(evidence, 1e-3) * gain * spread * pixels)
    jump = (maximum_filter(disparity, 5) - minimum_filter(disparity, 5)) / 2
    deviation = np.maximum.reduce(
        [np.hypot(deviation, _LIMIT), np.abs(rough - disparity), jump]
    ).astype(np.float32)
    return disparity, deviation, _seen(disparity, lattice.baseline)


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


# --- smoothing --------------------------------------------------------------------------------


def _smoothed(cost: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Return the cost of every plane with that of the best path there from eight directions.

    A jump costs less where there is a strong edge.
    """
    spread = float(np.percentile(np.ptp(cost, -1), 90))
    strength = np.sqrt(np.maximum(evidence, 0))
    jump = _JUMP * np.exp(-strength / (3 * np.median(strength) + 1e-6)) + 2 * _SLANT
    total = np.zeros((2, *cost.shape), np.float32)
    _semi_global(cost, np.float32(_SLANT * spread), (spread * jump).astype(np.float32), total)
    return total[0] + total[1]


@numba.njit(parallel=True, fastmath=True, cache=True)
def _semi_global(cost, slant, jump, total):
    """Add up the costs of paths, four directions downwards and four upwards, (2, H, W, D)."""
    height, width, count = cost.shape
    for turn in numba.prange(2):
        last = np.zeros((4, width + 2, count), np.float32)
        last_low = np.zeros((4, width + 2), np.float32)
        new, new_low = np.zeros_like(last), np.zeros_like(last_low)
        for r in range(height):
            row = r if turn == 0 else height - 1 - r
            for c in range(width):
                column = c if turn == 0 else width - 1 - c
                for way in range(4):  # beside, and the three in the row before
                    if way == 0:
                        before, low = new[0, c], new_low[0, c]
                    else:
                        before, low = last[way, c + way - 1], last_low[way, c + way - 1]
                    here, least = new[way, c + 1], np.float32(np.inf)
                    leap = low + jump[row, column]
                    for k in range(count):
                        z = min(before[k], leap)
                        if k > 0:
                            z = min(z, before[k - 1] + slant)
                        if k < count - 1:
                            z = min(z, before[k + 1] + slant)
                        z += cost[row, column, k] - low
                        here[k] = z
                        least = min(least, z)
                        total[turn, row, column, k] += z
                    new_low[way, c + 1] = least
            last, new = new, last
            last_low, new_low = new_low, last_low


def _lowest(total: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return where the cost is lowest, between planes by a parabola, (H, W) float32."""
    place = np.clip(total.argmin(-1), 1, len(planes) - 2)
    left, middle, right = (
        np.take_along_axis(total, place[..., None] + step, -1)[..., 0] for step in (-1, 0, 1)
    )
    bend = np.maximum(left - 2 * middle + right, 1e-9)
    part = np.clip((left - right) / (2 * bend), -0.5, 0.5)
    return (planes[place] + part * (planes[1] - planes[0])).astype(np.float32)


def _is_relief(cost: np.ndarray, planes: np.ndarray, rough: np.ndarray, usual: np.ndarray) -> bool:
    """Return whether a disparity map explains clearly more than one plane does, somewhere.

    A picture that is smooth everywhere shows its distance only as a whole: its single points follow
    the noise.
    """

    def at(disparity):
        place = np.rint((disparity - planes[0]) / (planes[1] - planes[0])).astype(int)
        place = np.clip(place, 0, len(planes) - 1)
        return np.take_along_axis(cost, place[..., None], -1)[..., 0]

    gain = gaussian_filter(at(usual) - at(rough), 3.0)
    return float(np.mean(gain > _CLEAR)) > 0.005


# --- filling ----------------------------------------------------------------------------------

_REACH, _CONTRAST = 10.0, 0.04
"""How far the filling reaches, px, and the contrast in the picture that stops it."""

_WRONG = 0.12
"""Disparity beyond which neighbours do not mean the same surface, px per pitch."""

_CHANCE, _ENOUGH = 4.0, 60.0
"""Evidence that noise alone shows in the mean of a neighbourhood, and evidence that is plenty."""


def _picture(
    views: "SubImages", lattice: Lattice, level: np.ndarray, rough: np.ndarray
) -> np.ndarray:
    """Return what the units nearest to the reference see in the mean, (H, W), about 1."""
    near = np.abs(lattice.baseline).max(1) < 1.5
    values = np.empty((1, near.sum(), *lattice.field), np.float32)
    resample(
        views.image.numpy()[None, near], views.bad.numpy()[near],
        lattice.places(views.margin + views.offset)[near], lattice.baseline[near], rough, CUBIC,
        values, np.empty(values.shape[1:], bool),
    )  # fmt: skip
    return gaussian_filter((values[0] / level[near, None, None]).mean(0), 0.6)


def _settled(
    rough: np.ndarray, evidence: np.ndarray, picture: np.ndarray, usual: np.ndarray
) -> np.ndarray:
    """Smooth a disparity map within the surfaces that the picture shows, and fill its gaps.

    Minimises sum w (d - rough)^2 + sum a (d_p - d_q)^2 over neighbours, a falling with their
    contrast, in turns: each point then counts by how well it agreed. An edge in the picture belongs
    to the nearer side, so that a surface is at most as near as its edges: points that would draw it
    nearer hardly count.
    """
    textured = gaussian_filter(evidence, 3.0) > _CHANCE
    believed = np.where(textured, np.clip(evidence / _ENOUGH, 0, 1), 0).astype(np.float32)
    bonds = [np.exp(-np.abs(np.diff(picture, axis=axis)) / _CONTRAST) for axis in (1, 0)]
    along, down = (np.ascontiguousarray(bond, np.float32) for bond in (bonds[0], bonds[1].T))
    # Where nothing is to be seen stands, to begin with, what stands anywhere around.
    far = usual + _averaged(rough - usual, believed, along, down, 8 * _REACH, 1e-4)
    rough = np.where(textured, rough, far.astype(np.float32))
    believed = believed + np.float32(1e-5)
    weight = believed
    for _ in range(6):
        disparity = _averaged(rough, weight, along, down, _REACH)
        above = rough - disparity
        doubt = np.where(above > _WRONG, 1e4, (1 + (above / _WRONG) ** 2) ** 2)
        weight = (believed / doubt).astype(np.float32)
    return disparity


def _averaged(
    values: np.ndarray,
    weight: np.ndarray,
    along: np.ndarray,
    down: np.ndarray,
    reach: float,
    none: float = 1e-30,
) -> np.ndarray:
    """Return weighted means over surfaces; they go to zero where the weight falls below `none`."""
    both = _diffuse(np.stack([weight * values, weight]), along, down, reach)
    return both[0] / (both[1] + np.float32(none))


def _diffuse(fields: np.ndarray, along: np.ndarray, down: np.ndarray, reach: float) -> np.ndarray:
    """Smooth fields, (C, H, W), by three turns of rows and columns, each solved exactly."""
    for turn in range(3):
        strength = np.float32(1.5 * 4 ** (2 - turn) / (4**3 - 1) * reach**2)
        _along_rows(fields, along, strength)
        fields = np.ascontiguousarray(fields.transpose(0, 2, 1))
        _along_rows(fields, down, strength)
        fields = np.ascontiguousarray(fields.transpose(0, 2, 1))
    return fields


@numba.njit(parallel=True, cache=True, fastmath=True)
def _along_rows(fields, bond, strength):
    """Solve (1 + strength Laplacian) u = f in every row; tridiagonal, by elimination."""
    channels, height, width = fields.shape
    for row in numba.prange(height):
        ratio, scale = np.zeros(width, np.float32), np.empty(width, np.float32)
        for x in range(width):
            left = strength * bond[row, x - 1] if x > 0 else np.float32(0)
            right = strength * bond[row, x] if x < width - 1 else np.float32(0)
            before = ratio[x - 1] if x > 0 else np.float32(0)
            scale[x] = 1 / (1 + left + right - left * before)
            ratio[x] = right * scale[x]
        for channel in range(channels):
            line = fields[channel, row]
            line[0] *= scale[0]
            for x in range(1, width):
                line[x] = (line[x] + strength * bond[row, x - 1] * line[x - 1]) * scale[x]
            for x in range(width - 2, -1, -1):
                line[x] += ratio[x] * line[x + 1]


# --- what is hidden ---------------------------------------------------------------------------


def _seen(disparity: np.ndarray, baseline: np.ndarray, apart: float = 0.08) -> np.ndarray:
    """Return whether each unit sees each point past what is nearer by `apart`, (H, W, M)."""
    seen = np.empty((*disparity.shape, len(baseline)), bool)
    _look(disparity, baseline, np.float32(apart), disparity.max(), seen)
    return seen


@numba.njit(parallel=True, cache=True)
def _look(disparity, baseline, apart, top, seen):
    height, width, units = seen.shape
    for row in numba.prange(height):
        for column in range(width):
            own = disparity[row, column]
            for unit in range(units):
                y, x = baseline[unit]
                seen[row, column, unit] = True
                longest = max(abs(y), abs(x))
                # The ray to the unit, half a pixel a step, up to the nearest thing of the scene.
                for step in range(1, int(2 * (top - own) * longest) + 2):
                    rise = step / (2 * max(longest, 1e-9))
                    i, j = int(np.rint(row - rise * y)), int(np.rint(column - rise * x))
                    if i < 0 or j < 0 or i >= height or j >= width:
                        break
                    there = disparity[i, j] - own
                    if there > apart and there > rise - 0.25 / longest:
                        seen[row, column, unit] = False
                        break
