"""TIFF: one grey page for each band, what else is known as JSON in the description."""

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.disk import check_size, reading, replacing
from squilla.files.lazy import OnDisk, lazy

if TYPE_CHECKING:
    from tifffile import TiffFile


def write_tiff(array: DataArray, path: Path) -> None:
    """Write a cube (y, x, wavelength), or a map (y, x), as one grey page a band."""
    import tifffile

    bands = array.values.reshape(*array.shape[:2], -1).transpose(2, 0, 1)
    told: dict[str, Any] = {"name": array.name, "attributes": array.attrs}
    for key in ("wavelength", "fwhm"):
        if key in array.coords:
            told[key] = array[key].values.tolist()
    with replacing(path) as temporary:
        tifffile.imwrite(
            temporary,
            np.ascontiguousarray(bands),
            photometric="minisblack",
            description=json.dumps(told),
            metadata=None,
        )


def open_tiff(path: Path) -> DataArray:
    """Open a cube of one grey page a band, whose numbers are read when used."""
    with opened(path) as tiff:
        first = tiff.pages.first
        check_size(path, len(tiff.pages) * first.nbytes)
        bands = _mapped(path, tiff)
        if bands.ndim != 3:
            raise InputError(f"{path} must hold one grey page for each band.")
        try:
            told = json.loads(first.description)
        except ValueError:
            told = None
        if not isinstance(told, dict) or "attributes" not in told:
            told = {"name": path.stem, "attributes": {}}  # others' files describe other things
        coords = {
            key: ("wavelength", np.array(told[key], float))
            for key in ("wavelength", "fwhm")
            if key in told
        }
        return lazy(OnDisk(bands, (1, 2, 0)), coords, told["name"], told["attributes"])


@contextmanager
def opened(path: Path) -> "Iterator[TiffFile]":
    """Open a TIFF whose chain of pages comes to an end; damaged ones go round in a circle."""
    import tifffile

    with reading(path, "TIFF"), tifffile.TiffFile(path) as tiff:
        layout, handle = tiff.tiff, tiff.filehandle
        link, seen = layout.offsetsize, set()  # where the place of the first page stands
        while True:
            handle.seek(link)
            (page,) = struct.unpack(layout.offsetformat, handle.read(layout.offsetsize))
            if page in seen:
                raise InputError(f"{path} is damaged: its pages go round in a circle.")
            if not 0 < page < handle.size - layout.tagnosize:
                break
            seen.add(page)
            handle.seek(page)
            (tags,) = struct.unpack(layout.tagnoformat, handle.read(layout.tagnosize))
            link = page + layout.tagnosize + tags * layout.tagsize
            if link > handle.size - layout.offsetsize:
                break
        yield tiff


def _mapped(path: Path, tiff: Any) -> np.ndarray:
    """Return the pages of a TIFF as one array, mapped from the disk where they lie plain on it."""
    first, starts = tiff.pages.first, [page.dataoffsets for page in tiff.pages]
    flat = [start[0] for start in starts if len(start) == 1]
    plain = first.is_memmappable and len(flat) == len(starts)
    if plain and all(start == flat[0] + n * first.nbytes for n, start in enumerate(flat)):
        kind = first.dtype.newbyteorder(tiff.byteorder)
        return np.memmap(path, kind, "r", flat[0], (len(flat), *first.shape))
    return _stacked(path, tiff)


def read_pages(path: Path) -> np.ndarray:
    """Read a TIFF of grey pages of one size, (pages, rows, columns)."""
    with opened(path) as tiff:
        return _stacked(path, tiff)


def _stacked(path: Path, tiff: Any) -> np.ndarray:
    return np.stack([read_page(path, page) for page in tiff.pages])


def read_page(path: Path, page: Any) -> np.ndarray:
    """Read a page of a TIFF whose header does not promise more than the file can hold.

    Raises
    ------
    InputError
        If it does: damaged headers promise millions of strips.
    """
    check_size(path, page.nbytes)
    strips, listed = int(np.prod(page.chunked)), len(page.dataoffsets)
    if strips != listed:
        raise InputError(
            f"{path} is damaged: its header tells of {strips:,} strips and lists {listed:,}."
        )
    return page.asarray()
