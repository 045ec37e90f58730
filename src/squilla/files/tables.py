"""Tables as text: columns of numbers below a heading, and lists of files with numbers to each."""

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from squilla.errors import InputError
from squilla.files.disk import existing, reading, replacing

_LARGEST = 64 << 20
"""Bytes beyond which a file is no table that a person made."""


def read_columns(path: str | Path) -> tuple[np.ndarray, list[str]]:
    """Read a table of numbers in columns, below any heading.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    columns : array, (rows, columns)
    heads : list of str
        Names of the columns; empty if there are none, or not one for each.

    Raises
    ------
    InputError
        If the file is missing, or is no such table; see `parse_columns`.
    """
    path = existing(path)
    if path.is_dir() or path.stat().st_size > _LARGEST:
        raise InputError(f"{path} is no table, or larger than {_LARGEST >> 20} MB.")
    with reading(path, "text"):
        text = path.read_text(encoding="utf-8-sig")
    return parse_columns(text, str(path))


def parse_columns(text: str, name: str) -> tuple[np.ndarray, list[str]]:
    """Find the columns of numbers in a text; see `read_columns`.

    Columns stand apart by commas, semicolons, tabs or blanks. What follows a # is passed over, and
    so is every line before the first row of numbers; the last of these names the columns.

    Parameters
    ----------
    text, name : str
        What the file holds, and how errors call it.

    Raises
    ------
    InputError
        If there is no row of numbers, or a line after the first is not a row of as many.
    """
    rows: list[list[float]] = []
    heading = ""
    for number, line in enumerate(text.splitlines(), 1):
        told = line.split("#")[0].strip(",; \t")
        if not told:
            continue
        try:
            row = [float(cell) for cell in re.split(r"[,;\s]+", told)]
        except ValueError:
            if not rows:
                heading = line.strip()  # a name may hold a #
                continue
            raise InputError(f"{name}, line {number}: {told[:60]!r} is not numbers.") from None
        if rows and len(row) != len(rows[0]):
            raise InputError(
                f"{name}, line {number}: {len(row)} columns, but {len(rows[0])} in the rows before."
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{name} holds no row of numbers; expected columns, wavelength first.")
    apart = next((sign for sign in "\t;," if sign in heading), None)
    heads = [head.strip().strip('"') for head in heading.split(apart)]
    return np.array(rows), heads if len(heads) == len(rows[0]) else []


def read_listed(
    table: Path, files: Sequence[str], numbers: Sequence[str]
) -> list[tuple[list[Path], list[float]]]:
    """Read a list of files that lie beside it, with numbers to each.

    Parameters
    ----------
    table : Path
        CSV whose first line names its columns.
    files, numbers : names of the columns wanted

    Returns
    -------
    list of (paths, numbers), a row each

    Raises
    ------
    InputError
        If the table cannot be read, lacks a column or a number, or a file is not there.
    """
    wanted = ", ".join((*files, *numbers))
    try:
        with table.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{table} cannot be read ({error}); wanted is a folder of frames with a table "
            f"{table.name} of {wanted}."
        ) from error
    listed = []
    for line, row in enumerate(rows, 2):
        try:
            paths = [table.parent / row[name] for name in files]
            values = [float(row[name]) for name in numbers]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{table}, line {line}: wanted are {wanted}.") from error
        listed.append(([existing(path) for path in paths], values))
    return listed


def write_listed(table: Path, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write what `read_listed` reads, whole or not at all."""
    with (
        replacing(table) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as stream,
    ):
        csv.writer(stream).writerows([heads, *rows])
