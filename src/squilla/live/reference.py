"""Reference spectra from a text file: wavelengths, then one column for each spectrum."""

from pathlib import Path
from typing import Any

import numpy as np

from squilla.errors import InputError
from squilla.files.tables import parse_columns, read_columns

_MOST = 64
"""Spectra that one file may hold."""


def read_references(path: Path) -> list[dict[str, Any]]:
    """Read the reference spectra of a CSV or text file; see `parse_references`."""
    return _references(*read_columns(path), path.name)


def parse_references(text: str, name: str) -> list[dict[str, Any]]:
    """Find spectra in a table: the first column wavelengths, nm or um, each other one a spectrum.

    Parameters
    ----------
    text : str
        See `squilla.files.tables.parse_columns`.
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
    return _references(*parse_columns(text, name), name)


def _references(table: np.ndarray, heads: list[str], name: str) -> list[dict[str, Any]]:
    if len(table) < 2 or not 2 <= table.shape[1] <= _MOST + 1:
        raise InputError(
            f"{name} must hold two wavelengths or more, and 1 to {_MOST} columns of spectra."
        )
    if not np.isfinite(table).all():
        raise InputError(f"{name} holds NaN or infinite values; leave those lines out.")
    table = table[np.argsort(table[:, 0], kind="stable")]
    wavelength, *columns = table.T
    if wavelength[-1] < 20:
        wavelength = wavelength * 1000  # um
    if not (np.diff(wavelength) > 0).all():
        raise InputError(f"{name} states a wavelength twice; keep one of them.")
    stem = Path(name).stem
    numbered = [f"{stem} {place + 1}" for place in range(len(columns))]
    names = heads[1:] or (numbered if len(columns) > 1 else [stem])
    return [
        {"name": label or stem, "wavelength": wavelength.tolist(), "values": column.tolist()}
        for label, column in zip(names, columns, strict=True)
    ]
