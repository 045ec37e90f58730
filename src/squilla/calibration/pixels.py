"""Dark and flat frames: what every pixel adds, how it answers, which pixels are broken."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import numba
import numpy as np

from squilla.errors import InputError
from squilla.files.raw import Raw

_FLICKER = 0.002
"""Change of the light from frame to frame that is evened out; noise makes less."""


@dataclass(frozen=True)
class Stack:
    """What several frames of the same thing tell of every pixel.

    mean : (rows, columns) float32, DN.
    variance : (rows, columns) float32, DN^2, from frame to frame; None for one frame.
    exposure : ms; None if unknown.
    camera : as the frames name it.
    light_change : largest change of the light against the first frame, which was evened out.
    """

    mean: np.ndarray
    variance: np.ndarray | None
    exposure: float | None
    camera: str
    light_change: float = 0.0

    @classmethod
    def of(cls, raws: Iterable[Raw], kind: str, darks: "Darks | None" = None) -> "Stack":
        """Average frames one by one, so that memory holds no more than one.

        Parameters
        ----------
        raws : iterable of Raw
        kind : str
            What they are, for messages.
        darks : Darks, optional
            For lit frames: each is then brought to the light of the first, where it differs from it
            by more than noise does. A lamp that flickers would pass for shot noise.

        Raises
        ------
        InputError
            If there is no frame, or they differ in size or exposure.
        """
        count, first, exposure, camera, change = 0, None, None, "", 0.0
        dark, level = np.zeros((0, 0), np.float32), 1.0
        total = squares = np.zeros((0, 0), np.float32)
        for raw in raws:
            if first is None:  # what is summed is the small difference to it: float32 is enough
                first, exposure = raw.frame, raw.exposure
                total, squares = np.zeros((2, *first.shape), np.float32)
                if darks is not None:
                    dark = darks.at(exposure)
                    level = _level(first, dark)
            if raw.frame.shape != first.shape:
                raise InputError(
                    f"The {kind} frames differ in size: {first.shape} and {raw.frame.shape}."
                )
            if raw.exposure != exposure:
                raise InputError(
                    f"The {kind} frames differ in exposure, {exposure} and {raw.exposure} ms; give "
                    "only those of one."
                )
            here = 1.0 if darks is None else _level(raw.frame, dark) / level
            if abs(here - 1) > _FLICKER:
                change = max(change, abs(here - 1))
                even = (raw.frame - dark) / np.float32(max(here, 0.01)) + dark
                _accumulate(even, first, total, squares)
            else:
                _accumulate(raw.frame, first, total, squares)
            count += 1
            camera = str(raw.metadata.get("camera", ""))
        if first is None:
            raise InputError(f"There is no {kind} frame; at least two are needed, better eight.")
        mean = total / count
        variance = None
        if count > 1:
            variance = np.asarray((squares - count * mean**2) / (count - 1))
        return cls(first + mean, variance, exposure, camera, change)


def _level(frame: np.ndarray, dark: np.ndarray) -> float:
    """Return the mean light of a frame, DN."""
    few = (slice(None, None, 3), slice(None, None, 3))
    return max(float((frame[few] - dark[few]).mean(dtype=float)), 1e-3)


@numba.njit(parallel=True, cache=True)
def _accumulate(frame, first, total, squares):
    for row in numba.prange(frame.shape[0]):
        for column in range(frame.shape[1]):
            step = np.float32(frame[row, column]) - np.float32(first[row, column])
            total[row, column] += step
            squares[row, column] += step * step


@dataclass(frozen=True)
class Darks:
    """What dark frames of one or several exposures tell of every pixel.

    bias : (rows, columns) float32, DN at no exposure.
    rate : (rows, columns) float32, DN per ms; zero where only one exposure is known.
    shortest : the frames of the shortest exposure.
    """

    bias: np.ndarray
    rate: np.ndarray
    shortest: Stack

    @classmethod
    def of(cls, raws: Iterable[Raw]) -> "Darks":
        """Average dark frames of each exposure; the shortest and the longest give the rate."""
        ordered = sorted(_grouped(raws).items())
        (short, first), (long, last) = ordered[0], ordered[-1]
        if long - short <= 0:
            return cls(first.mean, np.zeros_like(first.mean), first)
        rate = (last.mean - first.mean) / np.float32(long - short)
        return cls(first.mean - rate * np.float32(short), rate, first)

    def at(self, exposure: float | None) -> np.ndarray:
        """Return the dark frame of an exposure in ms, (rows, columns) DN."""
        return self.bias + self.rate * np.float32(exposure or 0.0)


def _grouped(raws: Iterable[Raw]) -> dict[float, Stack]:
    """Average frames by their exposure; each exposure's frames must follow each other."""
    stacks = {}
    for exposure, group in groupby(raws, key=lambda raw: raw.exposure or 0.0):
        if exposure in stacks:
            raise InputError(f"The dark frames of {exposure:g} ms must follow each other.")
        stacks[exposure] = Stack.of(group, "dark")
    if not stacks:
        raise InputError("There is no dark frame; at least two are needed, better eight.")
    return stacks


def noise_of(dark: Stack, flat: Stack, lit: np.ndarray) -> tuple[float, float]:
    """Return gain (e-/DN) and read noise (e-) from how frames of the same thing vary.

    Source: the photon transfer method: shot noise has the variance of its mean in electrons, so the
    variance in DN grows with the mean by 1 / gain (Janesick, Photon Transfer).

    Parameters
    ----------
    dark, flat : Stack
        Of at least two frames each.
    lit : array, (rows, columns) bool
        Pixels that the flat lights evenly.
    """
    if dark.variance is None or flat.variance is None:
        raise InputError("Noise is learnt from repeated frames: give at least two darks and flats.")
    rounding = 1 / 12
    read = float(np.median(dark.variance))  # hot pixels do not move a median far
    read = max(float(np.mean(np.minimum(dark.variance, 20 * max(read, rounding)))) - rounding, 0.0)
    signal = (flat.mean - dark.mean)[lit].astype(np.float64)
    grown = (flat.variance - dark.variance)[lit].astype(np.float64)
    slope = float((signal * grown).sum() / (signal**2).sum())
    if slope <= 0:
        raise InputError(
            "The flat frames do not vary more than the dark ones: they are dark, saturated or "
            "averaged; take them at about half of the full scale."
        )
    return 1 / slope, float(np.sqrt(read)) / slope


def defective(dark: np.ndarray, flat: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return the pixels that cannot be believed, (rows, columns) bool: hot, dead or unlit.

    Parameters
    ----------
    dark : array, (rows, columns)
        DN.
    flat : array, (rows, columns)
        Relative response, 1 for a normal pixel.
    lit : array, (rows, columns) bool
        Pixels that the flat lights evenly.
    """
    level = float(np.median(dark))
    spread = 1.4826 * float(np.median(np.abs(dark - level)))
    hot = dark > level + max(12 * spread, 4.0)
    return hot | ~lit | (flat < 0.5) | (flat > 1.5)
