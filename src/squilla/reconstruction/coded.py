"""Pictures of the compound model on a processor, and spectra worked out only where asked.

`interval.descend` says what is computed, here in loops that pass memory once. What comes out stays
in coefficients until somebody wants bands, spectra or the whole cube.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.reconstruction.compiled import inherited, mix
from squilla.reconstruction.evidence import CORRECTED, SPECTRAL, UNHEARD, Evidence
from squilla.reconstruction.kernels import compiled, over_rows, sigmoid
from squilla.threads import single_threaded_products

_CHANGED, _UNHEARD = CORRECTED[0], np.float32(UNHEARD)
_ROWS = 16
"""Rows of a picture that are spelt out at a time."""


@compiled
def _changes(first, last, kin, coarse, own, alone, changes):
    """Write by how much cells change the leading coefficients that they inherit."""
    below, right = coarse.shape[0] - 1, coarse.shape[1] - 1
    low = np.empty(own.shape[2], np.float32)
    for row in range(first, last):
        up, down = max((row - 1) // 2, 0), min((row + 1) // 2, below)
        for column in range(own.shape[1]):
            itself, change = sigmoid(alone[row, column]), changes[row, column]
            if itself < _UNHEARD:
                change[:] = 0
                continue
            before, after = max((column - 1) // 2, 0), min((column + 1) // 2, right)
            mix(kin[row, column], coarse, up, down, before, after, low, low.size)
            for i in range(low.size):
                change[i] = itself * (own[row, column, i] - low[i])


@compiled
def _decoded(first, last, top, kin, spectra, changes, basis, bright, cube):
    """Write non-negative spectra: those of the four coarse cells mixed, changed, and bright.

    spectra : of as many coarse rows as it takes, from row `top` on.
    """
    below, right = spectra.shape[0] - 1, spectra.shape[1] - 1
    for row in range(first, last):
        up, down = max((row - 1) // 2 - top, 0), min((row + 1) // 2 - top, below)
        for column in range(cube.shape[1]):
            before, after = max((column - 1) // 2, 0), min((column + 1) // 2, right)
            a, b = spectra[up, before], spectra[up, after]
            c, d = spectra[down, before], spectra[down, after]
            share, change = kin[row, column], changes[row, column]
            p, q, r, s = share[0], share[1], share[2], share[3]
            spectrum, factor = cube[row, column], bright[row, column]
            if not change.any():
                for k in range(spectrum.size):
                    value = p * a[k] + q * b[k] + r * c[k] + s * d[k]
                    spectrum[k] = factor * max(value, np.float32(0))
                continue
            for k in range(spectrum.size):
                value = p * a[k] + q * b[k] + r * c[k] + s * d[k]
                for i in range(_CHANGED):  # a constant: unrolled, and kept in registers
                    value += change[i] * basis[i, k]
                spectrum[k] = factor * max(value, np.float32(0))


def _spelt_out(first, last, coarse, basis, kin, changes, bright, cube):
    """Write the spectra of some rows, a few at a time, whose coarse spectra the caches hold."""
    room = np.empty((_ROWS // 2 + 2, coarse.shape[1], basis.shape[1]), np.float32)
    for start in range(first, last, _ROWS):
        stop = min(start + _ROWS, last)
        top, bottom = max((start - 1) // 2, 0), min(stop // 2 + 1, len(coarse))
        spectra = np.matmul(coarse[top:bottom], basis, out=room[: bottom - top])
        _decoded(start, stop, top, kin, spectra, changes, basis[:_CHANGED], bright, cube)


# --- all of it ----------------------------------------------------------------------------------


@dataclass
class Coded:
    """A reconstructed picture before it is spelt out.

    A spectrum is that of the four coarse cells around a pixel, mixed by `kin`, plus `changes` in
    the leading coefficients, times `bright`.

    coarse : (H/2, W/2, C) coefficients.  kin : (H, W, 4).  changes : (H, W, CORRECTED[0]).
    bright : (h, w), NaN where nothing is known.
    """

    coarse: np.ndarray
    kin: np.ndarray
    changes: np.ndarray
    bright: np.ndarray

    @single_threaded_products()
    def spell_out(self, basis: np.ndarray, threads: int) -> np.ndarray:
        """Return spectra, (h, w, K), in a basis (C, K), of all bands or of some."""
        bands = basis.shape[1]
        whole = np.zeros((len(basis), bands + -bands % 16), np.float32)  # full vector registers
        whole[:, :bands] = basis
        # NumPy, other than torch, asks for huge pages: four times as fast where memory is new.
        cube = np.empty((*self.bright.shape, bands), np.float32)
        bright = np.ascontiguousarray(self.bright)
        over_rows(
            _spelt_out, len(cube), threads, self.coarse, whole, self.kin, self.changes, bright, cube
        )
        return cube

    def at(self, rows: ArrayLike, columns: ArrayLike, basis: np.ndarray) -> np.ndarray:
        """Return the spectra of some pixels, (N, K)."""
        row, column = np.asarray(rows), np.asarray(columns)
        whole = np.zeros((len(row), len(basis)), np.float32)
        for number in range(4):
            y = np.clip((row - 1) // 2 + number // 2, 0, len(self.coarse) - 1)
            x = np.clip((column - 1) // 2 + number % 2, 0, self.coarse.shape[1] - 1)
            whole += self.kin[row, column, number, None] * self.coarse[y, x]
        whole[:, : self.changes.shape[-1]] += self.changes[row, column]
        return np.maximum(whole @ basis, 0) * self.bright[row, column, None]


def blended(seen: Evidence, known: np.ndarray, threads: int) -> Coded:
    """Do what `interval.descend` does, for one picture.

    known : (h, w), what brightness is multiplied by; of the picture before it was filled up.
    """

    def array(values: Tensor) -> np.ndarray:
        return values[0].numpy()

    x = array(seen.coefficients)
    changes = np.empty(0, np.float32)
    for level in reversed(range(SPECTRAL)):
        kin, alone, own = (array(each[level]) for each in (seen.kin, seen.alone, seen.own))
        changes = np.empty_like(own)
        over_rows(_changes, len(own), threads, kin, x, own, alone, changes)
        if level:
            low = np.empty((*own.shape[:2], x.shape[-1]), np.float32)
            over_rows(inherited, len(own), threads, kin, x, low)
            low[..., : own.shape[-1]] += changes
            x = low
    height, width = known.shape
    bright = array(seen.bright.amplitude)[:height, :width] * known
    return Coded(x, array(seen.kin[0]), changes, bright)
