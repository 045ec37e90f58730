"""`cube.squilla`: what a cube can show of itself, above all in a notebook."""

import json
from base64 import b64encode
from importlib.resources import files as package_files
from io import BytesIO
from secrets import token_hex

import numpy as np
from xarray import DataArray

from squilla.colour import rgb
from squilla.errors import InputError

_POINTS, _BANDS = 64, 84
"""Points a side and bands that a notebook keeps of a cube: about half a megabyte."""

_SIDE = 380
"""Width of the picture in a notebook, CSS px."""


class CubeAccessor:
    """The part ``cube.squilla`` of every cube.

    As the last line of a notebook's cell it shows the cube in colour; a click, or the arrow keys,
    choose the point whose spectrum is drawn beside it. The picture stays when scripts are not
    allowed to run.

    Parameters
    ----------
    cube : DataArray, (y, x, wavelength)
    """

    def __init__(self, cube: DataArray):
        if set(cube.dims) != {"y", "x", "wavelength"} or "wavelength" not in cube.coords:
            raise InputError(
                "squilla can show cubes (y, x, wavelength) with their wavelengths; this array has "
                f"the dims {cube.dims}."
            )
        self._cube = cube.transpose("y", "x", "wavelength")
        self._wavelength = np.asarray(cube["wavelength"], float)

    def rgb(self, white: np.ndarray | None = None) -> DataArray:
        """Return the colours that the CIE 1931 observer sees.

        Parameters
        ----------
        white : array, (K,), optional
            Spectrum that shall look white, the light of the scene; equal at all wavelengths if
            not given.

        Returns
        -------
        DataArray, (y, x, channel), 0..1, sRGB
        """
        values = rgb(self._cube.values, self._wavelength, white=white)
        return DataArray(values, {"channel": ["red", "green", "blue"]}, ("y", "x", "channel"))

    def spectrum(self, y: int, x: int, radius: int = 0) -> DataArray:
        """Return the mean spectrum of a square of pixels, those that are not valid left out.

        Parameters
        ----------
        y, x : int
            Its middle, px.
        radius : int
            Pixels around the middle on each side; 0 is the pixel alone.

        Returns
        -------
        DataArray, (wavelength,)
        """
        rows, columns = self._cube.shape[:2]
        if not (0 <= y < rows and 0 <= x < columns and radius >= 0):
            raise InputError(f"There is no pixel ({y}, {x}) in a cube of {rows} x {columns}.")
        top, left = max(y - radius, 0), max(x - radius, 0)
        square = self._cube[top : y + radius + 1, left : x + radius + 1]
        return square.mean(("y", "x"), keep_attrs=True)

    def _repr_html_(self) -> str:
        cube, name = self._cube, f"squilla-{token_hex(4)}"
        rows, columns, bands = cube.shape
        few = np.unique(np.linspace(0, bands - 1, min(bands, _BANDS)).round().astype(int))
        places = [
            np.linspace(0, size - 1, min(size, _POINTS)).round().astype(int)
            for size in (rows, columns)
        ]
        values = np.nan_to_num(cube.values[np.ix_(*places, few)]).clip(0)
        largest = values.max(-1, keepdims=True)
        share = np.round(255 * values / np.maximum(largest, 1e-30)).astype(np.uint8)
        data = {
            "wavelength": self._wavelength[few].round(2).tolist(),
            "rows": places[0].tolist(),
            "columns": places[1].tolist(),
            "largest": [float(f"{value:.4g}") for value in largest.ravel()],
            "share": b64encode(share.tobytes()).decode(),
        }
        first, last = self._wavelength[[0, -1]]
        script = (package_files("squilla") / "files" / "notebook.js").read_text(encoding="utf-8")
        return _PAGE.format(
            name=name, picture=_png(self.rgb().values), side=_SIDE, rows=rows, columns=columns,
            height=round(_SIDE * rows / columns), data=json.dumps(data), script=script,
            text=f"{rows} &times; {columns} px, {bands} bands, {first:g}&ndash;{last:g} nm",
        )  # fmt: skip


def _png(colours: np.ndarray) -> str:
    from PIL import Image

    stream = BytesIO()
    Image.fromarray(np.round(255 * np.nan_to_num(colours)).astype(np.uint8)).save(stream, "png")
    return b64encode(stream.getvalue()).decode()


_PAGE = """\
<div id="{name}" style="display: flex; flex-wrap: wrap; gap: 16px; font: 13px sans-serif">
<div><svg class="picture" width="{side}" height="{height}" viewBox="0 0 {columns} {rows}"
 tabindex="0" role="application" aria-label="Cube in colour; click, or use the arrow keys"
 style="cursor: crosshair">
<image href="data:image/png;base64,{picture}" width="{columns}" height="{rows}"/>
</svg><br>{text}</div>
<svg class="plot" width="420" height="{height}"></svg>
</div>
<script>
(
{script}
)(document.getElementById("{name}"), {data});
</script>
"""
