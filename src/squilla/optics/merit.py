"""How good a response matrix is: the error that it leaves of a spectrum, and simpler figures.

The figure that counts is the mean squared error of the best linear estimate. With the second moment
S of the spectra and the variance N of the noise on y = R x + n it is

    x^ = W y,   W = S R' (R S R' + N)^-1,   error = trace(S - W R S) / K,

the mean over bands and spectra. It is in closed form, has a gradient, and takes the noise as it is:
as strong in every channel, or that of photons, of which a narrow filter passes few.
"""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.errors import InputError
from squilla.priors import PRIORS
from squilla.spectra import grid

# --- what is known before anything is measured --------------------------------------------------


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of spectra before anything is measured.

    wavelength : (K,) nm.
    mean : (K,) of the spectra, each of which is scaled to a maximum of 1.
    moment : (K, K), the mean of x x'. The mean is not taken off, so that the estimator made of it
        gives twice the spectrum for twice the light.
    """

    wavelength: np.ndarray
    mean: Tensor
    moment: Tensor

    @classmethod
    def of(cls, spectra: Tensor, wavelength: ArrayLike) -> "Prior":
        """Return the prior of spectra, (N, K), at wavelengths (K,) in nm."""
        spectra = spectra.double()
        return cls(
            np.asarray(wavelength, float), spectra.mean(0), spectra.T @ spectra / len(spectra)
        )

    @classmethod
    def draw(
        cls,
        kind: str = "broad",
        wavelength: ArrayLike | None = None,
        *,
        count: int = 20_000,
        seed: int = 0,
    ) -> "Prior":
        """Return the prior of random spectra of a kind, one of ``squilla.priors.PRIORS``.

        The default wavelengths are those of `grid`, nm; their number changes the error little,
        which is a mean over bands.
        """
        if kind not in PRIORS:
            raise InputError(f"There is no prior {kind!r}; there are {', '.join(PRIORS)}.")
        wavelength = grid() if wavelength is None else np.asarray(wavelength, float)
        generator = torch.Generator().manual_seed(seed)
        return cls.of(PRIORS[kind](count, wavelength, generator=generator), wavelength)


class Noise(Protocol):
    """The noise of a measurement: independent in every filter, of a variance that R may set."""

    def variance(self, sensitivity: Tensor, prior: Prior) -> Tensor:
        """Return the variance, (..., M), averaged over the spectra of the prior, of y = R x."""
        ...


@dataclass(frozen=True)
class WhiteNoise:
    """Noise as strong in every filter.

    snr : dB (amplitude), of the root mean square over filters and spectra to the noise. An array
        that passes less light has less noise: this is a noise of the calibration, not of photons.

    Source: thesis, eq. 3.6.
    """

    snr: float

    def __post_init__(self):
        if not -300 <= self.snr <= 300:  # beyond, its power is no number any more
            raise InputError(f"The SNR must be a number of dB from -300 to 300, not {self.snr:g}.")

    def __str__(self) -> str:
        return f"{self.snr:g} dB"

    def variance(self, sensitivity: Tensor, prior: Prior) -> Tensor:
        square = ((sensitivity @ prior.moment) * sensitivity).sum(-1)
        power = square.mean(-1, keepdim=True) * 10 ** (-self.snr / 10)
        return power.expand(square.shape)


@dataclass(frozen=True, eq=False)
class PhotonNoise:
    """Shot noise and read noise, at the same exposure for every array.

    exposure : e- that a pixel without a filter would collect of the mean spectrum.
    read_noise : e-.
    clear : (K,), the sensitivity of that pixel, in the unit of R: 1 (default) where R is a
        transmittance, the quantum efficiency where R holds it.

    The variance of a photon count is its mean; averaged over spectra, it is that of the mean one,
    and the error of a linear estimator depends on nothing else.
    """

    exposure: float
    read_noise: float = 2.5
    clear: Tensor | float = field(default=1.0, repr=False)

    def __post_init__(self):
        if not (0 < self.exposure < math.inf and 0 <= self.read_noise < math.inf):
            raise InputError(
                f"An exposure of {self.exposure:g} e- with a read noise of {self.read_noise:g} e- "
                "cannot be; give an exposure above 0 and a read noise of 0 or more."
            )

    def __str__(self) -> str:
        return f"{self.exposure:g} e- of light, {self.read_noise:g} e- of read noise"

    def variance(self, sensitivity: Tensor, prior: Prior) -> Tensor:
        per_electron = (self.clear * prior.mean).sum() / self.exposure
        return sensitivity @ prior.mean * per_electron + (self.read_noise * per_electron) ** 2


# --- the error of linear estimators -------------------------------------------------------------


def expected_error(sensitivity: Tensor, prior: Prior, *, noise: Noise) -> Tensor:
    """Return the mean squared error of the best linear estimate of a spectrum.

    Parameters
    ----------
    sensitivity : Tensor, (..., M, K)
        Response matrix or transmittance, at the wavelengths of the prior; any number at once,
        gradients flow to it.
    prior : Prior
    noise : Noise
        `WhiteNoise` or `PhotonNoise`.

    Returns
    -------
    Tensor, (...), float64; the mean over bands and spectra of (x^ - x)^2, where the spectra have a
    maximum of 1. It is a bound: clipping negative values, or any better knowledge of the spectra
    than their second moment, leaves less.

    Raises
    ------
    InputError
        If the matrix does not fit the wavelengths of the prior, or the noise is lost in rounding.

    Source: the module's.
    """
    signal, covariance = _moments(sensitivity, prior, noise)
    # The trace of S R' G^-1 R S is the squared norm of L^-1 R S with G = L L'.
    explained = torch.linalg.solve_triangular(_root(covariance), signal, upper=False)
    left = prior.moment.trace() - explained.square().sum((-2, -1))
    return left / len(prior.wavelength)


def wiener(sensitivity: Tensor, prior: Prior, *, noise: Noise) -> Tensor:
    """Return the best linear estimator, (..., K, M): spectra are ``y @ matrix.mT``.

    Parameters, errors and source are those of `expected_error`.
    """
    signal, covariance = _moments(sensitivity, prior, noise)
    return torch.cholesky_solve(signal, _root(covariance)).mT


def estimator_error(
    estimator: Tensor, sensitivity: Tensor, prior: Prior, *, noise: Noise
) -> Tensor:
    """Return the mean squared error of any linear estimator on what filters truly measure.

    Parameters
    ----------
    estimator : Tensor, (..., K, M)
        Such as `wiener` of another response matrix, which filters were hoped to have.
    sensitivity : Tensor, (..., M, K)
        The true response matrix.
    prior, noise
        As in `expected_error`, which this error reaches only if the estimator is the best.

    Returns
    -------
    Tensor, (...), float64; the bias, (I - W R) x, and the noise that passes W, both squared
    """
    signal, covariance = _moments(sensitivity, prior, noise)
    together = (estimator.mT * signal).sum((-2, -1))
    spread = (covariance * (estimator.mT @ estimator)).sum((-2, -1))
    return (prior.moment.trace() - 2 * together + spread) / len(prior.wavelength)


def _moments(sensitivity: Tensor, prior: Prior, noise: Noise) -> tuple[Tensor, Tensor]:
    """Return R S and the second moment of the measurements, R S R' + N."""
    sensitivity = torch.as_tensor(sensitivity, dtype=torch.float64)
    bands = len(prior.wavelength)
    if sensitivity.ndim < 2 or sensitivity.shape[-1] != bands:
        raise InputError(
            f"The response matrix has the shape {tuple(sensitivity.shape)}; the prior is known at "
            f"{bands} wavelengths, (filters, {bands}) was expected."
        )
    signal = sensitivity @ prior.moment
    variance = noise.variance(sensitivity, prior)
    return signal, signal @ sensitivity.mT + torch.diag_embed(variance)


def _root(covariance: Tensor) -> Tensor:
    """Return the Cholesky factor of the second moment of measurements."""
    root, failed = torch.linalg.cholesky_ex(covariance)
    if failed.any():
        raise InputError(
            "The noise is lost in rounding against filters as alike as these; give a lower SNR or "
            "exposure (120 dB is plenty)."
        )
    return root


# --- simpler figures ----------------------------------------------------------------------------


def mean_correlation(response: Tensor) -> Tensor:
    """Return the mean absolute correlation of different rows of a response matrix, (M, K), 0..1.

    A row without any variation correlates with none.
    """
    rows = len(response)
    correlation = torch.corrcoef(response).abs().nan_to_num().fill_diagonal_(0)
    return correlation.sum() / (rows * (rows - 1))


def mutual_coherence(response: Tensor) -> Tensor:
    """Return the largest cosine between different columns of a response matrix, (M, K), 0..1.

    At 0 the columns are orthogonal, at 1 two of them cannot be told apart, as is nearly so for
    bands 1 nm apart: thin the bands, or multiply by a dictionary, (K, N), first.

    Source: Donoho and Elad, PNAS 100, 2197 (2003).
    """
    column = torch.nn.functional.normalize(response, dim=0)
    return (column.T @ column).abs().fill_diagonal_(0).max()


def singular_values(response: Tensor) -> Tensor:
    """Return the singular values of a response matrix, (M, K), relative to the largest, (M,)."""
    values = torch.linalg.svdvals(response)
    return values / values[0]


def condition_number(response: Tensor) -> Tensor:
    """Return the ratio of the largest to the smallest singular value of a matrix, (M, K)."""
    return 1 / singular_values(response)[-1]


def throughput(response: Tensor) -> Tensor:
    """Return the mean of a response matrix, (M, K): the share of white light that arrives."""
    return response.mean()


def peak_density(response: Tensor, wavelength: ArrayLike) -> float:
    """Return the number of maxima per 100 nm, averaged over the rows of a response, (M, K).

    A maximum counts if it stands out by 5 % of the largest value, more than the noise of a measured
    table does; those at the ends of the band do not count.
    """
    from scipy.signal import find_peaks

    wavelength = np.asarray(wavelength, float)
    rows = response.detach().cpu().numpy()
    peaks = sum(len(find_peaks(row, prominence=0.05 * rows.max())[0]) for row in rows)
    return float(100 * peaks / len(rows) / (wavelength[-1] - wavelength[0]))
