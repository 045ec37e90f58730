"""Thousands of captures into cubes: on all cores or on a cluster, and nothing is lost.

Each capture is a task of its own, measured, reconstructed and written by one thread of one process,
so that the result does not depend on how many there are. A journal beside the cubes takes a line
for each capture that is whole on the disk. A run that was killed goes on behind the last of them; a
capture that fails is noted and does not stop the others.
"""

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol

from squilla import __version__
from squilla.errors import InputError
from squilla.files.disk import flush, make_folder
from squilla.files.journal import Journal, stamp, stop_on_disk_error
from squilla.files.raw import Frame

if TYPE_CHECKING:
    import xarray as xr

    from squilla.calibration.calibration import Calibration
    from squilla.reconstruction.reconstructor import Reconstructor


@dataclass(frozen=True)
class Recipe:
    """What is done with every capture.

    calibration : path of the camera's calibration.
    model : name or file of a model.
    distance : of the scenes, mm; None if it is found from each of them.
    depth : whether to find a distance for every point instead.
    engine : what runs the networks, see `reconstruction.engine`; None for PyTorch.
    """

    calibration: Path
    model: str = "ridge"
    distance: float | None = None
    depth: bool = False
    engine: str | None = None

    def state(self) -> dict[str, Any]:
        """Return all that decides what comes out, to tell whether a run may go on."""
        model = Path(self.model)
        return asdict(self) | {
            "calibration": stamp(self.calibration),
            "model": stamp(model) if model.is_file() else self.model,
            "software": __version__,
        }


@dataclass
class Summary:
    """How a run ended.

    done : what the journal says of each capture that has a cube, by its name.
    found : how many of those were there before.
    failed : why the others have none, by their names.
    """

    done: dict[str, dict[str, Any]] = field(default_factory=dict)
    found: int = 0
    failed: dict[str, str] = field(default_factory=dict)


def reconstruct_all(
    frames: list[Frame],
    recipe: Recipe,
    output: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda ended, of: None,
) -> Summary:
    """Reconstruct many captures; go on where an earlier run with the same arguments ended.

    Parameters
    ----------
    frames : list of Frame
        See `squilla.files.raw.list_frames`.
    recipe : Recipe
    output : str or Path
        A folder, which gets one NetCDF file for each capture, or a ``.zarr``, which gets all of
        them along a first dimension "capture". The journal is ``journal.jsonl`` inside the
        folder, or beside ``night.zarr`` as ``night.journal.jsonl``.
    workers : int, optional
        Processes; default: one for each core. 1 stays in this process.
    scheduler : str, optional
        Address of a Dask scheduler, ``tcp://host:8786``, instead of processes of this machine. Its
        workers must see the same files.
    progress : function
        Called with the number of captures that have ended, and of all.

    Returns
    -------
    Summary

    Raises
    ------
    InputError
        If two captures have one name, the journal is of another run, another run writes to
        `output`, or the disk refuses. What was written until then stays.
    """
    named = {frame.name: frame for frame in frames}
    if not frames:
        raise InputError("There is no raw frame to reconstruct.")
    if len(named) < len(frames):
        raise InputError("Two raw frames have the same name; their cubes would be one.")
    output = Path(output)
    stacked = output.suffix.lower() == ".zarr"
    path = output.with_suffix(".journal.jsonl") if stacked else output / "journal.jsonl"
    if stacked and output.exists() and not path.exists():
        raise InputError(f"{output} is there, and {path.name} is not: give another output.")
    make_folder(output)
    with Journal(path, recipe.state()) as journal:
        summary = Summary({name: told for name, told in journal.done.items() if name in named})
        for name in list(summary.done):
            if stamp(named[name].path) != summary.done[name]["source"]:
                del summary.done[name]  # another picture under the same name
        summary.found = len(summary.done)
        sink = _Stack(output, list(named)) if stacked else _Folder(output)
        missing = [frame for name, frame in named.items() if name not in summary.done]
        sink.prepare(missing, recipe)
        progress(len(summary.done), len(named))
        for name, told in _run(missing, recipe, sink, workers, scheduler):
            if "failed" in told:
                summary.failed[name] = told["failed"]
            else:
                summary.done[name] = told
            journal.write(name, told)
            progress(len(summary.done) + len(summary.failed), len(named))
        sink.finish(summary)
    return summary


# --- one capture ------------------------------------------------------------------------------


class _Sink(Protocol):
    """Where cubes go; sent to the workers, which only `write`."""

    def prepare(self, frames: list[Frame], recipe: Recipe) -> None: ...

    def write(self, name: str, cube: "xr.Dataset") -> None: ...

    def finish(self, summary: Summary) -> None: ...


def _one(frame: Frame, recipe: Recipe, sink: _Sink) -> dict[str, Any]:
    """Turn one capture into a cube on the disk; return what the journal shall say of it."""
    start = perf_counter()
    try:
        cube, provenance = _cube(frame, recipe)
    except Exception as error:  # whatever one capture suffers from, the others go on
        known = isinstance(error, InputError)
        return {"failed": str(error) if known else f"{type(error).__name__}: {error}"}
    sink.write(frame.name, cube)
    seconds = round(perf_counter() - start, 3)
    return {"source": stamp(frame.path), "seconds": seconds, **provenance}


def reconstruct_one(
    frame: Frame, recipe: Recipe
) -> "tuple[xr.DataArray, dict[str, xr.DataArray], dict[str, Any]]":
    """Measure and reconstruct one capture.

    Returns
    -------
    cube : DataArray, (y, x, wavelength)
    extra : what belongs to it, by name: what each pixel is worth, and its depth
    provenance : of the measurement, and how well the cube explains it
    """
    from squilla.calibration.alignment import measure
    from squilla.reconstruction.judgement import judge, told_of

    calibration, model = _loaded(recipe, json.dumps(recipe.state(), sort_keys=True))
    raw = frame.read()
    measurement = measure(raw, calibration, distance=recipe.distance, depth=recipe.depth)
    cube = model.reconstruct(measurement)
    judged = judge(cube, measurement, calibration)
    told = told_of(judged)
    cube.attrs |= told
    extra = judged | (measurement.depth.arrays() if measurement.depth else {})
    return cube, extra, measurement.provenance | told


def _cube(frame: Frame, recipe: Recipe) -> "tuple[xr.Dataset, dict[str, Any]]":
    import xarray as xr

    with _one_thread():
        cube, extra, provenance = reconstruct_one(frame, recipe)
    return xr.Dataset({str(cube.name): cube, **extra}), provenance


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let one capture take one thread: sums then come out the same wherever it is worked on."""
    import numba
    import torch

    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


@lru_cache(maxsize=1)
def _loaded(recipe: Recipe, state: str) -> "tuple[Calibration, Reconstructor]":
    """Load what all captures share, once for each process and state of the files."""
    from squilla.calibration.store import load_calibration
    from squilla.reconstruction.reconstructor import load_model

    calibration = load_calibration(recipe.calibration)
    return calibration, load_model(recipe.model, calibration, recipe.engine)


def _first_cube(frames: list[Frame], recipe: Recipe) -> "xr.Dataset | None":
    """Return the cube of the first capture that has one; None if none has."""
    for frame in frames:
        try:
            return _cube(frame, recipe)[0]
        except InputError:
            continue  # it will be told of in its turn
    return None


# --- where cubes go ---------------------------------------------------------------------------


_SHARED = (
    "long_name", "units", "flag_masks", "flag_meanings",
    "model", "software", "calibration", "weights", "scale",
)  # fmt: skip
"""What is the same for the cubes of all captures."""


@dataclass(frozen=True)
class _Folder:
    """One NetCDF file for each capture."""

    path: Path

    def prepare(self, frames: list[Frame], recipe: Recipe) -> None:
        pass

    def write(self, name: str, cube: "xr.Dataset") -> None:
        from squilla.files.cube import save

        first, *others = cube.data_vars.values()
        extra = {str(array.name): array for array in others}
        save(first, self.path / f"{name}.nc", extra=extra)

    def finish(self, summary: Summary) -> None:
        pass


@dataclass(frozen=True)
class _Stack:
    """One Zarr for all captures, along a first dimension; each has chunks of its own."""

    path: Path
    names: list[str]

    def __post_init__(self):
        from squilla.files.cube import need_zarr

        need_zarr(self.path)
        if self.ready and self._opened().capture.values.tolist() != self.names:
            raise InputError(
                f"{self.path} was begun with other captures; give the same, or another output."
            )

    @property
    def ready(self) -> bool:
        """Whether the store was laid out to its end."""
        import zarr

        if not (self.path / "zarr.json").exists():
            return False
        return bool(zarr.open_group(self.path, mode="r").attrs.get("laid_out", False))

    def _opened(self) -> "xr.Dataset":
        import xarray as xr

        return xr.open_zarr(self.path, consolidated=False, chunks=None)

    def prepare(self, frames: list[Frame], recipe: Recipe) -> None:
        """Lay out the store by the first cube that can be made."""
        if not self.ready:
            first = _first_cube(frames, recipe)
            if first is not None:
                self._lay_out(first)

    def _lay_out(self, cube: "xr.Dataset") -> None:
        import dask.array
        import numpy as np
        import xarray as xr
        import zarr

        from squilla.files.cube import zarr_encoding

        count = len(self.names)
        empty = {
            name: (
                ("capture", *array.dims),
                dask.array.full(
                    (count, *array.shape),
                    np.nan if array.dtype.kind == "f" else 0,
                    dtype=array.dtype,
                    chunks=-1,
                ),
                {key: array.attrs[key] for key in _SHARED if key in array.attrs},
            )
            for name, array in cube.data_vars.items()
        }
        whole = xr.Dataset(empty, {**cube.coords, "capture": np.array(self.names, object)})
        whole.attrs = {"Conventions": "CF-1.11", "cube": next(iter(empty))}
        encoding = zarr_encoding(whole)
        with stop_on_disk_error(self.path):
            # Over what a run that was killed here has begun.
            whole.to_zarr(
                self.path, mode="w", zarr_format=3, consolidated=False, encoding=encoding,
                compute=False,
            )  # fmt: skip
            zarr.open_group(self.path, mode="r+").attrs["laid_out"] = True

    def write(self, name: str, cube: "xr.Dataset") -> None:
        place = self.names.index(name)
        one = cube.drop_vars(list(cube.coords)).expand_dims("capture")
        for array in one.variables.values():
            array.attrs = {}
        region = {"capture": slice(place, place + 1)}
        with stop_on_disk_error(self.path):
            one.to_zarr(self.path, region=region, zarr_format=3, consolidated=False)
            for variable in one.data_vars:
                flush(self.path / str(variable) / "c" / str(place))

    def finish(self, summary: Summary) -> None:
        """Write what is known of each capture beside its cube."""
        import numpy as np
        import xarray as xr

        if not self.ready:
            return
        known = {key for told in summary.done.values() for key in told}
        columns = {}
        for key in sorted(known - {"source"}):
            values = [summary.done.get(name, {}).get(key) for name in self.names]
            numbers = all(isinstance(value, int | float | None) for value in values)
            empty, kind, dtype = (np.nan, float, float) if numbers else ("", str, object)
            filled = [empty if value is None else kind(value) for value in values]
            columns[key] = ("capture", np.array(filled, dtype))
        reasons = [summary.failed.get(name, "") for name in self.names]
        columns["failed"] = ("capture", np.array(reasons, object))
        told = xr.Dataset(columns, attrs=self._opened().attrs)
        with stop_on_disk_error(self.path):
            told.to_zarr(self.path, mode="a", zarr_format=3, consolidated=False)


# --- workers ----------------------------------------------------------------------------------


def _run(
    frames: list[Frame], recipe: Recipe, sink: _Sink, workers: int | None, scheduler: str | None
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of each capture and what became of it, in the order in which they end."""
    workers = workers or len(os.sched_getaffinity(0))
    workers = min(workers, len(frames))
    if scheduler is None and workers <= 1:
        for frame in frames:
            yield frame.name, _one(frame, recipe, sink)
        return
    with _executor(workers, scheduler) as (executor, most):
        waiting, running = iter(frames), {}
        while True:
            # A few at a time: thousands of tasks in line would only take memory.
            while len(running) < most and (frame := next(waiting, None)) is not None:
                running[executor.submit(_one, frame, recipe, sink)] = frame.name
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                yield running.pop(future), future.result()


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Lend something that runs tasks, and tell how many to hand to it at once."""
    if scheduler is not None:
        try:
            from distributed import Client
        except ImportError as error:
            raise InputError(
                "A scheduler needs Dask; install it with: pip install 'squilla[batch]'."
            ) from error
        try:
            client: Any = Client(scheduler, timeout=20)
        except (OSError, ValueError) as error:
            raise InputError(f"No Dask scheduler answers at {scheduler}: {error}") from error
        with client:
            threads = sum(client.nthreads().values())
            if not threads:
                raise InputError(f"The scheduler at {scheduler} has no workers yet; start some.")
            yield client.get_executor(pure=False), 2 * threads
        return
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_alone)
    try:
        yield pool, 2 * workers
    except BrokenProcessPool as error:
        raise InputError(
            "A worker died, probably for lack of memory; run again, with fewer workers, to go on."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _alone() -> None:
    """Make a process of this machine a worker that ends with the run, and not before."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run above is interrupted, and ends us
    threading.Thread(target=_follow_the_run, daemon=True).start()


def _follow_the_run() -> None:
    """End this process when the one that started it has been killed; pools do not."""
    from multiprocessing import parent_process

    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
