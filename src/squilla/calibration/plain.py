"""Plain areas: what all their points tell together, and else what bounds them.

Where a surface has next to no texture no single point tells its distance. All the points of an area
may, for faint texture adds up, and so does what is left of its edges two pixels inside: in a small
area that is part of the sum. Where nothing adds up, the area lies behind the edges around it. Both
ways it reaches up to where the picture is steepest, however far the evidence of that edge spreads.
"""

from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

_SMOOTH, _ABOVE = 1.35, 4.5
"""Smoothing of the picture's gradient, px, and how many times its noise a plain point may have."""

_FAINT = 15.0
"""Evidence that suffices for a point to speak for itself."""

_BLUR, _FAR, _EDGE = 2, 5, 5
"""How far edges blur into an area, px, and strong ones where only sums tell; and how far outside of
it they may lie."""

_FEW, _MANY = 250, 1200
"""Clear points below which an area is left to its neighbours, and how many may well suffice."""

_RIM, _STEADY = 6, 0.3
"""How far around an area its bounds lie, px, and the belief that such a point needs."""

_CLEAR, _SURE = 0.002, 0.08
"""Dip of the mean cost that is no chance: of any area, and of one of a single point."""

_ASIDE = 0.6
"""Disparity beside the best by which a true one stands out, px per pitch: the width of edges."""

_LEAN = 0.5
"""Slant that a plain area is expected to have: distance per breadth."""

_WORTH = 15.0
"""Log likelihood of a unit of cost, of one point: windows overlap, and cost is a share."""

_NEARER = 0.1
"""Share of an area's bounds that may lie behind it."""

_FLAT = 0.3
"""Price of a slant, squared, for a step from one bound to the other may look like one."""


@dataclass(frozen=True)
class Area:
    """An area in which the picture shows next to nothing.

    around : rows and columns of the part of the picture that it and its bounds lie in.
    clear : (h, w) bool, there; points that no edge blurs into.
    whole : (h, w) bool; up to the edges around.
    """

    around: tuple[slice, slice]
    clear: np.ndarray
    whole: np.ndarray


def plain_areas(picture: np.ndarray, noise: float, evidence: np.ndarray) -> list[Area]:
    """Find where the picture shows nothing but noise and faint shading.

    Parameters
    ----------
    picture : array, (H, W)
    noise : float
        Standard deviation of its white noise.
    evidence : array, (H, W)
        Energy that the units share at each point, in that of the noise. Areas where it suffices
        point by point are none.
    """
    steep = ndimage.gaussian_gradient_magnitude(picture, _SMOOTH)
    of_noise = noise / np.sqrt(8 * np.pi) / _SMOOTH**2  # along one axis
    flat = np.empty(picture.shape, np.int32)
    ndimage.label(ndimage.binary_opening(steep < _ABOVE * of_noise, np.ones((3, 3))), output=flat)
    whole = flat.copy()
    for _ in range(_EDGE):
        _climb(whole.copy(), steep, whole)
    areas = []
    for number, place in enumerate(ndimage.find_objects(whole), 1):
        rows, columns = (slice(max(side.start - _RIM, 0), side.stop + _RIM) for side in place)
        around, inside = (rows, columns), flat[rows, columns] == number
        if inside.sum() >= _FEW:
            clear = _clear(inside, evidence[around])
            if clear.sum() >= _FEW:
                areas.append(Area(around, clear, whole[around] == number))
    return areas


def _clear(inside: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Return the points of an area that no edge blurs into; none if most speak for themselves.

    An area with points to spare keeps away from its edges so far that even the sum over its whole
    border tells nothing of them: a wall lies behind them. A small thing has them for its own.
    """
    silent = inside & (evidence < _FAINT)
    away = np.asarray(ndimage.distance_transform_edt(np.pad(inside, 1, mode="edge")))[1:-1, 1:-1]
    spared = np.sort(away[silent])[-_MANY:]
    inner = away > np.clip(spared.min(initial=np.inf), _BLUR, _FAR)
    return silent & inner & (2 * silent[inner].sum() >= inner.sum())


@numba.njit(cache=True)
def _climb(areas, steep, grown):
    """Give every free point to the area of its least steep neighbour, if that is less steep."""
    rows, columns = areas.shape
    for row in range(rows):
        for column in range(columns):
            low = steep[row, column]
            for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                y, x = row + down, column + right
                if areas[row, column] or not (0 <= y < rows and 0 <= x < columns):
                    continue
                if areas[y, x] and steep[y, x] <= low:
                    low, grown[row, column] = steep[y, x], areas[y, x]


def fill_plain(
    rough: np.ndarray,
    believed: np.ndarray,
    cost: np.ndarray,
    planes: np.ndarray,
    usual: np.ndarray,
    areas: list[Area],
    focal: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give every plain area one plane of disparity.

    Parameters
    ----------
    rough, believed : array, (H, W)
        Disparities, px per pitch, and how much each counts, 0..1.
    cost : array, (H, W, D)
        Of every disparity in `planes`.
    usual : array, (H, W)
        Disparity to assume where nothing bounds an area.
    areas : list of Area
    focal : float
        px.

    Returns
    -------
    rough, believed : array, (H, W)
        Filled.
    filled : array, (H, W) int32
        Number of the area that a point is in, from 1; 0 in none.
    """
    rough, believed = rough.copy(), believed.astype(np.float32)
    filled = np.zeros(rough.shape, np.int32)
    for number, area in enumerate(areas, 1):
        filled[area.around][area.whole] = number
    bounding = (believed > _STEADY) & (filled == 0)
    for area in areas:
        around, whole, frame = area.around, area.whole, _frame(area.whole)
        ramps = _ramps(whole, frame)
        plane = told_plane(
            cost[around][area.clear], _ramps(area.clear, frame), planes, _LEAN * frame[2] / focal
        )
        if plane is not None:
            disparity = plane @ ramps
        else:
            rim = np.asarray(ndimage.binary_dilation(whole, iterations=_RIM), bool)
            rim &= bounding[around]
            bounds, disparity = rough[around][rim], usual[around][whole]
            if len(bounds) > 3:
                behind = bounding_plane(bounds, _ramps(rim, frame)) @ ramps
                disparity = np.clip(behind, bounds.min(), bounds.max())
        rough[around][whole], believed[around][whole] = disparity, 1
    return rough, believed, filled


def told_plane(
    cost: np.ndarray, ramps: np.ndarray, planes: np.ndarray, lean: float
) -> np.ndarray | None:
    """Return the plane of disparity, (3,), at which n points cost least; None if none stands out.

    Parameters
    ----------
    cost : array, (n, D)
    ramps : array, (3, n)
        One, and the points' places across the area, -1..1.
    planes : array, (D,)
        Disparities.
    lean : float
        Expected coefficient of a ramp, as a share of the disparity.
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
    steep = 0.5 / (_WORTH * len(cost) * (lean * planes[best]) ** 2)

    def price(plane):
        return _mean_between(cost, plane @ ramps / step) + steep * (plane[1] ** 2 + plane[2] ** 2)

    # Downhill in distance and slants, with steps that halve where none leads down.
    plane, stride = np.array([planes[best], 0, 0]), step
    low = price(plane)
    while stride > step / 16:
        tried = [plane + sign * stride * way for way in np.eye(3) for sign in (-1, 1)]
        prices = [price(each) for each in tried]
        if min(prices) < low:
            low, plane = min(prices), tried[int(np.argmin(prices))]
        else:
            stride /= 2
    return plane


@numba.njit(cache=True)
def _mean_between(cost, place):
    """Return the mean cost of points at places between planes, by cubic convolution.

    A straight line between planes would be lowest on one of them.
    """
    points, count = cost.shape
    total = 0.0
    for n in range(points):
        at = min(max(place[n], 1.0), count - 2.001)
        k = int(at)
        t = at - k
        before, here, there, after = cost[n, k - 1], cost[n, k], cost[n, k + 1], cost[n, k + 2]
        bend = 2 * before - 5 * here + 4 * there - after
        twist = 3 * (here - there) + after - before
        total += here + 0.5 * t * (there - before + t * (bend + t * twist))
    return total / points


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


def _frame(inside: np.ndarray) -> tuple[float, float, float]:
    """Return the middle of an area, y and x, and half of its longer side, px."""
    rows, columns = np.nonzero(inside)
    return rows.mean(), columns.mean(), max(np.ptp(rows), np.ptp(columns), 1) / 2


def _ramps(points: np.ndarray, frame: tuple[float, float, float]) -> np.ndarray:
    """Return 1, y and x of the points, (3, n); -1..1 over the longer side of an area."""
    middle_y, middle_x, reach = frame
    y, x = np.nonzero(points)
    return np.stack([np.ones(len(y)), (y - middle_y) / reach, (x - middle_x) / reach])
