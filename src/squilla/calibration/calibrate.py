"""The whole calibration: from frames of a camera to one `Calibration`."""

import warnings
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from squilla import __version__
from squilla.calibration.bundle import lattice_from_shots
from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.calibration.check import white_levels
from squilla.calibration.geometry import lattice_from_flat, refine_with_target
from squilla.calibration.known import KnownScene, known_responses, sensitivity_from_spectra
from squilla.calibration.pixels import Darks, Stack, defective, noise_of
from squilla.calibration.sensitivity import (
    Responses,
    SweepStep,
    Zones,
    sweep_responses,
    sweep_sensitivity,
)
from squilla.calibration.stray import stray_light
from squilla.calibration.views import windows
from squilla.camera.design import CameraDesign
from squilla.camera.lens import cone
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.optics.angle import fit_effective_index


def calibrate(
    design: CameraDesign,
    *,
    dark: Iterable[Raw],
    flat: Iterable[Raw],
    sweep: Iterable[SweepStep] | None = None,
    known: Iterable[KnownScene] | None = None,
    target: Raw | None = None,
    target_distance: float | None = None,
    shots: Iterable[Raw] = (),
) -> Calibration:
    """Learn a camera from its frames.

    Parameters
    ----------
    design : CameraDesign
        For what a maker knows: shape of the array, pitch, focal length, stop, band.
    dark, flat : iterable of Raw
        Several frames each, without light and of an evenly lit surface at about half scale.
    sweep : iterable of SweepStep, optional
        Flat frames in narrow-band light over the whole band.
    known : iterable of KnownScene, optional
        Frames of surfaces of known spectra, instead of a sweep: a colour chart under several lamps.
    target : Raw, optional
        One frame of a textured plane facing the camera; refines the lattice lens by lens.
    target_distance : float, optional
        Its distance, mm.
    shots : iterable of Raw
        Hand-held shots of a textured plane at different distances that nobody measured, instead of
        the target or beside it; they also tell how single views are bent.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        If the frames do not show what they should; the message names the frame.
    """
    if design.filters.layout != "array":
        raise InputError(
            f"The filters of {design.name!r} are in a {design.filters.layout} layout; only cameras "
            "with a lens array are calibrated from frames."
        )
    if (sweep is None) == (known is None):
        raise InputError("Give either a narrow-band sweep or known scenes, to learn R from.")
    darks = Darks.of(dark)
    flats = Stack.of(flat, "flat", darks)
    if darks.bias.shape != design.sensor_shape or flats.mean.shape != design.sensor_shape:
        raise InputError(
            f"The frames have {darks.bias.shape} and {flats.mean.shape} px, the design "
            f"{design.sensor_shape}; take them with the camera of the design."
        )
    names = {darks.shortest.camera, flats.camera}
    names |= {str(target.metadata.get("camera", ""))} if target is not None else set()
    if len(names - {""}) > 1:
        raise InputError(f"The frames are of different cameras: {sorted(names - {''})}.")
    if flats.light_change > 0.01:
        warnings.warn(
            f"The light of the flats changed by {flats.light_change:.0%} from frame to frame; it "
            "was evened out. Let the lamp warm up.",
            stacklevel=2,
        )
    saturation = 0.98 * (2**design.sensor.bits - 1)
    light = flats.mean - darks.at(flats.exposure)
    lattice = lattice_from_flat(light, design)
    if np.mean(windows(flats.mean, lattice, 0)[1] >= saturation) > 1e-3:
        raise InputError("The flat frames are saturated; shorten their exposure.")
    if target is not None and (target_distance is None or not target_distance > 0):
        raise InputError("Give the distance of the target in mm.")
    seen = [_evenly_lit(raw, light, darks) for raw in ([target] if target else []) + list(shots)]
    if len(seen) == 1 and target is None and target_distance is None:
        raise InputError(
            "One hand-held shot tells nothing of its distance; give several, or a target whose "
            "distance was measured."
        )
    aligned = {}
    if len(seen) > 1:
        distances = {0: target_distance} if target_distance else {}
        lattice, planes = lattice_from_shots(seen, lattice, distances=distances)
        aligned = {"shot_distances": [round(lattice.distance(plane[0]), 1) for plane in planes]}
    elif target_distance and seen:
        lattice, score = refine_with_target(seen[0], lattice, target_distance)
        aligned = {"target_distance": target_distance, "target_score": score}
    lit = _lit(light, lattice)
    gain, read_noise = noise_of(darks.shortest, flats, lit)

    rough = Zones(lattice, lit)
    surface = rough.surface(lattice, rough(light.__getitem__), light.shape)
    relative = np.where(lit, light / np.maximum(surface, 1e-6), 1.0).astype(np.float32)
    valid = ~defective(darks.at(flats.exposure), relative, lit)
    zones = Zones(lattice, valid)
    surface = zones.surface(lattice, zones(light.__getitem__), light.shape)
    relative = np.where(valid, light / np.maximum(surface, 1e-6), 1.0).astype(np.float32)

    bias = np.where(lit, darks.bias, np.median(darks.bias)).astype(np.float32)
    dark_rate = np.where(lit, darks.rate, np.median(darks.rate)).astype(np.float32)
    pixels = Pixels(bias, dark_rate, relative, valid, saturation, gain, read_noise)
    if known is None:
        assert sweep is not None
        responses = sweep_responses(sweep, darks, relative, saturation, zones)
        spectral = _from_sweep(responses, design, zones.angle)
    else:
        spectral = _from_known(known, design, lattice, pixels, float(zones.angle[-1]))
    signal = float(windows(light, lattice, 0)[1].mean())
    return replace(
        spectral,
        lattice=lattice,
        pixels=pixels,
        white=white_levels(light, lattice, pixels) / (flats.exposure or 1.0),
        provenance={
            "software": f"squilla {__version__}",
            "design": design.name,
            "camera": flats.camera,
            **spectral.provenance,
            **aligned,
            **stray_light(flats.mean, flats.exposure, pixels, signal),
            "light_change": flats.light_change,
            "bad_pixels": int((~windows(valid, lattice, 0)[1]).sum()),
        },
    )


def _from_sweep(responses: Responses, design: CameraDesign, angle: np.ndarray) -> Calibration:
    """Return what a sweep teaches of the sensitivity at field angles (A,)."""
    found, doubts = sweep_sensitivity(responses, design.wavelength)
    sensitivity = np.maximum(found.sensitivity, 0)
    return Calibration(
        design.wavelength,
        sensitivity,
        angle,
        deviations=found.deviations,
        provenance={
            "sweep_steps": len(found.power_error),
            **doubts,
            "effective_index": _effective_index(design, sensitivity, angle),
        },
    )


def _from_known(
    known: Iterable[KnownScene],
    design: CameraDesign,
    lattice: Lattice,
    pixels: Pixels,
    corner: float,
) -> Calibration:
    """Return what known scenes teach of the sensitivity, up to the corner's angle, rad."""
    unknown = np.zeros((1, design.units, len(design.wavelength)))
    blank = Calibration(design.wavelength, unknown, np.zeros(1), lattice, pixels)
    measured, spectra, angle, snr = known_responses(known, blank)
    return sensitivity_from_spectra(
        measured,
        spectra,
        design.wavelength,
        angle=angle,
        snr=snr,
        f_number=design.lens.focal_length / design.lens.diameter,
        corner=corner,
    )


def _effective_index(design: CameraDesign, sensitivity: np.ndarray, angle: np.ndarray) -> float:
    """Return the effective index that explains best how the sensitivity, (A, M, K), shifts."""
    level = sensitivity / sensitivity.mean((1, 2), keepdims=True)  # without vignetting
    axis, *cones = (cone(design, one) for one in angle)
    return fit_effective_index(level[0], level[1:], design.wavelength, cones, measured_in=axis)


def _evenly_lit(raw: Raw, light: np.ndarray, darks: Darks) -> np.ndarray:
    """Return a frame of the target as if every pixel had the same light, (rows, columns)."""
    if raw.frame.shape != light.shape:
        raise InputError(f"The target has {raw.frame.shape} px, the flats {light.shape}.")
    share = np.where(light > 0, light / max(float(np.percentile(light, 99)), 1e-9), 1.0)
    return (raw.frame - darks.at(raw.exposure)) / np.maximum(share, 0.02)


def _lit(light: np.ndarray, lattice: Lattice) -> np.ndarray:
    """Return the pixels that the flat lights to a fifth at least of their own sub-image."""
    lit = np.zeros(light.shape, bool)
    reach = lattice.pitch * 0.75
    for centre, size in zip(lattice.centre, [lattice.field] * len(lattice.centre), strict=True):
        core = [
            slice(round(c - s / 4), round(c + s / 4)) for c, s in zip(centre, size, strict=True)
        ]
        window = tuple(
            slice(max(int(c - reach), 0), min(int(c + reach) + 1, length))
            for c, length in zip(centre, light.shape, strict=True)
        )
        lit[window] |= light[window] > 0.2 * np.median(light[tuple(core)])
    return lit
