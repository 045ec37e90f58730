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

from dataclasses import dataclass

import numpy as np

from squilla.errors import InputError

DRAWS = 24
"""Number of draws that stand for what is left open."""

_LEAST = np.log([2e-3, 0.02, 1e-5, 1e-5])
_MOST = np.log([2.0, 5.0, 0.3, 0.3])
_SHARED = 0.3  # share of R, RMS, in a spectral shape that all filters have, such as the sensor's


@dataclass(frozen=True)
class Inferred:
    """The sensitivity that responses speak for.

    sensitivity : (A, M, K).
    deviations : (J, A, M, K) float32; sensitivity + deviations[j] explains the responses as well:
        draws of the error.
    power_error : (S,) relative error of the power of each step, as far as it shows.
    power_noise : their standard deviation.
    noise : standard deviation of the rest, relative to the RMS of the responses.
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
    if settings is None:
        settings = _most_probable(light, scaled, wavelength)
    fit = _Fit(light, scaled, wavelength, settings)
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


def _most_probable(light: np.ndarray, response: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """Return the settings of `Inferred` under which the responses are most probable."""
    from scipy.optimize import minimize

    def misfit(settings: np.ndarray) -> float:
        inside = np.clip(settings, _LEAST, _MOST)
        beyond = float(np.square(settings - inside).sum())
        return _Fit(light, response, wavelength, inside).misfit + 100 * beyond

    start = np.log([0.08, 0.5, 1e-3, 0.01])
    simplex = start + np.vstack([np.zeros(4), np.diag([0.7, 0.7, -2.0, 1.0])])
    options = {"initial_simplex": simplex, "xatol": 0.03, "fatol": 0.3, "maxiter": 250}
    found = minimize(misfit, start, method="Nelder-Mead", options=options)
    return np.clip(found.x, _LEAST, _MOST)


class _Fit:
    """The model of responses, (S, A, M), under given settings.

    The angles count as repetitions: what they say of the settings and the power is averaged.
    """

    def __init__(
        self, light: np.ndarray, response: np.ndarray, wavelength: np.ndarray, settings: np.ndarray
    ):
        length, size, self.noise, self.power_noise = (float(each) for each in np.exp(settings))
        steps, angles, filters = response.shape
        wavenumber = 1 / np.asarray(wavelength, float)
        apart = np.abs(wavenumber[:, None] - wavenumber) / np.ptp(wavenumber) / length
        alike = _matern(apart)
        self.kernel = 1 + size**2 * alike
        self.seen = light @ self.kernel  # (S, K)
        covariance = self.seen @ light.T + self.noise**2 * np.eye(steps)
        self.inverse = np.linalg.inv(covariance)
        flat = response.reshape(steps, -1)
        likelihood = self.inverse * (flat @ flat.T) / angles
        # The weights w = 1 / (1 + e), first with the shape that all filters share in them.
        share = light / light.sum(-1, keepdims=True).clip(1e-12)
        self.shared = _SHARED**2 * (1 + share @ alike @ share.T)
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


def _matern(apart: np.ndarray) -> np.ndarray:
    """Return Matern's correlation of order 7/2 at distances in correlation lengths."""
    x = np.sqrt(7) * apart
    return (1 + x * (1 + x * (0.4 + x / 15))) * np.exp(-x)


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
