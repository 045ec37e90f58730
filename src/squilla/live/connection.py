"""What every way to a camera must be able to do: the seam between the libraries and `genicam`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from squilla.errors import InputError


class CameraLost(InputError):
    """A camera that answered before does not answer any more."""


@dataclass(frozen=True)
class CameraInfo:
    """Who a camera is.

    source : what `open_camera` takes, such as "genicam:Vendor-12345".
    address : where it is, as its library says; empty if unknown.
    """

    source: str
    vendor: str
    model: str
    serial: str
    address: str = ""

    def __str__(self) -> str:
        return f"{self.vendor} {self.model} {self.serial}"


@dataclass
class Statistics:
    """What became of the frames that a camera sent.

    delivered : handed to the reader.
    skipped : whole, but older than the one handed out, because the reader was slow.
    incomplete : packets of them were lost.
    lost : never seen: no packet came, or all buffers were full.
    reconnected : times that the camera was lost and came back.
    """

    delivered: int = 0
    skipped: int = 0
    incomplete: int = 0
    lost: int = 0
    reconnected: int = 0


@dataclass(frozen=True)
class Region:
    """The part of the sensor that is read, px."""

    rows: int
    columns: int
    row: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.rows} x {self.columns} px at ({self.row}, {self.column})"


@dataclass(frozen=True, eq=False)
class Arrival:
    """One frame as it came, in memory that is lent until `release` is called.

    complete : False if packets of it were lost.
    number : the camera's count; None where it was lost, which stands for the one after the last.
    timestamp : ns of the camera's own clock.
    code : of the pixel format.
    shape : (rows, columns).
    data : (bytes,) uint8.
    """

    complete: bool
    number: int | None
    timestamp: int
    code: int
    shape: tuple[int, int]
    data: np.ndarray
    release: Callable[[], None]


class Connection(Protocol):
    """An open camera. Every call returns within seconds, whatever the camera does.

    Each may raise `CameraLost`. `buffers` frames may wait to be received. Exposures are in ms, gain
    in the camera's own unit, mostly dB; both are None at a camera without. Settings change only
    while the camera stands still.
    """

    info: CameraInfo
    buffers: int
    formats: list[str]
    exposures: tuple[float, float] | None
    gains: tuple[float, float] | None

    @property
    def sensor(self) -> Region:
        """All of the sensor, whatever part of it is read."""
        ...

    def set_format(self, name: str) -> None: ...

    @property
    def exposure(self) -> float | None: ...
    def set_exposure(self, exposure: float) -> None: ...

    @property
    def gain(self) -> float | None: ...
    def set_gain(self, gain: float) -> None: ...

    @property
    def region(self) -> Region: ...
    def set_region(self, region: Region) -> None: ...

    def set_trigger(self, source: str | None) -> None:
        """Wait for a signal at `source`, such as "Software" or "Line1", or run free with None."""
        ...

    def fire(self) -> None:
        """Give the software trigger."""
        ...

    def start(self) -> None: ...
    def stop(self) -> None:
        """Stop the camera; what it sent before may still be received."""
        ...

    def receive(self, timeout: float) -> Arrival | None:
        """Return the oldest frame that waits; None if none comes within `timeout` s."""
        ...

    def alive(self) -> bool:
        """Ask the camera whether it is still there and still ours."""
        ...

    def close(self) -> None:
        """Let go of the camera; also when it is lost. Never raises."""
        ...
