"""From live frames to what a page shows: the newest one, measured, reconstructed if wanted."""

import threading
import time
import traceback
import warnings
from collections import deque
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numba
import numpy as np
from numba.np.ufunc.parallel import threading_layer

from squilla.calibration.alignment import Measurement, measure
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.live.answer import spectral_colours
from squilla.live.exposure import better_exposure
from squilla.live.frame import LiveFrame
from squilla.live.record import Recorder
from squilla.live.source import FrameSource, say
from squilla.reconstruction.reconstructor import Reconstructor

_ATTENTION = 2.0
"""Seconds after the last look at it for which a live view goes on measuring."""

_REPEAT = 10.0
"""Seconds for which the terminal is not told how a trouble changes."""

_PATIENCE = 60.0
"""Seconds for which a page waits for the first frame: on a new machine code is compiled before."""


class LiveSource:
    """A camera as a source of the page: always the newest frame, measured in a thread of its own.

    Nothing queues: a frame that nobody had time for is replaced by the next. While nobody looks
    and nothing is recorded, frames are only taken off the camera. The places of the sub-images in
    one frame are where the search begins in the next.

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
        source.check_size(calibration.pixels.bias.shape)
        source.report = self._heard
        self._source, self._calibration, self._pixels = source, calibration, calibration.pixels
        self._model, self._before = model, None
        self._title, self._recorder, self._distance = title, recorder, distance
        self._frame: LiveFrame | None = None
        self._trouble: str | None = None
        self._said, self._automatic = 0.0, False
        self._turn: AbstractContextManager = nullcontext()
        self._frozen, self._step = False, threading.Event()
        self._looked = time.monotonic()
        self._times: deque[float] = deque(maxlen=20)
        self._number = 0
        self._ended = threading.Event()
        self._first = threading.Event()  # a frame, or why there is none
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
            "exposures": self._source.exposures,
            "gains": self._source.gains,
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
            self._first.wait(_PATIENCE)
            frame = self._frame
        if frame is None:
            raise InputError(self._trouble or "The camera has not sent a frame yet.")
        return frame

    def control(self, name: str, value: float | bool | None) -> dict[str, Any]:
        """Follow a wish of the page and return how things stand then."""
        if name in ("exposure", "gain"):
            if value is None or isinstance(value, bool):
                raise InputError(f"The {name} must be a number.")
            self._automatic = self._automatic and name != "exposure"
            setattr(self._source, name, float(value))
        elif name == "automatic":
            if self._source.exposures is None:
                raise InputError("The exposure of this source cannot be set.")
            self._automatic = bool(value)
        elif name == "frozen":
            self._frozen = bool(value)
        elif name == "step":
            self._frozen = True
            self._step.set()
        elif name == "recording":
            if self._recorder is None:
                raise InputError("Nothing is recorded: start with --record and a place to write.")
            self._recorder.start() if value else self._recorder.stop()
        return self._switches()

    def close(self) -> None:
        """End the camera, the thread and the recording."""
        self._ended.set()
        self._source.close()  # whoever waits for a frame is told so
        self._thread.join(30)
        if self._recorder is not None:
            self._recorder.stop()

    # --- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        # One frame is measured while another is reconstructed: each by half of the cores.
        numba.set_num_threads(max(1, numba.get_num_threads() // 2))
        while not self._ended.is_set():
            try:
                start = time.perf_counter()
                raw = self._source.read(timeout=5.0)
                taken = time.perf_counter() - start
                if self._automatic:
                    self._expose(raw)
                if self._waits():
                    continue
                self._publish(raw, taken)
                self._trouble = None
            except InputError as error:  # a dark frame, a lost camera: told, not fatal
                if not self._ended.is_set():
                    self._tell(str(error))
                    self._ended.wait(0.05)
            except Exception as error:  # a fault of ours: the view goes on and says so
                traceback.print_exc()
                self._tell(f"A frame could not be shown ({type(error).__name__}: {error}).")
                self._ended.wait(0.05)

    def _expose(self, raw: Raw) -> None:
        """Set a better exposure, judged by a frame that was taken with the present one."""
        limits = self._source.exposures
        if limits is not None and raw.exposure == self._source.exposure:
            better = better_exposure(raw, self._pixels, limits)
            if better is not None:
                self._source.exposure = better

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
        with self._turn, warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", UserWarning)
            self._before = measurement = measure(
                raw, self._calibration, distance=self._distance, start=self._last_placed()
            )
        spent = time.perf_counter() - start
        if not self._number and threading_layer() == "workqueue":
            self._turn = threading.Lock()  # that pool of threads serves one at a time, or ends us
        self._times.append(time.monotonic())
        provenance = measurement.provenance
        told = self._status(raw) | {
            "snr": provenance["snr"],
            "distance": provenance["distance"],
            "alignment": provenance["alignment_score"],
            "notice": str(warned[0].message) if warned else None,
            "stages": {"frame": 1000 * taken, "measure": 1000 * spent},
        }
        self._number += 1
        frame = LiveFrame(
            self._number, measurement, self._model, told, self._turn, self._switches, self._frame
        )
        if self._recorder is not None and self._recorder.running:
            self._recorder.offer(raw, frame.cube)
        self._frame = frame
        self._first.set()

    def _last_placed(self) -> Measurement | None:
        """Return the last measurement if its places came from the scene: the next begins there."""
        before = self._before
        placed = before is not None and before.provenance["alignment"] == "from the scene"
        return before if placed else None

    def _status(self, raw: Raw) -> dict[str, Any]:
        counts, times = self._source.statistics, self._times
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None
        few = raw.frame[::8, ::8]
        return {
            "rate": rate,
            "dropped": counts.skipped + counts.lost,
            "incomplete": counts.incomplete,
            "exposure": raw.exposure,
            "taken": raw.metadata.get("frame"),
            "saturated": float(np.mean(few >= self._pixels.saturation)),
            "error": None,
        }

    def _switches(self) -> dict[str, Any]:
        """Return how what the page can set stands."""
        told = {
            "exposure": self._source.exposure,
            "gain": self._source.gain,
            "automatic": self._automatic,
            "frozen": self._frozen,
        }
        recorder = self._recorder
        if recorder is None:
            return told | {"recording": False, "recorded": 0, "missed": 0, "record_error": None}
        return told | {
            "recording": recorder.running,
            "recorded": recorder.written,
            "missed": recorder.missed,
            "record_error": recorder.error,
        }

    def _heard(self, sentence: str) -> None:
        """Hand on what happens to the camera."""
        say(sentence)
        self._show(sentence)

    def _tell(self, trouble: str) -> None:
        """Tell why a frame is not shown; in the terminal not with each frame."""
        now = time.monotonic()
        if self._trouble is None or (trouble != self._trouble and now - self._said > _REPEAT):
            self._said = now
            say(trouble)
        self._show(trouble)

    def _show(self, trouble: str) -> None:
        """Show a trouble on the page, with the last good frame."""
        last = self._frame
        if trouble != self._trouble and last is not None:
            self._number += 1
            self._frame = last.again(self._number, trouble)
        self._trouble = trouble
        self._first.set()
