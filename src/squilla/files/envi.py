"""ENVI: a text header that makes a cube of the numbers beside it."""

import json
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.disk import existing, flush, reading, replacing
from squilla.files.lazy import OnDisk, lazy

DATA_SUFFIXES = (".img", ".dat", ".raw", ".bsq", ".bil", ".bip", ".bin", ".cube")

_KINDS = {
    "1": "u1", "2": "i2", "3": "i4", "4": "f4", "5": "f8",
    "12": "u2", "13": "u4", "14": "i8", "15": "u8",
}  # fmt: skip
"""Real numbers by their ENVI "data type"."""

_AXES = {"bsq": "bls", "bil": "lbs", "bip": "lsb"}  # bands, lines, samples, as they lie on disk


def write_envi(array: DataArray, path: Path) -> None:
    """Write a cube (y, x, wavelength), or a map (y, x), as header `path` and data beside it.

    The bands lie one after the other (BSQ), so that a viewer fetches one picture in one piece. An
    older header goes first and the new one comes last: at no moment does a header stand beside
    numbers that it does not describe.
    """
    from spectral.io.envi import write_envi_header

    bands = array.values.reshape(*array.shape[:2], -1)
    bands = np.ascontiguousarray(bands.transpose(2, 0, 1))
    codes = {kind: code for code, kind in _KINDS.items()}
    kind = bands.dtype.str[1:] if bands.dtype.str[1:] in codes else "f4"
    bands = bands.astype("<" + kind, copy=False)
    header: dict[str, Any] = {
        "description": f"{array.name or 'cube'}, written by squilla",
        "samples": bands.shape[2],
        "lines": bands.shape[1],
        "bands": bands.shape[0],
        "header offset": 0,
        "data type": codes[kind],
        "interleave": "bsq",
        "byte order": 0,
    }
    if "wavelength" in array.dims:
        wavelength = array["wavelength"].values
        shown = [int(np.abs(wavelength - band).argmin()) + 1 for band in (650, 550, 500)]
        header |= {
            "wavelength units": "Nanometers",
            "wavelength": [repr(float(each)) for each in wavelength],
            "default bands": shown,
        }
        if "fwhm" in array.coords:
            header["fwhm"] = [repr(float(each)) for each in array["fwhm"].values]
    # The format has no place for attributes: one field of ours carries them, its braces escaped.
    told = json.dumps({"name": array.name, "attributes": array.attrs})
    header["squilla"] = quote(told, safe=" \",:[]()/*+-_.='")
    with replacing(path) as temporary_header:
        write_envi_header(str(temporary_header), header)
        with replacing(path.with_suffix(".img")) as temporary:
            bands.tofile(temporary)
            flush(temporary)
            path.unlink(missing_ok=True)


def read_envi(path: Path) -> DataArray:
    """Open an ENVI cube, (y, x, wavelength) of the type on disk; its numbers are read when used.

    Parameters
    ----------
    path : Path
        Header, or the data beside it.

    Returns
    -------
    DataArray
        Its wavelengths as the header states them, with their unit; bands that the header marks as
        bad ("bbl") are left out, and pixels that it marks as empty ("data ignore value") are NaN.

    Raises
    ------
    InputError
        If a half of the pair is missing, the header lacks what makes a cube, or the size of the
        data is not what the header says.
    """
    path, data = _pair(path)
    header = _header(path)
    lines, samples, count = (_whole(header, key, path) for key in ("lines", "samples", "bands"))
    offset = _whole(header, "header offset", path, default=0)
    dtype = _dtype(header, path)
    interleave = str(header.get("interleave", "bsq")).lower()
    if interleave not in _AXES:
        raise InputError(f"{path} names an unknown interleave {interleave!r}.")
    needed = offset + lines * samples * count * dtype.itemsize
    held = data.stat().st_size
    if needed != held:
        raise InputError(
            f"{data} is {held:,} bytes long, but by its header {path.name} it should be "
            f"{needed:,}; it is cut short or belongs to another header."
        )
    size = {"b": count, "l": lines, "s": samples}
    axes = _AXES[interleave]
    stored = np.memmap(data, dtype, "r", offset, tuple(size[axis] for axis in axes))
    coords, attributes, name = {}, {}, path.stem
    for key in ("wavelength", "fwhm"):
        if key in header:
            coords[key] = ("wavelength", _numbers(header, key, count, path))
    if "wavelength" in coords:
        coords["wavelength"] += ({"units": str(header.get("wavelength units", ""))},)
    empty = None
    if "data ignore value" in header:
        with reading(path, "ENVI"):
            empty = float(header["data ignore value"])
    if "squilla" in header:
        with reading(path, "ENVI"):
            ours = json.loads(unquote(header["squilla"]))
            name, attributes = ours["name"], ours["attributes"]
    on_disk = OnDisk(stored, tuple(axes.index(axis) for axis in "lsb"), empty)
    with reading(path, "ENVI"):
        cube = lazy(on_disk, coords, name, attributes)
    if "bbl" in header:
        cube = cube.isel(wavelength=_numbers(header, "bbl", count, path) > 0)
        cube.encoding["together"] = on_disk.together
    return cube


def _pair(path: Path) -> tuple[Path, Path]:
    """Return header and data, whichever of the two was given."""
    existing(path)
    if path.suffix.lower() == ".hdr":
        header, stem = path, path.with_suffix("")
        known = [stem, *(stem.with_suffix(suffix) for suffix in DATA_SUFFIXES)]
        known += [each.with_suffix(each.suffix.upper()) for each in known[1:]]
        found = [each for each in known if each.is_file() and each != header]
        if not found:
            raise InputError(
                f"The header {path} has no data beside it; {stem.name}.img was expected."
            )
        return header, found[0]
    for header in (path.with_suffix(".hdr"), path.with_name(path.name + ".hdr")):
        if header.is_file():
            return header, path
    raise InputError(f"{path} has no ENVI header beside it; {path.stem}.hdr was expected.")


def _header(path: Path) -> dict[str, Any]:
    from spectral.io.envi import read_envi_header

    with reading(path, "ENVI header"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # keys with capitals are common and harmless
        return read_envi_header(str(path))


def _whole(header: dict[str, Any], key: str, path: Path, default: int | None = None) -> int:
    text = str(header.get(key, "" if default is None else default))
    if not text.isdecimal() or (default is None and int(text) == 0):
        raise InputError(f'{path} must state "{key}" as a whole number, not {text!r}.')
    return int(text)


def _dtype(header: dict[str, Any], path: Path) -> np.dtype:
    kind, order = str(header.get("data type", "")), str(header.get("byte order", "0"))
    if kind not in _KINDS or order not in ("0", "1"):
        raise InputError(f"{path} states data type {kind!r} and byte order {order!r}.")
    return np.dtype("<>"[int(order)] + _KINDS[kind])


def _numbers(header: dict[str, Any], key: str, count: int, path: Path) -> np.ndarray:
    listed = [header[key]] if isinstance(header[key], str) else header[key]
    try:
        numbers = np.array([float(each) for each in listed])
    except ValueError as error:
        raise InputError(f'{path}: "{key}" is no list of numbers ({error}).') from error
    if len(numbers) != count:
        raise InputError(f'{path} has {count} bands but {len(numbers)} numbers in "{key}".')
    return numbers
