"""Figures of filter design: what a search gained, what the faults of a process cost."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from squilla.optics.design import Search
from squilla.optics.filters import FilterArray
from squilla.optics.tolerance import Tolerance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_search(search: Search, wavelength: ArrayLike, title: str = "") -> "Figure":
    """Return a figure of a search: the merits drawn, the way down, the filters before and after.

    Parameters
    ----------
    search : Search
    wavelength : (K,)
        nm, at which the filters are shown.
    title : str
        What the merit is.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.subplot_mosaic([["drawn", "way"], ["first", "array"]])
    drawn, first = search.drawn.numpy(), float(search.drawn.min())

    axes["drawn"].hist(drawn, 40, color="0.7")
    marks = {"median drawn": "0.4", "best drawn": "tab:orange", "optimised": "tab:blue"}
    for value, colour in zip((np.median(drawn), first, search.merit), marks.values(), strict=True):
        axes["drawn"].axvline(float(value), color=colour)
    axes["drawn"].set(xlim=(0, None), xlabel="expected error", ylabel="arrays drawn")

    improved = [first, *(step.merit for step in search.history[len(drawn) :])]
    median = float(np.median(drawn))
    axes["way"].axhline(median, color="0.4", label=f"median drawn {median:.4f}")
    axes["way"].axhline(first, color="tab:orange", label=f"best drawn {first:.4f}")
    axes["way"].plot(improved, ".-", color="tab:blue", label=f"optimised {search.merit:.4f}")
    axes["way"].legend(loc="lower right")
    axes["way"].set(ylim=(0, None), xlabel="rounds of improvement", ylabel="best so far")

    for name, array, label in (
        ("first", search.first, "best drawn"),
        ("array", search.array, "optimised"),
    ):
        image = show_filters(axes[name], array, wavelength)
        axes[name].set_title(label)
    figure.colorbar(image, ax=[axes["first"], axes["array"]], label="transmittance")
    figure.suptitle(title)
    return figure


def show_filters(axes: "Axes", array: FilterArray, wavelength: ArrayLike):
    """Draw the transmittances of an array as an image, filters in the order of their peaks."""
    wavelength = np.asarray(wavelength, float)
    response = array.transmittance(wavelength).numpy()
    order = response.argmax(-1).argsort(kind="stable")
    axes.set(xlabel="wavelength, nm", ylabel="filter, by peak")
    return axes.imshow(
        response[order],
        aspect="auto",
        vmin=0,
        vmax=1,
        extent=(wavelength[0], wavelength[-1], len(response) + 0.5, 0.5),
        interpolation="nearest",
    )


def plot_tolerance(
    faults: Mapping[str, tuple[Sequence[float], Sequence[Tolerance]]], title: str = ""
) -> "Figure":
    """Return a figure of the error against the size of each fault, fixed and recalibrated.

    Parameters
    ----------
    faults : from a name to sizes (relative) and what was found at each
    title : str
        Whose error it is.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(faults), 3.4), layout="constrained")
    axes = figure.subplots(1, len(faults), sharey=True, squeeze=False)[0]
    for panel, (name, (sizes, found)) in zip(axes, faults.items(), strict=True):
        percent = 100 * np.asarray(sizes)
        for kind, colour in (("fixed", "tab:red"), ("recalibrated", "tab:green")):
            factor = np.stack([getattr(each, kind).numpy() / each.nominal for each in found])
            low, middle, high = np.quantile(factor, (0.05, 0.5, 0.95), axis=1)
            panel.fill_between(percent, low, high, color=colour, alpha=0.2, linewidth=0)
            panel.plot(percent, middle, color=colour, label=kind)
        panel.axhline(1.1, color="0.7", linestyle=":")
        panel.set(title=name, xlabel="standard deviation, %", xlim=(0, percent[-1]))
    axes[0].set(ylabel="error against the design's", ylim=(0.8, 3))
    axes[-1].legend(loc="upper left")
    figure.suptitle(title)
    return figure
