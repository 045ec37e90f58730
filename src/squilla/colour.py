"""Colour: what a spectrum looks like to the CIE 1931 observer, and bands as colours."""

from functools import cache
from importlib.resources import files as package_files

import numpy as np

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
