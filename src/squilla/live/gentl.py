"""Cameras through the GenTL producers of their vendors, by the library harvesters."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from squilla.errors import InputError
from squilla.live.connection import Arrival, CameraInfo, CameraLost, Region
from squilla.live.pixel_format import FORMATS

PATH = "GENICAM_GENTL64_PATH"
"""Environment variable in which vendors' installers list the folders of their producers."""

_SEARCH = 2000
"""Milliseconds that a producer may take to find its cameras."""

_EXPOSURE, _GAIN = ("ExposureTime", "ExposureTimeAbs"), ("Gain", "GainRaw")
"""Names of the standard, and those of cameras older than it."""


def producers() -> list[Path]:
    """Return the GenTL producers (.cti) that the environment lists."""
    listed = [Path(part) for part in os.environ.get(PATH, "").split(os.pathsep) if part]
    found = []
    for place in listed:
        found += sorted(place.glob("*.cti")) if place.is_dir() else [place]
    return [path for path in found if path.is_file()]


def cameras() -> list[CameraInfo]:
    """Return the cameras that the producers find.

    Raises
    ------
    InputError
        If harvesters is not installed, there is no producer, or one cannot be loaded.
    """
    harvester = _harvester()
    try:
        return [_info(device) for device in harvester.device_info_list]
    finally:
        harvester.reset()


def _harvester() -> Any:
    """Load all producers and let them look for cameras."""
    try:
        from harvesters.core import Harvester  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "Vendors' GenTL producers need the Python package harvesters: "
            "pip install 'squilla[genicam]'."
        ) from error
    files = producers()
    if not files:
        raise InputError(
            f"No GenTL producer is known: {PATH} must list the folder of your camera vendor's .cti "
            "file; its installer mostly sets it."
        )
    harvester = Harvester()
    try:
        with _refusals("The GenTL producers cannot be loaded"):
            for file in files:
                harvester.add_file(str(file), check_existence=True, check_validity=True)
            harvester.timeout_for_update = _SEARCH
            harvester.update()
    except BaseException:
        harvester.reset()
        raise
    return harvester


def _info(device: Any) -> CameraInfo:
    told = {name: _told(device, name, "") for name in ("id_", "vendor", "model", "serial_number")}
    return CameraInfo(
        f"gentl:{told['id_']}", told["vendor"], told["model"], told["serial_number"] or told["id_"]
    )


def _genicam() -> tuple[Any, Any]:
    """Return the modules of features and of transport that harvesters stands on."""
    from genicam import genapi, gentl  # pyright: ignore  # no types, and not always installed

    return genapi, gentl


@contextmanager
def _refusals(what: str) -> Iterator[None]:
    """Turn what GenTL and GenApi raise into one sentence; what says that nobody is there, lost."""
    genapi, gentl = _genicam()

    gone = (gentl.IoException, gentl.InvalidHandleException, gentl.TimeoutException)
    try:
        yield
    except InputError:
        raise
    except gone as error:
        raise CameraLost(f"{what}: {_first_line(error)}.") from error
    except (gentl.GenericException, genapi.GenericException, ValueError, OSError) as error:
        raise InputError(f"{what}: {_first_line(error)}.") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


class GentlConnection:
    """A `Connection` by a vendor's GenTL producer.

    Parameters
    ----------
    name : str
        Identity or serial number of the camera; empty for the first one found.

    Raises
    ------
    InputError
        If there is no such camera or producer, or another program controls the camera.
    """

    buffers = 8

    def __init__(self, name: str):
        self._acquirer: Any = None
        self._harvester = _harvester()
        try:
            self._open(name)
        except BaseException:
            self.close()
            raise

    def _open(self, name: str) -> None:
        found = [(device, _info(device)) for device in self._harvester.device_info_list]
        chosen = [
            (device, info)
            for device, info in found
            if not name or name in (info.source.removeprefix("gentl:"), info.serial)
        ]
        if not chosen:
            known = ", ".join(info.source for _, info in found) or "none"
            raise CameraLost(f"There is no free GenTL camera {name!r}; found were: {known}.")
        device, self.info = chosen[0]
        self._what = f"The camera {self.info} refuses or does not answer"
        with _refusals(f"The camera {self.info} cannot be opened; another program may use it"):
            self._acquirer = self._harvester.create(device)
        with _refusals(self._what):
            self._acquirer.num_buffers = self.buffers
            self._nodes = self._acquirer.remote_device.node_map
            for automatic in ("ExposureAuto", "GainAuto"):
                self._put(automatic, "Off", optional=True)
            self.formats = list(self._node("PixelFormat").symbolics)
            exposures = self._bounds(*_EXPOSURE)
            self.exposures = exposures and (exposures[0] / 1000, exposures[1] / 1000)
            self.gains = self._bounds(*_GAIN)

    # --- nodes --------------------------------------------------------------------------------

    def _node(self, *names: str, writable: bool = False) -> Any:
        """Return the first of these features that the camera has now, else None."""
        access = _genicam()[0].EAccessMode
        modes = {access.WO, access.RW} | (set() if writable else {access.RO})
        nodes = (self._nodes.get_node(name) for name in names if self._nodes.has_node(name))
        return next((node for node in nodes if node.get_access_mode() in modes), None)

    def _bounds(self, *names: str) -> tuple[float, float] | None:
        node = self._node(*names)
        return None if node is None else (float(node.min), float(node.max))

    def _value(self, *names: str) -> float | None:
        with _refusals(self._what):
            node = self._node(*names)
            return None if node is None else float(node.value)

    def _put(self, name: str, value: Any, *others: str, optional: bool = False) -> None:
        """Set the first feature of these names, a whole number where it must be one."""
        genapi, _ = _genicam()
        with _refusals(self._what):
            node = self._node(name, *others, writable=True)
            if node is not None:
                node.value = round(value) if isinstance(node, genapi.IInteger) else value
            elif not optional:
                raise InputError(f"The camera {self.info} has no {name} to set.")

    def _do(self, command: str) -> None:
        with _refusals(self._what):
            node = self._node(command)
            if node is None:
                raise InputError(f"The camera {self.info} cannot do {command}.")
            node.execute()

    # --- settings -----------------------------------------------------------------------------

    @property
    def sensor(self) -> Region:
        # Where the sensor's own size is not told, the size of the first picture is all there is.
        sides = (self._value(f"Sensor{side}", f"{side}Max", side) for side in ("Height", "Width"))
        return Region(*(int(side or 0) for side in sides))

    def set_format(self, name: str) -> None:
        self._put("PixelFormat", name)

    @property
    def exposure(self) -> float | None:
        value = self._value(*_EXPOSURE)
        return None if value is None else value / 1000

    def set_exposure(self, exposure: float) -> None:
        self._put(_EXPOSURE[0], 1000 * exposure, *_EXPOSURE[1:])

    @property
    def gain(self) -> float | None:
        return self._value(*_GAIN)

    def set_gain(self, gain: float) -> None:
        self._put(_GAIN[0], gain, *_GAIN[1:])

    @property
    def region(self) -> Region:
        sides = (self._value(name) for name in ("Height", "Width", "OffsetY", "OffsetX"))
        return Region(*(int(side or 0) for side in sides))

    def set_region(self, region: Region) -> None:
        for name in ("OffsetX", "OffsetY"):  # makes room for the size
            self._put(name, 0, optional=True)
        self._put("Width", region.columns)
        self._put("Height", region.rows)
        self._put("OffsetX", region.column, optional=not region.column)
        self._put("OffsetY", region.row, optional=not region.row)

    def set_trigger(self, source: str | None) -> None:
        self._put("TriggerSelector", "FrameStart", optional=True)
        if source is not None:
            self._put("TriggerSource", source)
        self._put("TriggerMode", "Off" if source is None else "On", optional=source is None)

    def fire(self) -> None:
        self._do("TriggerSoftware")

    # --- frames -------------------------------------------------------------------------------

    def start(self) -> None:
        self._put("AcquisitionMode", "Continuous", optional=True)
        with _refusals(self._what):
            self._acquirer.start()
            self._sent = FORMATS[self._node("PixelFormat").value].code, self.region

    def stop(self) -> None:
        with _refusals(self._what):
            self._acquirer.stop()

    def receive(self, timeout: float) -> Arrival | None:
        """As in `Connection`, but harvesters drops incomplete frames; they are missed as lost."""
        if not self._acquirer.is_acquiring():
            return None  # what was on the way went with the stop
        with _refusals(self._what):
            # A time-out of nothing would be taken to wait without end.
            buffer = self._acquirer.try_fetch(timeout=max(timeout, 1e-6), is_raw=True)
            if buffer is None:
                return None
            code, region = self._sent
            shape = _told(buffer, "height", region.rows), _told(buffer, "width", region.columns)
            start = _told(buffer, "image_offset", 0)
            return Arrival(
                complete=True,
                number=_told(buffer, "frame_id", None),
                timestamp=_told(buffer, "timestamp_ns", 0),
                code=_told(buffer, "pixel_format", code),
                shape=shape,
                data=np.frombuffer(buffer.raw_buffer, np.uint8, offset=start),
                release=lambda: buffer.parent.queue_buffer(buffer),
            )

    def alive(self) -> bool:
        try:
            self._value("Width")
        except InputError:
            return False
        return True

    def close(self) -> None:
        self._harvester.reset()  # stops, closes and unloads


def _told(of: Any, name: str, otherwise: Any) -> Any:
    """Return what a producer tells of a thing; what it does not know it refuses to tell."""
    _, gentl = _genicam()
    try:
        return getattr(of, name)
    except gentl.GenericException:
        return otherwise
