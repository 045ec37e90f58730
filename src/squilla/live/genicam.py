"""Live cameras: open one, set it, and take its frames, the newest first, for as long as it takes.

with open_camera("genicam:Vendor-12345") as camera:
    camera.exposure = 20.0
    for raw in camera.frames():
        ...
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.live.connection import Arrival, CameraInfo, CameraLost, Connection, Region, Statistics
from squilla.live.pixel_format import FORMATS, best_format, pixel_format

_SLICE = 0.05
"""Seconds of one wait: after each, an interrupt is heard and another thread may set the camera."""

_SILENCE = 0.5
"""Seconds of silence, beyond the exposure, after which the camera is asked whether it lives."""

_SETTLING = 0.02
"""Seconds without a frame after which a stopped camera is taken to have sent its last."""

_PAUSE = 0.2
"""Seconds between two tries to find a lost camera."""

_WRAP = 65535
"""GigE Vision counts frames from 1 to 65 535 and starts again."""


def open_camera(
    source: str,
    *,
    pixel_format: str | None = None,
    patience: float = 30.0,
    report: Callable[[str], None] | None = None,
) -> "LiveCamera":
    """Open a camera.

    Parameters
    ----------
    source : str
        "genicam:" and the identity that `cameras` tells, or an address or serial number;
        "genicam:" alone takes the first one found. "gentl:" and an identity goes through the
        vendors' producers that the environment variable GENICAM_GENTL64_PATH lists.
    pixel_format : str, optional
        One of `squilla.live.pixel_format.FORMATS`. If not given, 12 bits with the least to send,
        or the next best that the camera has.
    patience : float
        Seconds for which a lost camera is looked for before `CameraLost` is raised.
    report : callable, optional
        Is told in one sentence that the camera was lost, and that it is back.

    Raises
    ------
    InputError
        If there is no such camera, another program controls it, or its formats are of no use.
    """
    way, _, name = source.partition(":")
    if way == "genicam":
        from squilla.live.aravis import AravisConnection as kind
    elif way == "gentl":
        from squilla.live.gentl import GentlConnection as kind
    else:
        raise InputError(
            f"A camera is named like genicam:ID or gentl:ID, not {source!r}; `squilla cameras` "
            "lists those that answer."
        )
    return LiveCamera(lambda: kind(name), pixel_format, patience, report)


class LiveCamera:
    """A camera that is open, made by `open_camera`; close it, or use it in a `with` block.

    Settings may be changed while frames come, from any thread: the camera then stands still for a
    moment, so that each frame carries the settings that it was taken with. They are set again when
    a lost camera comes back.
    """

    def __init__(
        self,
        connect: Callable[[], Connection],
        wanted_format: str | None,
        patience: float,
        report: Callable[[str], None] | None,
    ):
        self._connect, self._patience = connect, patience
        self.report = report or (lambda sentence: None)
        self._lock = threading.RLock()
        self._statistics, self._last = Statistics(), None
        self._streaming = self._gone = self._closed = False
        self._lost_since: float | None = None
        self._connection = connection = connect()
        try:
            if wanted_format is None:
                self.format = best_format(connection.formats)
            else:
                self.format = pixel_format(wanted_format)
                if wanted_format not in connection.formats:
                    raise InputError(
                        f"The camera {connection.info} has no {wanted_format}, but "
                        f"{', '.join(connection.formats)}."
                    )
            self._settings: dict[str, Any] = {"format": self.format.name, "trigger": None}
            self._adopt(connection)
        except BaseException:
            connection.close()
            raise

    def _adopt(self, connection: Connection) -> None:
        """Bring a camera that was just opened to the wanted settings."""
        for name, value in self._settings.items():
            getattr(connection, f"set_{name}")(value)
        self._connection, self._streaming, self._gone = connection, False, False
        self._read_back()

    def _read_back(self) -> None:
        """Remember what the camera made of its settings, which spares asking for every frame."""
        connection = self._connection
        self._exposure, self._gain = connection.exposure, connection.gain
        self._region, self._sensor = connection.region, connection.sensor

    def close(self) -> None:
        """Let go of the camera; another program may then open it."""
        with self._lock:
            if not self._closed:
                self._halt()
                self._closed = True
                self._connection.close()

    def __enter__(self) -> "LiveCamera":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- settings -----------------------------------------------------------------------------

    @property
    def info(self) -> CameraInfo:
        return self._connection.info

    @property
    def formats(self) -> list[str]:
        """Names of the camera's pixel formats that squilla can read."""
        return [name for name in FORMATS if name in self._connection.formats]

    @property
    def sensor(self) -> tuple[int, int]:
        """Rows and columns of the whole sensor."""
        return self._sensor.rows, self._sensor.columns

    @property
    def exposure(self) -> float | None:
        """Exposure, ms, as the camera rounded it; None at a camera without."""
        return self._exposure

    @exposure.setter
    def exposure(self, exposure: float) -> None:
        self._within("exposure", exposure, self._connection.exposures, " ms")
        self._set("exposure", float(exposure))

    @property
    def exposures(self) -> tuple[float, float] | None:
        """Least and largest exposure, ms; None at a camera without."""
        return self._connection.exposures

    @property
    def gains(self) -> tuple[float, float] | None:
        """Least and largest gain; None at a camera without."""
        return self._connection.gains

    @property
    def gain(self) -> float | None:
        """Gain in the camera's own unit, mostly dB; None at a camera without."""
        return self._gain

    @gain.setter
    def gain(self, gain: float) -> None:
        self._within("gain", gain, self._connection.gains)
        self._set("gain", float(gain))

    @property
    def region(self) -> Region:
        """Part of the sensor that is read."""
        return self._region

    @region.setter
    def region(self, region: Region) -> None:
        whole = self._sensor
        if (
            min(region.row, region.column) < 0
            or min(region.rows, region.columns) < 1
            or region.row + region.rows > whole.rows
            or region.column + region.columns > whole.columns
        ):
            raise InputError(
                f"The region {region} leaves the sensor of {whole.rows} x {whole.columns} px."
            )
        self._set("region", region)

    @property
    def trigger(self) -> str | None:
        """What starts an exposure: "Software", a line such as "Line1", or None to run free."""
        return self._settings["trigger"]

    @trigger.setter
    def trigger(self, source: str | None) -> None:
        self._set("trigger", source)

    def fire(self) -> None:
        """Start an exposure of a camera whose trigger is "Software"."""
        if self.trigger != "Software":
            raise InputError('Only a camera whose trigger is "Software" can be fired.')
        with self._lock:
            self._run()
            self._ask(self._connection.fire)

    def _within(
        self, name: str, value: float, limits: tuple[float, float] | None, unit: str = ""
    ) -> None:
        if limits is None:
            raise InputError(f"The camera {self.info} has no {name} to set.")
        if not limits[0] <= value <= limits[1]:
            raise InputError(
                f"The {name} of {self.info} goes from {limits[0]:g} to {limits[1]:g}{unit}, not "
                f"{value:g}."
            )

    def _set(self, name: str, value: Any) -> None:
        with self._lock:
            before = dict(self._settings)
            self._settings[name] = value
            if self._gone:
                return  # it is set when the camera is back
            streaming = self._streaming
            self._halt()
            try:
                self._ask(getattr(self._connection, f"set_{name}"), value)
                self._read_back()
            except CameraLost:
                raise  # the reader brings the camera back, with the new value
            except InputError:
                self._settings = before
                self._read_back()  # it may have taken a part
                raise
            if streaming:
                self._run()

    def check_size(self, shape: tuple[int, int]) -> None:
        """Raise InputError unless frames have this shape, (rows, columns), as a calibration's."""
        region = self._region
        if (region.rows, region.columns) != tuple(shape):
            raise InputError(
                f"The camera sends frames of {region.rows} x {region.columns} px, the calibration "
                f"was made for {shape[0]} x {shape[1]}: set the region that it was made with, or "
                "calibrate anew."
            )

    # --- frames -------------------------------------------------------------------------------

    @property
    def statistics(self) -> Statistics:
        """What became of the frames so far; a copy."""
        return replace(self._statistics)

    def frames(self, *, timeout: float = 5.0) -> Iterator[Raw]:
        """Yield whole frames without end, the newest each time; older ones are skipped.

        Parameters
        ----------
        timeout : float
            Seconds for which a camera that answers may send none, beyond its exposure.

        Raises
        ------
        CameraLost
            If the camera is gone and does not come back within the patience given.
        InputError
            If it sends no whole frame in time, or frames of another format or size.
        """
        try:
            while True:
                yield self.read(timeout=timeout)
        finally:
            with self._lock:
                self._halt()

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return the newest whole frame not handed out yet, waiting for one if needed.

        Parameters and errors as in `frames`.
        """
        before = replace(self._statistics)
        began = asked = time.monotonic()
        while True:
            try:
                with self._lock:
                    self._run()
                    arrival = self._newest()
                    if arrival is not None:
                        return self._raw(arrival)
                    exposure = (self._exposure or 0.0) / 1000
                    now = time.monotonic()
                    if now - asked > _SILENCE + exposure:
                        asked = now
                        self._lost_since = self._lost_since or now
                        if not self._connection.alive():
                            raise CameraLost(f"The camera {self.info} does not answer any more.")
                        self._lost_since = None
                if now - began > timeout + exposure:
                    raise InputError(self._why_none(before, timeout))
                time.sleep(0.001)  # lets a thread in that waits to set the camera
            except CameraLost as loss:
                self._recover(loss)
                began = asked = time.monotonic()

    def _ask(self, call: Callable, *arguments: Any) -> None:
        """Let the camera do something; a refusal of one that is gone means that it is gone."""
        try:
            call(*arguments)
        except CameraLost:
            raise
        except InputError as error:
            if self._connection.alive():
                raise
            raise CameraLost(f"The camera {self.info} does not answer any more.") from error

    def _run(self) -> None:
        """Let the camera send, if it does not yet."""
        if self._closed:
            raise InputError("The camera was closed; open it again.")
        if self._gone:
            raise CameraLost(f"The camera {self.info} is away.")
        if not self._streaming:
            self._last = None  # many cameras begin to count anew
            self._ask(self._connection.start)
            self._streaming = True

    def _halt(self) -> None:
        """Stop the camera and count what was still on the way, without handing it out."""
        if not self._streaming:
            return
        self._streaming = False
        try:
            self._connection.stop()
        except CameraLost:
            return  # it stands still
        while (arrival := self._connection.receive(_SETTLING)) is not None:
            self._count(arrival)
            self._statistics.skipped += arrival.complete
            arrival.release()

    def _newest(self) -> Arrival | None:
        """Wait a moment for a frame; of several, return the last whole one, release the rest."""
        newest, received = None, 0
        arrival = self._connection.receive(_SLICE)
        while arrival is not None:
            received += 1
            self._count(arrival)
            if arrival.complete:
                if newest is not None:
                    self._skip(newest)
                newest = arrival
            else:
                arrival.release()
            arrival = self._connection.receive(0.0)
        if newest is not None and received >= self._connection.buffers and self.trigger is None:
            self._skip(newest)  # all places were full: the camera has sent newer ones in vain
            return None
        return newest

    def _count(self, arrival: Arrival) -> None:
        """Count a frame that came, and those that the gap before it tells of."""
        self._lost_since = None
        self._statistics.incomplete += not arrival.complete
        last, number = self._last, arrival.number
        if number is None:
            self._last = None if last is None else last + 1
            return
        if last is not None:
            step = number - last
            if step < -_WRAP // 2 and last <= _WRAP + 1:  # the count began anew between the two
                step += _WRAP
            self._statistics.lost += max(step - 1, 0)
        self._last = number

    def _skip(self, arrival: Arrival) -> None:
        self._statistics.skipped += 1
        arrival.release()

    def _raw(self, arrival: Arrival) -> Raw:
        """Turn what came into a raw frame and give its memory back."""
        try:
            if arrival.code != self.format.code:
                names = {one.code: name for name, one in FORMATS.items()}
                came = names.get(arrival.code, f"the unknown {arrival.code:#010x}")
                raise InputError(
                    f"The camera {self.info} sends {came} although {self.format.name} was set; "
                    "another program may have changed it. Open it again."
                )
            frame = self.format.unpack(arrival.data, arrival.shape)
        finally:
            arrival.release()
        self._statistics.delivered += 1
        facts = {
            "camera": self.info.serial,
            "model": f"{self.info.vendor} {self.info.model}",
            "bits": self.format.bits,
            "pixel_format": self.format.name,
            "gain": self._gain,
            "row": self._region.row,
            "column": self._region.column,
            "frame": arrival.number,
            "timestamp": arrival.timestamp,
        }
        return Raw(frame, self._exposure, facts)

    def _why_none(self, before: Statistics, timeout: float) -> str:
        incomplete = self._statistics.incomplete - before.incomplete
        if incomplete:
            return (
                f"The camera {self.info} sends, but all {incomplete} frames of the last "
                f"{timeout:g} s had lost packets; lower its frame rate, see that the network "
                "carries it, or raise the system's net.core.rmem_max."
            )
        if self.trigger is not None:
            return f"No frame in {timeout:g} s: no trigger came at {self.trigger}."
        return (
            f"The camera {self.info} answers but sent no frame in {timeout:g} s; a firewall may "
            "keep its packets out, or another program may have changed its trigger."
        )

    # --- a lost camera ------------------------------------------------------------------------

    def _recover(self, loss: CameraLost) -> None:
        """Look for the lost camera until it is back, set it again and count it.

        Raises
        ------
        CameraLost
            If it is not back within the patience, counted from its last frame.
        """
        with self._lock:
            if self._closed:
                raise loss
            since = self._lost_since = self._lost_since or time.monotonic()
            self._streaming, self._gone = False, True
            self.report(f"{loss} Looking for it for {self._patience:g} s.")
            self._connection.close()
        why: InputError = loss
        while (waited := time.monotonic() - since) < self._patience and not self._closed:
            try:
                connection = self._connect()
            except InputError as error:  # gone, or it still believes itself under our control
                why = error
                time.sleep(_PAUSE)
                continue
            with self._lock:
                try:
                    if self._closed:
                        raise loss
                    self._adopt(connection)
                except InputError as error:  # gone again, or not fully awake
                    why = error
                    connection.close()
                    continue
                self._statistics.reconnected += 1
            self.report(f"The camera {self.info} is back after {waited:.1f} s.")
            return
        self._lost_since = None  # whoever asks again lets it be looked for again
        raise CameraLost(
            f"The camera {self.info} was lost and did not come back within {self._patience:g} s; "
            f"see its cable and power. The last try said: {why}"
        ) from why
