"""From a raw frame to the measurement: correct it, find the disparity, align the sub-images."""

import warnings
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from squilla.calibration.agreement import compare
from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.calibration.depth import Depth, find_depth
from squilla.calibration.disparity import find_plane, fit_plane, plane_map
from squilla.calibration.edges import find_edges
from squilla.calibration.quality import COSTLY, STALE, colour_error, drift, looseness, misalignment
from squilla.calibration.resample import SINC, resample, resample_smoothly
from squilla.calibration.stray import stray_light
from squilla.calibration.views import SubImages, evened, inner, sub_images
from squilla.calibration.wear import (
    told_of,
    warn_of_wear,
    without_covered_units,
    without_lost_rows,
    without_odd_pixels,
    without_veil,
)
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.threads import single_threaded_products

_TAPS = SINC.shape[0]

_DRIFT = 0.5
"""What a live scene's disparity may change by from frame to frame, px per pitch."""

_CLEAR = 0.5
"""Mean correlation of the sub-images' edges above which shifts of single units are believed."""

_FLAT = 1e-3
"""What a plane's disparity may differ by from a map, at the outermost unit, px: it was rounded."""

_TEXTURED = 0.1
"""Mean correlation of the sub-images' edges below which they agree by chance."""


@dataclass(frozen=True)
class Measurement:
    """The aligned measurement: what the filters saw of each point of the reference view.

    y : (H, W, M) float32, DN per ms, corrected for dark and flat.
    valid : (H, W, M) bool; False where saturated, defective, outside the sensor or hidden from the
        unit by something nearer.
    angle : (H, W) field angle, rad.
    disparity : (H, W) px per lens pitch.
    snr : (H, W) signal-to-noise ratio of each point over its channels, dB, by the sensor's
        calibrated noise; None if unknown.
    provenance : how it was made; plain numbers and strings.
    depth : how far away every point is; None where the scene was taken as a plane.
    """

    y: Tensor
    valid: Tensor
    angle: Tensor
    disparity: Tensor
    snr: Tensor | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    depth: Depth | None = None

    @classmethod
    def of(cls, y: Any, *, snr: float | None = None) -> "Measurement":
        """Take a picture whose channels lie on each other already, of any camera.

        Parameters
        ----------
        y : array, (H, W, M)
            In the unit of the sensitivity; NaN where there is no value.
        snr : float, optional
            Signal-to-noise ratio of its points over their channels, dB.

        Raises
        ------
        InputError
            If it is no picture.
        """
        y = torch.as_tensor(y, dtype=torch.float32)
        if y.ndim != 3 or 0 in y.shape:
            raise InputError(f"A measurement is (height, width, channels), not {tuple(y.shape)}.")
        valid, place = y.isfinite(), torch.zeros(y.shape[:2])
        ratio = None if snr is None else torch.full(y.shape[:2], float(snr))
        return cls(torch.where(valid, y, 0), valid, place, place, ratio, {"alignment": "given"})


@single_threaded_products()
def measure(
    raw: Raw,
    calibration: Calibration,
    *,
    distance: float | None = None,
    nearest: float = 60.0,
    depth: bool = False,
    start: Measurement | None = None,
    refine: bool | None = None,
) -> Measurement:
    """Turn a raw frame into the aligned measurement.

    Parameters
    ----------
    raw : Raw
    calibration : Calibration
        Made from frames of the same camera.
    distance : float, optional
        Distance of the scene's plane, mm; by default it is found from the scene itself.
    nearest : float
        The shortest distance that is looked for, mm.
    depth : bool
        Find a distance for every point instead of one for the whole scene.
    start : Measurement, optional
        Of the frame before, from which a live scene differs little; spares the search.
    refine : bool, optional
        Whether every unit's own place is found from the scene too; by default where the lattice
        looks as if it had moved since its calibration.

    Returns
    -------
    Measurement

    Raises
    ------
    InputError
        If the calibration is of another camera or knows no geometry, if the frame is dark or
        saturated, if a distance is so short that sub-images would shift by a whole pitch, or if
        one distance is given and one for every point wanted.
    """
    if not isinstance(raw, Raw) or not isinstance(calibration, Calibration):
        raise InputError(
            "A measurement is made of a raw frame (read_raw) and a calibration (load_calibration)."
        )
    lattice, pixels = _fitting(raw, calibration)
    shortest = lattice.distance(lattice.pitch)
    for given in (nearest, distance):
        if given is not None and not given > shortest:
            raise InputError(
                f"The distance must be a number of mm above {shortest:g}, not {given:g}."
            )
    if depth and distance is not None:
        raise InputError("Give either the distance of the scene or depth, which finds it.")
    largest = lattice.disparity(nearest if distance is None else distance)
    before = None
    known = distance is not None or depth
    if start is not None and not known and start.disparity.shape == lattice.field:
        before = fit_plane(start.disparity.numpy())
        largest = min(largest, float(np.abs(before).sum()) + _DRIFT)
    margin = int(np.ceil(largest * np.abs(lattice.baseline).max())) + _TAPS
    pixels, lost = without_lost_rows(raw, pixels)
    pixels, risen = without_veil(raw, pixels)
    views = sub_images(raw, lattice, pixels, margin)
    snr = _judge(views, raw, pixels)
    views, odd = without_odd_pixels(views, pixels)
    noise = _noise_variance(views, pixels)
    relief, seen = None, None
    if distance is not None:
        disparity = np.full(lattice.field, lattice.disparity(distance), np.float32)
        quality = {"alignment": "from the given distance", "alignment_score": 1.0}
    else:
        even = evened(without_covered_units(views), lattice, calibration)
        plane, offset, quality = place(
            even, lattice, largest, noise=noise, start=before, refine=refine
        )
        placed = quality["alignment"] == "from the scene"
        if before is not None and not (placed and np.abs(plane - before).sum() < _DRIFT):
            return measure(raw, calibration, nearest=nearest, refine=refine)  # another scene
        views = replace(views, offset=views.offset + offset)
        disparity = plane_map(plane, lattice).astype(np.float32)
        if depth:
            disparity, deviation, seen = find_depth(views, lattice, noise, largest, disparity)
            relief = Depth.of(disparity, deviation, lattice)
            score = float(relief.confident.float().mean())
            quality = {"alignment": "a distance for every point", "alignment_score": score}
    y, valid = align(views, lattice, disparity)
    if seen is not None:
        valid &= torch.from_numpy(seen)
    angle = torch.from_numpy(lattice.field_angle()).float()
    agreement = compare(y, valid, angle, calibration, pixels)
    if agreement.worn.any():
        valid[..., torch.from_numpy(agreement.worn)] = False
    snr_of_point = pointwise_snr(y, pixels)
    signal = float(y.mean())
    if "misalignment" in quality:
        quality["colour_error"] = colour_error(y, noise, quality["misalignment"])
        _warn(quality)
    worn = told_of(lost, risen, odd, agreement)
    warn_of_wear(worn, signal, y.numel())
    y /= raw.exposure or 1.0
    typical = float(np.median(disparity))
    return Measurement(
        y,
        valid,
        angle,
        torch.from_numpy(disparity),
        snr_of_point,
        {
            "snr": snr,
            "camera": raw.metadata.get("camera", "unknown"),
            "exposure": raw.exposure or 0.0,
            "unit": "DN/ms" if raw.exposure else "DN, exposure unknown",
            "disparity": typical,
            "distance": lattice.distance(typical),
            **quality,
            **worn,
            **stray_light(raw.frame, raw.exposure, pixels, signal),
        },
        relief,
    )


# --- judging -----------------------------------------------------------------------------------


def _noise_variance(views: SubImages, pixels: Pixels) -> np.ndarray:
    """Return the mean noise variance of each sub-image by the calibrated sensor, (M,) DN^2."""
    signal = np.maximum(views.level, 0)
    return signal / pixels.gain + (pixels.read_noise / pixels.gain) ** 2 + 1 / 12


def pointwise_snr(y: Tensor, pixels: Pixels) -> Tensor:
    """Return the signal-to-noise ratio of aligned points, (H, W, M) DN -> (H, W) dB."""
    fixed = (pixels.read_noise / pixels.gain) ** 2 + 1 / 12
    snr = torch.empty(y.shape[:2])
    _pointwise_snr(y.numpy(), np.float32(1 / pixels.gain), np.float32(fixed), snr.numpy())
    return snr


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _pointwise_snr(y, shot, fixed, snr):
    height, width, units = y.shape
    for row in numba.prange(height):
        for column in range(width):
            total, square = np.float32(0), np.float32(0)
            for unit in range(units):
                total += y[row, column, unit]
                square += y[row, column, unit] * y[row, column, unit]
            noise = shot * max(total / units, np.float32(0)) + fixed
            power = max(square / units - noise, np.float32(0.1) * noise)
            snr[row, column] = np.float32(10) * np.log10(power / noise)


def _judge(views: SubImages, raw: Raw, pixels: Pixels) -> float:
    """Return the signal-to-noise ratio of sub-images, dB; InputError if it is no picture."""
    if views.saturated > 0.5:
        raise InputError(
            f"{100 * views.saturated:.0f} % of the frame is saturated; expose shorter or dim the "
            "light."
        )
    few = (slice(None), slice(None, None, 4), slice(None, None, 4))  # of two million, enough
    image, bad = (each.numpy() for each in (views.image, views.bad))
    good = inner(image, views.margin)[few][~inner(bad, views.margin)[few]]
    noise = float(_noise_variance(views, pixels).mean())
    if len(good) and float(good.mean()) < -max(2.0, np.sqrt(noise)):
        raise InputError(
            f"The frame lies {-float(good.mean()):.0f} DN below the calibrated dark level: it has "
            "another bit depth or black level than the calibration's frames."
        )
    power = float(good @ good) / len(good) - noise if len(good) else 0.0
    if power <= noise:
        raise InputError(
            "The frame is dark: its signal does not rise above the noise; expose longer, open the "
            "stop or check the lens cover."
        )
    return float(10 * np.log10(power / noise))


def _fitting(raw: Raw, calibration: Calibration) -> tuple[Lattice, Pixels]:
    lattice, pixels = calibration.lattice, calibration.pixels
    if lattice is None or pixels is None:
        raise InputError(
            "This calibration knows a response matrix but no camera geometry; raw frames need one "
            "made by `squilla calibrate`."
        )
    if raw.frame.shape != pixels.bias.shape:
        raise InputError(
            f"The raw frame has {raw.frame.shape[0]} x {raw.frame.shape[1]} px, the calibration "
            f"was made for {pixels.bias.shape[0]} x {pixels.bias.shape[1]}: they are of different "
            "cameras or regions."
        )
    most = int(raw.frame[::8, ::8].max())
    if most > 1.1 * pixels.saturation:
        raise InputError(
            f"The raw frame holds values up to {most}, the calibrated sensor ends at "
            f"{pixels.saturation:.0f}: its bits were shifted or it is of another camera."
        )
    taken, made = raw.metadata.get("camera"), calibration.provenance.get("camera")
    if taken and made and taken != made:
        raise InputError(
            f"The raw frame is of camera {taken!r}, the calibration of {made!r}; use its own."
        )
    return lattice, pixels


# --- placing ----------------------------------------------------------------------------------


def place(
    views: SubImages,
    lattice: Lattice,
    largest: float,
    *,
    noise: np.ndarray | None = None,
    start: np.ndarray | None = None,
    refine: bool | None = None,
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Find where the units see the scene, and say how well.

    Parameters
    ----------
    views : SubImages
    lattice : Lattice
    largest : float
        Largest disparity looked for, px per pitch.
    noise : array, (M,), optional
        Variance of each sub-image's noise.
    start : array, (3,), optional
        The plane of a frame that differs little.
    refine : bool, optional
        Whether every unit's own place is found from the scene too; by default where the lattice
        looks as if it had moved since its calibration.

    Returns
    -------
    plane : array, (3,)
        Disparity in the middle and what it grows by to the last row and column, px per pitch.
    offset : array, (M, 2)
        By which each unit lies beside its place in the lattice, px.
    quality : dict
        How it was found and how sure it is, for the provenance.
    """
    step = 2 if start is None else 4  # a live frame is looked at four times as fast
    edges = find_edges(views.image.numpy(), views.bad.numpy(), noise, step=step)
    first = views.margin + views.offset
    span = (0.0, largest)
    found = find_plane(edges, lattice, first, span, start=start)
    moved = drift(found, lattice)
    told = moved > max(STALE, 1.5 * looseness(found)) and found.score > _CLEAR
    if told and refine is None and start is not None:  # for that, one looks again, more closely
        return place(views, lattice, largest, noise=noise)
    if refine or (refine is None and told):
        free = max(moved, STALE)
        found = find_plane(edges, lattice, first, span, start=found.plane, free=free)
        moved = drift(found, lattice)
    quality = {"alignment": "from the scene", "alignment_score": found.score}
    quality["misalignment"] = misalignment(found, lattice)
    quality["lattice_moved"] = moved
    # What agrees beyond infinity is no scene: a pattern that every unit shows at the same place.
    if found.score >= _TEXTURED and found.plane[0] > -_TEXTURED:
        return found.plane, found.offset, quality
    usual = np.array([lattice.disparity(lattice.usual), 0, 0])
    return usual, 0 * found.offset, quality | {"alignment": "no texture: at the usual distance"}


def _warn(quality: dict[str, Any]) -> None:
    """Tell a person what the figures mean where they are bad."""
    if quality["alignment"].startswith("no texture"):
        says = "The scene has too little texture to align by; it is taken to be at the usual "
        says += "distance. Give `distance` if you know it."
    elif quality["colour_error"] > COSTLY:
        says = f"The sub-images may lie {quality['misalignment']:.2f} px off each other, which "
        says += f"makes the colours wrong by about {100 * quality['colour_error']:.0f} %; is the "
        says += "scene no plane, or the calibration of another day?"
    elif quality["lattice_moved"] > STALE:
        says = f"The units lie {quality['lattice_moved']:.2f} px beside their calibrated places: "
        says += "the array has moved since; calibrate anew."
    else:
        return
    warnings.warn(says, stacklevel=3)


# --- resampling -------------------------------------------------------------------------------


def align(
    views: SubImages, lattice: Lattice, disparity: float | np.ndarray | Tensor
) -> tuple[Tensor, Tensor]:
    """Resample every sub-image onto the reference view, once.

    Parameters
    ----------
    views : SubImages
    lattice : Lattice
    disparity : float or array, (H, W)
        px per lens pitch, of the whole scene or of each point of the reference view. What lies
        beyond the margin of `views` is not valid.

    Returns
    -------
    y : Tensor, (H, W, M) float32
    valid : Tensor, (H, W, M) bool

    Notes
    -----
    By `resample.sinc_kernel`, the only interpolation between the sensor and the measurement; along
    rows and columns one after the other where the disparity is that of a plane.
    """
    everywhere = np.broadcast_to(np.asarray(disparity, np.float32), lattice.field)
    place = lattice.places(views.margin + views.offset)
    image, bad = views.image.numpy(), views.bad.numpy()
    y = torch.empty(*lattice.field, len(lattice.centre))
    valid = torch.empty(y.shape, dtype=torch.bool)
    into = y.numpy().transpose(2, 0, 1), valid.numpy().transpose(2, 0, 1)
    plane, reach = fit_plane(everywhere), np.abs(lattice.baseline).max()
    if reach * np.abs(everywhere - plane_map(plane, lattice)).max() < _FLAT:
        whole = place.copy()
        whole[..., :3] += lattice.baseline[..., None] * plane
        if resample_smoothly(image, bad, whole, *into):
            return y, valid
    resample(image[None], bad, place, lattice.baseline, everywhere, SINC, into[0][None], into[1])
    return y, valid
