"""The inner loops of the twin: flats, laying a scene on a canvas, seeing a relief from beside."""

import numba
import numpy as np


@numba.njit(nogil=True, cache=True)
def add_flat(square, share, nodes, rates, total):
    """Add the light of an even surface to a window: share x rate at the squared field angle."""
    rows, columns = total.shape
    for row in range(rows):
        for column in range(columns):
            right, weight = _place(square[row, column], nodes)
            rate = (1 - weight) * rates[right - 1] + weight * rates[right]
            total[row, column] += share[row, column] * rate


@numba.njit(cache=True)
def _place(square, nodes):
    """The node above a squared angle, and its weight in linear interpolation."""
    right = 1
    while right < len(nodes) - 1 and nodes[right] < square:
        right += 1
    return right, min((square - nodes[right - 1]) / (nodes[right] - nodes[right - 1]), 1.0)


def relief(
    image: np.ndarray,
    disparity: np.ndarray,
    first: np.ndarray,
    origin: np.ndarray,
    mean: float,
    baseline: np.ndarray,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the view of a scene with depth from a lens beside the reference lens.

    The scene is a relief over the reference view: what stands out is extruded from its back, so
    that a hidden flank shows the colour of its edge.

    Parameters
    ----------
    image : array, (r, y, x)
        What this unit sees of the scene, on the reference view's grid, from `first` on.
    disparity : array, (rows, columns)
        Of every scene sample, px per lens pitch; goes on mirrored.
    first : (2,) int
        Scene index of the first pixel of `image`.
    origin : (2,) float
        Scene position of the view's first pixel for a plane of the mean disparity.
    mean : float
        Mean disparity.
    baseline : (2,) float
        Of the unit, lens pitches.
    shape : (int, int)
        Of the view.

    Returns
    -------
    view : array, (r, *shape), float32
    hit : array, `shape`, float32
        Disparity of what is seen.
    """
    reach = max(float(np.abs(baseline).max()), 1e-9)
    top, bottom = float(disparity.max()), float(disparity.min())
    steps = max(1, int(np.ceil((top - bottom) * reach * 4)))  # a quarter of a pixel a step
    view = np.empty((len(image), *shape), np.float32)
    depth = np.empty(shape, np.float32)
    _cast(
        image, np.ascontiguousarray(disparity, np.float64), first.astype(np.float64), origin,
        mean, baseline, top, bottom, steps, view, depth,
    )  # fmt: skip
    return view, depth


def weigh(
    seen: np.ndarray,
    first: np.ndarray,
    position: np.ndarray,
    focal: float,
    nodes: np.ndarray,
    size: tuple[int, int],
) -> np.ndarray:
    """Interpolate between field angles, and continue a scene as its mirror image.

    Parameters
    ----------
    seen : array, (y, x, A, r) float32
        Signals of every scene sample at each of the angles.
    first : (2,) int
        Scene index of the canvas' first pixel.
    position : (2,) float
        Position of the canvas' first pixel against the lens' axis, px.
    focal : float
        px.
    nodes : array, (A,)
        Squared angles, rad^2.
    size : (int, int)
        Of the canvas.

    Returns
    -------
    array, (r, *size), float32
    """
    canvas = np.empty((seen.shape[-1], *size), np.float32)
    _weigh(seen, first, position, focal, nodes, canvas)
    return canvas


@numba.njit(parallel=True, cache=True)
def _weigh(seen, first, position, focal, nodes, canvas):
    terms, rows, columns = canvas.shape
    for row in numba.prange(rows):
        y = _mirror(first[0] + row, seen.shape[0])
        for column in range(columns):
            x = _mirror(first[1] + column, seen.shape[1])
            radius = np.hypot(position[0] + row, position[1] + column)
            right, share = _place(np.arctan(radius / focal) ** 2, nodes)
            for term in range(terms):
                canvas[term, row, column] = (1 - share) * seen[y, x, right - 1, term] + (
                    share * seen[y, x, right, term]
                )


@numba.njit(cache=True)
def _mirror(index, length):
    """The index of a sample of an axis that goes on mirrored."""
    index %= 2 * length
    return index if index < length else 2 * length - 1 - index


@numba.njit(cache=True)
def _height(disparity, y, x):
    """Bilinear disparity at a scene position of a scene that goes on mirrored."""
    rows, columns = disparity.shape
    i, j = int(np.floor(y)), int(np.floor(x))
    v, u = y - i, x - j
    top, bottom = _mirror(i, rows), _mirror(i + 1, rows)
    left, right = _mirror(j, columns), _mirror(j + 1, columns)
    return (1 - v) * ((1 - u) * disparity[top, left] + u * disparity[top, right]) + v * (
        (1 - u) * disparity[bottom, left] + u * disparity[bottom, right]
    )


@numba.njit(cache=True)
def _cubic(t):
    """Keys' cubic convolution weights of the four neighbours at a fraction t."""
    return (
        -0.5 * t + t * t - 0.5 * t**3,
        1 - 2.5 * t * t + 1.5 * t**3,
        0.5 * t + 2 * t * t - 1.5 * t**3,
        -0.5 * t * t + 0.5 * t**3,
    )


@numba.njit(parallel=True, cache=True)
def _cast(image, disparity, first, origin, mean, baseline, top, bottom, steps, view, depth):
    terms, rows, columns = view.shape
    for row in numba.prange(rows):
        for column in range(columns):
            # The ray meets depth d at the scene position base - (d - mean) * baseline.
            base_y, base_x = origin[0] + row, origin[1] + column
            front = top
            gap = front - _height(
                disparity,
                base_y - (front - mean) * baseline[0],
                base_x - (front - mean) * baseline[1],
            )
            hit = front
            if gap > 0:
                for step in range(1, steps + 1):
                    back = top + (bottom - top) * step / steps
                    below = back - _height(
                        disparity,
                        base_y - (back - mean) * baseline[0],
                        base_x - (back - mean) * baseline[1],
                    )
                    hit = back
                    if below <= 0:
                        hit = front + (back - front) * gap / (gap - below)
                        break
                    front, gap = back, below
            depth[row, column] = hit
            y = base_y - (hit - mean) * baseline[0] - first[0]
            x = base_x - (hit - mean) * baseline[1] - first[1]
            i, j = int(np.floor(y)), int(np.floor(x))
            weight_y, weight_x = _cubic(y - i), _cubic(x - j)
            # The canvas is mirrored beyond the scene already; what lies beyond it is not seen.
            i, j = min(max(i, 1), image.shape[1] - 3), min(max(j, 1), image.shape[2] - 3)
            for term in range(terms):
                total = 0.0
                for k in range(4):
                    for m in range(4):
                        total += weight_y[k] * weight_x[m] * image[term, i - 1 + k, j - 1 + m]
                view[term, row, column] = total
