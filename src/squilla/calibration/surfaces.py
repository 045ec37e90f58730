"""Surfaces from evidence: one disparity for every point, and which units see it.

What a sweep of planes says of single points is noisy, and silent where nothing is to be seen. Costs
are smoothed along paths, and the map within the surfaces that the picture shows.
"""

import numba
import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_gradient_magnitude

_SLANT, _JUMP = 0.02, 1.0
"""Prices of a step by one plane and of a jump, in the typical spread of the evidence."""

_CLEAR = 0.055
"""Share of the energy that a neighbourhood has to explain better to contradict a plane."""

_REACH, _CONTRAST = 7.0, 0.035
"""How far the settling reaches, px, and the contrast in the picture that stops it."""

_WRONG = 0.12
"""Disparity beyond which neighbours do not mean the same surface, px per pitch."""

ENOUGH = 60.0
"""Evidence beyond which a point counts no more."""

_STEEP = 0.035
"""Slope of a map at which its points count a quarter, px per pitch and px."""


# --- smoothing --------------------------------------------------------------------------------


def smoothed(cost: np.ndarray, evidence: np.ndarray) -> np.ndarray:
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


def lowest(total: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return where the cost is lowest, between planes by a parabola, (H, W) float32."""
    place = np.clip(total.argmin(-1), 1, len(planes) - 2)
    left, middle, right = (
        np.take_along_axis(total, place[..., None] + step, -1)[..., 0] for step in (-1, 0, 1)
    )
    bend = np.maximum(left - 2 * middle + right, 1e-9)
    part = np.clip((left - right) / (2 * bend), -0.5, 0.5)
    return (planes[place] + part * (planes[1] - planes[0])).astype(np.float32)


def is_relief(cost: np.ndarray, planes: np.ndarray, rough: np.ndarray, usual: np.ndarray) -> bool:
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


# --- settling ---------------------------------------------------------------------------------


def trusted(rough: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Return how much every point of a map counts, (H, W), 0..1.

    Surfaces are seldom steep. Around an edge, which some units see move with the near side and
    some with the far one, a map climbs from one surface to the other and is true for neither.
    """
    slope = gaussian_gradient_magnitude(rough, 3.0)
    return np.clip(evidence / ENOUGH, 0, 1) / (1 + (slope / _STEEP) ** 2) ** 2


def settled(
    rough: np.ndarray, believed: np.ndarray, picture: np.ndarray, areas: np.ndarray
) -> np.ndarray:
    """Smooth a disparity map within the surfaces that the picture shows.

    Minimises sum w (d - rough)^2 + sum a (d_p - d_q)^2 over neighbours, a falling with their
    contrast, in turns: each point then counts by how well it agreed. An edge in the picture belongs
    to the nearer side, so that a surface is at most as near as its edges: points that would draw it
    nearer hardly count. Nothing crosses the border of one of the numbered `areas`, (H, W) int.
    """
    picture = gaussian_filter(picture, 0.6)
    bonds = [
        np.exp(-np.abs(np.diff(picture, axis=axis)) / _CONTRAST) * (np.diff(areas, axis=axis) == 0)
        for axis in (1, 0)
    ]
    along, down = (np.ascontiguousarray(bond, np.float32) for bond in (bonds[0], bonds[1].T))
    weight = believed = (believed + 1e-5).astype(np.float32)
    for _ in range(6):
        both = _diffuse(np.stack([weight * rough, weight]), along, down, _REACH)
        disparity = both[0] / (both[1] + np.float32(1e-30))
        above = rough - disparity
        doubt = np.where(above > _WRONG, 1e4, (1 + (above / _WRONG) ** 2) ** 2)
        weight = (believed / doubt).astype(np.float32)
    return disparity


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


def unhidden(disparity: np.ndarray, baseline: np.ndarray, apart: float = 0.08) -> np.ndarray:
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
