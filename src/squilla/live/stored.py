"""A cube in a file as a source of pictures and spectra."""

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.evaluation.metrics import sam
from squilla.live.protocol import Picture, Region, Spectra
from squilla.spectra import rgb_weights

LARGEST_SIDE = 1024
"""Longest side of a picture that is sent, px; of a longer one every n-th pixel is taken."""

HELD = 1 << 30
"""Cubes up to so many bytes are held in memory; larger ones are read by need."""

_BLOCK = 1 << 25  # bytes of a cube that are worked on at once
_KEPT = 1 << 28  # bytes of bands kept that came along with others from the disk


class StoredCube:
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
        self.title = title
        self.extra = extra or {}
        self.wavelength = np.asarray(cube["wavelength"], float)
        self.shape = cube.shape
        self.cube = cube
        self._held = 4 * cube.size <= held
        self._values: np.ndarray | None = None
        self._kept: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._lock = Lock()

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

    # --- answers --------------------------------------------------------------------------------

    def picture(self, ask: Picture) -> tuple[np.ndarray, dict[str, Any]]:
        """Return planes (C, h, w) and a header with the window and the stride they show.

        Raises
        ------
        InputError
            If band, layer, window or spectrum are not of this cube.
        """
        window = self._checked(ask.window or (0, 0, self.shape[0], self.shape[1]))
        top, left, bottom, right = window
        stride = -(-max(bottom - top, right - left) // LARGEST_SIDE)
        rows, columns = slice(top, bottom, stride), slice(left, right, stride)
        if ask.kind == "colour":
            planes = self._colour(rows, columns, self._spectrum(ask.white))
        elif ask.kind == "angle":
            spectrum = self._spectrum(ask.spectrum)
            if spectrum is None:
                raise InputError("A spectrum is needed to compare every pixel with.")
            planes = self._angle(rows, columns, spectrum)[None]
        elif ask.kind == "layer":
            planes = self._layer(ask.layer, rows, columns, ask.band)[None]
        else:
            planes = self._band(self._index(ask.band), rows, columns)[None]
        return planes, {"window": window, "stride": stride}

    def spectra(self, ask: Spectra) -> tuple[np.ndarray, dict[str, Any]]:
        """Return mean and standard deviation, (2, N, K), and the pixels that count in each."""
        cube = self.cube if not ask.layer else self._spectral(ask.layer)
        held = self._held and not ask.layer
        means, spreads, counts = [], [], []
        for region in ask.regions:
            top, left, bottom, right = self._checked(region)
            stride = 1
            if not held:  # of a vast region on disk a million pixels will do
                stride = max(1, int(np.sqrt((bottom - top) * (right - left) / 1e6)))
            rows, columns = slice(top, bottom, stride), slice(left, right, stride)
            mean, spread, count = _moments(self._blocks(rows, columns, cube, held))
            means.append(mean)
            spreads.append(spread)
            counts.append(count)
        return np.stack([np.stack(means), np.stack(spreads)]), {"pixels": counts}

    def _colour(self, rows: slice, columns: slice, white: np.ndarray | None) -> np.ndarray:
        bands = slice(None)
        if not self._held and self.cube.encoding.get("together", 1) == 1:
            # Each band is a piece of disk of its own: about thirty tell the colour well enough.
            bands = slice(None, None, max(1, len(self.wavelength) // 32))
        weights = rgb_weights(self.wavelength[bands], None if white is None else white[bands])
        weights = weights.astype(np.float32)
        blocks = self._blocks(rows, columns, self.cube, self._held, bands)
        return np.concatenate([_along(block @ weights) for block in blocks], axis=1)

    def _angle(self, rows: slice, columns: slice, spectrum: np.ndarray) -> np.ndarray:
        blocks = self._blocks(rows, columns, self.cube, self._held)
        return np.concatenate([np.asarray(sam(block, spectrum), np.float32) for block in blocks])

    def _layer(self, name: str, rows: slice, columns: slice, band: int) -> np.ndarray:
        if name not in self.extra:
            raise InputError(f"{self.title} has no layer {name!r}.")
        layer = self.extra[name][rows, columns]
        if layer.ndim == 3:
            layer = layer[..., self._index(band)]
        with self._lock:
            return np.asarray(layer, np.float32)

    def _band(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        if self._held:
            return self._whole()[rows, columns, index]
        size = _length(rows) * _length(columns) * 4
        together = max(1, min(self.cube.encoding.get("together", 1), _KEPT // size))
        first = index - index % together
        key = (rows.start, rows.stop, columns.start, columns.stop, first)
        with self._lock:
            if key not in self._kept:
                bands = slice(first, min(first + together, len(self.wavelength)))
                blocks = self._blocks(rows, columns, self.cube, False, bands)
                self._kept[key] = np.concatenate([_along(block) for block in blocks], axis=1)
                while sum(each.nbytes for each in self._kept.values()) > _KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key][index - first]

    # --- reading --------------------------------------------------------------------------------

    def _whole(self) -> np.ndarray:
        with self._lock:
            if self._values is None:
                self._values = np.asarray(self.cube, np.float32)
            return self._values

    def _blocks(
        self,
        rows: slice,
        columns: slice,
        cube: DataArray,
        held: bool,
        bands: slice = slice(None),
    ) -> Iterator[np.ndarray]:
        """Go through a part of a cube in pieces (rows, columns, bands) that memory can bear."""
        source = self._whole() if held else cube
        step = rows.step or 1
        width = _length(columns) * 4 * len(self.wavelength[bands])
        high = max(1, _BLOCK // width) * step
        for top in range(rows.start, rows.stop, high):
            part = slice(top, min(top + high, rows.stop), step)
            yield np.asarray(source[part, columns, bands], np.float32)

    # --- what came from outside -----------------------------------------------------------------

    def _checked(self, region: Region) -> Region:
        top, left, bottom, right = region
        if not (top < bottom <= self.shape[0] and left < right <= self.shape[1]):
            raise InputError(
                f"The region {list(region)} is empty or beyond the {self.shape[0]} x "
                f"{self.shape[1]} px of {self.title}."
            )
        return region

    def _index(self, band: int) -> int:
        if band >= len(self.wavelength):
            raise InputError(f"{self.title} has {len(self.wavelength)} bands; there is no {band}.")
        return band

    def _spectrum(self, given: list[float] | None) -> np.ndarray | None:
        if given is not None and len(given) != len(self.wavelength):
            raise InputError(
                f"The spectrum has {len(given)} bands, {self.title} {len(self.wavelength)}."
            )
        return None if given is None else np.asarray(given, np.float32)

    def _spectral(self, name: str) -> DataArray:
        if name not in self.extra or self.extra[name].ndim != 3:
            raise InputError(f"{self.title} has no layer {name!r} with bands.")
        return self.extra[name]


def spectral_colours(wavelength: np.ndarray) -> list[str]:
    """Return the colour of the light of each band as ``#rrggbb``, dark where nobody sees it."""
    linear = np.clip(rgb_weights(wavelength), 0, None)
    linear = linear / max(float(linear.max()), 1e-12)
    return [
        "#" + "".join(f"{round(255 * part ** (1 / 2.4)):02x}" for part in each) for each in linear
    ]


def _moments(blocks: Iterator[np.ndarray]) -> tuple[np.ndarray, np.ndarray, int]:
    """Return mean and standard deviation of all pixels (K,), NaN left out, and their number."""
    pixels, count, total, square, pivot = 0, 0, 0.0, 0.0, np.zeros(0)
    for block in blocks:
        flat = block.reshape(-1, block.shape[-1]).astype(np.float64)
        if not pixels:  # the variance is the same about any value; near the mean it keeps digits
            pivot = np.nan_to_num(flat[0], posinf=0, neginf=0)
        good = np.isfinite(flat)
        flat = np.where(good, flat - pivot, 0)
        pixels += len(flat)
        count = count + good.sum(0)
        total = total + flat.sum(0)
        square = square + np.square(flat).sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / count
        spread = np.sqrt(np.maximum(square / count - mean**2, 0))
    return mean + pivot, spread, pixels


def _along(block: np.ndarray) -> np.ndarray:
    """Return (rows, columns, planes) as (planes, rows, columns)."""
    return np.ascontiguousarray(np.moveaxis(block, -1, 0))


def _length(part: slice) -> int:
    return len(range(part.start, part.stop, part.step or 1))
