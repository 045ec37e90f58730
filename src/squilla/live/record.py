"""Recording of live frames: raw TIFF files in a folder, or cubes in one Zarr."""

import queue
import threading
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.cube import need_zarr, zarr_encoding
from squilla.files.raw import Raw, write_raw
from squilla.live.source import say

_WAITING = 2
"""Frames that may wait for the disk; with more a frame is missed, and counted."""


class Recorder:
    """Writes frames in a thread of its own, so that a slow disk never stops the camera.

    Parameters
    ----------
    path : Path
        A folder, for raw frames ``frame-000001.tiff``; or a name that ends in .zarr, for the
        reconstructed cubes, one after the other along "time". What is there is gone on with, never
        overwritten.

    Raises
    ------
    InputError
        If the folder cannot be made, or a Zarr of that name exists.
    """

    def __init__(self, path: Path):
        self.path, self.cubes = path, path.suffix == ".zarr"
        self.written = self.missed = 0
        self.error: str | None = None
        self._waiting: queue.Queue[tuple[Raw, Callable[[], DataArray]] | None] = queue.Queue(
            _WAITING
        )
        self._thread: threading.Thread | None = None
        self._taking = threading.Lock()  # so that nothing comes after what ends the queue
        self._switching = threading.Lock()  # one start or stop at a time
        if self.cubes:
            need_zarr(path)
        if self.cubes and path.exists():
            raise InputError(f"{path} exists already; name another to record to.")
        try:
            (path.parent if self.cubes else path).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"The folder {path} cannot be made: {error.strerror}.") from error
        names = [] if self.cubes else [file.stem[6:] for file in path.glob("frame-*.tiff")]
        self._number = max((int(name) for name in names if name.isdecimal()), default=0)

    @property
    def running(self) -> bool:
        """Whether frames are taken."""
        return self._thread is not None

    def start(self) -> None:
        """Take frames from now on."""
        with self._switching:
            if self._thread is None:
                self.error = None
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()

    def stop(self) -> None:
        """Write what waits, then take no more."""
        with self._switching:
            with self._taking:
                thread, self._thread = self._thread, None
            if thread is not None:
                self._waiting.put(None)
                thread.join()

    def offer(self, raw: Raw, cube: Callable[[], DataArray]) -> None:
        """Hand over a frame; it is missed if the disk is behind, and passed over when stopped."""
        with self._taking:
            if self._thread is None:
                return
            try:
                self._waiting.put_nowait((raw, cube))
            except queue.Full:
                self.missed += 1

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            if self.error is not None:
                self.missed += 1
                continue
            raw, cube = item
            try:
                if self.cubes:
                    self._append(cube())
                else:
                    self._number += 1
                    write_raw(self.path / f"frame-{self._number:06d}.tiff", raw)
                self.written += 1
            except (InputError, OSError) as error:  # a full disk: told on the page
                self.error = f"Recording has stopped: {error}"
                say(self.error)
                self._mend()

    def _mend(self) -> None:
        """Take a cube back that is half written, so that those before it stay readable."""
        if not self.cubes or not self.path.exists():
            return
        import zarr

        try:
            if self.written:
                array = zarr.open_group(self.path, mode="r+")["radiance"]
                array.resize((self.written, *array.shape[1:]))  # pyright: ignore
            else:
                rmtree(self.path)
        except (OSError, KeyError, ValueError) as error:
            say(f"The last cube in {self.path} may be half written ({error}).")

    def _append(self, cube: DataArray) -> None:
        cube = cube.astype(np.float32).rename("radiance").expand_dims("time")
        cube.attrs = {}
        dataset = cube.to_dataset()
        if self.path.exists():
            dataset.to_zarr(self.path, append_dim="time", zarr_format=3, consolidated=False)
        else:
            packing = zarr_encoding(dataset)
            dataset.to_zarr(self.path, zarr_format=3, consolidated=False, encoding=packing)
