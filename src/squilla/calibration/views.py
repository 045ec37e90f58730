"""The sub-images of a frame: cut out, corrected, evened."""

from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.files.raw import Raw


@dataclass(frozen=True)
class SubImages:
    """Every unit's field with a margin around, corrected, not yet aligned.

    image : Tensor, (M, H + 2 margin, W + 2 margin) float32, DN.
    bad : Tensor of the same shape, bool; saturated, defective or outside the sensor.
    offset : (M, 2) px; where in its image each unit sees an infinitely distant point on the axis,
        against the middle.
    margin : px.
    saturated : share of saturated pixels, margins and all.
    """

    image: Tensor
    bad: Tensor
    offset: np.ndarray
    margin: int
    saturated: float

    @cached_property
    def level(self) -> np.ndarray:
        """Mean of each unit's field, (M,) float32, DN."""
        return inner(self.image, self.margin).mean((1, 2)).numpy()


def sub_images(raw: Raw, lattice: Lattice, pixels: Pixels, margin: int) -> SubImages:
    """Cut the sub-images out of a frame, subtract the dark, divide by the flat.

    Bad pixels are filled with the mean of their good neighbours.
    """
    origin = _corners(lattice, margin)
    height, width = (size + 2 * margin for size in lattice.field)
    image = np.empty((len(origin), height, width), np.float32)
    bad = np.empty(image.shape, bool)
    exposure, saturation = np.float32(raw.exposure or 0.0), np.float32(pixels.saturation)
    saturated = np.zeros((len(origin), height), np.int64)
    _correct(
        raw.frame, pixels.bias, pixels.dark_rate, exposure, pixels.flat, pixels.valid, saturation,
        origin, image, bad, saturated,
    )  # fmt: skip
    fill(image, bad)
    offset = lattice.centre - origin - (np.array(lattice.field) - 1) / 2 - margin
    share = float(saturated.sum() / image.size)
    return SubImages(torch.from_numpy(image), torch.from_numpy(bad), offset, margin, share)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _correct(
    frame, bias, rate, exposure, flat, valid, saturation, origin, image, bad, saturated
):  # fmt: skip
    units, height, width = image.shape
    rows, columns = frame.shape
    for line in numba.prange(units * height):
        unit, row = line // height, line % height
        y, left = origin[unit, 0] + row, origin[unit, 1]
        start, stop = max(left, 0), min(left + width, columns)
        image[unit, row], bad[unit, row] = 0, True
        if y < 0 or y >= rows or stop <= start:
            continue
        values, flags = image[unit, row, start - left : stop - left], bad[unit, row, start - left :]
        level, usable = frame[y, start:stop], valid[y, start:stop]
        dark, slope, share = bias[y, start:stop], rate[y, start:stop], flat[y, start:stop]
        for n in range(stop - start):
            value = (np.float32(level[n]) - dark[n] - exposure * slope[n]) / share[n]
            # What is saturated was at least so bright.
            values[n] = value if usable[n] else np.float32(0)
        count = 0
        for n in range(stop - start):
            over = np.float32(level[n]) >= saturation
            flags[n] = over or not usable[n]
            count += over
        saturated[unit, row] = count


@numba.njit(parallel=True, cache=True, nogil=True)
def fill(image, bad):
    """Put the mean of its good neighbours into each bad pixel of (M, H, W) pictures.

    What was saturated keeps its value beside others as bright: it was at least that. A single one
    that stands out of its neighbours twofold is a defect, for a lens spreads every point.
    """
    units, rows, columns = image.shape
    for line in numba.prange(units * rows):
        unit, row = line // rows, line % rows
        flags, some = bad[unit, row], False
        for column in range(columns):  # most lines are good, which a vector loop tells at once
            some |= flags[column]
        if some:
            for column in range(columns):
                if flags[column]:
                    fill_one(image[unit], bad[unit], row, column)


@numba.njit(cache=True, nogil=True)
def fill_one(image, bad, row, column):
    """Do what `fill` does for one pixel of one picture."""
    rows, columns = image.shape
    total, count = 0.0, 0
    for y in range(max(row - 1, 0), min(row + 2, rows)):
        for x in range(max(column - 1, 0), min(column + 2, columns)):
            if not bad[y, x]:
                total += image[y, x]
                count += 1
    if count:
        mean, own = np.float32(total / count), image[row, column]
        image[row, column] = own if mean < own < 2 * mean else mean


def windows(image: np.ndarray, lattice: Lattice, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut every unit's field out of a frame, at whole pixels.

    Returns
    -------
    origin : array, (M, 2) int
        Frame position of each window's first pixel.
    images : array, (M, H + 2 margin, W + 2 margin); zero outside the sensor.
    """
    origin = _corners(lattice, margin)
    height, width = (size + 2 * margin for size in lattice.field)
    images = np.zeros((len(origin), height, width), image.dtype)
    for window, (y, x) in zip(images, origin, strict=True):
        top, left = max(y, 0), max(x, 0)
        part = image[top : max(y + height, 0), left : max(x + width, 0)]
        window[top - y : top - y + part.shape[0], left - x : left - x + part.shape[1]] = part
    return origin, images


def _corners(lattice: Lattice, margin: int) -> np.ndarray:
    """Return the frame position of each window's first pixel, (M, 2) int."""
    half = (np.array(lattice.field) - 1) / 2
    return np.floor(lattice.centre - half).astype(int) - margin


def inner(images, margin: int):
    """Return pictures without their margin."""
    return images[:, margin : images.shape[1] - margin, margin : images.shape[2] - margin]


def evened(views: SubImages, lattice: Lattice, calibration: Calibration) -> SubImages:
    """Return sub-images without the shading that each filter gives the scene's mean spectrum.

    Towards the edge of the field lenses get less light, and filters pass other wavelengths. That
    shading stays with the unit when the scene moves, and would hold it where it is. Only for
    finding places: single points have other spectra, and keep their field angle instead.
    """
    if len(calibration.angle) < 2:
        return views
    response = calibration.mean_sensitivity.double().numpy()
    gram = response @ response.T
    gram += 1e-3 * np.trace(gram) / len(gram) * np.eye(len(gram))
    level = views.level.astype(float)
    spectrum = response.T @ np.linalg.solve(gram, level)
    light = np.maximum(calibration.sensitivity @ spectrum, 1e-30)  # (A, M)
    share = np.clip(light / light[0], 0.5, 2)
    square = np.tan(calibration.angle) ** 2 / np.tan(calibration.angle[-1]) ** 2
    powers = np.stack([square - square[0], square**2 - square[0] ** 2], -1)
    fit = np.linalg.lstsq(powers, share - 1, rcond=None)[0].T
    image = np.empty_like(views.image.numpy())
    middle = views.margin + views.offset + (np.array(lattice.field) - 1) / 2
    reach = lattice.focal * np.tan(calibration.angle[-1])
    _even(views.image.numpy(), middle, reach, fit.astype(np.float32), image)
    return replace(views, image=torch.from_numpy(image))


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _even(image, middle, reach, fit, even):
    units, rows, columns = image.shape
    for line in numba.prange(units * rows):
        unit, row = line // rows, line % rows
        y = np.float32((row - middle[unit, 0]) / reach)
        left, step = np.float32(-middle[unit, 1] / reach), np.float32(1 / reach)
        for column in range(columns):
            x = left + column * step
            t = min(y * y + x * x, np.float32(1))
            share = 1 + t * (fit[unit, 0] + t * fit[unit, 1])
            even[unit, row, column] = image[unit, row, column] / share
