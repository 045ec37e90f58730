"""What the sensitivity is, and how sure that is, given responses to light of known spectra.

Step s of a measurement shows light of the spectrum g_s and filter i answers

    y_si = (1 + e_s) g_s' R_i + noise,

where e_s, common to all filters, is the error with which the light's power is known. What is known
of R before: each row is a smooth random function, a Gaussian process in wavenumber, for there the
fringes of thin films are evenly spaced. Its correlation length and size, the noise and the size of
e follow from the responses themselves, as those under which the responses are most probable. All
filters see the same e_s, so most of what varies fast from step to step in all of them at once is
found and taken out; what varies slowly is a light brighter there or filters more sensitive there,
and no sweep can tell.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from squilla.errors import InputError

DRAWS = 24
"""Number of draws that stand for what is left open."""

_LEAST = np.log([2e-3, 0.02, 1e-3, 1e-5])
_MOST = np.log([2.0, 5.0, 0.3, 0.3])
"""Bounds of the settings of `Inferred`. A noise below 0.1 % is not believed: the finest wiggles of
real filters follow no simple model that closely."""
_SHARED = 0.3
"""What all filters have in common, such as the sensor's efficiency, varies by this much of R."""


@dataclass(frozen=True)
class Inferred:
    """The sensitivity that responses speak for.

    sensitivity : (A, M, K).
    deviations : (J, A, M, K) float32; sensitivity + deviations[j] explains the responses as well:
        draws of the error.
    power_error : (S,) relative error of the power of each step, as far as it shows.
    power_noise : their standard deviation.
    noise : (median) standard deviation of the rest, relative to the RMS of the responses.
    evidence : logarithm of the probability of the responses; to compare models of the light with.
    settings : (4,) logarithms of the correlation length, as a share of the band, of the size of R,
        the noise and the power noise.
    """

    sensitivity: np.ndarray
    deviations: np.ndarray
    power_error: np.ndarray
    power_noise: float
    noise: float
    evidence: float
    settings: np.ndarray


def infer_sensitivity(
    light: np.ndarray,
    response: np.ndarray,
    wavelength: np.ndarray,
    *,
    spread: np.ndarray | None = None,
    settings: np.ndarray | None = None,
) -> Inferred:
    """Infer the sensitivity from responses to light of known spectra.

    Parameters
    ----------
    light : array, (S, K)
        Spectrum of each step, such that a response is ``light @ sensitivity``.
    response : array, (S, A, M)
        Of M filters at A field angles.
    wavelength : array, (K,)
        nm.
    spread : array, (S,), optional
        Standard deviation of the noise of each step's responses, in any unit; default: all alike.
    settings : array, (4,), optional
        Those of an earlier inference, to compare evidence; default: the most probable.

    Returns
    -------
    Inferred

    Raises
    ------
    InputError
        If there are fewer than three steps, or no light.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, ch. 2, 4, 5 (the
    kernel is Matern's of order 7/2); the e_s by Laplace's approximation, for which the problem is
    convex.
    """
    if len(light) < 3:
        raise InputError(f"{len(light)} spectra of light teach no sensitivity; give at least 3.")
    unit = float(np.sqrt(np.mean(np.square(response)))) / max(float(light.sum(-1).mean()), 1e-300)
    if not unit > 0:
        raise InputError("The filters do not answer to the light: the frames are dark.")
    scaled = response / unit
    variance = np.ones(len(light)) if spread is None else np.square(spread / np.median(spread))
    if settings is None:
        settings = _most_probable(light, scaled, wavelength, variance)
    fit = _Fit(light, scaled, wavelength, variance, settings)
    error, covariance = fit.power_error()
    smooth, left = fit.smoother()
    corrected = scaled * (1 - error)[:, None, None]

    random = np.random.default_rng(0)
    common = random.standard_normal((DRAWS, len(light))) @ _root(covariance)
    own = random.standard_normal((DRAWS, 1, response.shape[2], len(wavelength))) @ _root(left)
    shared = np.einsum("ks,sam,js->jamk", smooth, scaled, common, optimize=True)
    return Inferred(
        unit * np.einsum("ks,sam->amk", smooth, corrected),
        (unit * (shared + own)).astype(np.float32),
        error,
        fit.power_noise,
        fit.noise,
        -fit.misfit,
        settings,
    )


def _most_probable(
    light: np.ndarray, response: np.ndarray, wavelength: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """Return the settings of `Inferred` under which the responses are most probable.

    Length and size first, with errors of the power as if each filter had its own: what is known to
    a percent tells how smooth filters are on the whole. Known to a thousandth, it would rather tell
    how no simple model of a filter is right, and lay that on the power.
    """
    steps, angles, filters = response.shape
    flat = response.reshape(steps, -1)
    moment = flat @ flat.T / angles

    def apart(settings: np.ndarray) -> float:
        length, size, noise, power_noise = np.exp(settings)
        covariance = light @ _kernel(wavelength, length, size) @ light.T
        error = noise**2 * variance + power_noise**2 * np.diag(moment) / filters
        covariance += np.diag(error)
        return float((np.linalg.inv(covariance) * moment).sum() + filters * _volume(covariance)) / 2

    def together(noises: np.ndarray) -> float:
        return _Fit(light, response, wavelength, variance, np.r_[shape, noises]).misfit

    start = np.log([0.08, 0.5, 1e-3, 0.01])
    shape = _least(apart, start, _LEAST, _MOST)[:2]
    return np.r_[shape, _least(together, start[2:], _LEAST[2:], _MOST[2:])]


def _least(
    function: Callable[[np.ndarray], float], start: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return where a function of a few variables is least between bounds."""
    from scipy.optimize import minimize

    def bounded(place: np.ndarray) -> float:
        inside = np.clip(place, low, high)
        return function(inside) + 100 * float(np.square(place - inside).sum())

    simplex = start + np.vstack([np.zeros(len(start)), 0.8 * np.eye(len(start))])
    options = {"initial_simplex": simplex, "xatol": 0.03, "fatol": 0.3, "maxiter": 250}
    return np.clip(minimize(bounded, start, method="Nelder-Mead", options=options).x, low, high)


class _Fit:
    """The model of responses, (S, A, M), under given settings.

    The angles count as repetitions: what they say of the settings and the power is averaged.
    """

    def __init__(
        self,
        light: np.ndarray,
        response: np.ndarray,
        wavelength: np.ndarray,
        variance: np.ndarray,
        settings: np.ndarray,
    ):
        length, size, self.noise, self.power_noise = (float(each) for each in np.exp(settings))
        steps, angles, filters = response.shape
        self.kernel = _kernel(wavelength, length, size)
        self.seen = light @ self.kernel  # (S, K)
        covariance = self.seen @ light.T + self.noise**2 * np.diag(variance)
        self.inverse = np.linalg.inv(covariance)
        flat = response.reshape(steps, -1)
        likelihood = self.inverse * (flat @ flat.T) / angles
        # The weights w = 1 / (1 + e), first with the shape that all filters share in them.
        share = light / light.sum(-1, keepdims=True).clip(1e-12)
        self.shared = share @ _kernel(wavelength, length, _SHARED) @ share.T
        prior = self.shared + self.power_noise**2 * np.eye(steps)
        self.prior_inverse = np.linalg.inv(prior)
        self.weight, self.hessian = _weights(likelihood, self.prior_inverse, filters)
        off = self.weight - 1
        volume = filters * _volume(covariance) + _volume(self.hessian) + _volume(prior)
        fit = self.weight @ likelihood @ self.weight + off @ self.prior_inverse @ off
        self.misfit = float((fit + volume) / 2 - filters * np.log(self.weight).sum())

    def power_error(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the relative error of each step's power, (S,), and its covariance, (S, S).

        Of what all filters share from step to step, the part that is no smooth spectral shape.
        """
        one, variance = np.eye(len(self.weight)), self.power_noise**2
        error = -variance * self.prior_inverse @ (self.weight - 1)
        precision = self.hessian - self.prior_inverse
        prior = self.shared + variance * one
        explained = np.linalg.inv(prior + np.linalg.inv(precision))
        return error, variance * one - variance**2 * explained

    def smoother(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what turns responses into sensitivities, and what that leaves open.

        smooth : (K, S); a row of the sensitivity is ``smooth @ response``.
        left : (K, K); the covariance of its error.
        """
        smooth = self.seen.T @ self.inverse
        return smooth, self.kernel - smooth @ self.seen


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return what standard normal numbers, (.., S), are multiplied by to have a covariance."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.sqrt(values.clip(0))[:, None] * vectors.T


def _volume(covariance: np.ndarray) -> float:
    """Return the logarithm of the determinant of a covariance."""
    return float(np.linalg.slogdet(covariance)[1])


def _kernel(wavelength: np.ndarray, length: float, size: float) -> np.ndarray:
    """Return the covariance of a smooth row of R, (K, K): a level, and Matern's of order 7/2."""
    wavenumber = 1 / np.asarray(wavelength, float)
    apart = np.abs(wavenumber[:, None] - wavenumber) / np.ptp(wavenumber)
    x = np.sqrt(7) / length * apart
    return 1 + size**2 * (1 + x * (1 + x * (0.4 + x / 15))) * np.exp(-x)


def _weights(
    likelihood: np.ndarray, prior_inverse: np.ndarray, filters: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable weights of the steps, (S,), and the curvature there, (S, S).

    Newton's method on w'Aw/2 - M sum(log w) + (w - 1)'P(w - 1)/2, which is convex.
    """
    weight = np.ones(len(likelihood))
    curved = likelihood + prior_inverse
    for _ in range(50):
        slope = likelihood @ weight - filters / weight + prior_inverse @ (weight - 1)
        hessian = curved + np.diag(filters / weight**2)
        step = np.linalg.solve(hessian, slope)
        weight = weight - min(1.0, 0.9 / max(float((step / weight).max()), 1e-9)) * step
        if np.abs(step).max() < 1e-7:
            break
    return weight, curved + np.diag(filters / weight**2)
