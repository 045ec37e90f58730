"""One live frame: measured, and of its cube only what somebody looks at."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from copy import copy
from typing import Any

import numpy as np
from xarray import DataArray

from squilla.calibration.alignment import Measurement
from squilla.live.answer import Answers
from squilla.reconstruction.linear import counted
from squilla.reconstruction.partial import Reconstruction
from squilla.reconstruction.reconstructor import Reconstructor


class LiveFrame(Answers):
    """Answers what a page asks of one frame.

    Parameters
    ----------
    number : int
        Of the frame, increasing.
    measurement : Measurement
    model : Reconstructor
    told : dict
        What the page shows of the frame; the time of reconstruction is added.
    turn : context manager
        Entered while reconstructing, where that must not go on beside other work.
    switches : callable
        Tells how what the page can set stands, now: a frame that was measured before it was
        changed may be shown after.
    before : LiveFrame, optional
        What was asked of the frame before is expected to be asked of this one too.
    """

    few_bands = True

    def __init__(
        self,
        number: int,
        measurement: Measurement,
        model: Reconstructor,
        told: dict[str, Any],
        turn: AbstractContextManager,
        switches: Callable[[], dict[str, Any]],
        before: "LiveFrame | None" = None,
    ):
        rows, columns, filters = measurement.y.shape
        seen = counted(measurement.y, measurement.valid) == filters
        valid = DataArray(seen.numpy(), dims=("y", "x"))
        super().__init__("live", (rows, columns), np.asarray(model.wavelength), {"valid": valid})
        self.number, self._told, self._turn, self._switches = number, told, turn, switches
        self._model, self._measurement = model, measurement
        self._looked: Reconstruction | None = None
        self._expected = [] if before is None else before._asked or before._expected
        self._asked: list[int] = []
        self._places: dict[int, tuple[int, int]] = {}  # of each decoded band
        self._planes: list[np.ndarray] = []

    def status(self) -> dict[str, Any]:
        """Return exposure, saturation, alignment, the times of the stages, how switches stand."""
        return self._switches() | self._told

    def again(self, number: int, trouble: str) -> "LiveFrame":
        """Return the same picture as another frame, of which a trouble is told."""
        other = copy(self)
        other.number, other._told = number, self._told | {"error": trouble}
        return other

    def cube(self) -> DataArray:
        """Return the whole reconstruction; worked out once."""
        with self._lock:
            return self._timed(lambda look: look.cube())

    def blocks(
        self, rows: slice, columns: slice, bands: slice = slice(None)
    ) -> Iterator[np.ndarray]:
        """Give a part of the cube in one piece."""
        wanted = list(range(len(self.wavelength))[bands])
        if len(wanted) < len(self.wavelength):
            yield self._decoded(wanted)[rows, columns]
        else:
            places = np.indices(self.shape)[:, rows, columns]
            height, width = places.shape[1:]
            with self._lock:
                found = self._timed(lambda look: look.spectra(*places.reshape(2, -1)))
            yield found.reshape(height, width, -1)

    def plane(self, band: int, rows: slice, columns: slice) -> np.ndarray:
        """Return a part of one band."""
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
                self._planes.append(self._timed(lambda look: look.bands(new)))
                group = len(self._planes) - 1
                self._places |= {band: (group, at) for at, band in enumerate(new)}
            places = [self._places[band] for band in bands]
        (group, first), last = places[0], places[-1][1]
        if places == [(group, at) for at in range(first, last + 1)]:
            return self._planes[group][..., first : last + 1]
        return np.stack([self._planes[group][..., at] for group, at in places], -1)

    def _timed(self, ask: Callable[[Reconstruction], Any]) -> Any:
        start = time.perf_counter()
        with self._turn:
            if self._looked is None:
                self._looked = self._model.look(self._measurement)
            found = ask(self._looked)
        stages = self._told["stages"]
        stages["decode"] = stages.get("decode", 0.0) + 1000 * (time.perf_counter() - start)
        return found
