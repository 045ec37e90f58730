"""Sparse recovery: the fewest Gaussian lines that explain a measurement.

For every pixel, x = Psi s, where s minimises 1/2 ||y - R Psi s||^2 + weight ||s||_1, s >= 0.
"""

import math
import warnings

import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration
from squilla.reconstruction.active_set import nonnegative_lasso
from squilla.reconstruction.linear import SNR
from squilla.reconstruction.reconstructor import Reconstructor

ANGLES = 16
"""Field angles for which the sensitivity is set up; a pixel takes the nearest (0.3 % of R)."""


class Sparse(Reconstructor):
    """Non-negative l1 recovery over a dictionary of Gaussian lines of all widths.

    The l1 weight follows the noise of each pixel: 0.025 x 10^(-0.06 SNR) times the largest
    correlation ||(R Psi)' y||_inf, that is 1.6e-3 at 20 dB. An atom has the height at which l1
    counts it as 1, the inverse square root of ||R psi||: with equal heights l1 favours broad lines
    too much, with equal ||R psi|| narrow ones. Rule and heights were chosen on random natural,
    Gaussian and line spectra at 15 to 40 dB.

    Source: thesis, section on sparse recovery.

    Parameters
    ----------
    calibration : Calibration
    tolerance : float
        Largest relative duality gap: the objective of each pixel is within this fraction of the
        minimum.
    """

    name = "sparse"
    piece = 16384

    def __init__(self, calibration: Calibration, tolerance: float = 1e-6):
        super().__init__(calibration)
        self.tolerance = tolerance
        nodes, response = _responses(calibration)
        self.nodes = nodes
        atoms = gaussian_lines(calibration.wavelength)
        seen = np.linalg.norm(response[-1] @ atoms.T, axis=0)
        # Where no filter looks, an atom keeps a finite height, and is never chosen.
        self.atoms = atoms * np.maximum(seen, 1e-3 * seen.max())[:, None] ** -0.5
        self.columns = np.ascontiguousarray(self.atoms @ response.mT.numpy())
        self.rows = np.ascontiguousarray(self.columns.swapaxes(1, 2))

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None) -> Tensor:
        spectra, gap = self._solve(y, angle, self.ratio(snr, len(y)), self.atoms)
        if not (gap <= self.tolerance).all():
            warnings.warn(
                f"{self.name}: {int((gap > self.tolerance).sum())} pixels ended at a relative "
                f"duality gap of up to {float(gap.max()):.1e}.",
                stacklevel=2,
            )
        return spectra.to(y)

    def ratio(self, snr: Tensor | None, count: int) -> np.ndarray:
        """Return the l1 weight of each pixel as a fraction of ||(R Psi)' y||_inf, (N,)."""
        decibel = np.full(count, SNR) if snr is None else snr.double().cpu().numpy()
        return 0.025 * 10 ** (-0.06 * decibel)

    def heights(
        self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the solution itself instead of its spectrum.

        Parameters
        ----------
        y : Tensor, (N, M)
        angle : Tensor, (N,), optional
            Field angle, rad.
        snr : Tensor, (N,), optional
            Signal-to-noise ratio, dB; default 20.

        Returns
        -------
        Tensor, (N, atoms), float64
            s, one height per row of `atoms`.
        Tensor, (N,), float64
            The relative duality gap: the objective exceeds its minimum by no more than this
            fraction.
        """
        return self._solve(y, angle, self.ratio(snr, len(y)), np.eye(len(self.atoms)))

    def _solve(
        self, y: Tensor, angle: Tensor | None, ratio: np.ndarray, synthesis: np.ndarray
    ) -> tuple[Tensor, Tensor]:
        solution, gap = nonnegative_lasso(
            self.rows,
            y.double().cpu().numpy(),
            ratio,
            columns=self.columns,
            choice=self._nearest(angle, len(y)),
            synthesis=synthesis,
            tolerance=self.tolerance,
            threads=torch.get_num_threads(),
        )
        return torch.from_numpy(solution), torch.from_numpy(gap)

    def _nearest(self, angle: Tensor | None, count: int) -> np.ndarray:
        """Return the index of the matrix that each pixel uses, (N,)."""
        if angle is None:
            return np.full(count, len(self.nodes))
        square = angle.double().square().cpu().numpy()
        low, high = self.nodes[0] ** 2, self.nodes[-1] ** 2
        position = (square - low) / (high - low) * (len(self.nodes) - 1)
        return np.rint(np.clip(position, 0, len(self.nodes) - 1)).astype(np.int64)


class NonNegative(Sparse):
    """Non-negative least squares over the same Gaussian lines: `Sparse` without the l1 term.

    It follows the noise as closely as non-negative sums of lines can; a bound to judge by, or for
    measurements of 40 dB and better.
    """

    name = "nnls"

    def ratio(self, snr: Tensor | None, count: int) -> np.ndarray:
        return np.zeros(count)


class Twist(Sparse):
    """The problem of `Sparse`, solved by the monotone two-step iteration TwIST.

    What much of the field computes with; kept to compare with. `Sparse` finds the same minimum
    hundreds of times faster.

    Source: J. M. Bioucas-Dias and M. A. T. Figueiredo, IEEE Trans. Image Process. 16, 2992 (2007).
    """

    name = "twist"
    piece = 4096

    def __init__(self, calibration: Calibration, tolerance: float = 1e-2):
        super().__init__(calibration, tolerance)

    def _solve(
        self, y: Tensor, angle: Tensor | None, ratio: np.ndarray, synthesis: np.ndarray
    ) -> tuple[Tensor, Tensor]:
        node = self._nearest(angle, len(y))
        result = torch.zeros(len(y), synthesis.shape[1], dtype=torch.float64)
        gap = torch.zeros(len(y), dtype=torch.float64)
        for index in np.unique(node):
            here = torch.from_numpy(np.flatnonzero(node == index))
            matrix = torch.from_numpy(self.rows[index])
            heights, gap[here] = two_step(
                matrix, y[here].cpu(), torch.from_numpy(ratio)[here], self.tolerance
            )
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
    matrix: Tensor, y: Tensor, ratio: float | Tensor, tolerance: float, most: int = 20_000
) -> tuple[Tensor, Tensor]:
    """Minimise 1/2 ||y - A s||^2 + weight ||s||_1 over s >= 0 by monotone TwIST.

    Parameters
    ----------
    matrix : Tensor, (M, atoms), float64
    y : Tensor, (N, M)
    ratio : float or Tensor, (N,)
        The weight as a fraction of ||A' y||_inf.
    tolerance : float
        Relative duality gap at which a problem ends.
    most : int
        Number of steps after which it ends anyway.

    Returns
    -------
    Tensor, (N, atoms), float64; Tensor, (N,), the relative duality gaps

    Source: see `Twist`.
    """
    y = y.double()
    norm = torch.linalg.matrix_norm(matrix, 2)
    scaled, target = matrix / norm, y / norm
    weight = (ratio * (target @ scaled).amax(-1).clamp_min(0))[:, None]
    # A'A is singular, so that its smallest eigenvalue is no guide; of 1e-2, 1e-3, 1e-4 and 1e-5
    # this one ended soonest for broadband filters.
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
