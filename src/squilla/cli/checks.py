"""What a person gave, looked at before the work is done, and how far the work is."""

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from squilla.errors import InputError


def check_file(path: Path, suffixes: tuple[str, ...] = ()) -> None:
    """Refuse a file that could not be written, or not as its suffix says.

    Parameters
    ----------
    path : Path
    suffixes : tuple of str
        Those that are known, in small letters; none: any will do.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path} cannot be written; its name must end in {', '.join(suffixes)}.")
    folder = path.resolve().parent
    if not folder.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {folder}.")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path} cannot be written: the folder {folder} is not yours to write to.")
    if path.is_dir() and path.suffix.lower() != ".zarr":
        raise InputError(f"{path} cannot be written: it is a folder; give the name of a file.")


def check_distance(distance: float | None) -> None:
    """Refuse a distance that is no positive number of mm; None is one to be found."""
    if distance is not None and not 0 < distance < math.inf:
        raise InputError(f"The distance must be a positive number of mm, not {distance:g}.")


@contextmanager
def counted(what: str, *, silent: bool) -> Iterator[Callable[[int, int], None]]:
    """Show a bar, and lend a function that is told how many have ended, of how many."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), disable=silent) as progress:
        bar = progress.add_task(what, total=None)
        yield lambda ended, of: progress.update(bar, completed=ended, total=of)
