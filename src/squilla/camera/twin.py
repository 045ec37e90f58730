"""The digital twin: what the designed camera would record of a scene."""

import hashlib
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Generator, Tensor
from xarray import DataArray

from squilla.camera import channels, lens, warp
from squilla.camera.blur import Blur, shift
from squilla.camera.design import CameraDesign
from squilla.camera.sensor import ImageSensor
from squilla.errors import InputError
from squilla.files.cube import labelled
from squilla.files.raw import Raw
from squilla.optics.filters import FilterArray
from squilla.optics.tables import MeasuredFilters
from squilla.spectra import resample


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


_MARGIN = 16
"""Pixels around a window that the blur may bring in."""


class Camera:
    """A camera that exists only as numbers.

    Parameters
    ----------
    design : CameraDesign, str or Path
        A design, its TOML file, or "thesis".

    Notes
    -----
    A scene is a DataArray (y, x, wavelength) of relative photon radiance; a value of 1 is
    ``design.light.radiance``. One sample falls on one sensor pixel, the middle of the scene on the
    axis of the reference unit (half a pixel beside it where scene and field are not both even or
    both odd), in the orientation of the sub-images. Beyond its edge a scene goes on as its mirror
    image. A scene with depth is blurred by the defocus of a few depths, interpolated in between.

    Filters and blur at a field angle are interpolated between a few angles, linearly in the squared
    angle; the blur over wavelength and angle is a sum of a few separable terms. So one unit's
    sub-image is, with the frequency response v_r and the shift s,

        image(q) = V(q) F^-1[ exp(-2 pi i f s) sum_r v_r(f) F[ sum_a w_a(q) sum_k B_ark X_k ] ](q).
    """

    def __init__(self, design: CameraDesign | str | Path = "thesis"):
        self.design = design if isinstance(design, CameraDesign) else CameraDesign.load(design)
        self.sensor = ImageSensor(self.design)
        self.windows = [lens.lit(self.design, unit) for unit in range(self.design.units)]

    @cached_property
    def filters(self) -> FilterArray | MeasuredFilters:
        """The filters, with a method ``transmittance(wavelength, angle)``."""
        return channels.filters_of(self.design)

    @cached_property
    def angles(self) -> np.ndarray:
        """Field angles between which filters and blur are interpolated, (A,) rad.

        Evenly in the squared angle: four up to the field's corner, and beyond to the last lit one
        two, or up to six where nothing confines the light.
        """
        size = np.array([self.design.field.size / np.sqrt(2), self._farthest])
        corner, last = np.arctan(size / self.design.focal) ** 2
        last = max(last, 1.01 * corner)  # a narrow stop may leave the corners dark
        beyond = min(max(2, int(last / corner / 4)), 6)
        return np.sqrt([*np.linspace(0, corner, 4), *np.linspace(corner, last, beyond + 1)[1:]])

    @property
    def _farthest(self) -> float:
        """Largest distance of a lit pixel from its lens' axis, px."""
        reach = [
            [
                max(centre - part.start, part.stop - centre)
                for part, centre in zip(w, c, strict=True)
            ]
            for w, c in zip(self.windows, self.design.centres, strict=True)
        ]
        return float(np.hypot(*np.array(reach).T).max())

    def response(self, angle: ArrayLike) -> np.ndarray:
        """Return the photoelectrons per ms of a scene of value 1 in each band.

        Through the filters alone, before vignetting and what misses them.

        Parameters
        ----------
        angle : array, (A,)
            Field angle, rad.

        Returns
        -------
        array, (A, M, K), e-/ms
        """
        return channels.response(self.design, self.filters, angle)

    @cached_property
    def clear_response(self) -> np.ndarray:
        """Photoelectrons per ms of a scene of value 1 in each band, without any filter, (K,)."""
        return channels.clear_response(self.design)

    def sensitivity(self, angle: ArrayLike) -> np.ndarray:
        """Return the true sensitivity, (A, M, K) DN/ms; for judging a calibration only.

        What leaks beside the filters is its mean around the axis.
        """
        return channels.seen(self.design, self.filters, angle) / self.design.sensor.gain

    @cached_property
    def _node_response(self) -> np.ndarray:
        return self.response(self.angles)

    @cached_property
    def serial(self) -> str:
        """Name and short digest of the design: what a real camera's serial number would be.

        A filter table counts by what it holds, not by where it lies.
        """
        filters = self.design.filters.model_copy(update={"table": None})
        figures = self.design.model_copy(update={"filters": filters})
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
        rows, columns = (_middle(size, length) for length in values.shape[:2])
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

    # --- light on the sensor ------------------------------------------------------------------

    def flat_rate(self, light: np.ndarray) -> np.ndarray:
        """Return the photoelectrons per ms of an evenly lit surface, in the shape of `rate`."""
        light = np.asarray(light, float)
        rates = self._node_response @ light
        leaking = self.design.filters.gap * self.clear_response @ light
        total = np.zeros(self._frames, np.float32)
        for channel in range(self.design.channels):
            view, part = self._behind(total, channel)
            geometry = self._geometry[self._unit(channel)]
            square, share, leak = (np.ascontiguousarray(each[part]) for each in geometry)
            # A mosaic's pixels lie apart in memory, which compiled loops do not take.
            light_of_channel = np.zeros(square.shape, np.float32)
            warp.add_flat(square, share, self.angles**2, rates[:, channel], light_of_channel)
            view += light_of_channel + share * leak * leaking
        return total

    def rate(
        self, scene: DataArray, *, distance: float = 300.0, depth: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the photoelectrons per ms of a scene, without noise.

        Returns
        -------
        array, (rows, columns) float32; (M, rows, columns) for the exposures of a sequence
        """
        values = torch.from_numpy(self._values(scene))
        plane = self._disparity(distance, depth, values.shape[:2])
        layers = _layers(plane)
        blur = self._blur(layers)
        reference = self.design.centres[self.design.field.reference]
        baselines = (self.design.centres - reference) / self.design.pitch
        margin = _MARGIN + int(
            np.ceil(np.abs(plane - np.mean(plane)).max() * np.abs(baselines).max())
        )
        tallest = np.max(
            [[part.stop - part.start for part in window] for window in self.windows], 0
        )
        height, width = (_fast_length(int(length)) for length in tallest + 2 * margin + 6)
        size = (height, width)
        transfer = blur.on_grid(size)
        response = torch.from_numpy(self._node_response).float()
        pixels = values.reshape(-1, values.shape[-1])

        def seen(response: Tensor) -> np.ndarray:
            """What responses (A, K) see of every sample at each angle and term: (y, x, A, r)."""
            filtered = (response[:, None, :] * blur.weight).flatten(0, 1)
            return (pixels @ filtered.T).view(*values.shape[:2], *blur.weight.shape[:2]).numpy()

        gap = self.design.filters.gap * torch.from_numpy(self.clear_response).float()
        leaking = seen(gap.expand(len(response), -1)) if self.design.filters.gap else None
        total = np.zeros(self._frames, np.float32)
        for channel in range(self.design.channels):
            unit = self._unit(channel)
            light = (seen(response[:, channel]), leaking)
            image = self._project(
                light, unit, baselines[unit], plane, layers, margin, transfer, size
            )
            view, part = self._behind(total, channel)
            view += self._geometry[unit][1][part] * np.maximum(image[part], 0)
        return total

    @property
    def _frames(self) -> tuple[int, ...]:
        sequence = self.design.filters.layout == "sequential"
        return (self.design.channels, *self.design.sensor_shape)[not sequence :]

    def _unit(self, channel: int) -> int:
        """Return the lens before which, or behind which, a filter lies."""
        return channel if self.design.filters.layout == "array" else 0

    def _behind(self, frames: np.ndarray, channel: int) -> tuple[np.ndarray, tuple[slice, slice]]:
        """Return a view of the pixels behind a filter, and which of its lens' window they are."""
        window = self.windows[self._unit(channel)]
        match self.design.filters.layout:
            case "sequential":
                return frames[channel][window], (slice(None), slice(None))
            case "mosaic":
                tile = self.design.mosaic
                rows, columns = (
                    slice((int(place[0]) - span.start) % period, None, period)
                    for place, span, period in zip(
                        np.nonzero(tile == channel), window, tile.shape, strict=True
                    )
                )
                return frames[window][rows, columns], (rows, columns)
        return frames[window], (slice(None), slice(None))

    def _project(
        self,
        seen: tuple[np.ndarray, np.ndarray | None],
        unit: int,
        baseline: np.ndarray,
        plane: float | np.ndarray,
        layers: np.ndarray,
        margin: int,
        transfer: Tensor,
        size: tuple[int, int],
    ) -> np.ndarray:
        """Lay what a unit sees of every scene sample, (y, x, A, r), on its window, blurred.

        seen : through the filter, and through the gap beside it where that is clear.
        """
        start = np.array([part.start for part in self.windows[unit]])
        stop = np.array([part.stop for part in self.windows[unit]])
        rows, columns = stop - start
        middle = float(np.mean(plane))
        on_axis = start - self.design.centres[unit]
        # Scene position of the window's first pixel, and of the first pixel of the canvas around.
        field = self.design.field.size
        centre = [_first(field, length) + (field - 1) / 2 for length in seen[0].shape[:2]]
        origin = on_axis - middle * baseline + centre
        first = np.floor(origin).astype(int) - margin - 2
        position = on_axis + first - origin
        place = (first, position, self.design.focal, self.angles**2, size)
        canvas = warp.weigh(seen[0], *place)
        if seen[1] is not None:
            rows_of_canvas, columns_of_canvas = (
                at + np.arange(length) for at, length in zip(position, size, strict=True)
            )
            leak = self._through(rows_of_canvas, columns_of_canvas)[1]
            canvas += leak * warp.weigh(seen[1], *place)
        if not isinstance(plane, np.ndarray):
            transfer = transfer[0] * shift(origin - first, size)
            spectrum = (torch.fft.rfft2(torch.from_numpy(canvas)) * transfer).sum(0)
            return torch.fft.irfft2(spectrum, s=size).numpy()[:rows, :columns]
        # The blur comes last: the soft edge of a near thing moves with it.
        view, hit = warp.relief(canvas, plane, first, origin - _MARGIN, middle, baseline, size)
        spectrum = torch.zeros(transfer.shape[-2:], dtype=torch.complex64)
        for layer, each in enumerate(transfer):
            share = np.interp(hit, layers, np.eye(len(layers))[layer]).astype(np.float32)
            spectrum += (torch.fft.rfft2(torch.from_numpy(view * share)) * each).sum(0)
        image = torch.fft.irfft2(spectrum, s=size).numpy()
        return image[_MARGIN : _MARGIN + rows, _MARGIN : _MARGIN + columns]

    def _blur(self, layers: np.ndarray) -> Blur:
        """Return the blur at some disparities, px per lens pitch."""
        inner = np.minimum(
            self.angles, self.angles[3]
        )  # outside the field it stays as in its corner
        cycles = np.linspace(0, np.sqrt(0.5), 96)
        far = self.design.array.pitch / 1000 * self.design.focal
        transfer = [
            lens.transfer_function(self.design, inner, far / float(layer), cycles)
            for layer in layers
        ]
        blur = Blur.of(np.stack(transfer, 2), cycles)
        return blur.displaced(lens.lateral_colour(self.design, inner, far / float(layers.mean())))

    @cached_property
    def _geometry(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of every pixel of each unit's window, (H, W) float32: the squared field angle, the share
        of light that comes through the filter, and for how much of it some comes beside it.
        """
        geometry = []
        for unit, window in enumerate(self.windows):
            rows, columns = (
                np.arange(part.start, part.stop) - centre
                for part, centre in zip(window, self.design.centres[unit], strict=True)
            )
            tangent = np.hypot(rows[:, None], columns[None, :]) / self.design.focal
            through, leak = self._through(rows, columns)
            share = lens.vignetting(self.design, unit, rows, columns) * through
            angle = np.arctan(tangent) ** 2
            geometry.append((angle.astype(np.float32), share.astype(np.float32), leak))
        return geometry

    def _through(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the share of light through the filter, and the ratio of what misses it to that.

        rows, columns : px against the lens' axis; the result is (H, W) float32.
        """
        coarse = [np.linspace(axis[0], axis[-1], 41) for axis in (rows, columns)]
        table = lens.through_filter(self.design, coarse[0][:, None], coarse[1][None, :])
        table = resample(table, coarse[1], columns)  # smooth: 41 nodes are plenty
        through = resample(table.T, coarse[0], rows).T.astype(np.float32)
        return through, (1 - through) / np.maximum(through, 1e-6)

    def _disparity(self, distance: float, depth: np.ndarray | None, shape):
        far = self.design.array.pitch / 1000 * self.design.focal
        nearest = self.design.lens.focal_length / 1000 * 5
        if depth is None:
            if not nearest < distance < np.inf:
                raise InputError(
                    f"The distance must be a number of mm above {nearest:g}, not {distance:g}."
                )
            return far / distance
        depth = np.asarray(depth, float)
        if depth.shape != tuple(shape):
            raise InputError(
                f"The depth map has shape {depth.shape}, the scene {tuple(shape)}; make them agree."
            )
        if not np.all(np.isfinite(depth)) or depth.min() <= nearest:
            raise InputError(f"Every depth must be finite and above {nearest:g} mm.")
        return far / depth

    def _values(self, scene: DataArray) -> np.ndarray:
        """Return a scene on the camera's wavelengths, (y, x, K) float32; checks it first."""
        if set(scene.dims) != {"y", "x", "wavelength"} or "wavelength" not in scene.coords:
            raise InputError(
                "A scene is a DataArray with dimensions (y, x, wavelength) and a wavelength "
                f"coordinate in nm; this one has {tuple(scene.dims)}."
            )
        scene = scene.transpose("y", "x", "wavelength")
        values = np.ascontiguousarray(
            resample(scene.values, scene.wavelength.values, self.design.wavelength), np.float32
        )
        if not np.isfinite(values).all():
            raise InputError("The scene holds NaN or infinite values; fill them before capturing.")
        if values.min() < 0:
            raise InputError("The scene holds negative radiance; clip it at zero before capturing.")
        return values


def _layers(plane: float | np.ndarray) -> np.ndarray:
    """Return the disparities at which the defocus is computed, rising; one for a plane.

    From one to the next its radius changes by 0.4 px at the most.
    """
    if not isinstance(plane, np.ndarray):
        return np.array([plane])
    low, high = float(plane.min()), float(plane.max())
    return np.linspace(low, high, 1 + max(1, int(np.ceil(high - low))))


def _first(size: int, length: int) -> int:
    """Return the index at which the middle `size` samples of an axis begin."""
    return (length - size) // 2


def _middle(size: int, length: int) -> np.ndarray:
    """Return the indices of the middle `size` samples of an axis that goes on mirrored."""
    index = (_first(size, length) + np.arange(size)) % (2 * length)
    return np.where(index < length, index, 2 * length - 1 - index)


def _fast_length(length: int) -> int:
    from scipy.fft import next_fast_len

    return int(next_fast_len(length, real=True) or length)
