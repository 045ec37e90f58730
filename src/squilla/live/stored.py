"""A cube in a file as a source of pictures and spectra."""

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from xarray import DataArray

from squilla.live.answer import Answers, along, length, spectral_colours

HELD = 1 << 30
"""Cubes up to so many bytes are held in memory; larger ones are read by need."""

_BLOCK = 1 << 25  # bytes of a cube that are worked on at once
_KEPT = 1 << 28  # bytes of bands kept that came along with others from the disk


class StoredCube(Answers):
    """Answers what a page asks of a cube that does not change.

    Parameters
    ----------
    cube : DataArray, (y, x, wavelength)
        In memory or on disk, as `open_cube` returns it.
    extra : dict of name to DataArray, optional
        Maps (y, x) or cubes (y, x, wavelength) of the same size.
    title : str
    held : int
        Size up to which the cube is held in memory, bytes.
    """

    number = 0
    """Of the frame; one that never changes."""

    def __init__(
        self,
        cube: DataArray,
        extra: dict[str, DataArray] | None = None,
        *,
        title: str = "cube",
        held: int = HELD,
    ):
        rows, columns, _ = cube.shape
        super().__init__(title, (rows, columns), cube["wavelength"].values, extra or {})
        self.cube = cube
        self.whole = self._held = 4 * cube.size <= held
        # Each band a piece of disk of its own.
        self.few_bands = not self._held and cube.encoding.get("together", 1) == 1
        self._values: np.ndarray | None = None
        self._kept: OrderedDict[tuple, np.ndarray] = OrderedDict()

    @classmethod
    def open(cls, path: Path, *, held: int = HELD, **how: Any) -> "StoredCube":
        """Open a file; `how` is handed to `open_cube`."""
        from squilla.files.cube import open_cube

        cube, extra = open_cube(path, **how)
        return cls(cube, extra, title=path.name, held=held)

    def warm(self) -> None:
        """Read the cube before it is asked for, where it is held in memory."""
        if self._held:
            self._whole()

    def now(self) -> "StoredCube":
        """Return what stands still while it is asked: the cube itself."""
        return self

    def status(self) -> dict[str, Any]:
        """Return what changes from frame to frame: nothing."""
        return {}

    def describe(self) -> dict[str, Any]:
        """Return what a page must know before it asks: size, wavelengths, layers, origin."""
        attributes = self.cube.attrs
        told = {str(k): str(v)[:200] for k, v in attributes.items() if str(v)}
        return {
            "title": self.title,
            "rows": self.shape[0],
            "columns": self.shape[1],
            "wavelength": self.wavelength.tolist(),
            "colours": spectral_colours(self.wavelength),
            "quantity": told.get("long_name", str(self.cube.name or "value")),
            "unit": told.get("units", ""),
            "by_need": not self._held,
            "live": False,
            "facts": dict(list(told.items())[:40]),
            "layers": [
                {
                    "name": name,
                    "label": str(each.attrs.get("long_name", name)),
                    "unit": str(each.attrs.get("units", "")),
                    "spectral": each.ndim == 3,
                    "truth": each.dtype == bool or name == "valid",
                }
                for name, each in self.extra.items()
            ],
        }

    # --- reading --------------------------------------------------------------------------------

    def blocks(
        self, rows: slice, columns: slice, bands: slice = slice(None)
    ) -> Iterator[np.ndarray]:
        """Go through a part of the cube in pieces."""
        return self._pieces(self._whole() if self._held else self.cube, rows, columns, bands)

    def layer_blocks(self, layer: DataArray, rows: slice, columns: slice) -> Iterator[np.ndarray]:
        """Go through a part of a layer with bands, in pieces."""
        return self._pieces(layer, rows, columns, slice(None))

    def plane(self, band: int, rows: slice, columns: slice) -> np.ndarray:
        """Return a part of one band."""
        if self._held:
            return self._whole()[rows, columns, band]
        size = length(rows) * length(columns) * 4
        together = max(1, min(self.cube.encoding.get("together", 1), _KEPT // size))
        first = band - band % together
        key = (rows.start, rows.stop, columns.start, columns.stop, first)
        with self._lock:
            if key not in self._kept:
                bands = slice(first, min(first + together, len(self.wavelength)))
                blocks = self._pieces(self.cube, rows, columns, bands)
                self._kept[key] = np.concatenate([along(block) for block in blocks], axis=1)
                while sum(each.nbytes for each in self._kept.values()) > _KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key][band - first]

    def _whole(self) -> np.ndarray:
        with self._lock:
            if self._values is None:
                self._values = np.asarray(self.cube, np.float32)
            return self._values

    def _pieces(
        self, source: DataArray | np.ndarray, rows: slice, columns: slice, bands: slice
    ) -> Iterator[np.ndarray]:
        step = rows.step or 1
        width = length(columns) * 4 * len(self.wavelength[bands])
        high = max(1, _BLOCK // width) * step
        for top in range(rows.start, rows.stop, high):
            part = slice(top, min(top + high, rows.stop), step)
            yield np.asarray(source[part, columns, bands], np.float32)
