"""Reference spectra from a text file: wavelengths, then one column for each spectrum."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from squilla.errors import InputError
from squilla.files.disk import existing, reading
from squilla.live.protocol import LARGEST

_MOST = 64
"""Spectra that one file may hold."""


def read_references(path: Path) -> list[dict[str, Any]]:
    """Read the reference spectra of a CSV or text file; see `parse_references`."""
    path = existing(path)
    if path.is_dir() or path.stat().st_size > LARGEST:
        raise InputError(f"{path} is no table of spectra, or larger than {LARGEST >> 20} MB.")
    with reading(path, "text"):
        text = path.read_text(encoding="utf-8-sig")
    return parse_references(text, path.name)


def parse_references(text: str, name: str) -> list[dict[str, Any]]:
    """Find spectra in a table: the first column wavelengths, nm or um, each other one a spectrum.

    Columns stand apart by comma, semicolon, tab or blanks. A first line without numbers names the
    columns; lines that begin with # are passed over.

    Parameters
    ----------
    text : str
    name : str
        Of the file; names a spectrum whose column has no name.

    Returns
    -------
    list of dict
        "name"; "wavelength", nm, increasing; "values".

    Raises
    ------
    InputError
        If it is no such table.
    """
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    if not lines:
        raise InputError(f"{name} is empty; a table of wavelengths and spectra was expected.")
    apart = next((sign for sign in ("\t", ";", ",") if sign in lines[0]), None)
    rows = [_cells(line, apart) for line in lines]
    heads = None if _numbers(rows[0]) is not None else rows.pop(0)
    table = []
    for number, row in enumerate(rows, 1 + (heads is not None)):
        values = _numbers(row)
        if values is None or len(values) < 2 or len(values) != len(rows[0]):
            raise InputError(
                f"{name}, line {number}: {', '.join(row)[:60]!r} is no wavelength followed by "
                "one number for each spectrum."
            )
        table.append(values)
    if len(table) < 2 or len(rows[0]) > _MOST + 1:
        raise InputError(f"{name} must hold two wavelengths or more, and at most {_MOST} spectra.")
    wavelength, *columns = np.array(table).T
    if wavelength.max() < 20:
        wavelength = wavelength * 1000  # um
    order = np.argsort(wavelength)
    wavelength = wavelength[order]
    if not (np.isfinite(wavelength).all() and (np.diff(wavelength) > 0).all()):
        raise InputError(f"{name} states a wavelength twice, or one that is no number.")
    stem = Path(name).stem
    names = heads[1:] if heads and len(heads) == len(rows[0]) else []
    return [
        {
            "name": (names[place] if names else "") or (f"{stem} {place + 1}"
                     if len(columns) > 1 else stem),
            "wavelength": wavelength.tolist(),
            "values": _plain(column[order], name),
        }
        for place, column in enumerate(columns)
    ]  # fmt: skip


def _plain(values: np.ndarray, name: str) -> list[float]:
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds NaN or infinite values; leave those lines out.")
    return values.tolist()


def _cells(line: str, apart: str | None) -> list[str]:
    cells = line.split(apart) if apart else re.split(r"\s+", line)
    return [cell.strip().strip('"') for cell in cells]


def _numbers(cells: list[str]) -> list[float] | None:
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
