"""The sensitivity without a monochromator: from surfaces and lamps whose spectra are known."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from squilla.calibration.alignment import measure
from squilla.calibration.calibration import Calibration
from squilla.calibration.inference import infer_sensitivity
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.optics.angle import blue_shift, pupil_cone

_BORDER = 20.0
"""Strip along the border of a surface that is left out, um on the sensor: blur reaches so far."""

_INDICES = (1.5, 1.75, 2.1)
"""Effective indices whose evidence a parabola is laid through."""


@dataclass(frozen=True)
class KnownScene:
    """One frame of surfaces whose spectra are known: a colour chart under one lamp.

    raw : the frame.
    spectra : (P, K) photon radiance of each surface, reflectance times lamp, in the unit that cubes
        shall have and on the wavelengths of the camera's design.
    labels : (H, W) int, the number of the surface that each pixel of the reference view shows, from
        0; -1 for none.
    distance : of the surfaces, mm; None: found from the frame.
    """

    raw: Raw
    spectra: np.ndarray
    labels: np.ndarray
    distance: float | None = None


def known_responses(
    scenes: Iterable[KnownScene], calibration: Calibration
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reduce frames of known surfaces, one by one, to their mean measurements.

    Parameters
    ----------
    scenes : iterable of KnownScene
    calibration : Calibration
        With lattice and pixels; its sensitivity is not used.

    Returns
    -------
    measured : array, (N, M), DN per ms
    spectra : array, (N, K)
    angle : array, (N,), rad
    snr : array, (N,), dB

    Raises
    ------
    InputError
        If shapes do not fit or no surface is large enough.
    """
    measured, spectra, angles, snr = [], [], [], []
    for number, scene in enumerate(scenes, 1):
        kinds, bands = np.shape(scene.spectra)
        lattice = calibration.lattice
        if bands != len(calibration.wavelength) or not np.all(np.isfinite(scene.spectra)):
            raise InputError(
                f"The spectra of known scene {number} have {bands} bands; finite ones on the "
                f"camera's {len(calibration.wavelength)} wavelengths were expected."
            )
        if lattice is None or scene.labels.shape != lattice.field or scene.labels.max() >= kinds:
            raise InputError(
                f"The labels of known scene {number} are {scene.labels.shape} px and name "
                f"{scene.labels.max() + 1} surfaces; the reference view and the {kinds} spectra "
                "must agree with them."
            )
        measurement = measure(scene.raw, calibration, distance=scene.distance)
        size = 2 * math.ceil(_BORDER / lattice.pixel) + 1
        inside = minimum_filter(scene.labels, size) == maximum_filter(scene.labels, size)
        for surface in range(kinds):
            chosen = torch.from_numpy(inside & (scene.labels == surface))
            y, valid = measurement.y[chosen].double(), measurement.valid[chosen]
            if int(valid.sum(0).min()) < 4:
                continue
            measured.append(((y * valid).sum(0) / valid.sum(0)).numpy())
            spectra.append(scene.spectra[surface])
            angles.append(float(measurement.angle[chosen].square().mean().sqrt()))
            assert measurement.snr is not None
            of_pixel = float(measurement.snr[chosen].mean())
            snr.append(of_pixel + 10 * math.log10(int(chosen.sum())))
    if not measured:
        raise InputError(
            "No known surface is large enough to be measured without its blurred border; show "
            "fewer and larger ones."
        )
    return np.stack(measured), np.stack(spectra), np.array(angles), np.array(snr)


def sensitivity_from_spectra(
    measured: np.ndarray,
    spectra: np.ndarray,
    wavelength: np.ndarray,
    *,
    angle: np.ndarray | None = None,
    snr: np.ndarray | None = None,
    f_number: float = np.inf,
    effective_index: float | None = None,
    corner: float | None = None,
) -> Calibration:
    """Infer the sensitivity from measurements of known spectra.

    Many more unknowns than spectra: what decides between them is that the sensitivity is smooth.
    Spectra with narrow features (single-colour LEDs, discharge lamps) teach most. A brightness that
    is not well known, by a few percent and in all filters alike, does little harm.

    Parameters
    ----------
    measured : array, (N, M)
    spectra : array, (N, K)
        Photon radiance.
    wavelength : array, (K,)
        nm, increasing.
    angle : array, (N,), optional
        Field angle at which each was seen, rad; without it all are seen alike.
    snr : array, (N,), optional
        Signal-to-noise ratio of each measurement, dB; default: as noisy relative to its light.
    f_number : float
        Of the lens, which gives the cone of light on a filter; infinite for a parallel beam.
    effective_index : float, optional
        Of the filters' thin films; default: that which explains the measurements best.
    corner : float, optional
        Largest field angle, rad; default: the largest of `angle`.

    Returns
    -------
    Calibration
        With the deviations that are left open; tilted from axis to corner where `angle` is given.

    Raises
    ------
    InputError
        If shapes do not fit, or values are missing.
    """
    measured, spectra = np.asarray(measured, float), np.asarray(spectra, float)
    wavelength = np.asarray(wavelength, float)
    count = len(measured)
    if measured.ndim != 2 or spectra.shape != (count, len(wavelength)):
        raise InputError(
            f"{measured.shape} measurements and {spectra.shape} spectra do not belong together; "
            f"(spectra, filters) and (spectra, {len(wavelength)}) were expected."
        )
    if not (np.isfinite(measured).all() and np.isfinite(spectra).all()):
        raise InputError("The measurements or spectra hold NaN or infinite values; leave them out.")
    level = spectra.sum(-1, keepdims=True)
    if not level.min() > 0:
        raise InputError("A known spectrum is dark; leave it out.")
    response, light = (measured / level)[:, None], spectra / level
    spread = np.ones(count) if snr is None else 10 ** (-np.asarray(snr, float) / 20)
    if spread.shape != (count,) or not np.isfinite(spread).all():
        raise InputError(f"{spread.shape} SNRs were given for {count} measurements.")
    if angle is None:
        found = infer_sensitivity(light, response, wavelength, spread=spread)
        index = None
    else:
        angle = np.asarray(angle, float)
        if angle.shape != (count,):
            raise InputError(f"{angle.shape} field angles were given for {count} measurements.")

        def seen(index: float) -> np.ndarray:
            return _on_axis(light, wavelength, angle, f_number, index)

        index = effective_index
        if index is None:
            index = _effective_index(seen, response, wavelength, spread)
        found = infer_sensitivity(seen(index), response, wavelength, spread=spread)
    one = Calibration(
        wavelength,
        np.maximum(found.sensitivity, 0),
        np.zeros(1),
        deviations=found.deviations,
        provenance={"known_spectra": count, "power_noise": found.power_noise},
    )
    if angle is None or index is None:
        return one
    return one.tilted(
        index, f_number=f_number, corner=float(angle.max()) if corner is None else corner
    )


def _on_axis(
    light: np.ndarray, wavelength: np.ndarray, angle: np.ndarray, f_number: float, index: float
) -> np.ndarray:
    """Return the spectra of which a filter on the axis sees as much as the tilted one of these."""
    each, which = np.unique(np.round(angle, 5), return_inverse=True)
    shifts = [
        np.cos(one) ** 4 * blue_shift(wavelength, pupil_cone(one, f_number), index) for one in each
    ]
    return np.stack([row @ shifts[one] for row, one in zip(light, which, strict=True)])


def _effective_index(
    seen: Callable[[float], np.ndarray],
    response: np.ndarray,
    wavelength: np.ndarray,
    spread: np.ndarray,
) -> float:
    """Return the effective index under which the responses are most probable."""
    inverse_square = np.array(_INDICES) ** -2.0  # in which the shift is linear
    given = {"spread": spread}
    given["settings"] = infer_sensitivity(seen(_INDICES[1]), response, wavelength, **given).settings
    evidence = [
        infer_sensitivity(seen(index), response, wavelength, **given).evidence for index in _INDICES
    ]
    curve, slope, _ = np.polyfit(inverse_square, evidence, 2)
    if not curve < 0:
        raise InputError(
            "The measurements do not tell the effective index of the filters; give it (about 1.75 "
            "for TiO2 and SiO2)."
        )
    best = float(np.clip(-slope / (2 * curve), 0.16, 1.0))
    return best**-0.5
