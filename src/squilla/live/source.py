"""Where live frames come from: a camera, the twin before a moving scene, a folder played again."""

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from xarray import DataArray

from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.files.raw import Raw, read_raws
from squilla.live.connection import Statistics
from squilla.live.twin_frames import TwinFrames, views

Limits = tuple[float, float] | None
"""Least and largest value that can be set; None where nothing can."""

EXPOSURES = (0.001, 1e5)
"""Exposures of the twin, ms."""

GAINS = (0.0, 24.0)
"""Gains of the twin, dB."""


class FrameSource(Protocol):
    """A camera, or what plays one. `read` and the settings may be called from different threads."""

    report: Callable[[str], None]
    """Is told in a sentence what happens to the camera while `read` waits."""

    @property
    def exposure(self) -> float | None:
        """Exposure, ms; None where it is unknown."""
        ...

    @exposure.setter
    def exposure(self, exposure: float) -> None: ...

    @property
    def gain(self) -> float | None:
        """Gain in the camera's own unit, mostly dB; None at a camera without."""
        ...

    @gain.setter
    def gain(self, gain: float) -> None: ...

    @property
    def exposures(self) -> Limits:
        """Exposures that can be set, ms."""
        ...

    @property
    def gains(self) -> Limits:
        """Gains that can be set."""
        ...

    @property
    def statistics(self) -> Statistics:
        """What became of the frames so far."""
        ...

    def check_size(self, shape: tuple[int, int]) -> None:
        """Raise InputError unless frames have this shape, (rows, columns)."""
        ...

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return the newest frame not handed out yet; InputError if none comes in time."""
        ...

    def close(self) -> None: ...


def say(sentence: str) -> None:
    """Say something in the terminal."""
    print(f"squilla: {sentence}", file=sys.stderr, flush=True)


class FolderFrames:
    """Raw frames of a folder or file, one after the other, again and again.

    Parameters
    ----------
    path : Path
    rate : float
        Frames a second, at most.
    """

    exposures = gains = None

    def __init__(self, path: Path, *, rate: float = 10.0):
        self._path, self._clock = path, _Clock(rate)
        self.statistics, self.report = Statistics(), say
        self._frames = read_raws(path)
        self._next: Raw | None = next(self._frames)  # what cannot be read is said at once
        self._exposure = self._next.exposure

    @property
    def exposure(self) -> float | None:
        """Exposure of the last frame, ms."""
        return self._exposure

    @exposure.setter
    def exposure(self, exposure: float) -> None:
        raise InputError("Recorded frames have the exposure that they were taken with.")

    @property
    def gain(self) -> float | None:
        """None: what was taken was taken."""
        return None

    @gain.setter
    def gain(self, gain: float) -> None:
        raise InputError("Recorded frames have the gain that they were taken with.")

    def check_size(self, shape: tuple[int, int]) -> None:
        """Raise InputError unless the first frame has this shape."""
        if self._next is not None and self._next.frame.shape != tuple(shape):
            rows, columns = self._next.frame.shape
            raise InputError(
                f"The frames of {self._path} have {rows} x {columns} px, the calibration was made "
                f"for {shape[0]} x {shape[1]}: they are of different cameras or regions."
            )

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return the next frame in its time."""
        self._clock.wait()
        raw = self._next
        if raw is None:
            self._frames = read_raws(self._path)
            raw = next(self._frames)
        self._next = next(self._frames, None)
        self.statistics.delivered += 1
        self._exposure = raw.exposure
        return raw

    def close(self) -> None:
        """Do nothing: no file stays open."""


class MovingTwin:
    """The twin before a scene that drifts, turns and comes nearer, there and back.

    The light on the sensor takes the twin about a second for each pose; poses join the movement as
    they are ready, the first before the first frame.

    Parameters
    ----------
    camera : Camera
    scene : str or DataArray
        As `twin_frames.views` takes it.
    distance : float
        Middle distance, mm.
    rate : float
        Frames a second, at most.
    seed : int
        Of the noise.
    """

    exposures, gains = EXPOSURES, GAINS

    def __init__(
        self,
        camera: Camera,
        scene: str | DataArray = "chart",
        *,
        distance: float = 300.0,
        rate: float = 10.0,
        seed: int = 0,
    ):
        self._clock = _Clock(rate)
        self.statistics, self.report = Statistics(), say
        self._poses = views(camera, scene, distance, moving=True)
        self._frames = TwinFrames(camera, [next(self._poses)], seed)
        self._bits = camera.design.sensor.bits
        self._exposure, self._gain = self._frames.bright_exposure, 0.0
        self._ended = threading.Event()
        self._maker = threading.Thread(target=self._make, daemon=True)
        self._maker.start()

    def _make(self) -> None:
        for rate in self._poses:
            if self._ended.is_set():
                return
            self._frames.add(rate)

    @property
    def poses(self) -> int:
        """Poses that are ready."""
        return len(self._frames.means)

    @property
    def exposure(self) -> float | None:
        """Exposure, ms."""
        return self._exposure

    @exposure.setter
    def exposure(self, exposure: float) -> None:
        low, high = EXPOSURES
        if not low <= exposure <= high:
            raise InputError(f"The exposure must be {low:g} to {high:g} ms, not {exposure:g}.")
        self._exposure = float(exposure)

    @property
    def gain(self) -> float | None:
        """Gain, dB above that at which the full well fills the scale."""
        return self._gain

    @gain.setter
    def gain(self, gain: float) -> None:
        low, high = GAINS
        if not low <= gain <= high:
            raise InputError(f"The gain must be {low:g} to {high:g} dB, not {gain:g}.")
        self._gain = float(gain)

    def check_size(self, shape: tuple[int, int]) -> None:
        """Raise InputError unless the twin's sensor has this shape."""
        rows, columns = self._frames.design.sensor_shape
        if (rows, columns) != tuple(shape):
            raise InputError(
                f"The twin's sensor has {rows} x {columns} px, the calibration was made for "
                f"{shape[0]} x {shape[1]}; name its design with --camera."
            )

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return a frame of the pose that is due."""
        number, missed = self._clock.wait()
        self.statistics.skipped += missed
        self.statistics.delivered += 1
        exposure, gain = self._exposure, self._gain
        frame = self._frames.draw(number, exposure, gain)
        facts = {"camera": self._frames.serial, "bits": self._bits, "gain": gain, "frame": number}
        return Raw(frame, exposure, facts)

    def close(self) -> None:
        """Stop making poses."""
        self._ended.set()
        self._maker.join(30)


class _Clock:
    """Ticks at a rate; who comes late is told how many ticks passed by."""

    def __init__(self, rate: float):
        self._period, self._last = 1 / rate, -1
        self._start: float | None = None

    def wait(self) -> tuple[int, int]:
        """Sleep until a tick that was not waited for yet; returns its number and those missed."""
        if self._start is None:
            self._start = time.monotonic()
        due = self._start + (self._last + 1) * self._period
        time.sleep(max(0.0, due - time.monotonic()))
        tick = max(int((time.monotonic() - self._start) / self._period), self._last + 1)
        missed, self._last = tick - self._last - 1, tick
        return tick, missed


def open_source(name: str, camera: str, scene: str) -> FrameSource:
    """Open a source by its name.

    Parameters
    ----------
    name : str
        "twin"; "genicam:ID" or "gentl:ID" as `open_camera` takes them; or a folder or file of raw
        frames.
    camera, scene : str
        The twin's design, and what it sees.
    """
    if name == "twin":
        return MovingTwin(Camera(camera), scene)
    if name.partition(":")[0] in ("genicam", "gentl"):
        from squilla.live.genicam import open_camera

        return open_camera(name if ":" in name else f"{name}:", report=say)
    if Path(name).exists():
        return FolderFrames(Path(name))
    raise InputError(
        f"There is no source {name!r}; give twin, genicam:ID as `squilla cameras` tells it, or a "
        "folder of raw frames."
    )
