"""Where live frames come from: the twin before a moving scene, a folder played again."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from xarray import DataArray

from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.files.raw import Raw, read_raws


@dataclass
class Counts:
    """What became of a camera's frames: handed out, too old, broken, never seen."""

    delivered: int = 0
    skipped: int = 0
    incomplete: int = 0
    lost: int = 0


class FrameSource(Protocol):
    """A camera, or what plays one."""

    @property
    def exposure(self) -> float | None:
        """Exposure, ms; None where it cannot be set."""
        ...

    @exposure.setter
    def exposure(self, exposure: float) -> None: ...

    @property
    def statistics(self) -> Any:
        """`Counts`, or what has the same fields."""
        ...

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return the newest frame not handed out yet; InputError if none comes in time."""
        ...

    def close(self) -> None: ...


class FolderFrames:
    """Raw frames of a folder or file, one after the other, again and again.

    Parameters
    ----------
    path : Path
    rate : float
        Frames a second, at most.
    """

    def __init__(self, path: Path, *, rate: float = 10.0):
        self._path, self._clock = path, _Clock(rate)
        self.statistics = Counts()
        self._frames = read_raws(path)
        self._next: Raw | None = next(self._frames)  # what cannot be read is said at once

    @property
    def exposure(self) -> float | None:
        """None: what was taken was taken."""
        return None

    @exposure.setter
    def exposure(self, exposure: float) -> None:
        raise InputError("Recorded frames have the exposure that they were taken with.")

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return the next frame in its time."""
        self._clock.wait()
        raw = self._next
        if raw is None:
            self._frames = read_raws(self._path)
            raw = next(self._frames)
        self._next = next(self._frames, None)
        self.statistics.delivered += 1
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
        What `load_scene` takes, or a scene.
    distance : float
        Middle distance, mm.
    poses : int
    rate : float
        Frames a second, at most.
    seed : int
        Of the noise.
    """

    def __init__(
        self,
        camera: Camera,
        scene: str | DataArray = "chart",
        *,
        distance: float = 300.0,
        poses: int = 8,
        rate: float = 10.0,
        seed: int = 0,
    ):
        import torch

        self._camera, self._clock = camera, _Clock(rate)
        self._generator = torch.Generator().manual_seed(seed)
        self.statistics = Counts()
        if not isinstance(scene, DataArray):
            scene = load_scene(scene, camera.design.wavelength, camera.design.field.size)
        self._poses = _movement(scene, camera, distance, poses)
        self._rates = [next(self._poses)]
        bright = float(np.percentile(self._rates[0][::8, ::8], 99.5))
        self._exposure = float(
            np.clip(0.7 * camera.design.sensor.full_well / max(bright, 1e-9), 0.01, 1e4)
        )
        self._ended = threading.Event()
        self._maker = threading.Thread(target=self._make, daemon=True)
        self._maker.start()

    def _make(self) -> None:
        for rate in self._poses:
            if self._ended.is_set():
                return
            self._rates.append(rate)

    @property
    def exposure(self) -> float | None:
        """Exposure, ms."""
        return self._exposure

    @exposure.setter
    def exposure(self, exposure: float) -> None:
        if not 0.001 <= exposure <= 1e5:
            raise InputError(f"The exposure must be 0.001 to 100 000 ms, not {exposure:g}.")
        self._exposure = float(exposure)

    def read(self, *, timeout: float = 5.0) -> Raw:
        """Return a frame of the pose that is due."""
        number, missed = self._clock.wait()
        self.statistics.skipped += missed
        self.statistics.delivered += 1
        there = len(self._rates)
        place = number % max(1, 2 * there - 2)  # there and back
        rate = self._rates[min(place, 2 * there - 2 - place) if there > 1 else 0]
        return self._camera.expose(rate, self._exposure, self._generator)

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


def _movement(
    scene: DataArray, camera: Camera, distance: float, poses: int
) -> Iterator[np.ndarray]:
    """Go through what falls on the sensor in the poses of half a swing, e-/ms."""
    import torch
    from torch.nn.functional import affine_grid, grid_sample

    picture = torch.from_numpy(np.ascontiguousarray(scene.values)).permute(2, 0, 1)[None]
    for swing in np.sin(np.linspace(-np.pi / 2, np.pi / 2, poses)):
        angle, shift = np.radians(5 * swing), 0.12 * swing
        turn = [
            [np.cos(angle), -np.sin(angle), shift],
            [np.sin(angle), np.cos(angle), shift / 2],
        ]
        where = affine_grid(torch.tensor([turn]).float(), list(picture.shape), align_corners=False)
        moved = grid_sample(picture.float(), where, padding_mode="reflection", align_corners=False)
        values = moved[0].permute(1, 2, 0).clamp_min(0).numpy()
        yield camera.rate(scene.copy(data=values), distance=distance * (1 - 0.15 * swing))


def open_source(name: str, camera: str, scene: str) -> FrameSource:
    """Open a source by its name: "twin", or a folder or file of raw frames."""
    if name == "twin":
        return MovingTwin(Camera(camera), scene)
    if Path(name).exists():
        return FolderFrames(Path(name))
    raise InputError(f"There is no source {name!r}; give twin, or a folder of raw frames.")
