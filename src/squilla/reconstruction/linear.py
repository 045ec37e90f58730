"""The linear (Wiener) estimator, and the filling of invalid channels, which is the same algebra."""

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.reconstruction.reconstructor import Reconstructor
from squilla.spectra import broad_spectra, reflectances

SNR = 20.0
"""Signal-to-noise ratio assumed where none is known, dB: what the thesis found for its camera."""


class Ridge(Reconstructor):
    """The best linear estimator for the broad prior: x = S R' (R S R' + sigma^2 I)^-1 y.

    S is the second moment of the spectra (their mean is not taken off, so that twice the light
    gives twice the spectrum). Negative values of the estimate are clipped to zero, which moves
    every spectrum nearer to the truth or leaves it.

    Parameters
    ----------
    calibration : Calibration
        With several field angles, there is one matrix for each and the estimates of a pixel are
        interpolated in between.
    snr : float, optional
        Signal-to-noise ratio of the measurements, dB. Default: that of each measurement given to
        `reconstruct`, or 20 where it is unknown.
    moment : Tensor, (K, K), optional
        Second moment of the spectra; default: that of the broad prior.

    Source: N. Wiener; here with the prior of spectra.broad_spectra.
    """

    name = "ridge"
    matrix: Tensor

    def __init__(
        self, calibration: Calibration, snr: float | None = None, moment: Tensor | None = None
    ):
        super().__init__(calibration)
        self.snr = snr
        self.moment = second_moment(calibration) if moment is None else moment
        response = calibration.sensitivities.double()
        response = torch.cat([response, calibration.mean_sensitivity.double()[None]])
        covariance = _covariance(response, self.moment, SNR if snr is None else snr)
        gain = torch.linalg.solve(covariance, response @ self.moment)  # (A + 1, M, K)
        self.register_buffer("matrix", gain.float(), persistent=False)

    def estimate(self, y: Tensor, angle: Tensor | None) -> Tensor:
        if angle is None:
            return y @ self.matrix[-1]
        weights = self.calibration.angle_weights(angle)
        # One product for all angles: the channels, weighted by each angle, side by side.
        weighted = (weights[..., None] * y[:, None, :]).flatten(1)
        return weighted @ self.matrix[:-1].flatten(0, 1)

    def tuned(self, snr: float | None) -> "Ridge":
        if self.snr is not None or snr is None:
            return self
        return Ridge(self.calibration, snr, self.moment).to(self.matrix.device)


def second_moment(calibration: Calibration) -> Tensor:
    """Return the mean of x x' over 20 000 spectra of the broad prior, (K, K), float64.

    Outside 500-750 nm the prior is stretched; see `within_tables`.
    """
    return _second_moment(tuple(calibration.wavelength.tolist()))


@lru_cache(maxsize=4)  # every capture with an invalid pixel needs it
def _second_moment(wavelength: tuple[float, ...]) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    spectra = broad_spectra(20_000, within_tables(np.array(wavelength)), generator=generator)
    return (spectra.T @ spectra).double() / len(spectra)


def within_tables(wavelength: np.ndarray) -> np.ndarray:
    """Return wavelengths at which natural spectra can be drawn for a band.

    They are the band's own where the measured tables (500-750 nm) cover it. Otherwise the band is
    mapped onto the tables': a camera of 400-1000 nm meets natural spectra stretched to its band,
    which are as varied and as smooth, if not its own.

    Parameters
    ----------
    wavelength : array, (K,)
        nm.

    Returns
    -------
    array, (K,), nm
    """
    known = reflectances().wavelength
    if known[0] - 1e-6 <= wavelength[0] and wavelength[-1] <= known[-1] + 1e-6:
        return wavelength
    share = (wavelength - wavelength[0]) / max(np.ptp(wavelength), 1e-9)
    return known[0] + share * np.ptp(known)


def complete(
    y: Tensor,
    valid: Tensor,
    calibration: Calibration,
    angle: Tensor | None = None,
    snr: float | None = None,
) -> Tensor:
    """Fill the invalid channels of each pixel with their linear estimate from the valid ones.

    To fill and then apply the Wiener estimator gives what the Wiener estimator of the valid
    channels alone gives; every other reconstructor gets the same filled channels.

    Parameters
    ----------
    y : Tensor, (..., M)
    valid : Tensor, (..., M), bool
        A channel that is NaN or infinite counts as invalid too.
    calibration : Calibration
    angle : Tensor, (...), optional
        Field angle, rad.
    snr : float, optional
        Signal-to-noise ratio, dB; default 20.

    Returns
    -------
    Tensor, (..., M); NaN where fewer than half of a pixel's channels are valid
    """
    valid = torch.as_tensor(valid, dtype=torch.bool)
    if valid.shape != y.shape:
        raise InputError(
            f"The valid mask has the shape {tuple(valid.shape)}, the measurement "
            f"{tuple(y.shape)}; they must agree."
        )
    valid = valid & y.isfinite()
    enough = valid.sum(-1) >= (y.shape[-1] + 1) // 2
    partial = enough & ~valid.all(-1)
    filled = torch.where(enough[..., None], y, torch.nan)
    if not partial.any():
        return filled
    response = calibration.sensitivities.double() if angle is not None else None
    if response is None:
        response = calibration.mean_sensitivity.double()[None]
    covariance = _covariance(
        response, second_moment(calibration), SNR if snr is None else snr
    ).float()
    known = torch.where(valid, y, 0)[partial]
    weights = torch.ones(len(known), 1)
    if angle is not None:
        weights = calibration.angle_weights(angle[partial])
    parts = zip(known.split(2048), valid[partial].split(2048), weights.split(2048), strict=True)
    filled[partial] = torch.cat([_fill(*part, covariance) for part in parts])
    return filled


def _fill(y: Tensor, valid: Tensor, weights: Tensor, covariance: Tensor) -> Tensor:
    """Return y, (N, M), with invalid channels replaced by C_iv C_vv^-1 y_v."""
    full = torch.einsum("na,amk->nmk", weights, covariance)
    both = valid[:, :, None] & valid[:, None, :]
    # Rows of invalid channels become those of the identity: they decouple and stay zero.
    reduced = torch.where(both, full, torch.eye(y.shape[-1]))
    explained = torch.linalg.solve(reduced, y)
    return torch.where(valid, y, torch.einsum("nmk,nk->nm", full, explained))


def _covariance(response: Tensor, moment: Tensor, snr: float) -> Tensor:
    """Return the second moment of noisy measurements, R S R' + sigma^2 I, (A, M, M)."""
    if math.isnan(snr):
        raise InputError("The signal-to-noise ratio is NaN; give a number of dB, or leave it out.")
    signal = response @ moment @ response.mT
    power = signal.diagonal(dim1=-2, dim2=-1).mean(-1)
    # Beyond 90 dB the rounding of float32 is the noise.
    noise = power * 10 ** (-min(float(snr), 90.0) / 10)
    return signal + noise[:, None, None] * torch.eye(response.shape[-2], dtype=torch.float64)
