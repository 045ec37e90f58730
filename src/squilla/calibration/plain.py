"""Plain areas: what all their points tell together, and else what bounds them.

Where a surface has next to no texture no single point tells its distance. All the points of an area
may, for faint texture adds up. Where it does not, the area lies behind the edges around it.
"""

import numpy as np
from scipy.ndimage import binary_dilation, find_objects, gaussian_filter, label

from squilla.calibration.surfaces import ENOUGH

_WEAK = 10.0
"""Mean evidence around a point below which it is plain."""

_FEW = 40
"""Points below which an area is left to its neighbours."""

_RIM, _STEADY = 6, 0.3
"""How far around an area its bounds lie, px, and the belief that such a point needs."""

_CLEAR, _SURE = 0.002, 0.19
"""Dip of the mean cost that is no chance: of any area, and of one of a single point."""

_ASIDE = 0.6
"""Disparity beside the best by which a true one stands out, px per pitch: the width of edges."""

_NEARER = 0.1
"""Share of an area's bounds that may lie behind it."""

_FLAT = 0.3
"""Price of a slant, squared, for a step from one bound to the other may look like one."""


def fill_plain(
    rough: np.ndarray,
    believed: np.ndarray,
    evidence: np.ndarray,
    cost: np.ndarray,
    planes: np.ndarray,
    usual: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Give every plain area one plane of disparity.

    Parameters
    ----------
    rough, believed : array, (H, W)
        Disparities, px per pitch, and how much each counts, 0..1.
    evidence : array, (H, W)
        Energy that the units share at each point, in that of the noise.
    cost : array, (H, W, D)
        Of every disparity in `planes`.
    usual : array, (H, W)
        Disparity to assume where nothing bounds an area.

    Returns
    -------
    rough, believed : array, (H, W)
        Filled; areas that are too small to tell anything are not believed.
    """
    weak = gaussian_filter(np.clip(evidence, 0, ENOUGH), 2.0) < _WEAK
    filled, trust = rough.copy(), np.where(weak, 0, believed).astype(np.float32)
    areas = np.empty(weak.shape, np.int32)
    label(weak, output=areas)
    for number, place in enumerate(find_objects(areas), 1):
        around = tuple(slice(max(side.start - _RIM, 0), side.stop + _RIM) for side in place)
        inside = areas[around] == number
        if inside.sum() < _FEW:
            continue
        plane = told_plane(cost[around][inside], _ramps(inside, inside), planes)
        if plane is None:
            near = np.asarray(binary_dilation(inside, iterations=_RIM), bool)
            rim = near & (trust[around] > _STEADY)
            bounds = rough[around][rim]
            plane = usual[around][inside]
            if len(bounds) > 3:
                behind = bounding_plane(bounds, _ramps(rim, inside)) @ _ramps(inside, inside)
                plane = np.clip(behind, bounds.min(), bounds.max())
        filled[around][inside], trust[around][inside] = plane, 1
    return filled, trust


def told_plane(cost: np.ndarray, ramps: np.ndarray, planes: np.ndarray) -> np.ndarray | None:
    """Return the plane of disparity, (n,), at which n points cost least; None if none stands out.

    Parameters
    ----------
    cost : array, (n, D)
    ramps : array, (3, n)
        One, and the points' places across the area, -1..1.
    planes : array, (D,)
        Disparities.
    """
    step, count = planes[1] - planes[0], len(planes)
    aside = max(1, round(_ASIDE / step))
    if count <= 2 * aside:  # all planes are within the width of an edge
        return None
    mean = cost.mean(0)
    best = aside + int(mean[aside:-aside].argmin())
    dip = (mean[best - aside] + mean[best + aside]) / 2 - mean[best]
    if dip < max(_CLEAR, _SURE / np.sqrt(len(cost))):
        return None
    points = np.arange(len(cost))

    def price(plane):
        place = np.clip(plane @ ramps / step, 0, count - 1.001)
        whole = place.astype(int)
        part = place - whole
        return np.mean((1 - part) * cost[points, whole] + part * cost[points, whole + 1])

    # Downhill in distance and slants, with steps that halve where none leads down.
    plane, stride = np.array([planes[best], 0, 0]), step
    low = price(plane)
    while stride > step / 8:
        tried = [plane + sign * stride * way for way in np.eye(3) for sign in (-1, 1)]
        prices = [price(each) for each in tried]
        if min(prices) < low:
            low, plane = min(prices), tried[int(np.argmin(prices))]
        else:
            stride /= 2
    return plane @ ramps


def bounding_plane(bounds: np.ndarray, ramps: np.ndarray) -> np.ndarray:
    """Return the plane, (3,), that lies behind all but a tenth of the bounds, as near as it can.

    An edge belongs to the nearer of its two sides, so what lies beyond edges is at most as near.

    Parameters
    ----------
    bounds : array, (n,)
        Disparities of the points around an area.
    ramps : array, (3, n)
        One, and their places.

    Notes
    -----
    Quantile regression by weighted least squares in turns: R. Koenker and G. Bassett,
    Econometrica 46 (1978); with a price on slants.
    """
    flat = 2 * _FLAT * len(bounds) * np.diag([0.0, 1, 1])
    weight, plane = np.ones(len(bounds)), np.zeros(3)
    for _ in range(20):
        heavy = weight * ramps
        plane = np.linalg.solve(heavy @ ramps.T + flat, heavy @ bounds)
        above = bounds - plane @ ramps
        weight = np.where(above > 0, _NEARER, 1 - _NEARER) / np.maximum(np.abs(above), 0.02)
    return plane


def _ramps(points: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return 1, y and x of the points, (3, n); -1..1 over the longer side of an area."""
    rows, columns = np.nonzero(inside)
    reach = max(np.ptp(rows), np.ptp(columns), 1) / 2
    y, x = np.nonzero(points)
    return np.stack([np.ones(len(y)), (y - rows.mean()) / reach, (x - columns.mean()) / reach])
