"""Measurements of cameras with a single lens: filters on its pixels, or one after another."""

from collections.abc import Iterable

import numpy as np
import torch
from scipy.ndimage import convolve1d

from squilla.calibration.alignment import Measurement, pointwise_snr
from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.calibration.views import sub_images
from squilla.errors import InputError
from squilla.files.raw import Raw

_AROUND = 16
"""Pixels beyond the field that demosaicking may look at, where the sensor has them."""

_TILES = 3
"""Tiles that continue a mosaic beyond its border: as far as any pixel looks."""


def measure_mosaic(raw: Raw, calibration: Calibration, tile: np.ndarray) -> Measurement:
    """Turn the raw frame of a mosaic of filters into a measurement.

    Parameters
    ----------
    raw : Raw
    calibration : Calibration
        With one unit for each filter, all at the place of the one lens.
    tile : array, (h, w) int
        Number of the filter on each pixel of the tile, which begins at pixel (0, 0).

    Returns
    -------
    Measurement
        Its `snr` is that of single pixels; what interpolation does to the noise depends on the
        scene.

    Raises
    ------
    InputError
        If calibration, tile and frame do not fit.
    """
    lattice, pixels = _known(calibration)
    if sorted(tile.ravel()) != list(range(calibration.filters)):
        raise InputError(
            f"The tile must hold each of the {calibration.filters} filters of the calibration once."
        )
    if raw.frame.shape != pixels.bias.shape:
        raise InputError(
            f"The raw frame has {raw.frame.shape} px, the calibration {pixels.bias.shape}."
        )
    corner = np.rint(lattice.centre[0] - (np.array(lattice.field) - 1) / 2).astype(int)
    low = np.maximum(corner - _AROUND, 0)
    high = np.minimum(corner + lattice.field + _AROUND, raw.frame.shape)
    window = tuple(slice(*ends) for ends in zip(low, high, strict=True))
    bad = ~pixels.valid[window] | (raw.frame[window] >= pixels.saturation)
    image = (raw.frame[window] - pixels.dark(raw.exposure)[window]) / pixels.flat[window]
    white = calibration.mean_sensitivity.sum(-1).numpy()
    aligned = np.roll(tile, tuple(-low % tile.shape), (0, 1))
    inner = tuple(
        slice(int(c - start), int(c - start) + size)
        for c, start, size in zip(corner, low, lattice.field, strict=True)
    )
    y = torch.from_numpy(demosaick(image, aligned, white / white.mean(), bad)[inner])
    # A pixel is believed if the raw pixel at its place is.
    valid = torch.from_numpy(~bad[inner])[..., None].expand(y.shape)
    return _measurement(y, valid, raw, calibration)


def measure_sequence(raws: Iterable[Raw], calibration: Calibration) -> Measurement:
    """Turn the raw frames of a sequence, one through each filter, into a measurement.

    Nothing is aligned: a scene that moves meanwhile is smeared over the spectrum.

    Parameters
    ----------
    raws : iterable of Raw
        In the order of the filters, equally exposed.
    calibration : Calibration
        With one unit for each filter, all at the place of the one lens.

    Returns
    -------
    Measurement

    Raises
    ------
    InputError
        If the frames do not fit the calibration.
    """
    lattice, pixels = _known(calibration)
    raws = list(raws)
    if len(raws) != calibration.filters or len({raw.exposure for raw in raws}) != 1:
        raise InputError(
            f"A sequence needs {calibration.filters} frames of one exposure, not {len(raws)} of "
            f"{sorted({raw.exposure or 0.0 for raw in raws})} ms."
        )
    one = Lattice(**{**vars(lattice), "centre": lattice.centre[:1], "baseline": np.zeros((1, 2))})
    views = [sub_images(raw, one, pixels, 0) for raw in raws]
    y = torch.cat([view.image for view in views]).permute(1, 2, 0).contiguous()
    valid = ~torch.cat([view.bad for view in views]).permute(1, 2, 0)
    return _measurement(y, valid, raws[0], calibration)


def _known(calibration: Calibration) -> tuple[Lattice, Pixels]:
    lattice, pixels = calibration.lattice, calibration.pixels
    if lattice is None or pixels is None or np.ptp(lattice.centre, 0).any():
        raise InputError("This calibration is not of a camera with a single lens.")
    return lattice, pixels


def _measurement(
    y: torch.Tensor, valid: torch.Tensor, raw: Raw, calibration: Calibration
) -> Measurement:
    lattice, pixels = _known(calibration)
    return Measurement(
        y / (raw.exposure or 1.0),
        valid,
        torch.from_numpy(lattice.field_angle()).float(),
        torch.zeros(lattice.field),
        pointwise_snr(y, pixels),
        {
            "camera": raw.metadata.get("camera", "unknown"),
            "exposure": raw.exposure or 0.0,
            "unit": "DN/ms" if raw.exposure else "DN, exposure unknown",
            "alignment": "a single lens: none needed",
        },
    )


def demosaick(
    image: np.ndarray, tile: np.ndarray, white: np.ndarray, bad: np.ndarray | None = None
) -> np.ndarray:
    """Estimate what every filter of a mosaic would have seen at every pixel.

    Filters of a scene see much the same edges, so what is interpolated is only how each differs
    from the mean of all. That mean is first taken over a tile about every pixel, then sharpened
    with the pixel itself, whose own filter's difference to the mean is known from the nearest
    pixels of the same filter, the more alike the better.

    Parameters
    ----------
    image : array, (H, W)
    tile : array, (h, w) int
        Number of the filter on each pixel of the tile, which begins at pixel (0, 0).
    white : array, (M,)
        What each filter reads of a white surface.
    bad : array, (H, W) bool, optional
        Pixels not to be believed.

    Returns
    -------
    array, (H, W, M) float32

    Source: Mihoubi, Losson, Mathon, Macaire, IEEE Transactions on Computational Imaging 3, 982
    (2017), "Multispectral demosaicing using pseudo-panchromatic image".
    """
    around = [_repeated(length, side) for length, side in zip(image.shape, tile.shape, strict=True)]
    number = tile[np.ix_(*(place % side for place, side in zip(around, tile.shape, strict=True)))]
    even = image[np.ix_(*around)].astype(np.float32) / white[number].astype(np.float32)
    (height, width), (rows, columns) = even.shape, tile.shape
    # Pairs of pixels of the same filter, next to each other.
    pairs = [
        [tuple(each) for each in zip(_pairs(height, down), _pairs(width, right), strict=True)]
        for down, right in ((rows, 0), (-rows, 0), (0, columns), (0, -columns))
    ]
    if bad is not None and bad.any():
        good = ~bad[np.ix_(*around)]
        total, count = np.zeros_like(even), np.full_like(even, 1e-6)
        for at, beside in pairs:
            total[at] += even[beside] * good[beside]
            count[at] += good[beside]
        even = np.where(good, even, total / count)
    mean = _smooth(even, np.ones_like(even), [_box(rows), _box(columns)])
    apart = np.float32(0.1 * np.abs(even).mean() + 1e-12)
    total, weights = np.zeros_like(even), np.zeros_like(even)
    for at, beside in pairs:
        weight = apart / (apart + np.abs(even[at] - even[beside]))
        total[at] += weight * (mean[beside] - even[beside])
        weights[at] += weight
    sharp = even + total / weights
    inner = tuple(
        slice(_TILES * side, _TILES * side + length)
        for side, length in zip(tile.shape, image.shape, strict=True)
    )
    kernels = [_triangle(rows), _triangle(columns)]
    result = np.empty((*image.shape, len(white)), np.float32)
    for channel, level in enumerate(white):
        known = (number == channel).astype(np.float32)
        result[..., channel] = level * (sharp + _smooth(even - sharp, known, kernels))[inner]
    return result


def _repeated(length: int, side: int) -> np.ndarray:
    """Return the places of an axis, `_TILES` more tiles like the outermost before and behind."""
    place = np.arange(-_TILES * side, length + _TILES * side)
    behind = length - side + (place - length) % side
    return np.where(place < 0, place % side, np.where(place < length, place, behind))


def _smooth(image: np.ndarray, weight: np.ndarray, kernels: list[np.ndarray]) -> np.ndarray:
    """Return the weighted mean of a picture about every pixel, (H, W) (normalised convolution)."""
    parts = []
    for part in (image * weight, weight):
        for axis, kernel in enumerate(kernels):
            part = convolve1d(part, kernel, axis, mode="constant")
        parts.append(part)
    return parts[0] / np.maximum(parts[1], 1e-12)


def _box(size: int) -> np.ndarray:
    """Return taps that weigh each place of a tile alike, an even one's ends by halves."""
    taps = np.ones(size + 1 - size % 2, np.float32)
    taps[[0, -1]] = 1 if size % 2 else 0.5
    return taps


def _triangle(size: int) -> np.ndarray:
    return (size - np.abs(np.arange(1 - size, size))).astype(np.float32)


def _pairs(length: int, step: int) -> tuple[slice, slice]:
    """Return the places of an axis that have a neighbour `step` on, and those neighbours."""
    if step >= 0:
        return slice(0, length - step), slice(step, length)
    return slice(-step, length), slice(0, length + step)
