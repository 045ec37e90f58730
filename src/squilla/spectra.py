"""Spectra: wavelength grids, the measured tables that ship, resampling.

A spectrum here is a relative photon radiance, so that the measurement is y = R x with the
sensitivity R = transmittance x quantum efficiency and no further factor.
"""

from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files as package_files

import numpy as np
from numpy.typing import ArrayLike

from squilla.errors import InputError

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


def nanometres(wavelength: ArrayLike) -> np.ndarray:
    """Return wavelengths, (K,), as numbers if they can be in nm.

    Raises
    ------
    InputError
        If they are not finite, or none of 100 to 30 000 nm, as in micrometres.
    """
    values = np.asarray(wavelength, float)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise InputError("Wavelengths must be a list of finite numbers, in nm.")
    if not 100 <= values.min() <= values.max() <= 30_000:
        raise InputError(
            f"Wavelengths of {values.min():g} to {values.max():g} cannot be in nm; multiply "
            "micrometres by 1000."
        )
    return values


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
