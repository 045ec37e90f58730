"""The calibration rehearsed with the twin: the frames that a lab would take of its own camera."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Generator
from xarray import DataArray

from squilla.calibration.calibrate import calibrate
from squilla.calibration.calibration import Calibration, Pixels
from squilla.calibration.geometry import lattice_at
from squilla.calibration.known import KnownScene
from squilla.calibration.sensitivity import SweepStep
from squilla.camera.scenes import chart_layout
from squilla.camera.twin import Camera
from squilla.files.cube import labelled
from squilla.files.raw import Raw
from squilla.spectra import lights, reflectances

LAMPS = ("A", "FL11", "LED-B1", "LED-B5", "D65")
"""White lamps of `squilla.spectra.lights` under which the chart of `Rehearsal.known` is shown."""


class Rehearsal:
    """Darks, flats, a narrow-band sweep and a poster, captured by the twin.

    The frames are made when asked for, one by one: a sweep is larger than a memory.

    Parameters
    ----------
    camera : Camera
    seed : int
        Of the noise of all frames.
    frames : int
        Number of darks and of flats.
    step, bandwidth : float
        Of the sweep, nm; bandwidth is the full width at half maximum.
    power_error : float
        Relative error with which the reference detector knows the power of each step, and the lab
        the brightness of each lamp.
    power_drift : float
        Relative change of the light over the whole sweep that the reference detector does not see.
    stray_light : float
        Share of the light of each step that is spread evenly over the band.
    distance : float
        Of the poster, mm.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        seed: int = 0,
        frames: int = 8,
        step: float = 4.0,
        bandwidth: float = 4.0,
        power_error: float = 0.0,
        power_drift: float = 0.0,
        stray_light: float = 0.0,
        distance: float = 300.0,
    ):
        self.camera = camera
        self.seed = seed
        self.frames = frames
        self.bandwidth = bandwidth
        self.power_error = power_error
        self.power_drift = power_drift
        self.stray_light = stray_light
        self.distance = distance
        band = camera.design.band
        count = int(np.ceil((band.stop - band.start) / step)) + 1
        self.wavelengths = np.linspace(band.start, band.stop, count)
        self._light = np.ones(len(camera.design.wavelength))

    def dark(self) -> Iterator[Raw]:
        """Yield frames with the lens covered, as long as the flats and as the steps at the ends.

        Those need the longest exposures.
        """
        flat = self._exposure(self.camera.flat_rate(self._light))
        for kind, exposure in enumerate((flat, self._longest)):
            for number in range(self.frames):
                generator = self._generator(5 + kind, number)
                yield self.camera.capture_dark(exposure, generator=generator)

    def flat(self) -> Iterator[Raw]:
        """Yield frames of an evenly lit white surface."""
        rate = self.camera.flat_rate(self._light)
        for number in range(self.frames):
            yield self.camera.expose(rate, self._exposure(rate), self._generator(2, number))

    def sweep(self) -> Iterator[SweepStep]:
        """Yield flat frames in narrow-band light, each exposed to the same level.

        The wavelengths are those of `wavelengths`, in their order; they may repeat, and lie outside
        the camera's band.
        """
        last = max(len(self.wavelengths) - 1, 1)
        for number, wavelength in enumerate(self.wavelengths):
            generator = self._generator(3, number)
            drift = 1 + self.power_drift * (number / last - 0.5)
            rate = drift * self.camera.flat_rate(self._band(wavelength))
            exposure = min(self._exposure(rate), self._longest)
            raw = self.camera.expose(rate, exposure, generator)
            error = self.power_error * float(torch.randn(1, generator=generator))
            yield SweepStep(raw, float(wavelength), 1.0 + error, self.bandwidth)

    def known(self, lamps: np.ndarray | None = None) -> Iterator[KnownScene]:
        """Yield frames of a chart of 24 matte surfaces under each of some lamps.

        The surfaces are from the Esser chart in `squilla.spectra.reflectances`.

        Parameters
        ----------
        lamps : array, (lamps, K), optional
            Photon radiance of white in their light; default: `LAMPS`.
        """
        size, wavelength = self.camera.design.field.size, self.camera.design.wavelength
        table, labels = reflectances(), chart_layout(size, size)
        chart = [number for number, name in enumerate(table.name) if name.startswith("esser")]
        chart = np.array(chart)[np.linspace(0, len(chart) - 1, 24).astype(int)]
        surface = np.vstack([table.on(wavelength)[chart], np.full(len(wavelength), 0.03)])
        if lamps is None:
            names = [lights().name.index(name) for name in LAMPS]
            lamps = lights().on(wavelength)[names]
        for number, lamp in enumerate(lamps):
            generator = self._generator(7, number)
            scene = labelled((surface * lamp).astype(np.float32)[labels], wavelength)
            rate = self.camera.rate(scene, distance=self.distance)
            raw = self.camera.expose(rate, self._exposure(rate), generator)
            error = self.power_error * float(torch.randn(1, generator=generator))
            yield KnownScene(raw, (1 + error) * surface[:-1] * lamp, labels, self.distance)

    def target(self) -> Raw:
        """Return a frame of a textured poster at `distance`, facing the camera."""
        scene = poster(self.camera.design.field.size + 100, self.camera.design.wavelength)
        rate = self.camera.rate(scene, distance=self.distance)
        return self.camera.expose(rate, self._exposure(rate), self._generator(4, 0))

    def calibrate(self, **lessons: Any) -> Calibration:
        """Take the frames and learn the camera from them.

        Parameters
        ----------
        lessons
            Arguments of `squilla.calibrate` in place of the rehearsal's own darks, flats, sweep,
            target and its distance; None where there shall be none.

        Returns
        -------
        Calibration
        """
        own = {"dark": self.dark, "flat": self.flat, "sweep": self.sweep, "target": self.target}
        frames = {name: take() for name, take in own.items() if name not in lessons}
        given: dict[str, Any] = {"target_distance": self.distance, **frames, **lessons}
        return calibrate(self.camera.design, **given)

    def _band(self, wavelength: float) -> np.ndarray:
        """Return the light of one step, (K,); all of it together, also beyond the band, is 1."""
        design = self.camera.design
        sigma = self.bandwidth / np.sqrt(8 * np.log(2))
        band = np.exp(-((design.wavelength - wavelength) ** 2) / (2 * sigma**2))
        band = band * design.band.step / (sigma * np.sqrt(2 * np.pi))
        return (1 - self.stray_light) * band + self.stray_light / len(band)

    @cached_property
    def _longest(self) -> float:
        """The exposure of the steps at the ends of the band, ms: half of their light is blocked."""
        band = self.camera.design.band
        ends = (self._band(wavelength) for wavelength in (band.start, band.stop))
        return max(self._exposure(self.camera.flat_rate(light)) for light in ends)

    def _exposure(self, rate: np.ndarray) -> float:
        """Return the exposure at which the brightest sub-image fills 70 % of the scale, ms."""
        return 0.7 * self.camera.design.sensor.full_well / float(rate.max())

    def _generator(self, kind: int, number: int) -> Generator:
        return torch.Generator().manual_seed(1_000_003 * self.seed + 10_007 * kind + number)


def ideal_calibration(camera: Camera, angles: int = 5) -> Calibration:
    """Return the calibration that perfect frames would give; for judging and comparing only.

    Parameters
    ----------
    camera : Camera
        Of any layout; a mosaic's or a sequence's filters all lie at the place of the one lens.
    angles : int
        Number of field angles from the axis to the corner of the field.
    """
    design = camera.design
    corner = np.arctan(np.hypot(design.field.size / 2, design.field.size / 2) / design.focal)
    angle = np.sqrt(np.linspace(0, corner**2, angles))
    array = design.filters.layout == "array"
    centre = np.repeat(design.centres, 1 if array else design.channels, 0)
    sensor = design.sensor
    dark_rate = camera.sensor.dark_rate / sensor.gain
    usual_rate = np.float32(sensor.dark_current / 1000 / sensor.gain)
    pixels = Pixels(
        bias=np.full(design.sensor_shape, sensor.black_level, np.float32),
        dark_rate=dark_rate.astype(np.float32),
        flat=camera.sensor.response,
        valid=dark_rate <= 10 * usual_rate,
        saturation=0.98 * (2**sensor.bits - 1),
        gain=sensor.gain,
        read_noise=sensor.read_noise,
    )
    provenance = {"design": design.name, "camera": camera.serial, "made": "from the twin's truth"}
    return Calibration(
        design.wavelength,
        camera.sensitivity(angle),
        angle,
        lattice_at(design, centre),
        pixels,
        provenance=provenance,
    )


def poster(size: int, wavelength: np.ndarray, seed: int = 0) -> DataArray:
    """Return a grey texture with detail at many scales, a printed alignment target.

    Parameters
    ----------
    size : int
        Height and width, px.
    wavelength : array, (K,)
        nm.
    """
    noise = np.random.default_rng(seed).standard_normal((4, size, size))
    layers = [gaussian_filter(layer, 1.2 * 2**level) for level, layer in enumerate(noise)]
    texture = sum(layer / layer.std() for layer in layers)
    grey = np.clip(0.45 + 0.15 * texture, 0.05, 0.95).astype(np.float32)
    values = np.repeat(grey[..., None], len(wavelength), -1)
    return labelled(values, wavelength)
