"""What has worn since the calibration, found in a frame itself, and the frame without it.

Rows that were lost on their way, a dark level that has risen (a warmer sensor, light that leaks
in), pixels that stick out of their neighbours, units that see something else than all the others.
"""

import warnings
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import torch

from squilla.calibration.agreement import Agreement
from squilla.calibration.calibration import Pixels
from squilla.calibration.stray import rise
from squilla.calibration.views import SubImages, fill_one
from squilla.files.raw import Raw

_OUT = 2.5
"""Noise by which a pixel is beyond all its neighbours, and their range, before it is odd."""

_MANY = 3e-5
"""Share of odd pixels that is reported; dozens may also be a scene's own glints."""

_RISEN = 0.01
"""Rise of the dark level that is reported, against the signal."""

_COVERED = 0.1
"""Level, against the median of all, below which a unit is not asked where the scene is."""


# --- before the sub-images are cut out ----------------------------------------------------------


def without_lost_rows(raw: Raw, pixels: Pixels) -> tuple[Pixels, int]:
    """Mark the rows that never came, all zero or the row before once more, as not valid.

    Returns
    -------
    pixels : Pixels
    lost : int
        How many rows cross a sub-image and are lost.
    """
    lost = np.zeros(len(raw.frame), bool)
    _find_lost(raw.frame, lost)
    if not lost.any():
        return pixels, 0
    black = np.median(pixels.bias[lost], 1)
    lost[lost] = raw.frame[lost].any(1) | (black > 2)  # without a black level, zeros may be dark
    count = int((lost & pixels.valid.any(1)).sum())
    return replace(pixels, valid=pixels.valid & ~lost[:, None]), count


@numba.njit(cache=True)
def _find_lost(frame, lost):
    rows, columns = frame.shape
    for row in range(rows):
        zero, same, flat = True, row > 0, True
        for column in range(columns):
            value = frame[row, column]
            zero = zero and value == 0
            flat = flat and value == frame[row, 0]
            same = same and value == frame[row - 1, column]
            if not (zero or same):
                break
        lost[row] = zero or (same and not flat)


def without_veil(raw: Raw, pixels: Pixels) -> tuple[Pixels, float]:
    """Take a dark level that has risen smoothly, over the whole sensor, into the bias.

    What the dark parts show is continued below the sub-images by a polynomial of fourth degree.
    Light that does not fit one comes from the scene and is left to `squilla.calibration.stray`.

    Returns
    -------
    pixels : Pixels
    risen : float
        Mean rise below the sub-images, DN; 0 where there is none to speak of. A level far below
        the calibrated one is another bit depth, and no wear.
    """
    blocks = pixels.dark_blocks
    every = len(blocks) // 1000 + 1
    blocks = blocks[::every]
    if len(blocks) < 40:
        return pixels, 0.0
    level = rise(raw.frame, raw.exposure, pixels, every=every)
    noise = np.sqrt((pixels.read_noise / pixels.gain) ** 2 + 1 / 12) / 8
    usual = float(np.median(level))
    if usual < max(5 * noise / np.sqrt(len(blocks)), 0.25):
        return pixels, 0.0
    size = np.array(raw.frame.shape)
    where = (blocks / size * 2 - 1).T
    powers = _powers(*where)
    shot = np.sqrt(max(usual, 0.0) / pixels.gain) / 8
    fit = np.linalg.lstsq(powers, level, rcond=None)[0]
    for _ in range(2):  # a few blocks may hold what is no veil
        left = np.abs(level - powers @ fit)
        kept = left <= 5 * np.median(left) + noise
        fit = np.linalg.lstsq(powers[kept], level[kept], rcond=None)[0]
    smooth = np.abs(level - powers @ fit) < 0.1 * usual + 4 * np.hypot(noise, shot)
    if smooth.mean() < 0.98:
        return pixels, 0.0
    y, x = (np.linspace(-1, 1, length, dtype=np.float32) for length in raw.frame.shape)
    row, column = (
        np.stack([axis**power for power in range(5)]).astype(np.float32) for axis in (y, x)
    )
    table = np.zeros((5, 5), np.float32)
    for (m, n), value in zip(_DEGREES, fit, strict=True):
        table[m, n] = value
    veil = row.T @ (table @ column)
    risen = float(veil[pixels.valid].mean()) if pixels.valid.any() else usual
    return replace(pixels, bias=pixels.bias + veil), risen


_DEGREES = [(m, n) for m in range(5) for n in range(5 - m)]


def _powers(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.stack([y**m * x**n for m, n in _DEGREES], -1)


# --- in the sub-images --------------------------------------------------------------------------


def without_odd_pixels(views: SubImages, pixels: Pixels) -> tuple[SubImages, int]:
    """Mark single pixels that stick out of all their neighbours as bad, and fill them.

    A lens spreads every point over its neighbours: what is brighter than all of them by more than
    they differ among themselves did not come through the lens.

    Returns
    -------
    views : SubImages
        The same; its arrays are changed in place.
    odd : int
        How many within the fields.
    """
    image, bad = views.image.numpy(), views.bad.numpy()
    floor = np.float32((pixels.read_noise / pixels.gain) ** 2 + 1 / 12)
    odd = np.zeros(bad.shape, bool)  # whose memory costs nothing where nothing is written
    lines = np.zeros(bad.shape[:2], bool)
    _find_odd(image, bad, floor, np.float32(1 / pixels.gain), odd, lines)
    units, rows = np.nonzero(lines)
    some, columns = np.nonzero(odd[units, rows])
    places = units[some], rows[some], columns
    if len(columns):
        image[places], bad[places] = 0, True  # nothing of it is to stay
        _fill_at(image, bad, *places)
    height, width = (length - views.margin for length in bad.shape[1:])
    within = (places[1] >= views.margin) & (places[1] < height)
    within &= (columns >= views.margin) & (columns < width)
    return views, int(within.sum())


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _find_odd(image, bad, floor, shot, odd, lines):
    units, rows, columns = image.shape
    for line in numba.prange(units * (rows - 2)):
        unit, row = line // (rows - 2), line % (rows - 2) + 1
        above, here, below = image[unit, row - 1], image[unit, row], image[unit, row + 1]
        top, bottom = np.empty(columns, np.float32), np.empty(columns, np.float32)
        highest, lowest = np.empty(columns, np.float32), np.empty(columns, np.float32)
        for x in range(columns):  # bad neighbours count as what they were filled with
            top[x], bottom[x] = max(above[x], below[x]), min(above[x], below[x])
            highest[x], lowest[x] = max(top[x], here[x]), min(bottom[x], here[x])
        out = np.empty(columns - 2, np.float32)
        left, right, least, last = highest[:-2], highest[2:], lowest[:-2], lowest[2:]
        over, own, under = top[1:-1], here[1:-1], bottom[1:-1]
        some = False
        for x in range(columns - 2):
            high = max(over[x], max(left[x], right[x]))
            low = min(under[x], min(least[x], last[x]))
            beyond = max(own[x] - high, low - own[x]) - (high - low)
            noise = floor + shot * max(over[x], np.float32(0))
            out[x] = beyond * abs(beyond) - np.float32(_OUT**2) * noise
            some |= out[x] > 0
        if not some:
            continue
        for x in range(columns - 2):
            if out[x] > 0 and not bad[unit, row, x + 1]:
                odd[unit, row, x + 1] = lines[unit, row] = True


@numba.njit(cache=True, nogil=True)
def _fill_at(image, bad, units, rows, columns):
    for number in range(len(units)):
        unit = units[number]
        fill_one(image[unit], bad[unit], rows[number], columns[number])


def without_covered_units(views: SubImages) -> SubImages:
    """Mark units that show next to nothing as bad, whose noise would lead the placing astray."""
    covered = views.level < _COVERED * np.median(views.level)
    if not covered.any():
        return views
    return replace(views, bad=views.bad | torch.from_numpy(covered)[:, None, None])


# --- what is told -------------------------------------------------------------------------------


def told_of(lost: int, risen: float, odd: int, agreement: Agreement) -> dict[str, Any]:
    """Return what was found, for the provenance of a measurement."""
    return {
        "lost_rows": lost,
        "dark_risen": risen,
        "odd_pixels": odd,
        "worn_units": agreement.told,
    }


def warn_of_wear(told: dict[str, Any], signal: float, count: int) -> None:
    """Tell a person what has worn, and what was done about it.

    signal : mean of the measurement, DN.  count : number of pixels in the fields.
    """
    says = []
    if told["worn_units"] != "none":
        says.append(
            "Some units do not see what the others do (in brackets what they pass of their light): "
            f"{told['worn_units']}; their channels are left out. Look for dust, or calibrate anew."
        )
    if told["lost_rows"]:
        says.append(f"{told['lost_rows']} rows of the frame were lost on their way; left out.")
    if told["odd_pixels"] > max(_MANY * count, 30):
        says.append(
            f"{told['odd_pixels']} pixels stick out of their neighbours, hot or dead since the "
            "calibration; they are left out. Take new dark frames."
        )
    if told["dark_risen"] > _RISEN * signal:
        says.append(
            f"The dark level lies {told['dark_risen']:.1f} DN above the calibrated one, and was "
            "corrected: the sensor is warmer, or light leaks in."
        )
    for sentence in says:
        warnings.warn(sentence, stacklevel=3)
