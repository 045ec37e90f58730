"""The twin as a GigE Vision camera: a real one for every client, without any hardware."""

import ctypes
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_uint32, c_uint64
from ctypes import c_void_p as pointer
from importlib.resources import files as package_files
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from squilla.errors import InputError
from squilla.live import aravis
from squilla.live.connection import Region
from squilla.live.genicam import LiveCamera
from squilla.live.pixel_format import FORMATS
from squilla.live.twin_frames import TwinFrames

_FILL = ctypes.CFUNCTYPE(None, pointer, pointer, c_uint32, c_uint32, c_uint32)
_SIMULATOR = {
    "arv_gv_fake_camera_new_full": (pointer, c_char_p, c_char_p, c_char_p),
    "arv_gv_fake_camera_get_fake_camera": (pointer, pointer),
    "arv_gv_fake_camera_is_running": (c_int, pointer),
    # The last argument is of version 0.9 and later; earlier ones do not look at it.
    "arv_fake_camera_set_fill_pattern": (None, pointer, _FILL, pointer, pointer),
    "arv_fake_camera_read_register": (c_int, pointer, c_uint32, POINTER(c_uint32)),
    "arv_fake_camera_write_register": (c_int, pointer, c_uint32, c_uint32),
    "arv_fake_camera_write_memory": (c_int, pointer, c_uint32, c_uint32, c_char_p),
    "arv_set_fake_camera_genicam_filename": (None, c_char_p),
    "arv_fake_device_get_fake_camera": (pointer, pointer),
    "arv_enable_interface": (None, c_char_p),
    "arv_disable_interface": (None, c_char_p),
    "arv_buffer_get_data": (pointer, pointer, POINTER(c_size_t)),
    "arv_buffer_get_frame_id": (c_uint64, pointer),
    "g_object_unref": (None, pointer),
}

# Registers of the simulator, those from 0x8000 on only of our XML.
_WIDTH, _HEIGHT, _COLUMN, _ROW = 0x100, 0x104, 0x130, 0x134
_SENSOR_HEIGHT, _SENSOR_WIDTH, _FORMAT = 0x118, 0x11C, 0x128
_GAIN, _EXPOSURE, _PERIOD, _PERIOD_WANTED = 0x110, 0x120, 0x138, 0x8000
_VENDOR, _MODEL, _SERIAL = 0x48, 0x68, 0x8040
_PACKET_SIZE, _PORT = 0x0D04, 3956

_JUMBO = 8192
"""Bytes of a packet; the loopback carries them, and there are fewer to lose."""

_LONGEST_SERIAL = 15
"""Letters of a serial number in GigE Vision's own registers; the XML tells the whole."""


def description() -> Path:
    """Return the GenICam description of the twin, an XML file."""
    return Path(str(package_files("squilla"))) / "live" / "twin_camera.xml"


class Simulation:
    """Lets a simulated camera of libaravis send the twin's frames.

    Parameters
    ----------
    camera : int
        Address of an ArvFakeCamera that was made with `description`.
    frames : TwinFrames
    rate : float
        Frames per second until a client asks for another; less where the exposure is longer.

    Attributes
    ----------
    sent : int
        Frames handed out so far.
    failure : Exception or None
        Why the last frame could not be made.

    Notes
    -----
    It must live as long as the simulated camera, whose thread calls it.
    """

    def __init__(self, camera: int, frames: TwinFrames, rate: float):
        rows, columns = frames.design.sensor_shape
        if columns % 4:
            raise InputError(f"A twin camera needs columns in fours; the design has {columns}.")
        if not 0.1 <= rate <= 1000:
            raise InputError(f"The frame rate must be 0.1 to 1000 frames/s, not {rate:g}.")
        self._camera, self._frames, self._lib = camera, frames, simulator()
        self.sent, self.failure = 0, None
        for register, value in (
            (_SENSOR_WIDTH, columns),
            (_SENSOR_HEIGHT, rows),
            (_WIDTH, columns),
            (_HEIGHT, rows),
            (_FORMAT, FORMATS["Mono12p"].code),
            (_EXPOSURE, round(1000 * frames.bright_exposure)),
            (_PERIOD, round(1e6 / rate)),
            (_PERIOD_WANTED, round(1e6 / rate)),
            (_PACKET_SIZE, _JUMBO),
        ):
            self._lib.arv_fake_camera_write_register(camera, register, value)
        for place, text in ((_VENDOR, "squilla"), (_MODEL, "twin"), (_SERIAL, frames.serial)):
            data = text.encode() + b"\0"
            self._lib.arv_fake_camera_write_memory(camera, place, len(data), data)
        self._fill = _FILL(self._send)  # the library does not keep it alive
        self._lib.arv_fake_camera_set_fill_pattern(camera, self._fill, None, None)

    def _register(self, address: int) -> int:
        value = c_uint32()
        self._lib.arv_fake_camera_read_register(self._camera, address, byref(value))
        return value.value

    def _send(self, buffer: int, _: int, exposure: int, gain: int, code: int) -> None:
        """Fill a frame; called from the library's thread with what the client has set."""
        try:
            region = Region(*map(self._register, (_HEIGHT, _WIDTH, _ROW, _COLUMN)))
            known = next(one for one in FORMATS.values() if one.code == code)
            number = self._lib.arv_buffer_get_frame_id(buffer)
            frame = self._frames.draw(number, exposure / 1000, gain / 100, region)
            frame >>= max(0, self._frames.design.sensor.bits - known.bits)
            start = self._lib.arv_buffer_get_data(buffer, byref(c_size_t()))
            place = (ctypes.c_uint8 * known.bytes_for(frame.size)).from_address(start)
            known.pack(frame, np.ctypeslib.as_array(place))
            period = max(self._register(_PERIOD_WANTED), exposure)
            self._lib.arv_fake_camera_write_register(self._camera, _PERIOD, period)
            self.sent += 1
        except Exception as error:  # the library cannot pass it on: whoever runs the camera will
            self.failure = error


class TwinCamera:
    """The twin on the network until `close`, or the end of the `with` block.

    Parameters
    ----------
    frames : TwinFrames
    rate : float
        Frames per second.
    address : str
        Network address of this machine at which it answers; 127.0.0.1 for this machine alone.
    lost : float
        Share of packets that get lost on the way, 0..1, to see how a client takes it.

    Raises
    ------
    InputError
        If libaravis is missing, or there is no such address, or another camera has it.
    """

    def __init__(
        self,
        frames: TwinFrames,
        *,
        rate: float = 5.0,
        address: str = "127.0.0.1",
        lost: float = 0.0,
    ):
        if not 0 <= lost <= 1:
            raise InputError(f"The share of lost packets must be 0 to 1, not {lost:g}.")
        self._lib = simulator()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((address, _PORT))
            except OSError as error:
                raise InputError(
                    f"No camera can answer at {address}, port {_PORT}: {error.strerror}. Another "
                    "twin camera may be running, or the address is not of this machine."
                ) from error
        serial = frames.serial[-_LONGEST_SERIAL:].encode()
        made = self._lib.arv_gv_fake_camera_new_full(
            address.encode(), serial, str(description()).encode()
        )
        self._simulator = made
        try:
            if not self._lib.arv_gv_fake_camera_is_running(made):
                raise InputError(
                    f"This machine has no network interface with the address {address}."
                )
            aravis.set_property(made, "gvsp-lost-ratio", float(lost))
            inner = self._lib.arv_gv_fake_camera_get_fake_camera(made)
            self._simulation = Simulation(inner, frames, rate)
        except BaseException:
            self.close()
            raise

    @property
    def sent(self) -> int:
        """Frames sent so far; raises what kept a frame from being made."""
        if self._simulation.failure is not None:
            raise self._simulation.failure
        return self._simulation.sent

    def close(self) -> None:
        """Take the camera off the network."""
        if self._simulator is not None:
            self._lib.g_object_unref(self._simulator)  # waits for its thread
            self._simulator = None

    def __enter__(self) -> "TwinCamera":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def camera_within(frames: TwinFrames, *, rate: float = 5.0) -> Iterator[LiveCamera]:
    """Open the twin as a camera inside this process, without any network.

    Parameters
    ----------
    frames : TwinFrames
    rate : float
        Frames per second.
    """
    lib, path = simulator(), str(description()).encode()
    lib.arv_set_fake_camera_genicam_filename(path)
    lib.arv_enable_interface(b"Fake")
    try:
        connection = aravis.AravisConnection("Fake_1")
    finally:
        lib.arv_disable_interface(b"Fake")  # nobody else is to find it
    try:
        inner = lib.arv_fake_device_get_fake_camera(connection.device)
        simulation = Simulation(inner, frames, rate)
    except BaseException:
        connection.close()
        raise
    with LiveCamera(lambda: connection, None, 0.0, None) as camera:
        yield camera
    if simulation.failure is not None:
        raise simulation.failure


def simulator() -> SimpleNamespace:
    """Return the functions of libaravis' simulated cameras; InputError if it is not installed."""
    return SimpleNamespace(**aravis.bind(_SIMULATOR))
