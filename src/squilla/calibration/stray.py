"""Light where no lens should send any: how ghosts from outside the field are noticed.

The aperture stop, or walls, leave the sensor dark beyond the sub-images. What a lens images there
has come past them, and lands in neighbouring sub-images too, where nothing can tell it from their
own picture. So the dark parts are watched. A sensor that the sub-images fill to its edges has none,
and a ghost below `_SHARE` of the signal is not told from glare.
"""

import numba
import numpy as np

from squilla.calibration.calibration import DARK_BLOCK as _BLOCK
from squilla.calibration.calibration import Pixels

_SHARE = 0.02
"""Stray light that is reported, against the mean signal."""


def stray_light(
    frame: np.ndarray, exposure: float | None, pixels: Pixels, signal: float
) -> dict[str, float | str]:
    """Judge the light in the dark parts of a frame.

    Parameters
    ----------
    frame : array, (rows, columns) uint16
        DN.
    exposure : float, optional
        ms.
    pixels : Pixels
    signal : float
        Mean signal of the sub-images, DN.

    Returns
    -------
    dict
        stray_light : a sentence; stray_share, stray_peak : mean and brightest of the dark parts
        against the signal, where there are any.
    """
    if not len(pixels.dark_blocks):
        return {"stray_light": "not judged: the sub-images leave no part of the sensor dark"}
    level = rise(frame, exposure, pixels)
    signal = max(signal, 1e-3)  # DN; of a frame that shows no picture at all
    share, peak = float(level.mean()) / signal, float(level.max()) / signal
    noise = 1.25 * np.sqrt((pixels.read_noise / pixels.gain) ** 2 + 1 / 12) / _BLOCK / signal
    found = {"stray_share": share, "stray_peak": peak}
    if max(share, peak - 8 * noise) < _SHARE:
        return found | {"stray_light": "none seen"}
    return found | {
        "stray_light": f"Light falls beside the sub-images, up to {100 * peak:.0f} % of their mean "
        "signal: something outside the field reaches the sub-images of neighbouring lenses too; "
        "check the aperture stop, or shade it."
    }


def rise(
    frame: np.ndarray, exposure: float | None, pixels: Pixels, *, every: int = 1
) -> np.ndarray:
    """Return by how much every n-th dark block lies above its calibrated level, (N,) DN."""
    blocks = pixels.dark_blocks[::every]
    bias, rate = pixels.dark_levels[:, ::every]
    total = np.empty(len(blocks), np.float32)
    _middle(frame, blocks, total)
    return total / np.float32(2 * _BLOCK) - bias - np.float32(exposure or 0.0) * rate


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _middle(frame, blocks, total):
    """Fill in the sum of each block's two middle rows, were its rows ordered by their sums.

    Not the mean: some rows may hold hot pixels. Dark parts have one dark level.
    """
    parts = 64
    for part in numba.prange(parts):
        some = blocks[part * len(blocks) // parts : (part + 1) * len(blocks) // parts]
        sums = np.empty((_BLOCK, len(some)), np.int32)
        for number in range(len(some)):
            y, x = some[number]
            for row in range(_BLOCK):
                pixels, value = frame[y + row, x : x + _BLOCK], np.int32(0)
                for column in range(_BLOCK):
                    value += pixels[column]
                sums[row, number] = value
        for turn in range(_BLOCK):  # neighbours change places until all are in order
            for row in range(turn % 2, _BLOCK - 1, 2):
                low, high = sums[row], sums[row + 1]
                for number in range(len(some)):
                    one, other = low[number], high[number]
                    low[number], high[number] = min(one, other), max(one, other)
        middle = sums[_BLOCK // 2 - 1 : _BLOCK // 2 + 1]
        for number in range(len(some)):
            total[part * len(blocks) // parts + number] = middle[0, number] + middle[1, number]
