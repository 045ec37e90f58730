"""Scenes to photograph: the colour chart under the light of the evaluation."""

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.cube import labelled
from squilla.spectra import CHART_LIGHT, chart_reflectances, lights, resample

CHART_SHAPE = (4, 6)
"""Rows and columns of patches."""

_PATCH = 0.86  # side of a patch over the distance of two, as on a printed ColorChecker
_FRAME = 0.03  # reflectance of the matte black between them


def chart_layout(height: int, width: int) -> np.ndarray:
    """Return where the patches of a colour chart lie in a picture that it fills.

    Parameters
    ----------
    height, width : int
        px.

    Returns
    -------
    array, (height, width), int
        Number of the patch, row by row from 0; -1 between patches.

    Raises
    ------
    InputError
        If the picture is too small for patches of 3 px.
    """
    rows, columns = CHART_SHAPE
    side = min(height / rows, width / columns)
    if side * _PATCH < 3:
        raise InputError(f"A chart needs at least 14 x 21 px, not {height} x {width}.")

    def cell(size: int, count: int) -> np.ndarray:
        """Return the number of the cell that each pixel of an axis lies in, -1 for none."""
        place = (np.arange(size) + 0.5 - size / 2) / side + count / 2
        number = np.floor(place)
        inside = (np.abs(place - number - 0.5) < _PATCH / 2) & (number >= 0) & (number < count)
        return np.where(inside, number, -1).astype(int)

    row, column = cell(height, rows)[:, None], cell(width, columns)[None, :]
    return np.where((row >= 0) & (column >= 0), row * columns + column, -1)


def chart_scene(light: str = CHART_LIGHT, size: int = 250) -> DataArray:
    """Build the colour chart: 24 matte patches in a black frame under one lamp.

    For evaluation only: never train on it.

    Parameters
    ----------
    light : str
        Name of a light in `squilla.spectra.lights`.
    size : int
        Height and width, px.

    Returns
    -------
    DataArray, (y, x, wavelength), float32
        Photon radiance, relative to a white surface at the peak of the light; 500-750 nm.
    """
    chart, lamp = chart_reflectances(), lights()
    labels = chart_layout(size, size)
    surfaces = np.vstack([chart.values, np.full(len(chart.wavelength), _FRAME)])
    radiance = surfaces * resample(lamp[light], lamp.wavelength, chart.wavelength)
    return labelled(
        radiance.astype(np.float32)[labels],  # -1 is the last row: the frame
        chart.wavelength,
        attributes={"name": f"colour chart under {light}", "light": light},
    )
