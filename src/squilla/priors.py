"""Priors: random spectra to train on, and what is usual among them.

Like every spectrum here they are relative photon radiances.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from squilla.spectra import CHART_LIGHT, lights, reflectances

if TYPE_CHECKING:
    from torch import Generator, Tensor


def gaussian_mixtures(
    count: int,
    wavelength: np.ndarray,
    *,
    fewest: Literal[1, 2] = 1,
    normalise: Literal["max", "minmax"] = "max",
    generator: "Generator | None" = None,
) -> "Tensor":
    """Draw the thesis' training spectra: sums of a few Gaussian lines.

    The number of lines is geometric with p = 0.3, plus one; centres are whole nanometres, uniform
    over the grid; heights uniform on 0..1; FWHM uniform on 2..50 nm.

    Parameters
    ----------
    count : int
    wavelength : array, (K,)
        nm.
    fewest : 1 or 2
        Whether the geometric number counts from 0 (at least one line, the default) or from 1; the
        thesis does not say.
    normalise : "max" or "minmax"
        Whether "normalised" means divided by the maximum (default) or stretched so that the
        minimum becomes 0 too; the thesis does not say.
    generator : torch.Generator, optional

    Returns
    -------
    Tensor, (count, K), float32, 0..1

    Source: thesis, section on training data.
    """
    import torch

    success = torch.rand(count, generator=generator).clamp_min(1e-12)
    lines = (success.log() / np.log(0.7)).floor().long() + fewest
    most = int(lines.max()) if count else 0
    low, high = round(float(wavelength[0])), round(float(wavelength[-1]))
    centre = torch.randint(low, high + 1, (count, most), generator=generator).float()
    height = torch.rand(count, most, generator=generator)
    height = height * (torch.arange(most) < lines[:, None])
    fwhm = 2 + 48 * torch.rand(count, most, generator=generator)
    return scaled(_sum_of_lines(wavelength, centre, height, fwhm), normalise)


def line_spectra(
    count: int,
    wavelength: np.ndarray,
    *,
    fwhm: tuple[float, float] = (1.0, 30.0),
    most: int = 3,
    generator: "Generator | None" = None,
) -> "Tensor":
    """Draw spectra of lasers and single-colour LEDs: one to `most` lines on a dark ground.

    Parameters
    ----------
    fwhm : (float, float)
        Line width, nm, drawn uniformly in its logarithm: lasers 1-5, LEDs 10-30.

    Returns
    -------
    Tensor, (count, K), float32, peak 1
    """
    import torch

    lines = torch.randint(1, most + 1, (count,), generator=generator)
    low, high = float(wavelength[0]), float(wavelength[-1])
    centre = low + (high - low) * torch.rand(count, most, generator=generator)
    height = 0.2 + 0.8 * torch.rand(count, most, generator=generator)
    height = height * (torch.arange(most) < lines[:, None])
    ratio = torch.rand(count, most, generator=generator)
    width = fwhm[0] * (fwhm[1] / fwhm[0]) ** ratio
    return scaled(_sum_of_lines(wavelength, centre, height, width))


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
    known, wavelength = reflectances().wavelength, np.asarray(wavelength, float)
    if known[0] - 1e-6 <= wavelength[0] and wavelength[-1] <= known[-1] + 1e-6:
        return wavelength
    share = (wavelength - wavelength[0]) / max(np.ptp(wavelength), 1e-9)
    return known[0] + share * np.ptp(known)


def natural_spectra(
    count: int, wavelength: np.ndarray, *, generator: "Generator | None" = None
) -> "Tensor":
    """Draw spectra as objects show them: a measured reflectance under a measured light.

    Two reflectances are mixed in a random proportion, half of the time with a white gloss; the
    evaluation light (`CHART_LIGHT`) is left out.

    A band that reaches beyond the measured tables gets them stretched; see `within_tables`.

    Returns
    -------
    Tensor, (count, K), float32, peak 1
    """
    import torch

    wavelength = within_tables(wavelength)
    surface = torch.from_numpy(reflectances().on(wavelength)).float()
    keep = [name != CHART_LIGHT for name in lights().name]
    light = torch.from_numpy(lights().on(wavelength)[keep]).float()
    pick = torch.randint(len(surface), (2, count), generator=generator)
    share = torch.rand(count, 1, generator=generator) ** 2
    reflectance = (1 - share) * surface[pick[0]] + share * surface[pick[1]]
    gloss = 0.3 * (torch.rand(count, 1, generator=generator) - 0.5).clamp_min(0)
    lamp = light[torch.randint(len(light), (count,), generator=generator)]
    return scaled((reflectance + gloss) * lamp)


def broad_spectra(
    count: int, wavelength: np.ndarray, *, generator: "Generator | None" = None
) -> "Tensor":
    """Draw from the broad prior: 60 % natural, 25 % Gaussian mixtures, 15 % lines, shuffled.

    Returns
    -------
    Tensor, (count, K), float32, peak 1
    """
    import torch

    gaussian, line = round(0.25 * count), round(0.15 * count)
    parts = [
        natural_spectra(count - gaussian - line, wavelength, generator=generator),
        gaussian_mixtures(gaussian, wavelength, generator=generator),
        line_spectra(line, wavelength, generator=generator),
    ]
    return torch.cat(parts)[torch.randperm(count, generator=generator)]


def second_moment(wavelength: np.ndarray) -> "Tensor":
    """Return the mean of x x' over 20 000 spectra of the broad prior, (K, K), float64.

    Outside 500-750 nm its natural spectra are stretched; see `natural_spectra`.
    """
    return _second_moment(tuple(np.asarray(wavelength, float).tolist()))


@lru_cache(maxsize=4)  # every capture needs it
def _second_moment(wavelength: tuple[float, ...]) -> "Tensor":
    import torch

    generator = torch.Generator().manual_seed(0)
    spectra = broad_spectra(20_000, np.array(wavelength), generator=generator)
    return (spectra.T @ spectra).double() / len(spectra)


PRIORS: dict[str, Callable[..., "Tensor"]] = {
    "gaussian": gaussian_mixtures,
    "natural": natural_spectra,
    "line": line_spectra,
    "broad": broad_spectra,
}
"""The kinds of random spectra by name; each is called as ``f(count, wavelength, generator=)``."""


def scaled(spectrum: "Tensor", normalise: Literal["max", "minmax"] = "max") -> "Tensor":
    """Scale each spectrum, (..., K), to a maximum of 1 (and, for "minmax", a minimum of 0)."""
    if normalise == "minmax":
        spectrum = spectrum - spectrum.amin(-1, keepdim=True)
    return spectrum / spectrum.amax(-1, keepdim=True).clamp_min(1e-12)


def _sum_of_lines(
    wavelength: np.ndarray, centre: "Tensor", height: "Tensor", fwhm: "Tensor"
) -> "Tensor":
    """Sum Gaussian lines, each parameter (N, lines), into spectra (N, K)."""
    import torch

    position = torch.as_tensor(np.asarray(wavelength), dtype=torch.float32)
    total = torch.zeros(len(centre), len(position))
    for line in range(centre.shape[1]):  # a loop, for the whole (N, lines, K) would not fit
        there = torch.nonzero(height[:, line])[:, 0]  # most spectra have few of the lines
        offset = (position - centre[there, line, None]) / fwhm[there, line, None]
        total[there] += height[there, line, None] * torch.exp(-4 * np.log(2) * offset**2)
    return total
