"""The back end of the compound model on a processor, and spectra worked out only where asked.

`back_end.BackEnd` says what is computed. Here its three networks are left to an engine, and the
rest runs in loops that pass memory once. What comes out stays in coefficients until somebody wants
bands, spectra or the whole cube.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.reconstruction.compiled import inherited
from squilla.reconstruction.engine import Network
from squilla.reconstruction.evidence import CORRECTED, SPECTRAL, Evidence
from squilla.reconstruction.kernels import ONE, compiled, over_rows, sigmoid, times
from squilla.threads import single_threaded_products

_CHANGED = CORRECTED[0]


@compiled
def _unit(cell, scale):
    """Return the rms of coefficients relative to their scale."""
    total = np.float32(0)
    for i in range(scale.size):
        total += (cell[i] / scale[i]) ** 2
    return max(math.sqrt(total / scale.size), np.float32(1e-6))


@compiled
def _clamped(value, most):
    return min(max(value, -most), most)


@compiled
def _coarse_inputs(first, last, coefficients, variance, features, scale, inputs):
    """Write what the network of the coarse cells sees; see `back_end.BackEnd`."""
    size, ten = scale.size, np.float32(10)
    for row in range(first, last):
        for column in range(inputs.shape[1]):
            cell, spread, seen = (
                coefficients[row, column],
                variance[row, column],
                inputs[row, column],
            )
            unit = _unit(cell, scale)
            for i in range(size):
                seen[i] = _clamped(cell[i] / (scale[i] * unit), ten)
            for i in range(size):
                doubt = math.sqrt(spread[i]) / (scale[i] * unit)
                seen[size + i] = math.log(max(doubt, np.float32(1e-6)))
            seen[2 * size] = features[row, column, 0] / 4
            seen[2 * size + 1] = features[row, column, 1] / 4


@compiled
def _unevenness(amplitude, smooth, deviation):
    return _clamped((smooth / amplitude - ONE) / deviation, np.float32(10))


@compiled
def _fine_inputs(first, last, low, own, noise, alone, scale, amplitude, smooth, inputs):
    """Write what the network of a finer level sees; an amplitude counts at the finest alone."""
    used, ten = scale.size, np.float32(10)
    for row in range(first, last):
        for column in range(inputs.shape[1]):
            cell, itself, seen = low[row, column], own[row, column], inputs[row, column]
            unit, deviation = _unit(cell, scale), math.sqrt(noise[row, column])
            told = max(deviation, np.float32(0.02))
            for i in range(used):
                seen[i] = _clamped(cell[i] / (scale[i] * unit), ten)
            for i in range(used):
                seen[used + i] = _clamped((itself[i] - cell[i]) / (scale[i] * unit * told), ten)
            seen[2 * used] = math.log(deviation) + 3
            seen[2 * used + 1] = _clamped(alone[row, column], ten) / 4
            seen[2 * used + 2] = math.log(unit)
            seen[2 * used + 3] = 0
            if amplitude.size:
                bright, even = amplitude[row, column], smooth[row, column]
                seen[2 * used + 3] = _unevenness(bright, even, deviation)


@compiled
def _fine_changes(
    first, last, low, own, noise, alone, scale, found, amplitude, smooth, changes, bright
):
    """Write how a finer level changes the leading coefficients, and the amplitude."""
    used = scale.size
    for row in range(first, last):
        for column in range(changes.shape[1]):
            cell, told, change = low[row, column], found[row, column], changes[row, column]
            deviation = math.sqrt(noise[row, column])
            step = deviation * _unit(cell, scale)
            itself = sigmoid(alone[row, column] + told[used])
            for i in range(used):
                change[i] = itself * (own[row, column, i] - cell[i]) + step * scale[i] * told[i]
            if amplitude.size:
                uneven = _unevenness(amplitude[row, column], smooth[row, column], deviation)
                calm = uneven * math.exp(-3 * uneven * uneven) * deviation
                calm *= sigmoid(told[used + 1])
                bright[row, column] = amplitude[row, column] * (ONE + calm)


@compiled
def _decoded(first, last, kin, spectra, changes, basis, bright, cube):
    """Write non-negative spectra: those of the four coarse cells mixed, changed, and bright."""
    below, right = spectra.shape[0] - 1, spectra.shape[1] - 1
    for row in range(first, last):
        up, down = max((row - 1) // 2, 0), min((row + 1) // 2, below)
        for column in range(cube.shape[1]):
            before, after = max((column - 1) // 2, 0), min((column + 1) // 2, right)
            a, b = spectra[up, before], spectra[up, after]
            c, d = spectra[down, before], spectra[down, after]
            share, change = kin[row, column], changes[row, column]
            p, q, r, s = share[0], share[1], share[2], share[3]
            spectrum, factor = cube[row, column], bright[row, column]
            for k in range(spectrum.size):
                value = p * a[k] + q * b[k] + r * c[k] + s * d[k]
                for i in range(_CHANGED):  # a constant: unrolled, and kept in registers
                    value += change[i] * basis[i, k]
                spectrum[k] = factor * max(value, np.float32(0))


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
        spectra = np.empty((*self.coarse.shape[:2], whole.shape[1]), np.float32)
        over_rows(times, len(spectra), threads, self.coarse, whole, spectra)
        # NumPy, other than torch, asks for huge pages: four times as fast where memory is new.
        cube = np.empty((*self.bright.shape, bands), np.float32)
        over_rows(
            _decoded, len(cube), threads, self.kin, spectra, self.changes,
            whole[:_CHANGED], np.ascontiguousarray(self.bright), cube,
        )  # fmt: skip
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


def refine(seen: Evidence, networks: Sequence[Network], scale: np.ndarray, threads: int) -> Coded:
    """Do what `back_end.BackEnd` does, up to the coefficients, for one picture.

    networks : of the coarse cells, of the finest and of those between.
    """

    def run(kernel: Callable[..., None], picture: np.ndarray, *arguments) -> np.ndarray:
        over_rows(kernel, len(picture), threads, *arguments, picture)
        return picture

    def array(values: Tensor) -> np.ndarray:
        return values[0].numpy()

    spectral, *finer = networks
    coefficients, variance = array(seen.coefficients), array(seen.variance)
    inputs = np.empty((*coefficients.shape[:2], 2 * len(scale) + 2), np.float32)
    run(_coarse_inputs, inputs, coefficients, variance, array(seen.features), scale)
    x = coefficients + np.sqrt(variance) * spectral(inputs[None])[0, ..., : len(scale)]
    nothing = np.empty((0, 0), np.float32)
    changes = bright = nothing
    for level in reversed(range(SPECTRAL)):
        kin, alone, own, noise = (
            array(values[level]) for values in (seen.kin, seen.alone, seen.own, seen.noise)
        )
        used, sides = own.shape[-1], own.shape[:2]
        light = nothing, nothing
        if level == 0:
            light = array(seen.amplitude), array(seen.smooth)
            bright = np.empty(sides, np.float32)
        low = run(inherited, np.empty((*sides, len(scale) if level else used), np.float32), kin, x)
        told = low, own, noise, alone, scale[:used]
        inputs = run(_fine_inputs, np.empty((*sides, 2 * used + 4), np.float32), *told, *light)
        found = finer[level](inputs[None])[0]
        changes = np.empty((*sides, used), np.float32)
        over_rows(_fine_changes, sides[0], threads, *told, found, *light, changes, bright)
        if level:
            x = low
            x[..., :used] += changes
    return Coded(x, array(seen.kin[0]), changes, bright)
