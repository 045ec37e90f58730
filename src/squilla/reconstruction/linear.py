"""The linear (Wiener) estimator, and the filling of invalid channels, which is the same algebra."""

from collections.abc import Sequence
from copy import copy

import numba
import numpy as np
import torch
from torch import Tensor

from squilla.calibration.agreement import model_error
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.priors import second_moment
from squilla.reconstruction.reconstructor import Reconstructor, Scale
from squilla.threads import single_threaded_products

SNR = 20.0
"""Signal-to-noise ratio assumed where none is known, dB: what the thesis found for its camera."""


_FEW = 256
"""Pixels that are worked on at a time: what they leave to the next step stays in the caches."""


class Ridge(Reconstructor):
    """The best linear estimator for the broad prior: x = S R' (R S R' + E + sigma^2 I)^-1 y.

    S is the second moment of the spectra (their mean is not taken off, so that twice the light
    gives twice the spectrum), E that of what an uncertain R measures wrong of them (`model_error`).
    In the eigenvectors of R S R' + E = U L U' the noise of each pixel,
    sigma^2, only divides by another L + sigma^2, so every pixel is treated by its own. Negative
    values of the estimate are clipped to zero, which moves every spectrum nearer to the truth or
    leaves it.

    Source: N. Wiener; here with the prior of priors.broad_spectra.

    Parameters
    ----------
    calibration : Calibration
        With several field angles, there is one estimator for each and the estimates of a pixel
        are interpolated in between.
    moment : Tensor, (K, K), optional
        Second moment of the spectra; default: that of the broad prior.
    """

    name = "ridge"
    piece = 8192
    basis: Tensor
    power: Tensor
    gain: Tensor

    def __init__(self, calibration: Calibration, moment: Tensor | None = None):
        super().__init__(calibration)
        moment = second_moment(calibration.wavelength) if moment is None else moment
        response = calibration.sensitivities.double()
        response = torch.cat([response, calibration.mean_sensitivity.double()[None]])
        signal = response @ moment @ response.mT + model_error(calibration, moment)
        power, basis = torch.linalg.eigh(signal)  # (A + 1, M), (A + 1, M, M)
        self.register_buffer("basis", basis.float(), persistent=False)
        self.register_buffer("power", power.clamp_min(0).float(), persistent=False)
        self.register_buffer("gain", (basis.mT @ response @ moment).float(), persistent=False)

    def only(self, bands: Sequence[int]) -> "Ridge":
        some = copy(self)
        some._buffers = self._buffers | {"gain": self.gain[..., list(bands)].contiguous()}
        some.wavelength = np.asarray(self.wavelength)[list(bands)]
        return some

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None) -> Tensor:
        noise = _noise_to_signal(snr, len(y), y.device)[:, None]
        if angle is None:
            power = self.power[-1]
            return (y @ self.basis[-1] / (power + noise * power.mean())) @ self.gain[-1]
        weights = self.calibration.angle_weights(angle)
        lower = (weights > 0).to(torch.uint8).argmax(-1).clamp_max(weights.shape[-1] - 2)
        x = y.new_empty(len(y), self.gain.shape[-1])
        basis, gain = self._pairs()
        for low in range(weights.shape[-1] - 1):
            some = (lower == low).nonzero()[:, 0]
            pair = slice(low, low + 2)
            seen = (y[some] @ basis[low]).unflatten(-1, (2, -1))
            level = noise[some, None] * self.power[pair].mean(-1, keepdim=True)
            seen *= weights[some, pair, None] / (self.power[pair] + level)
            x[some] = seen.flatten(1) @ gain[low]
        return x

    def _pairs(self) -> tuple[Tensor, Tensor]:
        """Return basis and gain of neighbouring angles side by side: one product serves both."""
        basis = torch.cat([self.basis[:-2], self.basis[1:-1]], -1)
        return basis, torch.cat([self.gain[:-2], self.gain[1:-1]], -2)

    def _whole(self, y: Tensor, angle: Tensor | None, snr: Tensor | None, scale: Scale) -> Tensor:
        if angle is None or y.device.type != "cpu":
            return super()._whole(y, angle, snr, scale)
        node = np.square(self.calibration.angle).astype(np.float32)
        x = torch.empty(len(y), self.gain.shape[-1])
        noise = _noise_to_signal(snr, len(y), y.device)
        told = (y, angle.square(), noise, torch.from_numpy(node), self.power, *self._pairs(), x)
        with single_threaded_products():
            _estimate(*(each.detach().numpy() for each in told))
        return x


@numba.njit(cache=True, nogil=True)
def _estimate(y, square, noise, node, power, basis, gain, x):
    """Do what `Ridge.estimate` says for pixels as they are: it is linear, and needs no scale."""
    zone, count = np.zeros(len(y), np.uint8), np.zeros(len(basis) + 1, np.int64)
    for n in range(len(y)):
        for low in range(1, len(basis)):
            zone[n] += square[n] > node[low]
        count[zone[n] + 1] += 1
    first = np.cumsum(count)
    order, place = np.empty(len(y), np.int64), first.copy()
    for n in range(len(y)):
        order[place[zone[n]]] = n
        place[zone[n]] += 1
    for low in range(len(basis)):
        for start in range(first[low], first[low + 1], _FEW):
            some = order[start : min(start + _FEW, first[low + 1])]
            ends, levels = node[low : low + 2], power[low : low + 2]
            _between(y, square, noise, some, ends, levels, basis[low], gain[low], x)
    for n in range(len(y)):
        lit, finite = False, True
        for unit in range(y.shape[1]):
            lit |= y[n, unit] > 0
            finite &= y[n, unit] * 0 == 0
        if not (lit and finite):
            x[n] = 0 if finite else np.nan


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _between(y, square, noise, some, node, power, basis, gain, x):
    """Estimate the spectra of a few pixels that lie between two angles."""
    seen = np.empty((len(some), y.shape[1]), np.float32)
    for n in range(len(some)):
        seen[n] = y[some[n]]
    score = np.dot(seen, basis).reshape(len(some), 2, -1)
    for n in range(len(some)):
        share = (square[some[n]] - node[0]) / (node[1] - node[0])
        share = min(max(share, np.float32(0)), np.float32(1))
        for side in range(2):
            weight = share if side else 1 - share
            noisy = noise[some[n]] * power[side].mean()
            for i in range(y.shape[1]):
                score[n, side, i] *= weight / (power[side, i] + noisy)
    found = np.dot(score.reshape(len(some), -1), gain)
    for n in range(len(some)):
        for band in range(x.shape[1]):
            x[some[n], band] = max(found[n, band], np.float32(0))


def levelling(calibration: Calibration) -> Tensor:
    """Return what turns measurements at a field angle into those that the mean sensitivity gives.

    A network learns one sensitivity. The difference of the others to it is small, so that the
    linear estimate of the spectrum is good enough to take it off: y - (R_a - R) W_a y.

    Returns
    -------
    Tensor, (A, M, M), float32; for noise of 30 dB, which serves 20 to 40
    """
    moment = second_moment(calibration.wavelength)
    response, mean = calibration.sensitivities.double(), calibration.mean_sensitivity.double()
    signal = response @ moment @ response.mT
    one = torch.eye(calibration.filters, dtype=torch.float64)
    noise = 1e-3 * signal.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * one
    estimator = torch.linalg.solve(signal + noise, response @ moment).mT
    return (one - (response - mean) @ estimator).float()


def _noise_to_signal(snr: Tensor | None, count: int, device: torch.device) -> Tensor:
    """Return the ratio of noise to signal power of each pixel, (N,); 20 dB where it is unknown."""
    if snr is None:
        return torch.full((count,), 10 ** (-SNR / 10), device=device)
    # Beyond 90 dB the rounding of float32 is the noise.
    return 10 ** (-snr.clamp_max(90.0) / 10)


def complete(
    y: Tensor,
    valid: Tensor,
    calibration: Calibration,
    angle: Tensor | None = None,
    snr: Tensor | None = None,
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
    snr : Tensor, (...), optional
        Signal-to-noise ratio of each pixel, dB; default 20.

    Returns
    -------
    Tensor, (..., M); NaN where fewer than half of a pixel's channels are valid
    """
    valid = torch.as_tensor(valid, dtype=torch.bool, device=y.device)
    if valid.shape != y.shape:
        raise InputError(
            f"The valid mask has the shape {tuple(valid.shape)}, the measurement "
            f"{tuple(y.shape)}; they must agree."
        )
    count = counted(y, valid)
    if (count == y.shape[-1]).all():
        return y
    enough = count >= (y.shape[-1] + 1) // 2
    partial = enough & (count < y.shape[-1])
    filled = y.clone()
    if not enough.all():
        filled[~enough] = torch.nan
    if not partial.any():
        return filled
    if angle is None:
        response = calibration.mean_sensitivity.double()[None]
        covariance = response @ second_moment(calibration.wavelength) @ response.mT
    else:
        covariance = calibration.usual_moments
    covariance = covariance.float().to(y.device)
    known, valid = y[partial], valid[partial]
    valid = valid & known.isfinite()
    known = torch.where(valid, known, 0)
    noise = _noise_to_signal(None if snr is None else snr[partial], len(known), y.device)
    weights = torch.ones(len(known), 1, device=y.device)
    if angle is not None:
        weights = calibration.angle_weights(angle[partial])
    parts = [
        _fill(known[some], valid[some], weights[some], noise[some], covariance)
        for some in torch.arange(len(known), device=y.device).split(2048)
    ]
    filled[partial] = torch.cat(parts)
    return filled


def counted(y: Tensor, valid: Tensor) -> Tensor:
    """Return how many channels of each pixel, (..., M), are valid and finite, (...) int32."""
    if y.device.type != "cpu":
        return (valid & y.isfinite()).sum(-1, dtype=torch.int32)
    count = np.empty(y.shape[:-1], np.int32)
    flat = y.detach().reshape(-1, y.shape[-1]).numpy()
    _count(flat, valid.reshape(-1, y.shape[-1]).numpy(), count.reshape(-1))
    return torch.from_numpy(count)


@numba.njit(cache=True, nogil=True)
def _count(y, valid, count):
    for place in range(len(y)):
        total = 0
        for unit in range(y.shape[1]):
            total += valid[place, unit] & (y[place, unit] * 0 == 0)
        count[place] = total


def _fill(y: Tensor, valid: Tensor, weights: Tensor, noise: Tensor, covariance: Tensor) -> Tensor:
    """Return y, (N, M), with invalid channels replaced by C_iv C_vv^-1 y_v."""
    signal = torch.einsum("na,amk->nmk", weights, covariance)
    power = noise * signal.diagonal(dim1=-2, dim2=-1).mean(-1)
    one = torch.eye(y.shape[-1], device=y.device)
    both = valid[:, :, None] & valid[:, None, :]
    # Rows of invalid channels become those of the identity: they decouple and stay zero.
    reduced = torch.where(both, signal + power[:, None, None] * one, one)
    explained = torch.linalg.solve(reduced, y)
    return torch.where(valid, y, torch.einsum("nmk,nk->nm", signal, explained))
