"""What years do to a camera: dust, dead units, hot pixels, warmth, leaks, swollen films."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.camera.design import CameraDesign
from squilla.camera.sensor import ImageSensor
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.optics.filters import FilterArray
from squilla.optics.tables import MeasuredFilters

_DOUBLING = 7.0
"""Warming by which a sensor's dark current doubles, K."""

_HOT = 20.0, 2000.0
"""Dark current of pixels that have gone hot, e-/ms; its logarithm is spread evenly."""


@dataclass(frozen=True)
class Dust:
    """A grain before the sensor, with a soft edge.

    unit : whose sub-image it shades.
    place : (y, x) px from the middle of that sub-image.
    radius : px at half its depth; a grain on the lens is wider than the sub-image.
    transmittance : in its middle; 0 for a unit that is covered.
    """

    unit: int
    place: tuple[float, float] = (0.0, 0.0)
    radius: float = 1e6
    transmittance: float = 0.0

    def __post_init__(self):
        if not (0 <= self.transmittance <= 1 and self.radius > 0):
            raise InputError("Dust has a radius above 0 px and a transmittance from 0 to 1.")


@dataclass(frozen=True)
class Wear:
    """What has happened to a camera since it was built.

    dust : grains.
    hot_pixels : share of pixels that have gone hot.
    warmer : K by which the sensor is warmer; all dark current grows.
    leak : light that comes in at the sensor's left edge and falls off to the right, e-/ms.
    drift : nm to the red by which the filters have moved.
    seed : draws which pixels go hot.
    """

    dust: tuple[Dust, ...] = ()
    hot_pixels: float = 0.0
    warmer: float = 0.0
    leak: float = 0.0
    drift: float = 0.0
    seed: int = 0


class WornCamera(Camera):
    """A camera after some wear; it does not tell, and bears the same serial number.

    Parameters
    ----------
    design : CameraDesign, str or Path
    wear : Wear
    """

    def __init__(self, design: CameraDesign | str, wear: Wear):
        super().__init__(design)
        self.wear = wear
        self.sensor = _WornSensor(self.design, wear)
        beyond = [grain.unit for grain in wear.dust if not 0 <= grain.unit < self.design.units]
        if beyond:
            raise InputError(f"There is no unit {beyond[0]}; there are {self.design.units}.")

    @cached_property
    def filters(self) -> "FilterArray | MeasuredFilters | _Drifted":
        sound = Camera(self.design).filters
        return _Drifted(sound, self.wear.drift) if self.wear.drift else sound

    def rate(self, scene, *, distance: float = 300.0, depth: np.ndarray | None = None):
        return super().rate(scene, distance=distance, depth=depth) * self._shade + self._leak

    def flat_rate(self, light: np.ndarray) -> np.ndarray:
        return super().flat_rate(light) * self._shade + self._leak

    def capture_dark(self, exposure: float, *, generator=None) -> Raw:
        return self.expose(self._leak, exposure, generator)

    @cached_property
    def _shade(self) -> np.ndarray:
        """Return the share of light that dust lets through, (rows, columns)."""
        shade = np.ones(self.design.sensor_shape, np.float32)
        for grain in self.wear.dust:
            window = self.windows[grain.unit]
            y, x = (
                np.arange(part.start, part.stop) - centre - off
                for part, centre, off in zip(
                    window, self.design.centres[grain.unit], grain.place, strict=True
                )
            )
            distance = np.hypot(y[:, None], x[None, :]) / grain.radius
            shade[window] *= 1 - (1 - grain.transmittance) / (1 + distance**6)
        return shade

    @cached_property
    def _leak(self) -> np.ndarray:
        """Return what leaks in, (rows, columns) e-/ms."""
        rows, columns = self.design.sensor_shape
        falling = self.wear.leak / (1 + 2 * np.arange(columns) / columns) ** 2
        return np.broadcast_to(falling.astype(np.float32), (rows, columns))


class _WornSensor(ImageSensor):
    def __init__(self, design: CameraDesign, wear: Wear):
        super().__init__(design)
        self.wear = wear

    @cached_property
    def dark_rate(self) -> np.ndarray:
        rate = ImageSensor(self.design).dark_rate * np.float32(2 ** (self.wear.warmer / _DOUBLING))
        random = np.random.default_rng([self.wear.seed, 4])
        hot = random.integers(rate.size, size=round(self.wear.hot_pixels * rate.size))
        low, high = map(math.log, _HOT)
        rate.ravel()[hot] = np.exp(random.uniform(low, high, len(hot)))
        return rate


@dataclass(frozen=True)
class _Drifted:
    """Filters whose transmittance has moved to the red by `drift` nm."""

    sound: FilterArray | MeasuredFilters
    drift: float

    def transmittance(self, wavelength: ArrayLike, angle: ArrayLike = 0.0) -> Tensor:
        return self.sound.transmittance(np.asarray(wavelength) - self.drift, angle)


def drop_rows(raw: Raw, first: int, count: int, *, repeated: bool = False) -> Raw:
    """Return a frame some of whose rows got lost on their way.

    Parameters
    ----------
    raw : Raw
    first, count : int
        Which rows.
    repeated : bool
        Whether the row before them stands in their place (a stale buffer); else zeros.
    """
    frame = raw.frame.copy()
    frame[first : first + count] = frame[first - 1] if repeated and first else 0
    return replace(raw, frame=frame)
