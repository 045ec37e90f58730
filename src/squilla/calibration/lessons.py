"""Folders of frames that teach the sensitivity, each with a table of what was shown."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from squilla.calibration.known import KnownScene
from squilla.calibration.sensitivity import SweepStep
from squilla.errors import InputError
from squilla.files.disk import make_folder
from squilla.files.raw import read_raw, write_raw
from squilla.files.tables import read_columns, read_listed, write_listed
from squilla.spectra import resample

_SWEEP = ("wavelength", "power", "bandwidth")
_KNOWN = ("file", "spectra", "labels")


def read_sweep(folder: Path) -> Iterator[SweepStep]:
    """Read ``sweep.csv`` in a folder at once, and return an iterator over the frames it lists.

    Its columns are file, wavelength (nm), power (photon radiance of the light) and bandwidth (nm,
    full width at half maximum).
    """
    listed = read_listed(folder / "sweep.csv", ("file",), _SWEEP)
    return (SweepStep(read_raw(path), *values) for (path,), values in listed)


def write_sweep(folder: Path, steps: Iterable[SweepStep]) -> None:
    """Write a sweep as `read_sweep` reads it."""
    make_folder(folder)
    rows = []
    for number, step in enumerate(steps):
        name = f"{number:03d}.tiff"
        write_raw(folder / name, step.raw)
        rows.append((name, f"{step.wavelength:g}", f"{step.power:.6g}", f"{step.bandwidth:g}"))
    write_listed(folder / "sweep.csv", ("file", *_SWEEP), rows)


def read_known(folder: Path, wavelength: np.ndarray) -> Iterator[KnownScene]:
    """Read ``known.csv`` in a folder at once, and return an iterator over the scenes it lists.

    Its columns are file (a frame), spectra (a text file: a column of wavelengths in nm, then the
    photon radiance of each surface), labels (a picture of the reference view: 1 where it shows the
    first surface, 0 where none) and distance (mm). The spectra come on `wavelength`, (K,) nm.
    """
    listed = read_listed(folder / "known.csv", _KNOWN, ("distance",))
    return (_known(paths, distance, wavelength) for paths, (distance,) in listed)


def _known(paths: list[Path], distance: float, wavelength: np.ndarray) -> KnownScene:
    from PIL import Image, UnidentifiedImageError

    frame, spectra, labels = paths
    columns = read_columns(spectra)[0].T
    try:
        with Image.open(labels) as picture:
            numbers = np.asarray(picture).astype(int) - 1
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"The labels {labels} cannot be read as a picture: {error}.") from None
    values = resample(columns[1:], columns[0], wavelength)
    return KnownScene(read_raw(frame), values, numbers, distance)


def write_known(folder: Path, wavelength: np.ndarray, scenes: Iterable[KnownScene]) -> None:
    """Write known scenes, whose spectra are on `wavelength`, as `read_known` reads them."""
    from PIL import Image

    make_folder(folder)
    rows = []
    for number, scene in enumerate(scenes):
        row = (f"{number:03d}.tiff", f"{number:03d}.txt", "labels.png", f"{scene.distance:g}")
        write_raw(folder / row[0], scene.raw)
        np.savetxt(folder / row[1], np.vstack([wavelength, scene.spectra]).T, fmt="%.7g")
        Image.fromarray((scene.labels + 1).astype(np.uint8)).save(folder / row[2])
        rows.append(row)
    write_listed(folder / "known.csv", (*_KNOWN, "distance"), rows)
