"""Sparse recovery: the fewest Gaussian lines that explain a measurement.

For every pixel, x = Psi s, where s minimises 1/2 ||y - R Psi s||^2 + weight ||s||_1, s >= 0.

A spectrum needs a handful of lines, at most as many as there are filters. So the solver adds one
line at a time to an active set and solves for the set exactly through its Cholesky factor, as
Lawson and Hanson do without the l1 term; it ends at the exact optimum after some ten steps, each a
few hundred nanoseconds to microseconds long, where first-order methods take thousands.
"""

import math
import warnings
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration
from squilla.reconstruction.linear import SNR
from squilla.reconstruction.reconstructor import Reconstructor

ANGLES = 16
"""Field angles for which the sensitivity is set up; a pixel takes the nearest (0.3 % of R)."""

_compiled = numba.njit(
    # Freedoms that let sums run in vector registers, while NaN and infinity stay exact.
    fastmath={"reassoc", "contract", "nsz"},
    error_model="numpy",
    nogil=True,
    cache=True,
)


class Sparse(Reconstructor):
    """Non-negative l1 recovery over a dictionary of Gaussian lines of all widths.

    The l1 weight follows the noise: 0.025 x 10^(-0.06 SNR) times the largest correlation
    ||(R Psi)' y||_inf, that is 1.6e-3 at 20 dB. An atom has the height at which l1 counts it as 1,
    the inverse square root of ||R psi||: with equal heights l1 favours broad lines too much, with
    equal ||R psi|| narrow ones. Rule and heights were chosen on random natural, Gaussian and line
    spectra at 15 to 40 dB.

    Parameters
    ----------
    calibration : Calibration
    snr : float, optional
        Signal-to-noise ratio of the measurements, dB. Default: that of each measurement given to
        `reconstruct`, or 20 where it is unknown.
    tolerance : float
        Largest relative duality gap: the objective of each pixel is within this fraction of the
        minimum.

    Source: thesis, section on sparse recovery; C. L. Lawson and R. J. Hanson, Solving Least
    Squares Problems, ch. 23.
    """

    name = "sparse"
    piece = 16384

    def __init__(self, calibration: Calibration, snr: float | None = None, tolerance: float = 1e-6):
        super().__init__(calibration)
        self.snr = snr
        self.tolerance = tolerance
        self.ratio = 0.025 * 10 ** (-0.06 * (SNR if snr is None else snr))
        nodes, response = _responses(calibration)
        self.nodes = nodes
        atoms = gaussian_lines(calibration.wavelength)
        height = np.linalg.norm(response[-1] @ atoms.T, axis=0) ** -0.5
        self.atoms = atoms * height[:, None]
        self.columns = np.ascontiguousarray(self.atoms @ response.mT.numpy())
        self.rows = np.ascontiguousarray(self.columns.swapaxes(1, 2))

    def estimate(self, y: Tensor, angle: Tensor | None) -> Tensor:
        spectra, gap = self._solve(y, angle, self.atoms)
        if not (gap <= self.tolerance).all():
            warnings.warn(
                f"{self.name}: {int((gap > self.tolerance).sum())} pixels ended at a relative "
                f"duality gap of up to {float(gap.max()):.1e}.",
                stacklevel=2,
            )
        return spectra.to(y)

    def heights(self, y: Tensor, angle: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the solution itself instead of its spectrum.

        Parameters
        ----------
        y : Tensor, (N, M)
        angle : Tensor, (N,), optional
            Field angle, rad.

        Returns
        -------
        Tensor, (N, atoms), float64
            s, one height per row of `atoms`.
        Tensor, (N,), float64
            The relative duality gap: the objective exceeds its minimum by no more than this
            fraction.
        """
        return self._solve(y, angle, np.eye(len(self.atoms)))

    def _solve(self, y: Tensor, angle: Tensor | None, synthesis: np.ndarray):
        def recover(pixels: slice):
            return _recover(
                self.rows, self.columns, node[pixels], measured[pixels],
                self.ratio, self.tolerance, synthesis,
            )  # fmt: skip

        node = self._nearest(angle, len(y))
        measured = y.double().cpu().numpy()
        pieces = [slice(start, start + 512) for start in range(0, len(y), 512)]
        # The kernel lets go of the interpreter's lock, so that plain threads run it in parallel,
        # also when several threads reconstruct at once (numba's own thread pool cannot do that).
        with ThreadPoolExecutor(torch.get_num_threads()) as threads:
            spectra, gap = zip(*threads.map(recover, pieces), strict=True)
        return torch.from_numpy(np.concatenate(spectra)), torch.from_numpy(np.concatenate(gap))

    def _nearest(self, angle: Tensor | None, count: int) -> np.ndarray:
        """Return the index of the matrix that each pixel uses, (N,)."""
        if angle is None:
            return np.full(count, len(self.nodes))
        square = angle.double().square().cpu().numpy()
        low, high = self.nodes[0] ** 2, self.nodes[-1] ** 2
        position = (square - low) / (high - low) * (len(self.nodes) - 1)
        return np.rint(np.clip(position, 0, len(self.nodes) - 1)).astype(np.int64)

    def tuned(self, snr: float | None) -> "Sparse":
        if self.snr is not None or snr is None:
            return self
        return type(self)(self.calibration, snr, self.tolerance)


class NonNegative(Sparse):
    """Non-negative least squares over the same Gaussian lines: `Sparse` without the l1 term.

    It follows the noise as closely as non-negative sums of lines can; a bound to judge by, or for
    measurements of 40 dB and better.
    """

    name = "nnls"

    def __init__(self, calibration: Calibration):
        super().__init__(calibration)
        self.ratio = 0.0

    def tuned(self, snr: float | None) -> "NonNegative":
        return self


class Twist(Sparse):
    """The problem of `Sparse`, solved by the monotone two-step iteration TwIST.

    What much of the field computes with; kept to compare with. `Sparse` finds the same minimum
    hundreds of times faster.

    Source: J. M. Bioucas-Dias and M. A. T. Figueiredo, IEEE Trans. Image Process. 16, 2992 (2007).
    """

    name = "twist"
    piece = 4096

    def __init__(self, calibration: Calibration, snr: float | None = None, tolerance: float = 1e-2):
        super().__init__(calibration, snr, tolerance)

    def _solve(self, y: Tensor, angle: Tensor | None, synthesis: np.ndarray):
        node = self._nearest(angle, len(y))
        result = torch.zeros(len(y), synthesis.shape[1], dtype=torch.float64)
        gap = torch.zeros(len(y), dtype=torch.float64)
        for index in np.unique(node):
            here = torch.from_numpy(np.flatnonzero(node == index))
            matrix = torch.from_numpy(self.rows[index])
            heights, gap[here] = two_step(matrix, y[here].cpu(), self.ratio, self.tolerance)
            result[here] = heights @ torch.from_numpy(synthesis)
        return result, gap


def gaussian_lines(wavelength: np.ndarray) -> np.ndarray:
    """Return the dictionary: Gaussian lines of seven widths, and the constant.

    The FWHM doubles from 1/62.5 of the spectral range (4 nm of 250) to all of it, but is never
    below 1.5 bands; the centres are 0.4 FWHM apart and reach half a FWHM beyond the ends.

    Parameters
    ----------
    wavelength : array, (K,)
        nm.

    Returns
    -------
    array, (atoms, K), peak 1; 339 atoms on the thesis' grid
    """
    low, high = float(wavelength[0]), float(wavelength[-1])
    atoms = [np.ones((1, len(wavelength)))]
    for octave in range(7):
        fwhm = (high - low) / 62.5 * 2**octave
        if len(wavelength) < 2 or fwhm < 1.5 * np.diff(wavelength).max():
            continue
        count = math.ceil((high - low + fwhm) / (0.4 * fwhm)) + 1
        centre = np.linspace(low - fwhm / 2, high + fwhm / 2, count)
        atoms.append(np.exp(-4 * np.log(2) * ((wavelength - centre[:, None]) / fwhm) ** 2))
    return np.concatenate(atoms)


def two_step(
    matrix: Tensor, y: Tensor, ratio: float, tolerance: float, most: int = 20_000
) -> tuple[Tensor, Tensor]:
    """Minimise 1/2 ||y - A s||^2 + weight ||s||_1 over s >= 0 by monotone TwIST.

    Parameters
    ----------
    matrix : Tensor, (M, atoms), float64
    y : Tensor, (N, M)
    ratio : float
        The weight as a fraction of ||A' y||_inf.
    tolerance : float
        Relative duality gap at which a problem ends.
    most : int
        Number of steps after which it ends anyway.

    Returns
    -------
    Tensor, (N, atoms), float64; Tensor, (N,), the relative duality gaps

    Source: Bioucas-Dias and Figueiredo, eq. 16 to 18 and section V.
    """
    y = y.double()
    norm = torch.linalg.matrix_norm(matrix, 2)
    scaled, target = matrix / norm, y / norm
    weight = ratio * (target @ scaled).amax(-1, keepdim=True).clamp_min(0)
    # A'A is singular, so that its smallest eigenvalue is no guide; of 1e-2 to 1e-5 this one, below
    # what the authors try, ended soonest for broadband filters.
    smallest = 1e-5
    rho = (1 - math.sqrt(smallest)) / (1 + math.sqrt(smallest))
    alpha = 1 + rho**2
    beta = 2 * alpha / (1 + smallest)

    def step(s: Tensor, residual: Tensor) -> Tensor:
        return (s + residual @ scaled - weight[todo]).clamp_min(0)

    def objective(s: Tensor, residual: Tensor) -> Tensor:
        return residual.square().sum(-1) / 2 + weight[todo, 0] * s.sum(-1)

    result = torch.zeros(len(y), matrix.shape[1], dtype=torch.float64)
    gaps = torch.full((len(y),), torch.inf, dtype=torch.float64)
    todo = torch.arange(len(y))
    before = result.clone()
    now = step(before, target)
    residual = target - now @ scaled.T
    value = objective(now, residual)
    for count in range(most):
        thresholded = step(now, residual)
        after = ((1 - alpha) * before + (alpha - beta) * now + beta * thresholded).clamp_min(0)
        rest = target[todo] - after @ scaled.T
        new = objective(after, rest)
        worse = new > value
        if worse.any():  # there the plain thresholding step, which never ascends
            after[worse] = thresholded[worse]
            rest[worse] = target[todo[worse]] - after[worse] @ scaled.T
            new = objective(after, rest)
        before, now, residual, value = now, after, rest, new
        if count % 20 and count < most - 1:
            continue
        top = (residual @ scaled).amax(-1)
        fit, power = (residual * target[todo]).sum(-1), residual.square().sum(-1)
        shrink = torch.minimum(fit / power, weight[todo, 0] / top.clamp_min(1e-300))
        bound = shrink * fit - shrink**2 * power / 2
        gap = torch.where(value > 0, 1 - bound / value, 0)
        result[todo], gaps[todo] = now, gap
        left = gap > tolerance
        if not left.any():
            break
        todo, before, now, residual, value = (
            part[left] for part in (todo, before, now, residual, value)
        )
    return result, gaps


def _responses(calibration: Calibration) -> tuple[np.ndarray, Tensor]:
    """Return field angles, (B,), and the sensitivity at each, with the mean last, (B + 1, M, K)."""
    mean = calibration.sensitivities.double().mean(0, keepdim=True)
    if len(calibration.angle) == 1:
        return calibration.angle, torch.cat([mean, mean])
    low, high = calibration.angle[0] ** 2, calibration.angle[-1] ** 2
    nodes = np.sqrt(np.linspace(low, high, ANGLES))
    weights = calibration.angle_weights(torch.from_numpy(nodes)).double()
    at_nodes = torch.einsum("ba,amk->bmk", weights, calibration.sensitivities.double())
    return nodes, torch.cat([at_nodes, mean])


# --- the kernel -----------------------------------------------------------------------------


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
def _recover(rows, columns, node, y, ratio, tolerance, synthesis):
    """Solve every pixel.

    rows (B, M, atoms) and columns (B, atoms, M) hold the same matrices R Psi; node (N,) says which
    of them a pixel uses. Returns s' synthesis, (N, .), and the relative duality gaps, (N,).
    """
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
        row, column, measured = rows[node[n]], columns[node[n]], y[n]
        _correlate(row, measured, correlation)
        peak = correlation.max()
        if peak <= 0:
            continue
        weight = ratio * peak
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
            if ratio == 0 and excess <= 1e-10 * peak:
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
