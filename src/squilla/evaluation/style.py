"""The hand that draws all figures: one typeface, pale axes, colours that all can tell apart."""

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

INK, PALE, EMPTY = "#22262b", "#8b929c", "#d9dce0"
"""Text and truth; axes; pixels that hold nothing."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""One for each model, told apart by colour-blind eyes too. Source: Okabe & Ito (2008)."""

WIDTH = 7.2
"""Text width of a page, inches."""

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: figures look the same everywhere
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": PALE,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": PALE,
    "ytick.color": PALE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "image.cmap": "gray",
    "figure.dpi": 120,
    "savefig.dpi": 200,
}

_P = ParamSpec("_P")
_R = TypeVar("_R")


def styled(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a function draw in this style without changing anybody's settings."""

    @wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        import matplotlib

        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return drawn


def canvas(width: float, height: float) -> "Figure":
    """Return an empty figure, inches, that lays out its axes itself."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def sheet(
    rows: int, columns: int, ratio: float, width: float = WIDTH, *, colour_bar: bool = False
) -> "Figure":
    """Return a figure, at most `width` inches wide, with a grid of pictures.

    ratio : height of a picture over its width.
    colour_bar : whether to leave room for one.
    """
    from matplotlib.figure import Figure

    beside = 0.75 if colour_bar else 0.25
    side = min((width - beside) / columns, 2.6)
    figure = Figure(
        figsize=(side * columns + beside, side * rows * ratio + 0.25), layout="compressed"
    )
    figure.subplots(rows, columns)
    return figure


def draw_picture(axes: "Axes", picture: np.ndarray, title: str = "", **how: Any) -> "AxesImage":
    """Draw a picture without axes; `how` is handed to matplotlib's imshow."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    if title:
        axes.set_title(title, pad=3)
    return axes.imshow(picture, **how)


def label_row(axes: "Axes", text: str) -> None:
    """Write at the left of a row of pictures what it shows."""
    axes.set_ylabel(text, labelpad=4)


def draw_colour_bar(figure: "Figure", picture: "AxesImage", label: str) -> None:
    """Draw the scale of the pictures at the right of a figure."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    bar = figure.colorbar(picture, ax=figure.axes, fraction=0.04, aspect=30, pad=0.02)
    if isinstance(picture.norm, LogNorm):
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    bar.outline.set_visible(False)
    bar.set_label(label)
