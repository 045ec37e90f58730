"""What goes wrong between the sensitivity and the measurement, drawn anew for every sample."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from squilla.camera.design import Sensor
from squilla.errors import InputError


@dataclass(frozen=True)
class SensorNoise:
    """What an image sensor adds: shot noise, read noise, and rounding to digital numbers.

    full_well, read_noise : e-.
    gain : e-/DN.
    exposure : part of the full well that the brightest channel of a sample fills, drawn uniformly
        in its logarithm between the two.
    """

    full_well: float
    read_noise: float
    gain: float
    exposure: tuple[float, float] = (0.01, 0.9)

    def __post_init__(self):
        low, high = self.exposure
        sound = self.full_well > 0 and self.gain > 0 and self.read_noise >= 0
        if not (sound and 0 < low <= high <= 1):
            raise InputError(
                f"A sensor of {self.full_well:g} e-, {self.gain:g} e-/DN and a read noise of "
                f"{self.read_noise:g} e- cannot be exposed to {low:g}-{high:g} of its full well; "
                "give parts between 0 and 1, and no negative figure."
            )

    @classmethod
    def of(cls, sensor: Sensor) -> "SensorNoise":
        """Return the noise of the sensor of a camera design."""
        return cls(sensor.full_well, sensor.read_noise, sensor.gain)

    def __str__(self) -> str:
        low, high = self.exposure
        return (
            f"sensor: {self.full_well:g} e- exposed {low:g}-{high:g}, "
            f"read noise {self.read_noise:g} e-, {self.gain:.3g} e-/DN"
        )


Noise = None | float | tuple[float, float] | SensorNoise
"""No noise, one signal-to-noise ratio, a range of them to draw from uniformly (dB), or a sensor."""


def add_noise(y: Tensor, noise: Noise, generator: torch.Generator | None = None) -> Tensor:
    """Add noise to measurements.

    Parameters
    ----------
    y : Tensor, (..., M)
        Measurements, any unit.
    noise : None, float, (float, float) or SensorNoise
        Signal-to-noise ratio, dB, by amplitude: white Gaussian noise of the standard deviation
        sqrt(mean(y^2)) / 10^(noise/20). A pair draws one ratio per measurement, uniformly between
        the two. A sensor adds its own noise. None returns `y` itself.
    generator : torch.Generator, optional
        On the device of `y`.

    Returns
    -------
    Tensor, (..., M)

    Source: thesis, eq. 3.5 and 3.6; the sensor's noise is this project's.
    """
    if noise is None:
        return y
    like = {"device": y.device, "dtype": y.dtype, "generator": generator}
    share = torch.rand(*y.shape[:-1], 1, **like)
    if isinstance(noise, SensorNoise):
        low, high = noise.exposure
        peak = y.amax(-1, keepdim=True).clamp_min(1e-12)
        electrons = noise.full_well * low * (high / low) ** share / peak  # per unit of y
        seen = torch.poisson((y * electrons).clamp_min(0), generator)
        seen = seen + noise.read_noise * torch.randn(y.shape, **like)
        return (seen / noise.gain).round() * noise.gain / electrons
    low, high = noise if isinstance(noise, tuple) else (noise, noise)
    if not (math.isfinite(low) and low <= high < math.inf):
        raise InputError(
            f"A noise of {noise} dB cannot be drawn; give one number, or a pair (low, high)."
        )
    ratio = low + (high - low) * share
    deviation = y.square().mean(-1, keepdim=True).sqrt() * 10 ** (-ratio / 20)
    return y + deviation * torch.randn(y.shape, **like)


def add_gain_errors(y: Tensor, deviation: float, generator: torch.Generator) -> Tensor:
    """Multiply every channel of every sample by a factor around 1, as if R were wrong by it.

    Parameters
    ----------
    y : Tensor, (..., M)
    deviation : float
        Standard deviation of the factors; 0.02 is a filter array calibrated to 2 %.
    generator : torch.Generator
        On the device of `y`.

    Returns
    -------
    Tensor, (..., M)
    """
    return y * (1 + deviation * torch.randn(y.shape, device=y.device, generator=generator))


def drop_channels(y: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Return which channels a sample keeps when each is lost with a probability, (..., M), bool.

    A sample keeps at least half of its channels: with fewer, no pixel is reconstructed.

    Parameters
    ----------
    y : Tensor, (..., M)
    share : float
        Probability, 0..0.5.
    generator : torch.Generator
        On the device of `y`.
    """
    chance = torch.rand(y.shape, device=y.device, generator=generator)
    fewest = (y.shape[-1] + 1) // 2
    kept_anyway = chance >= chance.sort(-1, descending=True).values[..., fewest - 1, None]
    return (chance >= share) | kept_anyway
