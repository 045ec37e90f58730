"""Figures of what the camera saw: raw frames, sub-images, their alignment and disparity."""

from typing import TYPE_CHECKING

import numpy as np

from squilla.evaluation.style import (
    COLOURS,
    EMPTY,
    WIDTH,
    canvas,
    draw_colour_bar,
    draw_picture,
    label_row,
    sheet,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def raw_figure(frame: np.ndarray, centres: np.ndarray, field: tuple[int, int]) -> "Figure":
    """Draw a raw frame with the sub-images that were found in it, and one of them larger.

    Parameters
    ----------
    frame : array, (rows, columns)
        DN.
    centres : array, (M, 2)
        Centre of each sub-image, (y, x), px.
    field : (int, int)
        Height and width of a sub-image, px.
    """
    from matplotlib.patches import Rectangle

    height, width = frame.shape
    figure = canvas(WIDTH, 0.35 + WIDTH * 0.64 * height / width)
    whole, close = figure.subplots(1, 2, width_ratios=(1.9, 1))
    top = max(float(np.percentile(frame[::7, ::7], 99.9)), 1.0)
    chosen = np.linalg.norm(centres - np.array(frame.shape) / 2, axis=1).argmin()
    around = [
        slice(max(0, round(middle - 0.68 * size)), min(limit, round(middle + 0.68 * size)))
        for middle, size, limit in zip(centres[chosen], field, frame.shape, strict=True)
    ]
    views = (
        (whole, slice(0, height), slice(0, width), max(1, width // 1600)),
        (close, *around, 1),
    )
    for axes, rows, columns, step in views:
        shown = np.sqrt(frame[rows, columns][::step, ::step] / top)
        extent = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
        axes.imshow(shown, vmin=0, vmax=1, extent=extent, interpolation="antialiased")
        for unit, (y, x) in enumerate(centres):
            corner = (x - field[1] / 2, y - field[0] / 2)
            line = {"fc": "none", "ec": COLOURS[-1], "lw": 1.4 if unit == chosen else 0.6}
            axes.add_patch(Rectangle(corner, field[1], field[0], **line))
            axes.plot(x, y, "+", color=COLOURS[-1], ms=4 if axes is whole else 9, mew=0.7)
        axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="column (px)")
        axes.spines[:].set_visible(False)
    whole.set_ylabel("row (px)")
    whole.set_title(f"raw frame, {height} × {width} px, {len(centres)} sub-images", loc="left")
    close.set_title(f"unit {chosen}", loc="left")
    return figure


@styled
def alignment_figure(before: np.ndarray, after: np.ndarray, shape: tuple[int, int]) -> "Figure":
    """Draw the sub-images and the edges of three far units before and after alignment.

    The edges of three units, corners where there are as many, are printed over each other in cyan,
    magenta and yellow: where they agree they make black lines, where not they fall apart into
    colours.

    Parameters
    ----------
    before, after : array, (M, H, W)
    shape : (int, int)
        Rows and columns of the array.
    """
    rows, columns = shape
    corners = [0, columns - 1, (rows - 1) * columns]
    if min(shape) == 1:
        corners = [0, len(before) // 2, len(before) - 1]
    ratio = before.shape[1] / before.shape[2]
    figure = sheet(2, 2, ratio, width=WIDTH * 0.8)
    for column, (title, images) in enumerate({"before": before, "after": after}.items()):
        agreement = _edge_agreement(images)
        draw_picture(figure.axes[column], _mosaic(images, shape), title, vmin=0, vmax=1)
        inks = np.stack([_edges(images[unit]) for unit in corners], -1)
        draw_picture(figure.axes[2 + column], 1 - inks, f"correlation of edges {agreement:.2f}")
    label_row(figure.axes[0], f"all {len(before)} sub-images")
    label_row(figure.axes[2], "edges of three far units")
    return figure


@styled
def disparity_figure(disparity: np.ndarray) -> "Figure":
    """Draw a disparity map: how far a point moves from one unit to the next.

    Parameters
    ----------
    disparity : array, (H, W)
        px per lens pitch; NaN where unknown.
    """
    import matplotlib

    low, high = np.nanpercentile(disparity, (0.5, 99.5))
    middle, half = (low + high) / 2, max((high - low) / 2, 0.05)
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=EMPTY)
    figure = sheet(1, 1, disparity.shape[0] / disparity.shape[1], 0.55 * WIDTH, colour_bar=True)
    limits = {"vmin": middle - half, "vmax": middle + half}
    picture = draw_picture(figure.axes[0], disparity, cmap=colours, **limits)
    draw_colour_bar(figure, picture, "disparity (px per lens pitch); nearer is larger")
    return figure


@styled
def depth_figure(distance: np.ndarray, confident: np.ndarray) -> "Figure":
    """Draw how far away every point is, and beside it only what its own texture tells.

    Parameters
    ----------
    distance : array, (H, W)
        mm.
    confident : array, (H, W) bool
        Points that have enough texture; the others are filled in from their neighbours.
    """
    import matplotlib

    low, high = np.percentile(distance[confident] if confident.any() else distance, (0.5, 99.5))
    colours = matplotlib.colormaps["viridis_r"].with_extremes(bad=EMPTY)
    figure = sheet(1, 2, distance.shape[0] / distance.shape[1], 0.8 * WIDTH, colour_bar=True)
    maps = {"every point": distance, "by its own texture": np.where(confident, distance, np.nan)}
    for axes, (title, each) in zip(figure.axes, maps.items(), strict=True):
        limits = {"vmin": low, "vmax": max(high, low + 1)}
        picture = draw_picture(axes, each, title, cmap=colours, **limits)
    draw_colour_bar(figure, picture, "distance (mm)")
    return figure


def _mosaic(images: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Join the sub-images into one picture with white seams, square root of a scale to 1."""
    count, height, width = images.shape
    seam = max(2, height // 40)
    joined = np.ones((shape[0] * (height + seam) - seam, shape[1] * (width + seam) - seam))
    top = max(float(np.nanpercentile(images[:, ::4, ::4], 99.8)), 1e-12)
    for unit in range(count):
        row, column = divmod(unit, shape[1])
        y, x = row * (height + seam), column * (width + seam)
        shown = np.sqrt(np.clip(np.nan_to_num(images[unit]) / top, 0, 1))
        joined[y : y + height, x : x + width] = shown
    return joined


def _edges(image: np.ndarray) -> np.ndarray:
    """Return the strength of the edges of a picture, 0..1, whatever its brightness."""
    from scipy.ndimage import gaussian_gradient_magnitude

    image = np.nan_to_num(np.asarray(image, float))
    strength = gaussian_gradient_magnitude(np.sqrt(np.maximum(image, 0)), 1.0)
    return np.clip(strength / max(np.percentile(strength, 99), 1e-12), 0, 1)


def _edge_agreement(images: np.ndarray) -> float:
    """Return how alike the edges are that the units see: their mean correlation over all pairs."""
    edges = np.stack([_edges(each) for each in images]).reshape(len(images), -1)
    edges -= edges.mean(1, keepdims=True)
    edges /= np.maximum(np.linalg.norm(edges, axis=1, keepdims=True), 1e-12)
    pairs = edges @ edges.T
    return float((pairs.sum() - pairs.trace()) / (len(images) * (len(images) - 1)))
