"""One live frame: measured, and of its cube only what somebody looks at."""

import time
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from xarray import DataArray

from squilla.calibration.alignment import Measurement
from squilla.live.answer import Answers
from squilla.reconstruction.reconstructor import Reconstructor

_LARGE = 0.2
"""Share of the picture from which on a region's spectra are worth the whole cube."""


class Decoder:
    """Reconstructs some bands of all pixels, or all bands of some, where the model can.

    Parameters
    ----------
    model : Reconstructor
    """

    def __init__(self, model: Reconstructor):
        self.model = model
        self.selective = model.only([0]) is not None
        self._last: tuple[Sequence[int], Reconstructor] | None = None

    def bands(self, measurement: Measurement, bands: Sequence[int]) -> np.ndarray:
        """Return some bands of all pixels, (H, W, bands)."""
        last = self._last
        if last is None or last[0] != bands:
            some = self.model.only(bands)
            assert some is not None
            self._last = last = (bands, some)
        return last[1].reconstruct(measurement).values

    def pixels(self, measurement: Measurement, rows: slice, columns: slice) -> np.ndarray:
        """Return all bands of some pixels, (h, w, K)."""
        part = {
            name: None if (whole := getattr(measurement, name)) is None else whole[rows, columns]
            for name in ("y", "valid", "angle", "disparity", "snr")
        }
        return self.model.reconstruct(replace(measurement, **part)).values

    def cube(self, measurement: Measurement) -> DataArray:
        """Return all of the cube."""
        return self.model.reconstruct(measurement)


class LiveFrame(Answers):
    """Answers what a page asks of one frame.

    Parameters
    ----------
    number : int
        Of the frame, increasing.
    measurement : Measurement
    decoder : Decoder
    told : dict
        What the page shows of the frame; the time of reconstruction is added.
    before : LiveFrame, optional
        What was asked of the frame before is expected to be asked of this one too.
    """

    def __init__(
        self,
        number: int,
        measurement: Measurement,
        decoder: Decoder,
        told: dict[str, Any],
        before: "LiveFrame | None" = None,
    ):
        model = decoder.model
        valid = DataArray(measurement.valid.all(-1).numpy(), dims=("y", "x"))
        rows, columns, _ = measurement.y.shape
        super().__init__("live", (rows, columns), np.asarray(model.wavelength), {"valid": valid})
        self.number, self.few_bands = number, decoder.selective
        self._measurement, self._decoder, self._told = measurement, decoder, told
        self._expected = [] if before is None else before._asked or before._expected
        self._asked: list[int] = []
        self._places: dict[int, tuple[int, int]] = {}  # of each decoded band
        self._planes: list[np.ndarray] = []
        self._held: list[DataArray] = []  # the cube, once worked out

    def status(self) -> dict[str, Any]:
        """Return exposure, saturation, alignment, the times of the stages."""
        return self._told

    def again(self, number: int, told: dict[str, Any]) -> "LiveFrame":
        """Return the same picture as another frame, of which other things are told."""
        other = copy(self)
        other.number, other._told = number, told
        return other

    def cube(self) -> DataArray:
        """Return the whole reconstruction; worked out once."""
        with self._lock:
            if not self._held:
                self._held.append(self._timed(self._decoder.cube))
            return self._held[0]

    def blocks(
        self, rows: slice, columns: slice, bands: slice = slice(None)
    ) -> Iterator[np.ndarray]:
        """Give a part of the cube in one piece."""
        wanted = range(len(self.wavelength))[bands]
        share = len(range(self.shape[0])[rows]) * len(range(self.shape[1])[columns])
        share /= self.shape[0] * self.shape[1]
        if self._held or not self._decoder.selective:
            yield self.cube().values[rows, columns, bands]
        elif len(wanted) < len(self.wavelength):
            yield self._decoded(list(wanted))[rows, columns]
        elif share < _LARGE:
            yield self._timed(self._decoder.pixels, rows, columns)
        else:
            yield self.cube().values[rows, columns, bands]

    def plane(self, band: int, rows: slice, columns: slice) -> np.ndarray:
        """Return a part of one band."""
        if self._held or not self._decoder.selective:
            return self.cube().values[rows, columns, band]
        return self._decoded([band])[rows, columns, 0]

    def _decoded(self, bands: list[int]) -> np.ndarray:
        """Return some bands, (H, W, bands); with those not there yet come all that are expected."""
        with self._lock:
            self._asked += [band for band in bands if band not in self._asked]
            if not self._places.keys() >= set(bands):
                new = [
                    band
                    for band in dict.fromkeys(self._expected + bands)
                    if band not in self._places
                ]
                self._planes.append(self._timed(self._decoder.bands, new))
                group = len(self._planes) - 1
                self._places |= {band: (group, at) for at, band in enumerate(new)}
            places = [self._places[band] for band in bands]
        (group, first), last = places[0], places[-1][1]
        if places == [(group, at) for at in range(first, last + 1)]:
            return self._planes[group][..., first : last + 1]
        return np.stack([self._planes[group][..., at] for group, at in places], -1)

    def _timed(self, call, *arguments) -> Any:
        start = time.perf_counter()
        found = call(self._measurement, *arguments)
        stages = self._told["stages"]
        stages["decode"] = stages.get("decode", 0.0) + 1000 * (time.perf_counter() - start)
        return found
