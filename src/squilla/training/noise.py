"""Noise on measurements, drawn anew each time a sample is used."""

import math

import torch
from torch import Tensor

from squilla.errors import InputError

Noise = None | float | tuple[float, float]
"""No noise, one signal-to-noise ratio, or a range of them to draw from uniformly; dB."""


def add_noise(y: Tensor, snr: Noise, generator: torch.Generator | None = None) -> Tensor:
    """Add white Gaussian noise of a given signal-to-noise ratio to measurements.

    Parameters
    ----------
    y : Tensor, (..., M)
        Measurements, any unit.
    snr : None, float or (float, float)
        Signal-to-noise ratio, dB, by amplitude: the noise has the standard deviation
        sqrt(mean(y^2)) / 10^(snr/20). A pair draws one value per measurement, uniformly between
        the two; None returns `y` itself.
    generator : torch.Generator, optional
        On the device of `y`.

    Returns
    -------
    Tensor, (..., M)

    Source: thesis, eq. 3.5 and 3.6.
    """
    if snr is None:
        return y
    low, high = snr if isinstance(snr, tuple) else (snr, snr)
    if not (math.isfinite(low) and low <= high < math.inf):
        raise InputError(
            f"A noise of {snr} dB cannot be drawn; give one number, or a pair (low, high)."
        )
    like = {"device": y.device, "dtype": y.dtype, "generator": generator}
    ratio = low + (high - low) * torch.rand(*y.shape[:-1], 1, **like)
    deviation = y.square().mean(-1, keepdim=True).sqrt() * 10 ** (-ratio / 20)
    return y + deviation * torch.randn(y.shape, **like)
