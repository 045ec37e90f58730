"""Figures of cubes: colours, bands, spectra and errors beside the truth, and a window to look in.

Each function returns a matplotlib Figure and touches no global state; `show` alone opens a window.
"""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from xarray import DataArray

from squilla.colour import composite, rgb, tristimulus
from squilla.errors import InputError
from squilla.evaluation.metrics import DARKEST, mse
from squilla.evaluation.style import (
    COLOURS,
    EMPTY,
    INK,
    WIDTH,
    canvas,
    draw_colour_bar,
    draw_picture,
    label_row,
    sheet,
    styled,
)
from squilla.files.lazy import DIMS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# --- cubes --------------------------------------------------------------------------------------


@styled
def colour_figure(
    truth: DataArray, estimates: Mapping[str, DataArray], light: np.ndarray | None = None
) -> "Figure":
    """Draw the colours of truth and estimates side by side.

    Above as the CIE 1931 observer sees them, below with the bands at 650, 550 and 500 nm as red,
    green and blue, gamma 2.2; all in the exposure of the truth.

    Source: thesis, figures 5.1 to 5.5, for the lower row.

    Parameters
    ----------
    truth : DataArray, (y, x, wavelength)
    estimates : mapping of model name to DataArray, (y, x, wavelength)
    light : array, (K,), optional
        Light of the scene on the truth's wavelengths, shown white.
    """
    cubes = {"truth": truth, **estimates}
    figure = sheet(2, len(cubes), truth.shape[0] / truth.shape[1])
    exposure, scale = _exposures(truth, light)
    for column, (name, cube) in enumerate(cubes.items()):
        white = None if light is None else np.interp(_bands(cube), _bands(truth), light)
        seen = rgb(cube.values, _bands(cube), white=white, exposure=exposure)
        bands = composite(cube.values, _bands(cube), white=white, scale=scale)
        draw_picture(figure.axes[column], seen, name)
        draw_picture(figure.axes[len(cubes) + column], bands ** (1 / 2.2))
    label_row(figure.axes[0], "CIE 1931 observer")
    label_row(figure.axes[len(cubes)], "650, 550, 500 nm")
    return figure


@styled
def band_figure(
    truth: DataArray,
    estimates: Mapping[str, DataArray],
    bands: Sequence[float] = (500, 550, 600, 650, 700, 750),
) -> "Figure":
    """Draw single bands, one row for the truth and one for each estimate.

    Each column is scaled to the truth, so that its rows compare.

    Source: thesis, figures A.2 to A.4.

    Parameters
    ----------
    truth : DataArray, (y, x, wavelength)
    estimates : mapping of model name to DataArray, (y, x, wavelength)
    bands : sequence of float
        nm; the nearest bands are shown, those beyond the cube not. Where all are, the bands at its
        ends and in its middle.
    """
    ends = _bands(truth)[[0, -1]] + (-1, 1)
    bands = [band for band in bands if ends[0] <= band <= ends[1]]
    bands = bands or list(np.unique(_bands(truth)[[0, len(_bands(truth)) // 2, -1]]))
    cubes = {"truth": truth, **estimates}
    figure = sheet(len(cubes), len(bands), truth.shape[0] / truth.shape[1])
    grid = np.reshape(np.array(figure.axes, object), (len(cubes), len(bands)))
    for column, band in enumerate(bands):
        top = np.nanpercentile(truth.sel(wavelength=band, method="nearest"), 99.8)
        for row, cube in enumerate(cubes.values()):
            picture = cube.sel(wavelength=band, method="nearest").values
            title = f"{band:g} nm" if row == 0 else ""
            draw_picture(grid[row, column], picture, title, vmin=0, vmax=max(top, 1e-12))
    for row, name in enumerate(cubes):
        label_row(grid[row, 0], name)
    return figure


@styled
def error_figure(truth: DataArray, estimates: Mapping[str, DataArray]) -> "Figure":
    """Draw where each estimate is wrong: the root mean squared error of every pixel's spectrum.

    The error is relative to the maximum of the true spectrum; pixels too dark to be judged are
    grey.

    Parameters
    ----------
    truth : DataArray, (y, x, wavelength)
    estimates : mapping of model name to DataArray, (y, x, wavelength)
    """
    import matplotlib
    from matplotlib.colors import LogNorm

    peak = truth.values.max(-1)
    peak = np.where(peak >= DARKEST * np.nanmax(peak), peak, np.nan)
    maps = {
        name: 100 * np.sqrt(mse(cube.values, truth.values)) / peak
        for name, cube in estimates.items()
    }
    inside = np.concatenate([each[np.isfinite(each)] for each in maps.values()])
    low, high = np.percentile(np.maximum(inside, 1e-3), (1, 99)) if inside.size else (1, 10)
    norm = LogNorm(low, max(high, 2 * low), clip=True)
    colours = matplotlib.colormaps["magma_r"].with_extremes(bad=EMPTY)
    figure = sheet(1, len(maps), truth.shape[0] / truth.shape[1], colour_bar=True)
    for axes, (name, each) in zip(figure.axes, maps.items(), strict=True):
        title = f"{name}, median {np.nanmedian(each):.2g} %"
        picture = draw_picture(axes, each, title, cmap=colours, norm=norm)
    draw_colour_bar(figure, picture, "rms error (% of the peak)")
    return figure


# --- spectra ------------------------------------------------------------------------------------


@styled
def spectra_figure(
    wavelength: np.ndarray,
    truth: np.ndarray,
    estimates: Mapping[str, np.ndarray],
    names: Sequence[str],
    *,
    columns: int = 4,
) -> "Figure":
    """Draw spectra in small panels, each model's mean squared error above its panel.

    Source: thesis, figures 5.1 to 5.5, for the layout and the scale of the error.

    Parameters
    ----------
    wavelength : array, (K,)
        nm.
    truth : array, (N, K)
    estimates : mapping of model name to array, (N, K)
    names : sequence of N str
    columns : int
        Panels beside each other.
    """
    columns = min(columns, len(names))
    rows = -(-len(names) // columns)
    figure = canvas(WIDTH, 0.35 + 1.45 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    _draw_spectra(axes, np.asarray(wavelength), truth, estimates, names)
    return figure


@styled
def points_figure(
    truth: DataArray,
    estimates: Mapping[str, DataArray],
    points: Sequence[tuple[int, int]] | None = None,
    light: np.ndarray | None = None,
) -> "Figure":
    """Draw the spectra of marked points beside the picture that shows where they are.

    Parameters
    ----------
    truth : DataArray, (y, x, wavelength)
    estimates : mapping of model name to DataArray, (y, x, wavelength)
    points : sequence of (row, column), optional
        px; default: six points whose spectra differ most (`distinct_points`).
    light : array, (K,), optional
        Light of the scene, shown white.
    """
    from matplotlib.patheffects import withStroke

    points = list(distinct_points(truth) if points is None else points)
    names = [chr(ord("A") + number) for number in range(len(points))]
    columns = max(2, -(-len(points) // 2))
    figure = canvas(WIDTH, 3.1)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 2.1))[0]
    axes = left.subplots()
    exposure, _ = _exposures(truth, light)
    draw_picture(axes, rgb(truth.values, _bands(truth), white=light, exposure=exposure))
    for name, (row, column) in zip(names, points, strict=True):
        axes.plot(column, row, "o", ms=6.5, mfc="none", mec="white", mew=1.8)
        axes.plot(column, row, "o", ms=6.5, mfc="none", mec=INK, mew=0.7)
        text = axes.annotate(name, (column, row), (5, 4), textcoords="offset points")
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
    place = tuple(np.transpose(points))
    panels = right.subplots(2, columns, squeeze=False, sharex=True, sharey=True)
    spectra = {name: cube.values[place] for name, cube in estimates.items()}
    _draw_spectra(panels, _bands(truth), truth.values[place], spectra, names)
    return figure


def distinct_points(cube: DataArray, count: int = 6) -> list[tuple[int, int]]:
    """Return points whose spectra differ most, found one after the other.

    Parameters
    ----------
    cube : DataArray, (y, x, wavelength)
    count : int

    Returns
    -------
    list of (row, column), px, from top to bottom
        Well inside areas of one colour, away from the rim and not in the dark.
    """
    from scipy.ndimage import uniform_filter

    height, width = cube.shape[:2]
    step = max(1, min(height, width) // 40)
    window = 2 * step + 1
    first = step if min(height, width) >= window else 0  # of a picture of 2 px all is rim
    some = (slice(first, height - first, step), slice(first, width - first, step))
    bands = np.nan_to_num(cube.values[..., :: max(1, cube.shape[-1] // 16)])
    mean = uniform_filter(bands, window, axes=(0, 1))[some]
    spread = uniform_filter(bands**2, window, axes=(0, 1))[some]
    spread = np.sqrt(np.maximum(spread - mean**2, 0)).mean(-1)
    level = mean.max(-1)
    shape = mean / np.maximum(level, 1e-12)[..., None]
    # Spectra in edges and in the dark are poor examples: their distances count less.
    spread = spread / np.maximum(level, 1e-12)
    worth = np.clip(level / (0.2 * level.max()), 0, 1) / (1 + (spread / 0.03) ** 2)
    rim = [size // 12 for size in level.shape]
    inner = np.zeros_like(worth)
    inner[rim[0] : -rim[0] or None, rim[1] : -rim[1] or None] = 1
    worth = worth * inner
    place = np.unravel_index(np.argmax(worth * level), level.shape)
    found, nearest = [place], np.full(level.shape, np.inf)
    for _ in range(count - 1):
        nearest = np.minimum(nearest, np.linalg.norm(shape - shape[place], axis=-1))
        place = np.unravel_index(np.argmax(nearest * worth), level.shape)
        found.append(place)
    return sorted((first + int(row) * step, first + int(column) * step) for row, column in found)


def _draw_spectra(
    axes: np.ndarray,
    wavelength: np.ndarray,
    truth: np.ndarray,
    estimates: Mapping[str, np.ndarray],
    names: Sequence[str],
) -> None:
    """Fill a grid of axes with spectra, each divided by the maximum of its truth."""
    from matplotlib.ticker import MaxNLocator

    panels = list(axes.flat)
    for number, (panel, name) in enumerate(zip(panels, names, strict=False)):
        peak = max(float(np.nanmax(truth[number])), 1e-12)
        reference = truth[number] / peak
        panel.fill_between(wavelength, reference, color="#e7e9ec", lw=0)
        panel.plot(wavelength, reference, color=INK, lw=0.9, label="truth")
        errors = []
        for colour, (model, spectra) in zip(cycle(COLOURS), estimates.items(), strict=False):
            panel.plot(wavelength, spectra[number] / peak, color=colour, label=model)
            errors.append((float(mse(spectra[number] / peak, reference)), colour))
        _headline(panel, name, errors)
        if len(wavelength) > 1:
            panel.set_xlim(wavelength[0], wavelength[-1])
        panel.set_ylim(0, 1.25)
        panel.set_yticks([0, 0.5, 1])
        panel.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
    for panel in panels[len(names) :]:
        panel.set_visible(False)
    for panel in axes[-1]:
        panel.set_xlabel("wavelength (nm)")
    for panel in axes[:, 0]:
        panel.set_ylabel("radiance / peak")
    figure = panels[0].figure
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower right",
        ncols=len(labels) + 1,
        handlelength=1.4,
        title="above each panel: mean squared error × 1000",
        alignment="right",
    )


def _headline(axes: "Axes", name: str, errors: list[tuple[float, str]]) -> None:
    """Write a name above a panel and under it, in thousandths, each model's error in its colour."""
    from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea

    axes.set_title(name, loc="left", fontweight="bold", pad=9)
    texts: list[Artist] = [
        TextArea(
            f"{1000 * error:.2g}" if error >= 1e-5 else "<0.01",
            textprops={"color": colour, "size": 6.5},
        )
        for error, colour in errors
    ]
    packed = HPacker(children=texts, pad=0, sep=5)
    anchor = {"bbox_to_anchor": (0, 1.01), "bbox_transform": axes.transAxes}
    box = AnchoredOffsetbox("lower left", child=packed, pad=0, borderpad=0, frameon=False, **anchor)
    box.set_in_layout(False)
    axes.add_artist(box)


# --- a window -------------------------------------------------------------------------------------


@styled
def show(cube: DataArray) -> None:
    """Open a cube: its colours, and the spectrum of whatever point is clicked.

    Parameters
    ----------
    cube : DataArray, (y, x, wavelength)

    Raises
    ------
    InputError
        If it is no such cube.
    """
    import matplotlib.pyplot as plt

    if not isinstance(cube, DataArray) or cube.dims != DIMS or "wavelength" not in cube.coords:
        raise InputError(
            "A DataArray (y, x, wavelength) can be shown; make one of an array and its wavelengths "
            "with squilla.labelled."
        )
    figure = plt.figure(figsize=(WIDTH, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    draw_picture(left, rgb(cube.values, _bands(cube)), str(cube.name or ""))
    right.set(xlabel="wavelength (nm)", ylabel=str(cube.attrs.get("units", "radiance")))
    if cube.shape[2] > 1:
        right.set_xlim(*_bands(cube)[[0, -1]])
    picked = 0

    def pick(row: int, column: int) -> None:
        nonlocal picked
        colour = COLOURS[picked % len(COLOURS)]
        right.plot(_bands(cube), cube.values[row, column], color=colour, label=f"({row}, {column})")
        left.plot(column, row, "o", ms=6, mfc="none", mec=colour, mew=1.5)
        right.legend(loc="best", title="row, column (px)")
        right.set_ylim(bottom=min(0, right.get_ylim()[0]))
        picked += 1
        figure.canvas.draw_idle()

    def clicked(event: Any) -> None:
        if event.inaxes is left and event.xdata is not None:
            pick(round(event.ydata), round(event.xdata))

    pick(cube.shape[0] // 2, cube.shape[1] // 2)
    figure.canvas.mpl_connect("button_press_event", clicked)
    plt.show()


def _bands(cube: DataArray) -> np.ndarray:
    return np.asarray(cube["wavelength"], float)


def _exposures(truth: DataArray, light: np.ndarray | None) -> tuple[float, float]:
    """Return the exposures that make the truth fill the scale, for `rgb` and for `composite`."""
    wavelength = _bands(truth)
    white = np.ones(len(wavelength)) if light is None else np.asarray(light, float)
    luminance = tristimulus(np.nan_to_num(truth.values), wavelength)[..., 1]
    luminance = luminance / max(float(tristimulus(white, wavelength)[1]), 1e-12)
    nearest = [int(np.abs(wavelength - band).argmin()) for band in (650, 550, 500)]
    shown = truth.values[..., nearest] / np.maximum(white[nearest], 1e-12)
    return float(np.percentile(luminance, 99)), float(np.nanpercentile(shown, 99.5))
