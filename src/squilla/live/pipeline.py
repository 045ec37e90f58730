"""From live frames to what a page shows: the newest one, measured, reconstructed if wanted."""

import threading
import time
import traceback
from collections import deque
from typing import Any

import numpy as np

from squilla.calibration.alignment import Measurement, measure
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.live.protocol import Picture, Spectra
from squilla.live.record import Recorder
from squilla.live.source import FrameSource
from squilla.live.stored import StoredCube, spectral_colours
from squilla.reconstruction.reconstructor import Reconstructor

_ATTENTION = 2.0
"""Seconds after the last look at it for which a live view goes on measuring."""


class LiveFrame:
    """One frame: its measurement, and its cube once somebody wants to see it."""

    def __init__(
        self, number: int, measurement: Measurement, model: Reconstructor, told: dict[str, Any]
    ):
        self.number = number
        self._measurement, self._model, self._told = measurement, model, told
        self._cube: StoredCube | None = None
        self._lock = threading.Lock()

    def cube(self) -> StoredCube:
        """Return the reconstruction; worked out once."""
        with self._lock:
            if self._cube is None:
                start = time.perf_counter()
                cube = self._model.reconstruct(self._measurement)
                valid = cube.isel(wavelength=0, drop=True).copy(
                    data=self._measurement.valid.all(-1).numpy()
                )
                self._cube = StoredCube(cube, {"valid": valid}, title="live")
                self._told["stages"]["reconstruct"] = 1000 * (time.perf_counter() - start)
            return self._cube

    def picture(self, ask: Picture) -> tuple[np.ndarray, dict[str, Any]]:
        """Answer as a stored cube does."""
        return self.cube().picture(ask)

    def spectra(self, ask: Spectra) -> tuple[np.ndarray, dict[str, Any]]:
        """Answer as a stored cube does."""
        return self.cube().spectra(ask)

    def status(self) -> dict[str, Any]:
        """Return exposure, saturation, alignment, the times of the stages."""
        return self._told


class LiveSource:
    """A camera as a source of the page: always the newest frame, measured in a thread of its own.

    Nothing queues: a frame that nobody had time for is replaced by the next. While nobody looks
    and nothing is recorded, frames are only taken off the camera.

    Parameters
    ----------
    source : FrameSource
    calibration : Calibration
    model : Reconstructor
    title : str
    recorder : Recorder, optional
        Where frames go when the page asks to record.
    distance : float, optional
        Of the scene, mm; found from each frame if not given.
    """

    def __init__(
        self,
        source: FrameSource,
        calibration: Calibration,
        model: Reconstructor,
        *,
        title: str = "live",
        recorder: Recorder | None = None,
        distance: float | None = None,
    ):
        if calibration.lattice is None or calibration.pixels is None:
            raise InputError("A live view needs a calibration made by `squilla calibrate`.")
        self._source, self._calibration, self._model = source, calibration, model
        self._title, self._recorder, self._distance = title, recorder, distance
        self._frame: LiveFrame | None = None
        self._trouble: str | None = None
        self._frozen, self._step = False, threading.Event()
        self._looked = time.monotonic()
        self._times: deque[float] = deque(maxlen=20)
        self._number = 0
        self._ended = threading.Event()
        self._first = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    # --- what the server asks -------------------------------------------------------------------

    def describe(self) -> dict[str, Any]:
        """Return what a page must know before it asks."""
        assert self._calibration.lattice is not None
        rows, columns = self._calibration.lattice.field
        wavelength = np.asarray(self._calibration.wavelength, float)
        return {
            "title": self._title,
            "rows": rows,
            "columns": columns,
            "wavelength": wavelength.tolist(),
            "colours": spectral_colours(wavelength),
            "quantity": "photon radiance",
            "unit": "",
            "by_need": False,
            "live": True,
            "adjustable": self._source.exposure is not None,
            "records": self._recorder is not None,
            "facts": {"model": self._model.name},
            "layers": [
                {
                    "name": "valid", "label": "valid", "unit": "",
                    "spectral": False, "truth": True,
                }
            ],
        }  # fmt: skip

    def now(self) -> LiveFrame:
        """Return the newest frame, or InputError if there has been none that could be measured."""
        self._looked = time.monotonic()
        frame = self._frame
        if frame is None:
            self._first.wait(5.0)
            frame = self._frame
        if frame is None:
            raise InputError(self._trouble or "The camera has not sent a frame yet.")
        return frame

    def control(self, name: str, value: float | bool | None) -> dict[str, Any]:
        """Follow a wish of the page and return how things stand then."""
        if name == "exposure":
            if value is None or isinstance(value, bool):
                raise InputError("The exposure must be a number of ms.")
            self._source.exposure = float(value)
        elif name == "frozen":
            self._frozen = bool(value)
        elif name == "step":
            self._frozen = True
            self._step.set()
        elif name == "recording":
            if self._recorder is None:
                raise InputError("Nothing is recorded: start with --record and a place to write.")
            self._recorder.start() if value else self._recorder.stop()
        return {"exposure": self._source.exposure, "frozen": self._frozen} | self._recorded()

    def close(self) -> None:
        """End the thread, the recording and the camera."""
        self._ended.set()
        self._thread.join(10)
        if self._recorder is not None:
            self._recorder.stop()
        self._source.close()

    # --- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                start = time.perf_counter()
                raw = self._source.read(timeout=5.0)
                taken = time.perf_counter() - start
                if self._waits():
                    continue
                self._publish(raw, taken)
                self._trouble = None
            except InputError as error:  # a dark frame, a lost camera: told, not fatal
                self._tell(str(error))
            except Exception as error:  # a fault of ours: the view goes on and says so
                traceback.print_exc()
                self._tell(f"A frame could not be shown ({type(error).__name__}: {error}).")

    def _waits(self) -> bool:
        """Tell whether the frame just read is not to be shown."""
        recording = self._recorder is not None and self._recorder.running
        if self._step.is_set():
            self._step.clear()
            return False
        if self._frozen:
            return True
        return not recording and time.monotonic() - self._looked > _ATTENTION

    def _publish(self, raw: Raw, taken: float) -> None:
        start = time.perf_counter()
        measurement = measure(raw, self._calibration, distance=self._distance)
        spent = time.perf_counter() - start
        self._times.append(time.monotonic())
        told = self._status(raw) | {
            "snr": measurement.provenance["snr"],
            "distance": measurement.provenance["distance"],
            "alignment": measurement.provenance["alignment_score"],
            "stages": {"frame": 1000 * taken, "measure": 1000 * spent},
        }
        self._number += 1
        frame = LiveFrame(self._number, measurement, self._model, told)
        if self._recorder is not None and self._recorder.running:
            self._recorder.offer(raw, frame.cube)
        self._frame = frame
        self._first.set()

    def _status(self, raw: Raw) -> dict[str, Any]:
        pixels, counts = self._calibration.pixels, self._source.statistics
        assert pixels is not None
        times = self._times
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None
        return {
            "rate": rate,
            "dropped": counts.skipped + counts.incomplete + counts.lost,
            "exposure": raw.exposure,
            "saturated": float(np.mean(raw.frame[::4, ::4] >= pixels.saturation)),
            "frozen": self._frozen,
            "error": None,
        } | self._recorded()

    def _recorded(self) -> dict[str, Any]:
        recorder = self._recorder
        if recorder is None:
            return {"recording": False, "recorded": 0, "missed": 0, "record_error": None}
        return {
            "recording": recorder.running,
            "recorded": recorder.written,
            "missed": recorder.missed,
            "record_error": recorder.error,
        }

    def _tell(self, trouble: str) -> None:
        """Show a trouble with the last good frame, once."""
        last = self._frame
        if trouble != self._trouble and last is not None:
            told = last.status() | {"error": trouble}
            self._number += 1
            frame = LiveFrame(self._number, last._measurement, self._model, told)
            frame._cube = last._cube
            self._frame = frame
        self._trouble = trouble
        self._first.set()
        self._ended.wait(0.05)
