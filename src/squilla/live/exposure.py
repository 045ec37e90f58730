"""Automatic exposure: the brighter pixels are kept at seven tenths of the scale."""

import numpy as np

from squilla.calibration.calibration import Pixels
from squilla.files.raw import Raw

_WANTED = 0.7
"""Where the brighter pixels are to lie, of the scale between black and saturation."""

_FINE = (0.55, 0.85)
"""Where they may lie before the exposure is changed, which stops a camera for a moment."""

_STEP = 4.0
"""Largest factor of one change; a dark frame tells little of how dark it is."""

_LONGEST = 1000.0
"""Longest exposure chosen, ms: longer ones are no live view."""


def better_exposure(raw: Raw, pixels: Pixels, limits: tuple[float, float]) -> float | None:
    """Return the exposure that shows the scene better, ms; None where that of a frame is fine.

    Parameters
    ----------
    raw : Raw
    pixels : Pixels
    limits : (float, float)
        Least and largest exposure of the camera, ms.
    """
    if not raw.exposure:
        return None
    few = (slice(None, None, 8), slice(None, None, 8))
    frame, black = raw.frame[few], float(pixels.bias[few].mean())
    bright = float(np.quantile(frame, 0.995)) - black
    level = bright / (pixels.saturation - black)
    clipped = float(np.mean(frame >= pixels.saturation)) > 0.005  # how far above, nobody knows
    if not clipped and _FINE[0] <= level <= _FINE[1]:
        return None
    factor = 0.4 if clipped else min(_WANTED / max(level, 1e-3), _STEP)
    low, high = limits
    wanted = min(max(raw.exposure * factor, low), high, _LONGEST)
    return None if abs(wanted / raw.exposure - 1) < 0.02 else wanted
