"""The digital twin: what the designed camera would record of a scene."""

import hashlib
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from torch import Generator
from xarray import DataArray

from squilla.camera import channels
from squilla.camera.design import CameraDesign
from squilla.camera.projection import Projection, middle
from squilla.camera.sensor import ImageSensor
from squilla.errors import InputError
from squilla.files.cube import labelled
from squilla.files.raw import Raw


@dataclass(frozen=True)
class Truth:
    """What the twin knows and no reconstruction may: for judging only.

    cube : DataArray (y, x, wavelength), the scene as the reference unit sees it, unblurred.
    disparity : (H, W) px per lens pitch.
    centres : (M, 2) px, where each unit images an infinitely distant point on the axis.
    """

    cube: DataArray
    disparity: np.ndarray
    centres: np.ndarray


class Camera(Projection):
    """A camera that exists only as numbers.

    Parameters
    ----------
    design : CameraDesign, str or Path
        A design, its TOML file, or "thesis".
    """

    def __init__(self, design: CameraDesign | str | Path = "thesis"):
        super().__init__(design if isinstance(design, CameraDesign) else CameraDesign.load(design))
        self.sensor = ImageSensor(self.design)

    def sensitivity(self, angle: ArrayLike) -> np.ndarray:
        """Return the true sensitivity, (A, M, K) DN/ms; for judging a calibration only.

        What leaks beside the filters is its mean around the axis.
        """
        return channels.seen(self.design, self.filters, angle) / self.design.sensor.gain

    @cached_property
    def serial(self) -> str:
        """Name and short digest of the design: what a real camera's serial number would be.

        A filter table counts by what it holds, not by where it lies.
        """
        sections = {name: getattr(self.design, name) for name in CameraDesign.model_fields}
        sections["filters"] = self.design.filters.model_copy(update={"table": None})
        figures = CameraDesign.model_construct(**sections)  # no design, so it is not checked
        digest = hashlib.sha256(figures.model_dump_json(exclude={"effects"}).encode())
        if self.design.filters.table is not None:
            digest.update(self.filters.transmittance(self.design.wavelength).numpy().tobytes())
        return f"{self.design.name}-{digest.hexdigest()[:8]}"

    # --- taking pictures ----------------------------------------------------------------------

    def capture(
        self,
        scene: DataArray,
        *,
        distance: float = 300.0,
        depth: np.ndarray | None = None,
        exposure: float | None = None,
        snr: float | None = None,
        generator: Generator | None = None,
    ) -> Raw:
        """Take a raw frame of a scene.

        Parameters
        ----------
        scene : DataArray, (y, x, wavelength)
            Relative photon radiance; its wavelengths must cover the camera's band.
        distance : float
            Distance of a plane scene facing the camera, mm.
        depth : array, (y, x), optional
            Distance of every scene sample, mm, in the reference unit's view; nearer surfaces hide
            farther ones in the other units' views. Overrides `distance`.
        exposure : float, optional
            ms.
        snr : float, optional
            Signal-to-noise ratio over all sub-images, dB, instead of an exposure.
        generator : torch.Generator, optional
            Seeds the noise.

        Returns
        -------
        Raw

        Raises
        ------
        InputError
            If the scene has NaN or negative values or does not cover the band, or if neither or
            both of `exposure` and `snr` are given, or the SNR cannot be reached, or if the filters
            are sequential.
        """
        if (exposure is None) == (snr is None):
            raise InputError("Give either an exposure in ms or an SNR in dB.")
        rate = self.rate(scene, distance=distance, depth=depth)
        if exposure is None:
            assert snr is not None
            exposure = self.sensor.exposure_for(self.fields(rate), snr)
        return self.expose(rate, exposure, generator)

    def capture_sequence(
        self,
        scene: DataArray | Iterable[DataArray],
        *,
        exposure: float,
        distance: float = 300.0,
        generator: Generator | None = None,
    ) -> Iterator[Raw]:
        """Take the frames of a sequence, one through each filter.

        Parameters
        ----------
        scene : DataArray, (y, x, wavelength), or one for each exposure if it moves
        exposure : float
            Of all frames together, ms.
        distance, generator : as in `capture`

        Yields
        ------
        Raw

        Raises
        ------
        InputError
            As `capture`, and if the camera's filters are not sequential.
        """
        count = self.design.channels
        if self.design.filters.layout != "sequential":
            raise InputError("This camera sees all of its filters at once; use Camera.capture.")
        still = self.rate(scene, distance=distance) if isinstance(scene, DataArray) else None
        scenes = [scene] * count if isinstance(scene, DataArray) else scene
        for channel, one in enumerate(itertools.islice(scenes, count)):
            rates = self.rate(one, distance=distance) if still is None else still
            yield self.expose(rates[channel], exposure / count, generator)

    def capture_dark(self, exposure: float, *, generator: Generator | None = None) -> Raw:
        """Take a frame with the lens covered."""
        return self.expose(np.zeros(self.design.sensor_shape, np.float32), exposure, generator)

    def truth(
        self, scene: DataArray, *, distance: float = 300.0, depth: np.ndarray | None = None
    ) -> Truth:
        """Return what a perfect reconstruction of a capture would be; for judging only."""
        values = self._values(scene)
        size = self.design.field.size
        rows, columns = (middle(size, length) for length in values.shape[:2])
        seen = values[np.ix_(rows, columns)]
        cube = labelled(seen, self.design.wavelength, attributes=scene.attrs)
        far = self.design.array.pitch / 1000 * self.design.focal
        plane = np.full(values.shape[:2], distance) if depth is None else np.asarray(depth)
        return Truth(cube, far / plane[np.ix_(rows, columns)], self.design.centres)

    def expose(self, rate: np.ndarray, exposure: float, generator: Generator | None = None) -> Raw:
        """Take a frame of the photoelectrons per ms, (rows, columns), that `rate` returned."""
        if not exposure > 0:
            raise InputError(f"The exposure must be a positive number of ms, not {exposure}.")
        if rate.ndim > 2:
            raise InputError(
                f"This camera takes {len(rate)} exposures one after another, no single raw frame; "
                "use Camera.capture_sequence."
            )
        frame = self.sensor.expose(rate, exposure, generator=generator)
        return Raw(frame, exposure, {"camera": self.serial, "bits": self.design.sensor.bits})

    def fields(self, image: np.ndarray) -> np.ndarray:
        """Return the pixels within the units' fields, (M, size, size)."""
        size = self.design.field.size
        corner = np.rint(self.design.centres - (size - 1) / 2).astype(int)
        return np.stack([image[..., y : y + size, x : x + size] for y, x in corner])
