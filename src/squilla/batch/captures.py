"""Thousands of captures into cubes: on all cores or on a cluster, and nothing is lost.

Each capture is a task of its own, measured, reconstructed and written by one thread of one process,
so that the result does not depend on how many there are. A journal beside the cubes takes a line
for each capture that is whole on the disk. A run that was killed goes on behind the last of them; a
capture that fails is noted and does not stop the others.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from squilla import __version__
from squilla.batch.sinks import Folder, Sink, Stack
from squilla.batch.workers import crew, one_thread
from squilla.errors import InputError
from squilla.files.disk import make_folder
from squilla.files.journal import Journal, stamp
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
    interval : whether to tell how far each value may be off; `compound` can.
    """

    calibration: Path
    model: str = "ridge"
    distance: float | None = None
    depth: bool = False
    engine: str | None = None
    interval: bool = False

    def absolute(self) -> "Recipe":
        """Return the same for processes that stand in other folders."""
        model = Path(self.model)
        return replace(
            self,
            calibration=self.calibration.absolute(),
            model=str(model.absolute()) if model.is_file() else self.model,
        )

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
    output = Path(output).absolute()  # workers on a cluster may stand in other folders
    stacked = output.suffix.lower() == ".zarr"
    path = output.with_suffix(".journal.jsonl") if stacked else output / "journal.jsonl"
    if stacked and output.exists() and not path.exists():
        raise InputError(f"{output} is there, and {path.name} is not: give another output.")
    make_folder(output)
    recipe = recipe.absolute()
    with Journal(path, recipe.state()) as journal:
        summary = Summary({name: told for name, told in journal.done.items() if name in named})
        for name in list(summary.done):
            if stamp(named[name].path) != summary.done[name].get("source"):
                del summary.done[name]  # another picture under the same name
        summary.found = len(summary.done)
        progress(summary.found, len(named))
        sink: Sink = Stack(output, list(named)) if stacked else Folder(output)
        missing = [
            replace(frame, path=frame.path.absolute())
            for name, frame in named.items()
            if name not in summary.done
        ]
        with crew(len(missing), workers, scheduler) as lent:
            if missing and not sink.ready:
                lent.do(_lay_out, sink, missing, recipe)
            tasks = ((frame.name, (frame, recipe, sink)) for frame in missing)
            for name, told in lent.each(_one, tasks):
                if "failed" in told:
                    summary.failed[name] = told["failed"]
                else:
                    summary.done[name] = told
                journal.write(name, told)
                progress(len(summary.done) + len(summary.failed), len(named))
        sink.finish(summary.done, summary.failed)
    return summary


# --- one capture ------------------------------------------------------------------------------


def _one(frame: Frame, recipe: Recipe, sink: Sink) -> dict[str, Any]:
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
    extra : what belongs to it, by name: what each pixel is worth, its depth, the interval
    provenance : of the measurement, and how well the cube explains it
    """
    from squilla.calibration.alignment import measure
    from squilla.reconstruction.judgement import judge, told_of

    calibration, model = _loaded(recipe, json.dumps(recipe.state(), sort_keys=True))
    raw = frame.read()
    measurement = measure(raw, calibration, distance=recipe.distance, depth=recipe.depth)
    extra = measurement.depth.arrays() if measurement.depth else {}
    if recipe.interval:
        cube, width = model.reconstruct_interval(measurement)
        extra["uncertainty"] = width
    else:
        cube = model.reconstruct(measurement)
    judged = judge(cube, measurement, calibration)
    told = told_of(judged)
    cube.attrs |= told
    return cube, judged | extra, measurement.provenance | told


def _cube(frame: Frame, recipe: Recipe) -> "tuple[xr.Dataset, dict[str, Any]]":
    import xarray as xr

    with one_thread():
        cube, extra, provenance = reconstruct_one(frame, recipe)
    return xr.Dataset({str(cube.name): cube, **extra}), provenance


@lru_cache(maxsize=1)
def _loaded(recipe: Recipe, state: str) -> "tuple[Calibration, Reconstructor]":
    """Load what all captures share, once for each process and state of the files."""
    from squilla.calibration.store import load_calibration
    from squilla.reconstruction.models import load_model

    calibration = load_calibration(recipe.calibration)
    return calibration, load_model(recipe.model, calibration, recipe.engine)


def _lay_out(sink: Sink, frames: list[Frame], recipe: Recipe) -> None:
    """Make a sink ready by the first capture that becomes a cube, if one does."""
    for frame in frames:
        try:
            cube, _ = _cube(frame, recipe)
        except InputError:
            continue  # it will be told of in its turn
        sink.lay_out(cube)
        return
