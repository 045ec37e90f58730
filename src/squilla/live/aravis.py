"""GigE Vision and USB3 Vision cameras through libaravis, called by ctypes."""

import ctypes
import ctypes.util
from collections.abc import Callable, Mapping
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64
from ctypes import c_void_p as pointer
from functools import cache
from itertools import chain
from types import SimpleNamespace
from typing import Any

import numpy as np

from squilla.errors import InputError
from squilla.live.connection import Arrival, CameraInfo, CameraLost, Region

INSTALL = (
    "The library that speaks to GenICam cameras, libaravis, is not on this machine; install it: "
    "apt-get install libaravis-0.8-0 (Debian, Ubuntu) or brew install aravis (macOS)."
)

_SONAMES = ("libaravis-0.8.so.0", "libaravis-0.10.so.0")

_SOCKET_BUFFER = 16 << 20
"""Bytes that the system is asked to hold between camera and library; it grants net.core.rmem_max.
The library's own choice, one frame, loses packets whenever its thread has to wait for its turn."""

_RETENTION = 200_000
"""Microseconds without a packet after which a frame is given up. The library's own 100 000 pass
while a busy computer lets its thread wait."""

_COMPLETE = 0  # ArvBufferStatus
_GONE = (2, 4, 5)  # ArvDeviceError: not connected, transfer error, time-out
_INTEGER, _DOUBLE = 6 << 2, 15 << 2  # GType
_CONTROL = 0x0A00  # GigE Vision bootstrap register: who controls the camera

_PLAIN = {
    "arv_update_device_list": (None,),
    "arv_get_n_devices": (c_uint,),
    "arv_get_device_id": (c_char_p, c_uint),
    "arv_get_device_vendor": (c_char_p, c_uint),
    "arv_get_device_model": (c_char_p, c_uint),
    "arv_get_device_serial_nbr": (c_char_p, c_uint),
    "arv_get_device_address": (c_char_p, c_uint),
    "arv_camera_get_device": (pointer, pointer),
    "arv_camera_is_gv_device": (c_int, pointer),
    "arv_camera_gv_set_stream_options": (None, pointer, c_int),
    "arv_gv_device_is_controller": (c_int, pointer),
    "arv_buffer_new": (pointer, c_size_t, pointer),
    "arv_buffer_get_status": (c_int, pointer),
    "arv_buffer_get_data": (pointer, pointer, POINTER(c_size_t)),
    "arv_buffer_get_frame_id": (c_uint64, pointer),
    "arv_buffer_get_timestamp": (c_uint64, pointer),
    "arv_buffer_get_image_width": (c_int, pointer),
    "arv_buffer_get_image_height": (c_int, pointer),
    "arv_buffer_get_image_pixel_format": (c_uint32, pointer),
    "arv_stream_push_buffer": (None, pointer, pointer),
    "arv_stream_try_pop_buffer": (pointer, pointer),
    "arv_stream_timeout_pop_buffer": (pointer, pointer, c_uint64),
    "g_object_unref": (None, pointer),
    "g_object_set_property": (None, pointer, c_char_p, pointer),
    "g_value_init": (pointer, pointer, c_size_t),
    "g_value_set_int": (None, pointer, c_int),
    "g_value_set_double": (None, pointer, c_double),
    "g_free": (None, pointer),
    "g_error_free": (None, pointer),
}
"""Result and arguments of each function."""

_RANGE = (None, pointer, POINTER(c_double), POINTER(c_double))
_FALLIBLE = {
    "arv_camera_new": (pointer, c_char_p),
    "arv_camera_get_vendor_name": (c_char_p, pointer),
    "arv_camera_get_model_name": (c_char_p, pointer),
    "arv_camera_get_device_serial_number": (c_char_p, pointer),
    "arv_camera_get_sensor_size": (None, pointer, POINTER(c_int), POINTER(c_int)),
    "arv_camera_dup_available_pixel_formats_as_strings": (pointer, pointer, POINTER(c_uint)),
    "arv_camera_set_pixel_format_from_string": (None, pointer, c_char_p),
    "arv_camera_is_exposure_time_available": (c_int, pointer),
    "arv_camera_is_exposure_auto_available": (c_int, pointer),
    "arv_camera_set_exposure_time_auto": (None, pointer, c_int),
    "arv_camera_get_exposure_time": (c_double, pointer),
    "arv_camera_set_exposure_time": (None, pointer, c_double),
    "arv_camera_get_exposure_time_bounds": _RANGE,
    "arv_camera_is_gain_available": (c_int, pointer),
    "arv_camera_is_gain_auto_available": (c_int, pointer),
    "arv_camera_set_gain_auto": (None, pointer, c_int),
    "arv_camera_get_gain": (c_double, pointer),
    "arv_camera_set_gain": (None, pointer, c_double),
    "arv_camera_get_gain_bounds": _RANGE,
    "arv_camera_get_region": (None, pointer, *[POINTER(c_int)] * 4),
    "arv_camera_set_region": (None, pointer, *[c_int] * 4),
    "arv_camera_set_trigger": (None, pointer, c_char_p),
    "arv_camera_clear_triggers": (None, pointer),
    "arv_camera_software_trigger": (None, pointer),
    "arv_camera_set_acquisition_mode": (None, pointer, c_int),
    "arv_camera_start_acquisition": (None, pointer),
    "arv_camera_stop_acquisition": (None, pointer),
    "arv_camera_get_payload": (c_uint, pointer),
    "arv_camera_create_stream_full": (pointer, pointer, pointer, pointer, pointer),
    "arv_device_read_register": (c_int, pointer, c_uint64, POINTER(c_uint32)),
}
"""Those that take the place of an error as well; it is raised."""


class _Error(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


@cache
def load() -> ctypes.CDLL:
    """Open libaravis of either interface version; InputError where there is none."""
    elsewhere = map(ctypes.util.find_library, ("aravis-0.8", "aravis-0.10"))
    for name in chain(_SONAMES, filter(None, elsewhere)):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise InputError(INSTALL)


def bind(table: Mapping[str, tuple]) -> dict[str, Any]:
    """Return functions of libaravis by name, given their results and arguments."""
    handle, bound = load(), {}
    for name, (result, *arguments) in table.items():
        function = getattr(handle, name, None) or handle[name.removesuffix("_full")]
        function.restype, function.argtypes = result, arguments
        bound[name] = function
    return bound


@cache
def library() -> SimpleNamespace:
    """Return the functions that a client calls, those that can fail raising what went wrong."""
    place = POINTER(POINTER(_Error))
    fallible = bind({name: (*types, place) for name, types in _FALLIBLE.items()})
    return SimpleNamespace(
        **bind(_PLAIN), **{name: _raising(function) for name, function in fallible.items()}
    )


def _raising(function: Callable) -> Callable:
    def call(*arguments):
        error = POINTER(_Error)()
        result = function(*arguments, byref(error))
        if not error:
            return result
        code, said = error.contents.code, error.contents.message.decode(errors="replace")
        library().g_error_free(error)
        kind = CameraLost if code in _GONE else InputError
        raise kind(f"The camera refuses or does not answer: {said}.")

    return call


class _Value(ctypes.Structure):
    """A GValue: a type and a number."""

    _fields_ = (("type", c_size_t), ("data", c_uint64 * 2))


def set_property(target: int, name: str, value: float) -> None:
    """Set a property of a GObject: a real number by a float, anything countable by an int."""
    lib, holder = library(), _Value()
    if isinstance(value, float):
        lib.g_value_init(byref(holder), _DOUBLE)
        lib.g_value_set_double(byref(holder), value)
    else:
        lib.g_value_init(byref(holder), _INTEGER)
        lib.g_value_set_int(byref(holder), value)
    lib.g_object_set_property(target, name.encode(), byref(holder))


def cameras() -> list[CameraInfo]:
    """Return the cameras that answer on all networks and USB ports; takes about a second."""
    lib = library()
    lib.arv_update_device_list()

    def text(name: str, index: int) -> str:
        return (getattr(lib, f"arv_get_device_{name}")(index) or b"").decode(errors="replace")

    return [
        CameraInfo(
            source=f"genicam:{text('id', index)}",
            **{name: text(name, index) for name in ("vendor", "model", "address")},
            serial=text("serial_nbr", index),
        )
        for index in range(lib.arv_get_n_devices())
    ]


class AravisConnection:
    """A `Connection` by libaravis.

    Parameters
    ----------
    name : str
        Identity, address or serial number of the camera; empty for the first one found.

    Raises
    ------
    InputError
        If there is no such camera, or another program controls it.
    """

    buffers = 8  # 144 MB at 12 megapixels of 12 bits

    def __init__(self, name: str):
        self._lib = lib = library()
        try:
            self._camera = lib.arv_camera_new(name.encode() or None)
        except InputError as error:
            raise CameraLost(
                f"There is no camera {name!r} on the network or USB; is it plugged in and powered, "
                "and in the same network? `squilla cameras` lists those that answer."
                if name
                else "No GenICam camera answers; plug one in, or start `squilla twin-camera`."
            ) from error
        self._stream = None
        try:
            self.device = lib.arv_camera_get_device(self._camera)
            self._network = bool(lib.arv_camera_is_gv_device(self._camera))
            if self._network and not lib.arv_gv_device_is_controller(self.device):
                raise InputError(
                    f"The camera {name or 'found'} is controlled by another program; close that "
                    "one first. A program that was killed holds it for a few seconds more."
                )
            self._learn(name)
        except BaseException:
            self.close()
            raise

    def _learn(self, name: str) -> None:
        """Ask who the camera is and what it can do, and take its automatics out."""
        lib, camera = self._lib, self._camera
        vendor, model, serial = (
            (getattr(lib, f"arv_camera_get_{what}")(camera) or b"").decode(errors="replace")
            for what in ("vendor_name", "model_name", "device_serial_number")
        )
        self.info = CameraInfo(f"genicam:{name}", vendor, model, serial)
        count = c_uint()
        names = lib.arv_camera_dup_available_pixel_formats_as_strings(camera, byref(count))
        listed = ctypes.cast(names, POINTER(c_char_p))[: count.value] if names else []
        self.formats = [(one or b"").decode() for one in listed]
        lib.g_free(names)
        self.exposures = self.gains = None
        if lib.arv_camera_is_exposure_time_available(camera):
            if lib.arv_camera_is_exposure_auto_available(camera):
                lib.arv_camera_set_exposure_time_auto(camera, 0)
            low, high = self._range(lib.arv_camera_get_exposure_time_bounds)
            self.exposures = low / 1000, high / 1000
        if lib.arv_camera_is_gain_available(camera):
            if lib.arv_camera_is_gain_auto_available(camera):
                lib.arv_camera_set_gain_auto(camera, 0)
            self.gains = self._range(lib.arv_camera_get_gain_bounds)

    def _integers(self, function: Callable, count: int) -> list[int]:
        places = [c_int() for _ in range(count)]
        function(self._camera, *map(byref, places))
        return [place.value for place in places]

    def _range(self, function: Callable) -> tuple[float, float]:
        low, high = c_double(), c_double()
        function(self._camera, byref(low), byref(high))
        return low.value, high.value

    @property
    def sensor(self) -> Region:
        columns, rows = self._integers(self._lib.arv_camera_get_sensor_size, 2)
        return Region(rows, columns)

    def set_format(self, name: str) -> None:
        self._lib.arv_camera_set_pixel_format_from_string(self._camera, name.encode())

    @property
    def exposure(self) -> float | None:
        if self.exposures is None:
            return None
        return self._lib.arv_camera_get_exposure_time(self._camera) / 1000

    def set_exposure(self, exposure: float) -> None:
        self._lib.arv_camera_set_exposure_time(self._camera, 1000 * exposure)

    @property
    def gain(self) -> float | None:
        return None if self.gains is None else self._lib.arv_camera_get_gain(self._camera)

    def set_gain(self, gain: float) -> None:
        self._lib.arv_camera_set_gain(self._camera, gain)

    @property
    def region(self) -> Region:
        x, y, width, height = self._integers(self._lib.arv_camera_get_region, 4)
        return Region(height, width, y, x)

    def set_region(self, region: Region) -> None:
        self._lib.arv_camera_set_region(
            self._camera, region.column, region.row, region.columns, region.rows
        )

    def set_trigger(self, source: str | None) -> None:
        if source is None:
            self._lib.arv_camera_clear_triggers(self._camera)
        else:
            self._lib.arv_camera_set_trigger(self._camera, source.encode())

    def fire(self) -> None:
        self._lib.arv_camera_software_trigger(self._camera)

    def start(self) -> None:
        lib, camera = self._lib, self._camera
        self._drop_stream()
        if self._network:
            # No packet socket: only root may have one, and it does not see what this machine sends
            # to itself by the address of another network.
            lib.arv_camera_gv_set_stream_options(camera, 1)
        self._stream = lib.arv_camera_create_stream_full(camera, None, None, None)
        if self._network:
            set_property(self._stream, "socket-buffer", 0)  # of fixed size
            set_property(self._stream, "socket-buffer-size", _SOCKET_BUFFER)
            set_property(self._stream, "frame-retention", _RETENTION)
        self._payload = lib.arv_camera_get_payload(camera)
        for _ in range(self.buffers):
            lib.arv_stream_push_buffer(self._stream, lib.arv_buffer_new(self._payload, None))
        lib.arv_camera_set_acquisition_mode(camera, 0)  # continuous
        lib.arv_camera_start_acquisition(camera)

    def stop(self) -> None:
        self._lib.arv_camera_stop_acquisition(self._camera)

    def receive(self, timeout: float) -> Arrival | None:
        lib = self._lib
        if timeout > 0:
            buffer = lib.arv_stream_timeout_pop_buffer(self._stream, round(1e6 * timeout))
        else:
            buffer = lib.arv_stream_try_pop_buffer(self._stream)
        if not buffer:
            return None
        complete = lib.arv_buffer_get_status(buffer) == _COMPLETE
        number, shape, code, data = None, (0, 0), 0, np.empty(0, np.uint8)
        if complete:  # else the packet that tells all this may be lost, and older facts stand there
            number = lib.arv_buffer_get_frame_id(buffer)
            shape = tuple(
                getattr(lib, f"arv_buffer_get_image_{side}")(buffer) for side in ("height", "width")
            )
            code = lib.arv_buffer_get_image_pixel_format(buffer)
            start = lib.arv_buffer_get_data(buffer, byref(c_size_t()))  # its size is not kept up
            held = (ctypes.c_uint8 * self._payload).from_address(start)
            data = np.ctypeslib.as_array(held)
        return Arrival(
            complete=complete,
            number=number,
            timestamp=lib.arv_buffer_get_timestamp(buffer),
            code=code,
            shape=shape,
            data=data,
            release=lambda: lib.arv_stream_push_buffer(self._stream, buffer),
        )

    def alive(self) -> bool:
        try:
            if not self._network:
                self._lib.arv_camera_get_payload(self._camera)
                return True
            value = c_uint32()
            self._lib.arv_device_read_register(self.device, _CONTROL, byref(value))
        except CameraLost:
            return False
        return value.value != 0 and bool(self._lib.arv_gv_device_is_controller(self.device))

    def close(self) -> None:
        self._drop_stream()
        if self._camera:
            self._lib.g_object_unref(self._camera)
            self._camera = None

    def _drop_stream(self) -> None:
        if self._stream:
            self._lib.g_object_unref(self._stream)  # waits for its thread, frees its buffers
            self._stream = None
