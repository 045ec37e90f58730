"""What a page asks of a cube, worked out: pictures and spectra, wherever the numbers come from."""

from collections.abc import Iterator
from threading import Lock
from typing import Any

import numpy as np
from xarray import DataArray

from squilla.colour import rgb_weights
from squilla.errors import InputError
from squilla.evaluation.metrics import sam
from squilla.live.protocol import Picture, Region, Spectra

LARGEST_SIDE = 1024
"""Longest side of a picture that is sent, px; of a longer one every n-th pixel is taken."""

_MANY = 1_000_000
"""Pixels of a vast region that are enough for its mean, where each must be fetched."""


class Answers:
    """Answers what a page asks of a cube; a subclass knows where the cube's numbers are.

    Parameters
    ----------
    title : str
    shape : (rows, columns)
    wavelength : array, (K,)
        nm.
    extra : dict of name to DataArray
        Maps (y, x) or cubes (y, x, wavelength) of the same size.
    """

    few_bands = False
    """Whether bands cost by their number, so that colour is told from about thirty."""

    whole = True
    """Whether every pixel of a region is looked at, however many there are."""

    def __init__(
        self,
        title: str,
        shape: tuple[int, int],
        wavelength: np.ndarray,
        extra: dict[str, DataArray],
    ):
        self.title, self.shape, self.extra = title, shape, extra
        self.wavelength = np.asarray(wavelength, float)
        self._lock = Lock()

    def blocks(
        self, rows: slice, columns: slice, bands: slice = slice(None)
    ) -> Iterator[np.ndarray]:
        """Go through a part of the cube in pieces (rows, columns, bands) that memory can bear."""
        raise NotImplementedError

    def plane(self, band: int, rows: slice, columns: slice) -> np.ndarray:
        """Return a part of one band, (rows, columns)."""
        raise NotImplementedError

    def layer_blocks(self, layer: DataArray, rows: slice, columns: slice) -> Iterator[np.ndarray]:
        """Go through a part of a layer with bands, in pieces."""
        yield np.asarray(layer[rows, columns], np.float32)

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
            planes = self.plane(self._index(ask.band), rows, columns)[None]
        return planes, {"window": window, "stride": stride}

    def spectra(self, ask: Spectra) -> tuple[np.ndarray, dict[str, Any]]:
        """Return mean and standard deviation, (2, N, K), and the pixels that count in each."""
        layer = self._spectral(ask.layer) if ask.layer else None
        means, spreads, counts = [], [], []
        for region in ask.regions:
            top, left, bottom, right = self._checked(region)
            stride = 1
            if layer is not None or not self.whole:
                stride = max(1, int(np.sqrt((bottom - top) * (right - left) / _MANY)))
            place = slice(top, bottom, stride), slice(left, right, stride)
            blocks = self.blocks(*place) if layer is None else self.layer_blocks(layer, *place)
            mean, spread, count = _moments(blocks)
            means.append(mean)
            spreads.append(spread)
            counts.append(count)
        return np.stack([np.stack(means), np.stack(spreads)]), {"pixels": counts}

    def _colour(self, rows: slice, columns: slice, white: np.ndarray | None) -> np.ndarray:
        bands = colour_bands(len(self.wavelength)) if self.few_bands else slice(None)
        weights = rgb_weights(self.wavelength[bands], None if white is None else white[bands])
        weights = weights.astype(np.float32)
        blocks = self.blocks(rows, columns, bands)
        return np.concatenate([along(block @ weights) for block in blocks], axis=1)

    def _angle(self, rows: slice, columns: slice, spectrum: np.ndarray) -> np.ndarray:
        blocks = self.blocks(rows, columns)
        return np.concatenate([np.asarray(sam(block, spectrum), np.float32) for block in blocks])

    def _layer(self, name: str, rows: slice, columns: slice, band: int) -> np.ndarray:
        if name not in self.extra:
            raise InputError(f"{self.title} has no layer {name!r}.")
        layer = self.extra[name][rows, columns]
        if layer.ndim == 3:
            layer = layer[..., self._index(band)]
        with self._lock:
            return np.asarray(layer, np.float32)

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


def colour_bands(count: int) -> slice:
    """Return about thirty of `count` bands, which tell the colour well enough."""
    return slice(None, None, max(1, count // 32))


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


def along(block: np.ndarray) -> np.ndarray:
    """Return (rows, columns, planes) as (planes, rows, columns)."""
    return np.ascontiguousarray(np.moveaxis(block, -1, 0))


def length(part: slice) -> int:
    return len(range(part.start, part.stop, part.step or 1))
