"""Random cameras to train on: filter arrays of every kind on sensors of any colour."""

import numpy as np
import torch
from torch import Generator, Tensor

from squilla.optics.filters import FabryPerotRecipe, FreeRecipe, StencilRecipe
from squilla.optics.tables import band_pass

FILTERS = (16, 25, 36, 36, 36, 49, 64)
"""Numbers of filters that are drawn from."""


def random_response(wavelength: np.ndarray, generator: Generator) -> Tensor:
    """Draw the response of a camera, (M, K) float32: filters times a sensor.

    Half of them are stencil arrays as the thesis', the others free stacks, Fabry-Perot cavities,
    sums of sinusoids and band-passes; each filter has a gain of its own, within 5 %.

    Parameters
    ----------
    wavelength : array, (K,)
        nm.
    generator : torch.Generator
    """

    def random() -> float:
        return float(torch.rand((), generator=generator))

    filters = FILTERS[int(random() * len(FILTERS))]
    kind = random()
    if kind < 0.5:
        array = StencilRecipe(filters).draw(generator)
    elif kind < 0.65:
        array = FreeRecipe(filters).draw(generator)
    elif kind < 0.85:
        array = FabryPerotRecipe(filters, mirror=3 + 2 * int(2 * random())).draw(generator)
    else:
        array = None
    if array is not None:
        transmittance = array.transmittance(wavelength).float()
    elif kind < 0.95:
        transmittance = _sinusoids(filters, wavelength, generator)
    else:
        step = np.ptp(wavelength) / filters
        passes = band_pass(filters, wavelength, fwhm=step * (1 + 2 * random()))
        transmittance = passes.transmittance(wavelength).float()
    gain = 1 + 0.05 * torch.randn(filters, 1, generator=generator)
    return transmittance * gain * _sensor(wavelength, generator)


def _sinusoids(filters: int, wavelength: np.ndarray, generator: Generator) -> Tensor:
    """Draw filters that are sums of sinusoids in the wavenumber."""
    wave = 1 / wavelength
    place = torch.from_numpy((wave - wave[-1]) / (wave[0] - wave[-1])).float()
    order = 0.3 + 10 * torch.rand(filters, 6, 1, generator=generator)
    phase = torch.rand(filters, 6, 1, generator=generator)
    return 0.5 + 0.45 * torch.cos(2 * torch.pi * (order * place + phase)).mean(1)


def _sensor(wavelength: np.ndarray, generator: Generator) -> Tensor:
    """Draw a smooth quantum efficiency, (K,); one camera in six is blind at one end of the band."""
    levels, cut = torch.rand(4, generator=generator).numpy(), torch.rand(3, generator=generator)
    place = (wavelength - wavelength[0]) / np.ptp(wavelength)
    curve = np.interp(place, np.linspace(0, 1, 4), 0.25 + 0.75 * levels)
    if cut[0] < 1 / 6:
        end = 0.4 + 0.5 * float(cut[1])
        edge = (place if cut[2] < 0.7 else 1 - place) - end
        curve = curve / (1 + np.exp(np.clip(edge / 0.02, -50, 50)))
    return torch.from_numpy(curve).float()
