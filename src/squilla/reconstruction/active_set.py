"""Non-negative l1 least squares for many pixels, each to its exact optimum, by an active set.

A solution has few atoms, at most as many as there are filters. So one atom at a time joins an
active set, for which the problem is solved exactly through its Cholesky factor, as Lawson and
Hanson do without the l1 term. It ends after some ten steps of a microsecond, where first-order
methods creep for thousands among atoms that look nearly alike through broadband filters.

Source: C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, ch. 23; the l1 term only adds
a constant to the gradient of positive heights.
"""

import math
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np

_compiled = numba.njit(
    # Freedoms that let sums run in vector registers, while NaN and infinity stay exact.
    fastmath={"reassoc", "contract", "nsz"},
    error_model="numpy",
    nogil=True,
    cache=True,
)


def nonnegative_lasso(
    rows: np.ndarray,
    y: np.ndarray,
    ratio: float | np.ndarray,
    *,
    columns: np.ndarray | None = None,
    choice: np.ndarray | None = None,
    synthesis: np.ndarray | None = None,
    tolerance: float = 1e-6,
    threads: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise 1/2 ||y - A s||^2 + weight ||s||_1 over s >= 0 for every pixel.

    Parameters
    ----------
    rows : array, (B, M, P), float64
        The matrices A, for M filters and P atoms.
    y : array, (N, M), float64
    ratio : float or array, (N,)
        The weight as a fraction of ||A' y||_inf, of each pixel; 0 for non-negative least squares.
    columns : array, (B, P, M), optional
        The same matrices transposed, to save transposing them.
    choice : array, (N,), optional
        The index of the matrix that each pixel uses; default: the first.
    synthesis : array, (P, K), optional
        Return s' synthesis instead of s.
    tolerance : float
        Relative duality gap at which a pixel ends.
    threads : int

    Returns
    -------
    array, (N, P) or (N, K), float64
    array, (N,), float64
        Relative duality gap: the objective exceeds its minimum by no more than this fraction.
        Without l1 term there is no finite bound; then it is 0 where the optimality conditions
        hold to 1e-10, and 1 elsewhere.
    """
    columns = np.ascontiguousarray(rows.swapaxes(1, 2)) if columns is None else columns
    choice = np.zeros(len(y), np.int64) if choice is None else choice
    synthesis = np.eye(rows.shape[2]) if synthesis is None else synthesis
    ratio = np.broadcast_to(np.asarray(ratio, float), len(y)).copy()

    def solve(pixels: slice):
        return _solve_pixels(
            rows, columns, choice[pixels], y[pixels], ratio[pixels], tolerance, synthesis
        )  # fmt: skip

    # The kernel lets go of the interpreter's lock, so that plain threads run it in parallel, also
    # when several threads reconstruct at once (numba's own thread pool cannot do that).
    parts = [slice(start, start + 512) for start in range(0, max(len(y), 1), 512)]
    with ThreadPoolExecutor(threads) as pool:
        results, gaps = zip(*pool.map(solve, parts), strict=True)
    return np.concatenate(results), np.concatenate(gaps)


@_compiled
def _dot(a, b):
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@_compiled
def _correlate(rows, residual, correlation):
    """Write rows' residual into `correlation`; four rows at a time keep the sums in registers."""
    correlation[:] = 0.0
    filters, atoms = rows.shape
    whole = filters - filters % 4
    for m in range(0, whole, 4):
        for j in range(atoms):
            correlation[j] += (
                residual[m] * rows[m, j]
                + residual[m + 1] * rows[m + 1, j]
                + residual[m + 2] * rows[m + 2, j]
                + residual[m + 3] * rows[m + 3, j]
            )
    for m in range(whole, filters):
        for j in range(atoms):
            correlation[j] += residual[m] * rows[m, j]


@_compiled
def _append(columns, active, factor, size, atom):
    """Extend the Cholesky factor of the active Gram matrix; False if the atom depends on the set.

    Row `size` of `factor` is written in any case.
    """
    column = columns[atom]
    power = _dot(column, column)
    rest = power
    for i in range(size):
        value = _dot(columns[active[i]], column)
        for j in range(i):
            value -= factor[i, j] * factor[size, j]
        value /= factor[i, i]
        factor[size, i] = value
        rest -= value * value
    if size == column.size or rest <= 1e-12 * power:
        return False
    factor[size, size] = math.sqrt(rest)
    active[size] = atom
    return True


@_compiled
def _solve_upper(factor, size, x):
    """Solve L' x = x in place."""
    for i in range(size - 1, -1, -1):
        value = x[i] / factor[i, i]
        x[i] = value
        for j in range(i):
            x[j] -= factor[i, j] * value


@_compiled
def _solve(factor, size, right, x):
    """Solve L L' x = right."""
    for i in range(size):
        value = right[i]
        for j in range(i):
            value -= factor[i, j] * x[j]
        x[i] = value / factor[i, i]
    _solve_upper(factor, size, x)


@_compiled
def _drop(columns, active, factor, size, height, right):
    """Take the atoms of height zero out of the active set; return its new size."""
    kept = 0
    first = size
    for i in range(size):
        if height[i] > 0:
            height[kept], active[kept], right[kept] = height[i], active[i], right[i]
            kept += 1
        elif first == size:
            first = i
    for i in range(first, kept):
        _append(columns, active, factor, i, active[i])
    return kept


@_compiled
def _descend(columns, active, factor, size, height, right, wanted):
    """Move the heights to the minimum over the active set, dropping atoms on the way."""
    while size > 0:
        _solve(factor, size, right, wanted)
        step = 1.0
        for i in range(size):
            if wanted[i] <= 0:
                step = min(step, height[i] / (height[i] - wanted[i]))
        if step == 1.0:
            height[:size] = wanted[:size]
            return size
        for i in range(size):
            blocks = wanted[i] <= 0 and height[i] / (height[i] - wanted[i]) <= step
            height[i] = 0.0 if blocks else height[i] + step * (wanted[i] - height[i])
        size = _drop(columns, active, factor, size, height, right)
    return size


@_compiled
def _exchange(columns, active, factor, size, height, right, atom, wanted):
    """Put in an atom that depends on the active set, at the price of one that it replaces.

    The residual stays; the sum of heights falls. Returns the new size.
    """
    share = wanted
    share[:size] = factor[size, :size]
    _solve_upper(factor, size, share)
    amount = np.inf
    out = 0
    for i in range(size):
        if share[i] > 0 and height[i] / share[i] < amount:
            amount, out = height[i] / share[i], i
    for i in range(size):
        height[i] = max(height[i] - amount * share[i], 1e-300)
    height[out] = 0.0
    size = _drop(columns, active, factor, size, height, right)
    height[size] = amount
    return size


@_compiled
def _solve_pixels(rows, columns, choice, y, ratio, tolerance, synthesis):
    """Solve one pixel after the other; see `nonnegative_lasso`."""
    count, filters = y.shape
    atoms = rows.shape[2]
    result = np.zeros((count, synthesis.shape[1]))
    gaps = np.zeros(count)
    factor = np.zeros((filters + 1, filters + 1))
    active = np.zeros(filters + 1, np.int64)
    height = np.zeros(filters + 1)
    right = np.zeros(filters + 1)
    wanted = np.zeros(filters + 1)
    correlation = np.zeros(atoms)
    residual = np.zeros(filters)
    for n in range(count):
        row, column, measured = rows[choice[n]], columns[choice[n]], y[n]
        _correlate(row, measured, correlation)
        peak = correlation.max()
        if peak <= 0:
            continue
        weight = ratio[n] * peak
        size = 0
        for _ in range(20 * (filters + 1)):
            size = _descend(column, active, factor, size, height, right, wanted)
            residual[:] = measured
            for i in range(size):
                for m in range(filters):
                    residual[m] -= height[i] * column[active[i], m]
            _correlate(row, residual, correlation)
            best = correlation.argmax()
            excess = correlation[best] - weight
            # The residual, shrunk into the dual feasible set, bounds the minimum from below.
            power = _dot(residual, residual)
            fit = _dot(residual, measured)
            objective = power / 2 + weight * height[:size].sum()
            shrink = min(fit / power, weight / correlation[best]) if power > 0 else 0.0
            gap = objective - shrink * (fit - shrink * power / 2)
            gaps[n] = gap / objective if objective > 0 else 0.0
            if ratio[n] == 0 and excess <= 1e-10 * peak:
                gaps[n] = 0.0
            if gaps[n] <= tolerance:
                break
            if _append(column, active, factor, size, best):
                height[size] = 0.0
            else:
                if excess <= 1e-10 * peak:  # only rounding is left
                    break
                size = _exchange(
                    column, active, factor, size, height, right, best, wanted
                )  # fmt: skip
                if not _append(column, active, factor, size, best):
                    break
            right[size] = _dot(column[best], measured) - weight
            size += 1
        for i in range(size):
            for k in range(synthesis.shape[1]):
                result[n, k] += height[i] * synthesis[active[i], k]
    return result, gaps
