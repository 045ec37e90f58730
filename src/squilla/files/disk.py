"""What is written is whole or not there; what is read is believed only as far as it can be true."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from squilla.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

_DENSEST = 2000
"""Bytes in memory that one byte on disk can stand for; deflate reaches 1030, on zeros alone."""


@contextmanager
def replacing(path: str | Path, *, folder: bool = False) -> Iterator[Path]:
    """Lend a temporary name beside `path`; what was written there then takes the place of `path`.

    Parameters
    ----------
    path : str or Path
        Final name; a link is followed.
    folder : bool
        Whether a folder is written, which may replace an older folder.

    Raises
    ------
    InputError
        If the parent folder is missing or the disk refuses; nothing is left behind then.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {target.parent}.")
    if target.is_dir() and not folder:
        raise InputError(f"{path} cannot be written: it is a folder; give the name of a file.")
    token = uuid4().hex[:8]
    temporary = target.with_name(f".{target.stem}-{token}{target.suffix}")
    try:
        yield temporary
        flush(temporary)
        if target.is_dir():  # a full folder cannot be replaced in one step, only swapped
            older = target.with_name(f".{target.stem}-{token}-older")
            os.replace(target, older)
            os.replace(temporary, target)
            shutil.rmtree(older)
        else:
            os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{path} could not be written: {error.strerror or error}.") from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


def write_netcdf(dataset: "xr.Dataset", path: str | Path, **how: Any) -> None:
    """Write a NetCDF file, whole or not at all.

    It is made in memory first: HDF5 takes the whole process with it when a disk is full.
    """
    content = dataset.to_netcdf(engine="h5netcdf", **how)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def flush(path: Path) -> None:
    """Hand a file, or all files of a folder, from the system's cache to the disk itself."""
    for file in path.rglob("*") if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb+") as stream:
                os.fsync(stream.fileno())


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, where there is none; InputError if that is refused."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder {path} cannot be made: {error.strerror}.") from error


def existing(path: str | Path) -> Path:
    """Return `path`, or say that nothing is there."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"There is no file {path}.")
    return path


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a reader of `kind` raises at a damaged or foreign file into an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # the readers' libraries fail on bad bytes in a dozen ways
        if path.is_file() and path.stat().st_size == 0:
            raise InputError(f"{path} is empty; it was never written to its end.") from error
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{path} cannot be read as {kind}; it may be cut short or of another kind ({reason})."
        ) from error


def check_size(path: Path, needed: int) -> None:
    """Refuse a file whose header promises more bytes than its size can hold, compressed or not."""
    files = path.rglob("*") if path.is_dir() else [path]
    held = sum(file.stat().st_size for file in files if file.is_file())
    if needed > _DENSEST * held:
        raise InputError(
            f"{path} promises {needed:,} bytes of data but is only {held:,} bytes long; "
            "it is cut short or its header is wrong."
        )
