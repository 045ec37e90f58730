"""What each filter lets its pixels see: from the design's recipe to photoelectrons."""

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.camera import lens
from squilla.camera.design import CameraDesign
from squilla.errors import InputError
from squilla.optics.filters import (
    FabryPerotRecipe,
    FilterArray,
    StencilRecipe,
    linear_variable_filter,
    read_filters,
)
from squilla.optics.merit import Noise, PhotonNoise, Prior, WhiteNoise
from squilla.optics.tables import MeasuredFilters, band_pass
from squilla.spectra import grid, resample


def filters_of(design: CameraDesign) -> FilterArray | MeasuredFilters:
    """Draw or read the filters of a design; InputError if a file holds another number of them."""
    filters, count = design.filters, design.channels
    band = float(design.wavelength[0]), float(design.wavelength[-1])
    if filters.table is not None:
        array = read_filters(filters.table, effective_index=filters.effective_index)
        given = len(array.transmittance(design.wavelength))
        if given != count:
            raise InputError(
                f"The filter file {filters.table} has {given} filters; the camera has {count} "
                f"{'units' if filters.layout == 'array' else 'filters'}."
            )
        return array
    match filters.recipe:
        case "fabry-perot":
            return FabryPerotRecipe(filters=count, band=band).draw(filters.seed)
        case "linear-variable":
            return linear_variable_filter(count, band)
        case "band-pass":
            return band_pass(
                count,
                design.wavelength,
                fwhm=filters.fwhm,
                effective_index=filters.effective_index,
            )
    return StencilRecipe(filters=count).draw(filters.seed)


def clear_response(design: CameraDesign) -> np.ndarray:
    """Return what a pixel without any filter sees of a scene of value 1, (K,) e-/ms.

    Source: radiance x solid angle of the pupil x pixel area x band x quantum efficiency.
    """
    solid = np.pi * (design.lens.diameter / 2) ** 2 / design.lens.focal_length**2
    pixel = (design.sensor.pixel * 1e-6) ** 2
    scale = design.light.radiance * solid * pixel / 1000 * design.band.step
    return scale * design.quantum_efficiency


def response(
    design: CameraDesign, filters: FilterArray | MeasuredFilters, angle: ArrayLike
) -> np.ndarray:
    """Return what pixels see through the filters alone, before vignetting and what misses them.

    Parameters
    ----------
    design : CameraDesign
    filters : with a method ``transmittance(wavelength, angle)``
    angle : array, (A,)
        Field angle, rad.

    Returns
    -------
    array, (A, M, K), e-/ms of a scene of value 1

    Source: `clear_response` x T, averaged over the cone of light that reaches the pixel.
    """
    cones = [lens.cone(design, float(one)) for one in np.atleast_1d(np.asarray(angle, float))]
    widest = max(angles.max() for angles, _ in cones)
    square = np.linspace(0, widest**2, 48 if widest > 0 else 1)  # T is smooth in the square
    table = filters.transmittance(design.wavelength, np.sqrt(square)).numpy()
    flat = table.reshape(len(square), -1)
    mean = np.stack(
        [
            weights @ resample(flat.T, square, angles**2).T if len(square) > 1 else flat[0]
            for angles, weights in cones
        ]
    ).reshape(len(cones), *table.shape[1:])
    return mean * clear_response(design)


def seen(
    design: CameraDesign, filters: FilterArray | MeasuredFilters, angle: ArrayLike
) -> np.ndarray:
    """Return what pixels see in all: through the filters and beside them, less the cos^4.

    What leaks is its mean around the axis. Parameters and result are those of `response`.
    """
    angle = np.atleast_1d(np.asarray(angle, float))
    falloff = np.cos(angle) ** 4 if design.effects.vignetting else np.ones(len(angle))
    turn = 2 * np.pi * (np.arange(32) + 0.5) / 32
    radius = np.tan(angle)[:, None] * design.focal
    through = lens.through_filter(design, radius * np.sin(turn), radius * np.cos(turn))
    through = through.mean(1)[:, None, None]
    beside = (1 - through) * design.filters.gap * clear_response(design)
    return (through * response(design, filters, angle) + beside) * falloff[:, None, None]


def figure_of_merit(
    design: CameraDesign, prior: str, snr: float | None = None, exposure: float | None = None
) -> tuple[Prior, Noise, Tensor]:
    """Return what filters for a camera are judged by.

    Parameters
    ----------
    design : CameraDesign
    prior : str
        Spectra to be seen; see `Prior.draw`.
    snr : float, optional
        dB, alike in every filter; default: 20.
    exposure : float, optional
        Instead, electrons of the mean spectrum in a pixel without a filter.

    Returns
    -------
    prior : Prior
        On the camera's band, in steps of 2 nm or more: neither filters nor spectra are finer.
    noise : Noise
    efficiency : Tensor, (K,)
        Quantum efficiency behind the filters.

    Raises
    ------
    InputError
        If both an SNR and an exposure are given.
    """
    if snr is not None and exposure is not None:
        raise InputError("Give --snr or --exposure, not both.")
    band = grid(design.band.start, design.band.stop, max(design.band.step, 2.0))
    table = design.sensor.quantum_efficiency
    efficiency = torch.from_numpy(np.interp(band, table.wavelength, table.value))
    if exposure is None:
        noise = WhiteNoise(20.0 if snr is None else snr)
    else:
        noise = PhotonNoise(exposure, design.sensor.read_noise, efficiency)
    return Prior.draw(prior, band), noise, efficiency
