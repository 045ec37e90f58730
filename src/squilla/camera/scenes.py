"""Scenes to photograph: the colour chart, two measured pictures, files of one's own."""

from importlib.resources import files as package_files
from pathlib import Path

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.cube import labelled, read_scene
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


_SHIPPED = {
    "indian-pines": "indian_pines.npz",
    "corn-kernel": "corn-kernel-hyperspectral.hdr",
}
SCENES = ("chart", *_SHIPPED)
"""Names of the scenes that ship."""


def load_scene(
    source: str | Path, wavelength: np.ndarray, size: int = 250, *, light: str = CHART_LIGHT
) -> DataArray:
    """Return a scene that fills the camera's field, by name or from a file.

    The shipped pictures are taken out of their own light, whose spectrum is estimated as the 99th
    percentile of each band, and put under `light`. A file of one's own keeps its light.

    Parameters
    ----------
    source : str or Path
        "chart", "indian-pines", "corn-kernel", or a file that `read_scene` reads.
    wavelength : array, (K,)
        Wavelengths of the camera, nm, which the scene must cover.
    size : int
        Height and width wanted, px.
    light : str
        Name of a light in `squilla.spectra.lights`.

    Returns
    -------
    DataArray, (y, x, wavelength), float32, about 1 at its brightest
    """
    if source == "chart":
        chart = chart_scene(light, size)
        values = resample(chart.values, chart["wavelength"].values, wavelength)
        return labelled(values, wavelength, attributes=chart.attrs)
    shipped = _SHIPPED.get(str(source))
    if shipped is None:
        scene = read_scene(source)
        return fitted(scene, wavelength, size)
    folder = Path(str(package_files("squilla"))) / "data" / "scenes"
    picture = fitted(read_scene(folder / shipped), wavelength, size)
    lamp = lights().one(light, wavelength)
    own = np.percentile(picture.values, 99, axis=(0, 1))
    values = np.clip(picture.values / own, 0, 1.2) * lamp
    return labelled(
        values.astype(np.float32),
        wavelength,
        attributes={"name": f"{source} under {light}", "light": light},
    )


def fitted(scene: DataArray, wavelength: np.ndarray, size: int) -> DataArray:
    """Cut the middle square out of a scene and resize it to the camera's field and wavelengths.

    Bicubic, with smoothing where it becomes smaller; scaled to 1 at its 99.9th percentile.
    """
    import torch

    values = resample(
        scene.values.astype(np.float32), np.asarray(scene["wavelength"], float), wavelength
    )
    side = min(values.shape[:2])
    top, left = ((length - side) // 2 for length in values.shape[:2])
    square = torch.from_numpy(values[top : top + side, left : left + side]).permute(2, 0, 1)
    resized = torch.nn.functional.interpolate(
        square[None], (size, size), mode="bicubic", antialias=True, align_corners=False
    )[0].clamp_min(0)
    values = resized.permute(1, 2, 0).numpy()
    peak = max(float(np.percentile(values, 99.9)), 1e-12)
    return labelled(np.ascontiguousarray(values / peak), wavelength, attributes=dict(scene.attrs))
