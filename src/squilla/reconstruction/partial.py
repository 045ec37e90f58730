"""A reconstruction that works out only what is asked of it: some bands, some spectra, a colour.

Who looks at a picture needs three numbers a pixel, or one spectrum, not 251 times as many. A view
that goes with a camera asks here and leaves the cube to those who save it.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike

from squilla.calibration.alignment import Measurement
from squilla.errors import InputError

if TYPE_CHECKING:
    from xarray import DataArray

    from squilla.reconstruction.coded import Coded
    from squilla.reconstruction.reconstructor import Reconstructor


class Reconstruction:
    """What a model makes of one measurement; the whole cube is made at most once.

    Parameters
    ----------
    model : Reconstructor
    measurement : Measurement
    """

    def __init__(self, model: "Reconstructor", measurement: Measurement):
        self._model, self._measurement = model, measurement
        self._cube: DataArray | None = None

    def cube(self) -> "DataArray":
        """Return all spectra, as `Reconstructor.reconstruct` does."""
        if self._cube is None:
            self._cube = self._model.reconstruct(self._measurement)
        return self._cube

    def bands(self, numbers: list[int]) -> np.ndarray:
        """Return some bands, (y, x, len(numbers))."""
        return self.cube().values[..., self._checked(numbers)]

    def mixed(self, weights: np.ndarray) -> np.ndarray:
        """Return weighted sums over the bands, (K, C) -> (y, x, C), such as a colour.

        Weighted before negative values are clipped where that saves the cube: sums of all bands
        then differ by the little that noise makes negative.
        """
        return self.cube().values @ np.asarray(weights, np.float32)

    def spectra(self, rows: ArrayLike, columns: ArrayLike) -> np.ndarray:
        """Return the spectra of some pixels, (N, K)."""
        return self.cube().values[np.asarray(rows), np.asarray(columns)]

    def _checked(self, numbers: list[int]) -> list[int]:
        bands = len(self._model.wavelength)
        if not all(-bands <= number < bands for number in numbers):
            raise InputError(f"The bands are numbered 0 to {bands - 1}; {numbers} reach beyond.")
        return numbers


class PointwiseReconstruction(Reconstruction):
    """The same where every pixel is taken by itself: some pixels, or some bands, cost less."""

    def bands(self, numbers: list[int]) -> np.ndarray:
        some = None if self._cube is not None else self._model.only(self._checked(numbers))
        if some is None:
            return super().bands(numbers)
        return some.spectra_of(self._measurement)

    def spectra(self, rows: ArrayLike, columns: ArrayLike) -> np.ndarray:
        if self._cube is not None:
            return super().spectra(rows, columns)
        places = (np.asarray(rows), np.asarray(columns))
        parts = {
            name: getattr(self._measurement, name)
            for name in ("y", "valid", "angle", "disparity", "snr")
        }
        few = {
            name: None if part is None else torch.as_tensor(part)[places][None]
            for name, part in parts.items()
        }
        return self._model.spectra_of(replace(self._measurement, depth=None, **few))[0]


class CodedReconstruction(Reconstruction):
    """The same where spectra stand as coefficients until they are asked for.

    Parameters
    ----------
    model, measurement
        See `Reconstruction`.
    coded : Coded
    basis : array, (C, K)
    """

    def __init__(
        self, model: "Reconstructor", measurement: Measurement, coded: "Coded", basis: np.ndarray
    ):
        super().__init__(model, measurement)
        self._coded, self._basis = coded, basis

    def cube(self) -> "DataArray":
        if self._cube is None:
            self._cube = self._model.labelled(self._spelt(self._basis), self._measurement)
        return self._cube

    def bands(self, numbers: list[int]) -> np.ndarray:
        return self._spelt(self._basis[:, self._checked(numbers)])

    def mixed(self, weights: np.ndarray) -> np.ndarray:
        return self._spelt(self._basis @ np.asarray(weights, np.float32))

    def spectra(self, rows: ArrayLike, columns: ArrayLike) -> np.ndarray:
        return self._coded.at(rows, columns, self._basis)

    def _spelt(self, basis: np.ndarray) -> np.ndarray:
        return self._coded.spell_out(np.ascontiguousarray(basis), torch.get_num_threads())
