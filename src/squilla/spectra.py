"""Spectra: the measured tables that ship, random spectra to train on, resampling, colour.

A spectrum here is a relative photon radiance, so that the measurement is y = R x with the
sensitivity R = transmittance x quantum efficiency and no further factor.
"""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, lru_cache
from importlib.resources import files as package_files
from typing import TYPE_CHECKING, Literal

import numpy as np

from squilla.errors import InputError

if TYPE_CHECKING:
    from torch import Generator, Tensor

CHART_LIGHT = "LED-B3"
"""The white LED of every evaluation scene; kept out of the training lights."""


def grid(start: float = 500.0, stop: float = 750.0, step: float = 1.0) -> np.ndarray:
    """Return an even wavelength grid with both ends, nm; the default is the thesis' 251 bands.

    A step that does not divide the band gives way to the nearest that does.

    Raises
    ------
    InputError
        If the step is not positive, the band is reversed or infinite, or a million bands would
        not fill it.
    """
    steps = (stop - start) / step if step > 0 else np.nan
    if not 0 <= steps < 1e6:
        raise InputError(
            f"There is no grid from {start:g} to {stop:g} nm in steps of {step:g} nm; give a start "
            "below the stop and a positive step."
        )
    return np.linspace(start, stop, round(steps) + 1)


# --- measured tables ------------------------------------------------------------------------


@dataclass(frozen=True)
class SpectralTable:
    """Measured spectra with their names.

    wavelength : (K,) nm.  values : (N, K) reflectance, 0..1 and a little above for fluorescent
    samples, or light with its peak at 1.  name : (N,).
    """

    wavelength: np.ndarray
    values: np.ndarray
    name: tuple[str, ...]

    def on(self, wavelength: np.ndarray) -> np.ndarray:
        """Return the values on another grid, (N, K'); refuses to extrapolate."""
        return resample(self.values, self.wavelength, wavelength)

    def one(self, name: str, wavelength: np.ndarray) -> np.ndarray:
        """Return the spectrum of a name on another grid, (K',); InputError if there is none."""
        return resample(self[name], self.wavelength, wavelength)

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.name:
            near = get_close_matches(name, self.name, 5, 0.0)
            raise InputError(
                f"There is no spectrum named {name!r} among {len(self.name)}; the nearest are "
                f"{', '.join(near)}."
            )
        return self.values[self.name.index(name)]


def _table(file: str, quantity: str) -> SpectralTable:
    with np.load(str(package_files("squilla") / "data" / "spectra" / file)) as table:
        return SpectralTable(
            table["wavelength"], table[quantity].astype(np.float64), tuple(table["name"].tolist())
        )


@cache
def reflectances() -> SpectralTable:
    """Return 573 measured reflectances of paints, skin, minerals, textiles, 500-750 nm.

    Source: NOTICE, spectra/reflectance_train.npz.
    """
    return _table("reflectance_train.npz", "reflectance")


@cache
def lights() -> SpectralTable:
    """Return 629 measured or standard lights, peak 1, 500-750 nm.

    Source: NOTICE, spectra/light_train.npz.
    """
    return _table("light_train.npz", "light")


@cache
def chart_reflectances() -> SpectralTable:
    """Return the 24 patches of a ColorChecker, row by row. For evaluation only: never train on it.

    Source: NOTICE, spectra/reflectance_chart.npz.
    """
    return _table("reflectance_chart.npz", "reflectance")


def resample(spectrum: np.ndarray, wavelength: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Interpolate spectra linearly onto another wavelength grid.

    Parameters
    ----------
    spectrum : array, (..., K)
    wavelength : array, (K,)
        Where `spectrum` is known, nm, increasing.
    onto : array, (K',)
        Wanted wavelengths, nm; every one must lie within `wavelength`.

    Returns
    -------
    array, (..., K'), of the type of `spectrum` (float64 for integers)
        On its own wavelengths it is `spectrum` itself, no copy.

    Raises
    ------
    InputError
        If `wavelength` does not fit the spectra or does not increase, or if `onto` reaches beyond
        it: nothing is extrapolated.
    """
    spectrum, wavelength = np.asarray(spectrum), np.asarray(wavelength, float)
    if not np.issubdtype(spectrum.dtype, np.floating):
        spectrum = spectrum.astype(np.float64)
    onto = np.asarray(onto, float)
    if spectrum.shape[-1] != len(wavelength):
        raise InputError(
            f"The spectra have {spectrum.shape[-1]} bands but {len(wavelength)} wavelengths."
        )
    if not np.all(np.diff(wavelength) > 0):
        raise InputError("Wavelengths must increase from band to band; sort the bands first.")
    if np.array_equal(onto, wavelength):
        return spectrum
    slack = 1e-6
    if not (wavelength[0] - slack <= onto.min() and onto.max() <= wavelength[-1] + slack):
        raise InputError(
            f"The spectra cover {wavelength[0]:g}-{wavelength[-1]:g} nm, but "
            f"{onto.min():g}-{onto.max():g} nm is needed; nothing is extrapolated."
        )
    if len(wavelength) == 1:
        return np.broadcast_to(spectrum, (*spectrum.shape[:-1], len(onto))).copy()
    right = np.clip(np.searchsorted(wavelength, onto), 1, len(wavelength) - 1)
    step = wavelength[right] - wavelength[right - 1]
    weight = np.clip((onto - wavelength[right - 1]) / step, 0, 1).astype(spectrum.dtype)
    return spectrum[..., right - 1] * (1 - weight) + spectrum[..., right] * weight


# --- random spectra -------------------------------------------------------------------------


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


# --- colour ---------------------------------------------------------------------------------

_XYZ_TO_RGB = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)  # Source: IEC 61966-2-1, sRGB

_D65 = np.array([0.3127 / 0.3290, 1.0, (1 - 0.3127 - 0.3290) / 0.3290])
"""The white of sRGB, XYZ."""


@cache
def _observer() -> tuple[np.ndarray, np.ndarray]:
    """Return the CIE 1931 observer: wavelengths, nm, and colour matching functions (N, 3).

    Source: CIE 015:2018; NOTICE, spectra/observer.npz.
    """
    with np.load(str(package_files("squilla") / "data" / "spectra" / "observer.npz")) as table:
        return table["wavelength"], table["xyz"]


def _matching(wavelength: np.ndarray) -> np.ndarray:
    """Return what a photon of each band adds to the CIE 1931 observer's XYZ, (K, 3).

    Parameters
    ----------
    wavelength : array, (K,)
        nm, increasing; those that nobody sees add nothing.
    """
    wavelength = np.asarray(wavelength, float)
    known, receptors = _observer()
    matching = np.stack(
        [np.interp(wavelength, known, each, left=0, right=0) for each in receptors.T], axis=-1
    )
    step = np.gradient(wavelength) if len(wavelength) > 1 else np.ones(1)
    return matching * (step / wavelength)[:, None]  # photons to power


def tristimulus(spectrum: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """Return what the three receptors of the CIE 1931 observer see, XYZ, in a scale of their own.

    Wavelengths outside the band add nothing.

    Parameters
    ----------
    spectrum : array, (..., K)
        Photon radiance, any scale.
    wavelength : array, (K,)
        nm, increasing.

    Returns
    -------
    array, (..., 3)

    Source: CIE 015:2018.
    """
    spectrum = np.asarray(spectrum)
    return spectrum @ _matching(wavelength).astype(np.result_type(spectrum.dtype, np.float32))


def linear_rgb(
    cube: np.ndarray, wavelength: np.ndarray, *, white: np.ndarray | None = None
) -> np.ndarray:
    """Return the colour that the CIE 1931 observer sees in a cube, as linear light of sRGB.

    Wavelengths outside the cube's band add nothing; adapting to `white`, which is cut to the same
    band, keeps white things white.

    Parameters
    ----------
    cube : array, (..., K)
        Photon radiance, any scale.
    wavelength : array, (K,)
        nm, increasing.
    white : array, (K,), optional
        Spectrum that shall be (1, 1, 1); the light of the scene. Default: equal at all wavelengths.

    Returns
    -------
    array, (..., 3)
        Not clipped: colours outside sRGB have negative parts.

    Source: CIE 015:2018; adaptation to D65 by XYZ scaling.
    """
    cube = np.asarray(cube)
    return np.nan_to_num(cube) @ rgb_weights(wavelength, white).astype(
        np.result_type(cube.dtype, np.float32)
    )


def rgb_weights(wavelength: np.ndarray, white: np.ndarray | None = None) -> np.ndarray:
    """Return the matrix of `linear_rgb`, (K, 3): what each band adds to red, green and blue."""
    white = np.ones(len(wavelength)) if white is None else np.asarray(white, float)
    matching = _matching(wavelength)
    white_xyz = white @ matching
    luminance = max(float(white_xyz[1]), 1e-12)
    # Von Kries scaling of X, Y, Z themselves, as in CIELAB. Sharper cone spaces make their blue
    # from a difference: in a band that begins at 500 nm, with hardly any blue, mostly noise.
    adapted = matching / luminance * (_D65 / np.maximum(white_xyz / luminance, 1e-6))
    return adapted @ _XYZ_TO_RGB.T


def rgb(
    cube: np.ndarray,
    wavelength: np.ndarray,
    *,
    white: np.ndarray | None = None,
    exposure: float | None = None,
) -> np.ndarray:
    """Return the colour that the CIE 1931 observer sees in a cube, as sRGB.

    Parameters
    ----------
    cube : array, (..., K)
    wavelength : array, (K,)
    white : array, (K,), optional
        As in `linear_rgb`.
    exposure : float, optional
        Luminance relative to `white` that becomes 1; default: the 99th percentile of the cube.

    Returns
    -------
    array, (..., 3), 0..1, gamma encoded
    """
    linear = linear_rgb(cube, wavelength, white=white)
    if exposure is None:
        # The luminance again, from the colours themselves.
        exposure = float(np.percentile(linear @ np.linalg.inv(_XYZ_TO_RGB)[1], 99))
    linear = np.clip(linear / max(exposure, 1e-12), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def composite(
    cube: np.ndarray,
    wavelength: np.ndarray,
    bands: tuple[float, float, float] = (650.0, 550.0, 500.0),
    *,
    white: np.ndarray | None = None,
    scale: float | None = None,
) -> np.ndarray:
    """Return three bands as red, green and blue: the thesis' picture of a cube.

    The values are linear in the radiance; a gamma of 2.2 brings them nearer to what the eye sees.

    Parameters
    ----------
    cube : array, (..., K)
    wavelength : array, (K,)
        nm.
    bands : (float, float, float)
        Wavelengths shown as red, green, blue, nm; the nearest bands are taken.
    white : array, (K,), optional
        Spectrum that shall look white; the light of the scene. Default: equal at all wavelengths.
    scale : float, optional
        Radiance, relative to `white`, that becomes 1; default: the 99.5th percentile.

    Returns
    -------
    array, (..., 3), 0..1

    Source: thesis, figures 5.1 to 5.5.
    """
    nearest = [int(np.abs(wavelength - band).argmin()) for band in bands]
    picture = np.asarray(cube)[..., nearest]
    if white is not None:
        picture = picture / np.maximum(np.asarray(white, float)[nearest], 1e-12)
    scale = float(np.percentile(picture, 99.5)) if scale is None else scale
    return np.clip(np.nan_to_num(picture) / max(scale, 1e-12), 0, 1)
