"""Cubes that stay on disk until a part of them is asked for."""

from typing import Any

import numpy as np
from xarray import DataArray, Variable
from xarray.backends import BackendArray
from xarray.core.indexing import IndexingSupport, LazilyIndexedArray, explicit_indexing_adapter

DIMS = ("y", "x", "wavelength")


class OnDisk(BackendArray):
    """A stored array that xarray slices as (y, x, wavelength) and reads when it must.

    Parameters
    ----------
    stored : array, memory map or xarray.Variable
        Three axes; sliced with slices, it gives its numbers.
    axes : (int, int, int)
        Which of its axes are y, x and wavelength.
    empty : float, optional
        The number that stands for no number; whole numbers then become floats.
    """

    def __init__(self, stored: Any, axes: tuple[int, ...], empty: float | None = None):
        self.stored, self.axes, self.empty = stored, tuple(axes), empty
        self.shape = tuple(stored.shape[axis] for axis in axes)
        self.dtype = np.dtype(stored.dtype).newbyteorder("=")
        if empty is not None:
            self.dtype = np.result_type(self.dtype, np.float32)

    def __getitem__(self, key: Any) -> np.ndarray:
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.BASIC, self._part)

    def _part(self, key: tuple[int | slice, ...]) -> np.ndarray:
        single = tuple(place for place, each in enumerate(key) if not isinstance(each, slice))
        slices = [each if isinstance(each, slice) else slice(each, each + 1) for each in key]
        inner = [slices[self.axes.index(axis)] for axis in range(3)]
        values = np.asarray(self.stored[tuple(inner)]).transpose(self.axes)
        part = np.array(values, self.dtype, order="C")
        if self.empty is not None:
            part[values == self.empty] = np.nan
        return part.squeeze(single)

    @property
    def together(self) -> int:
        """Number of bands that the disk must bring when one is wanted."""
        bands = self.shape[2]
        stored, axis = self.stored, self.axes[2]
        if isinstance(stored, np.ndarray):
            return bands if abs(stored.strides[axis]) == min(map(abs, stored.strides)) else 1
        chunks = stored.encoding.get("chunksizes") or stored.encoding.get("chunks")
        if chunks:
            return int(chunks[axis])
        return bands if axis == 2 else 1


def lazy(
    stored: OnDisk, coords: dict[str, Any], name: str, attributes: dict[str, Any]
) -> DataArray:
    """Return what lies on disk as a cube; `encoding["together"]` tells how its bands lie."""
    variable = Variable(DIMS, LazilyIndexedArray(stored), attributes)
    cube = DataArray(variable, coords, name=name)
    cube.encoding["together"] = stored.together
    return cube
