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
    blocks = pixels.dark_blocks
    if not len(blocks):
        return {"stray_light": "not judged: the sub-images leave no part of the sensor dark"}
    level = dark_levels(frame, exposure, pixels, blocks)
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


def dark_levels(
    frame: np.ndarray, exposure: float | None, pixels: Pixels, blocks: np.ndarray
) -> np.ndarray:
    """Return by how much blocks, (N, 2) px, lie above the calibrated dark, (N,) DN."""
    level = np.empty(len(blocks), np.float32)
    _levels(frame, pixels.bias, pixels.dark_rate, np.float32(exposure or 0.0), blocks, level)
    return level


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _levels(frame, bias, dark_rate, exposure, blocks, level):
    parts = 64
    for part in numba.prange(parts):
        mean = np.empty(_BLOCK, np.float32)
        for number in range(part * len(blocks) // parts, (part + 1) * len(blocks) // parts):
            y, x = blocks[number]
            for row in range(_BLOCK):
                total = np.float32(0)
                for column in range(x, x + _BLOCK):
                    total += np.float32(frame[y + row, column])
                place = row
                while place > 0 and mean[place - 1] > total:  # in order
                    mean[place] = mean[place - 1]
                    place -= 1
                mean[place] = total
            # Not the mean: some rows may hold hot pixels. Dark parts have one dark level.
            middle = (mean[_BLOCK // 2 - 1] + mean[_BLOCK // 2]) / (2 * _BLOCK)
            level[number] = middle - bias[y, x] - exposure * dark_rate[y, x]
