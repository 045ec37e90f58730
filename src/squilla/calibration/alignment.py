"""From a raw frame to the measurement: correct, find the disparity, align."""

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Measurement:
    """The aligned measurement: what the filters saw of each point of the reference view.

    y : (H, W, M) float32, DN per ms, corrected for dark and flat.
    valid : (H, W, M) bool; False where saturated, defective or outside the sensor.
    angle : (H, W) field angle, rad.
    disparity : (H, W) px per lens pitch.
    snr : signal-to-noise ratio of `y`, dB, by the sensor's calibrated noise; None if unknown.
    provenance : how it was made; plain numbers and strings.
    """

    y: Tensor
    valid: Tensor
    angle: Tensor
    disparity: Tensor
    snr: float | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
