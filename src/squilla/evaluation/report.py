"""The report: one page that shows what was captured, what was reconstructed, and how well."""

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from importlib.resources import files as package_files
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.evaluation import captures, plots
from squilla.evaluation.chart import COLOURS, inner, patch_errors, patch_means
from squilla.evaluation.metrics import evaluate
from squilla.evaluation.style import WIDTH
from squilla.files.disk import replacing
from squilla.files.raw import Raw
from squilla.spectra import chart_reflectances

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from squilla.calibration.calibration import Lattice
    from squilla.calibration.depth import Depth


# --- what goes in ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Trial:
    """One scene on its way through the camera; what is None is not shown.

    name : of the scene.
    truth : (y, x, wavelength).
    estimates : reconstructed cubes by model, in the unit and on the grid of the truth.
    seconds : time to reconstruct by model.
    text : what the scene is, in a sentence or two.
    light : (K,) light of the scene on the truth's wavelengths, shown white.
    raw, lattice : the frame, and where its sub-images were found.
    before, after : (M, H, W) sub-images as they lie on the lattice, and aligned.
    disparity : (H, W) px per lens pitch.
    labels : (H, W) patches of a colour chart, -1 between them (`chart_layout`).
    depth : how far away every point was found to be.
    """

    name: str
    truth: DataArray
    estimates: Mapping[str, DataArray]
    seconds: Mapping[str, float] = field(default_factory=dict)
    text: str = ""
    light: np.ndarray | None = None
    raw: Raw | None = None
    lattice: "Lattice | None" = None
    before: np.ndarray | None = None
    after: np.ndarray | None = None
    disparity: np.ndarray | None = None
    labels: np.ndarray | None = None
    depth: "Depth | None" = None

    def __post_init__(self):
        if not self.estimates:
            raise InputError(f"Nothing was reconstructed of {self.name}; there is nothing to show.")
        for model, cube in self.estimates.items():
            if cube.shape[:2] != self.truth.shape[:2]:
                raise InputError(
                    f"{model} shows {self.name} in {cube.shape[0]} x {cube.shape[1]} px, its truth "
                    f"has {self.truth.shape[0]} x {self.truth.shape[1]}; cut or resize one of them."
                )
            own, true = (each["wavelength"].values for each in (cube, self.truth))
            if len(own) != len(true) or not np.allclose(own, true):
                raise InputError(
                    f"{model} and the truth of {self.name} have other wavelengths; resample the "
                    "truth first (squilla.spectra.resample)."
                )

    @cached_property
    def metrics(self) -> dict[str, dict[str, float]]:
        """Return for each model what `evaluate` says of the scene.

        A chart is judged where the thesis judges it: inside its first 18 patches, pixel by pixel,
        and as "colours_mse" by the mean spectrum of each patch (table 5.1).
        """
        mask = None
        if self.labels is not None:
            labels = inner(self.labels)
            mask = (labels >= 0) & (labels < COLOURS)
        with ThreadPoolExecutor(os.cpu_count()) as pool:  # NumPy works without the lock
            every = pool.map(
                lambda cube: evaluate(cube, self.truth, mask=mask), self.estimates.values()
            )
            judged = dict(zip(self.estimates, every, strict=True))
        if self.labels is not None:
            for name, cube in self.estimates.items():
                errors = patch_errors(cube, self.truth, self.labels)[:COLOURS]
                judged[name]["colours_mse"] = float(errors.mean())
        return judged


@dataclass(frozen=True)
class Illustration:
    """A figure and the sentence that says what one sees in it."""

    figure: "Figure"
    caption: str


@dataclass(frozen=True)
class Table:
    """A table of numbers.

    head : the columns' names, the first that of the rows; after a line break the unit.
    rows : name and numbers; NaN is shown as a dash.
    digits : how each column of numbers is written, such as ".3f".
    best : which end of each column is printed bold: "low", "high" or "".
    """

    head: Sequence[str]
    rows: Sequence[tuple[str, Sequence[float]]]
    digits: Sequence[str]
    best: Sequence[str]
    caption: str


@dataclass(frozen=True)
class Section:
    """A heading, a text and what belongs to it; an empty line in the text begins a paragraph."""

    title: str
    text: str = ""
    parts: Sequence[Illustration | Table] = ()


# --- sections of the usual kind -----------------------------------------------------------------


def results_section(trials: Sequence[Trial]) -> Section:
    """Compare the models over all scenes.

    Parameters
    ----------
    trials : sequence of Trial
        With the same models.
    """
    models = list(trials[0].estimates)
    heads, keys = [], []
    for trial in trials:
        if trial.labels is not None:
            heads.append(f"{trial.name}\npatch means")
            keys.append((trial, "colours_mse"))
        heads.append(f"{trial.name}\nsingle pixels")
        keys.append((trial, "mse"))
    rows = [
        (model, [trial.metrics.get(model, {}).get(key, np.nan) for trial, key in keys])
        for model in models
    ]
    table = Table(
        ["model", *heads],
        rows,
        [".5f"] * len(keys),
        ["low"] * len(keys),
        "Mean squared error of spectra, each divided by the peak of the true spectrum. A chart is "
        "judged inside its 18 colours, as in the thesis' table 5.1. The lowest of each column is "
        "bold.",
    )
    return Section("Results", parts=[table])


def scene_section(trial: Trial) -> Section:
    """Show one scene: frame, alignment, numbers, colours, spectra, bands, errors.

    Parameters
    ----------
    trial : Trial
    """
    truth, estimates = trial.truth, trial.estimates
    parts: list[Illustration | Table] = [*_capture_parts(trial), _metrics_table(trial)]
    parts.append(
        Illustration(
            plots.colour_figure(truth, estimates, trial.light),
            "Colours of the truth and of each reconstruction in one exposure: above as the CIE "
            "1931 observer sees this band, below with the bands at 650, 550 and 500 nm as red, "
            "green and blue.",
        )
    )
    if trial.labels is not None:
        parts.append(_chart_part(trial, trial.labels))
    parts += [
        Illustration(
            plots.points_figure(truth, estimates, light=trial.light),
            "Spectra of single pixels, marked in the picture where they differ most. The grey "
            "ground is the truth.",
        ),
        Illustration(
            plots.band_figure(truth, estimates),
            "Single bands. Each column is scaled to the truth, so that noise and lost contrast "
            "show as such.",
        ),
        Illustration(
            plots.error_figure(truth, estimates),
            "Where the error lies, on one logarithmic scale: dark is wrong. Pixels too dim to be "
            "judged are grey.",
        ),
    ]
    return Section(trial.name, trial.text, parts)


def _capture_parts(trial: Trial) -> list[Illustration]:
    parts = []
    lattice = trial.lattice
    if trial.raw is not None and lattice is not None:
        typical = 0.0 if trial.disparity is None else float(np.nanmedian(trial.disparity))
        centres = lattice.centre + typical * lattice.baseline
        exposure = trial.raw.exposure
        exposed = "" if exposure is None else f", exposed for {exposure:g} ms"
        parts.append(
            Illustration(
                captures.raw_figure(trial.raw.frame, centres, lattice.field),
                f"The raw frame{exposed}, and the sub-images where the calibration finds them. "
                "Each filter sees the scene in its own brightness, from its own place.",
            )
        )
    if trial.before is not None and trial.after is not None and lattice is not None:
        parts.append(
            Illustration(
                captures.alignment_figure(trial.before, trial.after, lattice.shape),
                "The sub-images before and after alignment. Below, the edges that three corner "
                "units see are printed over each other in cyan, magenta and yellow: black lines "
                "are edges on which they agree.",
            )
        )
    if trial.depth is not None:
        distance, confident = trial.depth.distance.numpy(), trial.depth.confident.numpy()
        parts.append(
            Illustration(
                captures.depth_figure(distance, confident),
                "The distance that was found for every point. Where it is grey on the right there "
                f"is too little texture ({100 * (1 - confident.mean()):.0f} % of the points), and "
                "the left is filled in from the neighbours.",
            )
        )
    elif trial.disparity is not None and np.ptp(trial.disparity) > 0 and lattice is not None:
        near, far = np.nanpercentile(trial.disparity, (99, 1))
        parts.append(
            Illustration(
                captures.disparity_figure(trial.disparity),
                f"The disparity that was found, {far:.2f} to {near:.2f} px per lens pitch: "
                f"distances of {lattice.distance(near):.0f} to {lattice.distance(far):.0f} mm.",
            )
        )
    return parts


def _chart_part(trial: Trial, labels: np.ndarray) -> Illustration:
    truth, *spectra = (
        patch_means(cube, labels) for cube in (trial.truth, *trial.estimates.values())
    )
    names = chart_reflectances().name
    if len(names) != len(truth):
        names = [f"patch {number + 1}" for number in range(len(truth))]
    wavelength = trial.truth["wavelength"].values
    estimates = dict(zip(trial.estimates, spectra, strict=True))
    best = min(trial.metrics, key=lambda model: trial.metrics[model]["colours_mse"])
    return Illustration(
        plots.spectra_figure(
            wavelength, truth, estimates, names, columns=6 if len(estimates) <= 4 else 4
        ),
        f"Mean spectra of the patches. Over the first {COLOURS} the error of {best} is the lowest, "
        f"{trial.metrics[best]['colours_mse']:.5f}.",
    )


def _metrics_table(trial: Trial) -> Table:
    columns = [  # key, head, how it is written, which end is best
        ("mse", "MSE", ".5f", "low"),
        ("colours_mse", "MSE\npatch means", ".5f", "low"),
        ("psnr_db", "PSNR\ndB", ".1f", "high"),
        ("sam_deg", "angle\ndegrees", ".2f", "low"),
        ("gfc", "GFC", ".4f", "high"),
        ("ssim", "SSIM", ".3f", "high"),
        ("seconds", "time\ns", ".2g", "low"),
    ]
    judged = {
        model: {**metrics, "seconds": trial.seconds.get(model, np.nan)}
        for model, metrics in trial.metrics.items()
    }
    shown = [each for each in columns if any(each[0] in metrics for metrics in judged.values())]
    keys, heads, digits, best = zip(*shown, strict=True)
    counts = [int(each["pixels"]) for each in judged.values()]
    least, most = min(counts), max(counts)
    judged_pixels, some = (
        (f"{most:,}", "") if least == most else (f"{least:,} to {most:,}", "up to ")
    )
    left_out = max(int(each["left_out"]) for each in judged.values())
    out = f"; {some}{left_out:,} too dim or without a value are left out" if left_out else ""
    if trial.labels is not None:
        out = f" inside the first {COLOURS} patches"
    return Table(
        ["model", *heads],
        [(model, [each.get(key, np.nan) for key in keys]) for model, each in judged.items()],
        digits,
        best,
        f"Agreement with the truth over {judged_pixels} pixels{out}. MSE after division by "
        "the peak of each true spectrum; angle, goodness of fit (GFC) and structural similarity "
        "(SSIM) as means.",
    )


# --- what comes out -----------------------------------------------------------------------------


def write_report(
    path: str | Path,
    sections: Sequence[Section],
    *,
    title: str,
    text: str = "",
    facts: Mapping[str, str] | None = None,
) -> None:
    """Write a report as one HTML page that needs nothing else, not even a network.

    Parameters
    ----------
    path : str or Path
    sections : sequence of Section
        As `results_section` and `scene_section` make them, or one's own.
    title : str
    text : str
        What was done, in a few sentences.
    facts : mapping of str to str, optional
        The circumstances: camera, distance, noise.

    Raises
    ------
    InputError
        If the place cannot be written.
    """
    style = (package_files("squilla.evaluation") / "report.css").read_text()
    known = "".join(
        f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in (facts or {}).items()
    )
    links = "".join(
        f'<li><a href="#part-{number}">{escape(section.title)}</a></li>'
        for number, section in enumerate(sections, 1)
    )
    counts = {"Figure": 0, "Table": 0}
    body = "".join(_section(section, number, counts) for number, section in enumerate(sections, 1))
    page = f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
{_paragraphs(text, 'class="lead"')}
{f"<dl>{known}</dl>" if known else ""}
<nav aria-label="Contents"><ol>{links}</ol></nav>
</header>
<main>
{body}</main>
<footer>Written by squilla.</footer>
</body>
</html>
"""
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _section(section: Section, number: int, counts: dict[str, int]) -> str:
    parts = []
    for part in section.parts:
        kind = "Figure" if isinstance(part, Illustration) else "Table"
        counts[kind] += 1
        label = f"{kind} {counts[kind]}"
        parts.append(
            _figure(part, label) if isinstance(part, Illustration) else _table(part, label)
        )
    return (
        f'<section id="part-{number}">\n<h2>{escape(section.title)}</h2>\n'
        f"{_paragraphs(section.text)}{''.join(parts)}</section>\n"
    )


def _paragraphs(text: str, how: str = "") -> str:
    return "".join(
        f"<p{' ' + how if how else ''}>{escape(each.strip())}</p>\n"
        for each in text.split("\n\n")
        if each.strip()
    )


def _figure(part: Illustration, label: str) -> str:
    stream = BytesIO()
    part.figure.savefig(
        stream, format="webp", dpi=170, bbox_inches="tight", pad_inches=0.04,
        pil_kwargs={"quality": 88, "method": 2},
    )  # fmt: skip
    picture = b64encode(stream.getvalue()).decode()
    caption = escape(part.caption)
    share = 100 * part.figure.get_figwidth() / WIDTH
    return (
        f'<figure>\n<img src="data:image/webp;base64,{picture}" alt="{caption}" '
        f'style="width:{share:.0f}%">\n'
        f"<figcaption><b>{label}.</b> {caption}</figcaption>\n</figure>\n"
    )


def _table(part: Table, label: str) -> str:
    heads = []
    for head in part.head:
        name, _, unit = escape(head).partition("\n")
        heads.append(f'<th scope="col">{name}{f"<small>{unit}</small>" if unit else ""}</th>')
    columns = list(zip(*(values for _, values in part.rows), strict=True))
    written = [
        ["–" if np.isnan(value) else format(value, digits) for value in column]
        for column, digits in zip(columns, part.digits, strict=True)
    ]
    ends = [
        written[number][int(np.nanargmin(column) if best == "low" else np.nanargmax(column))]
        if best and len(column) > 1 and not np.isnan(column).all()
        else None
        for number, (column, best) in enumerate(zip(columns, part.best, strict=True))
    ]
    lines, best = [], ' class="best"'
    for row, (name, _) in enumerate(part.rows):
        cells = "".join(
            f"<td{best if column[row] == end else ''}>{column[row]}</td>"
            for column, end in zip(written, ends, strict=True)
        )
        lines.append(f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>\n')
    return (
        f'<figure class="table">\n<figcaption><b>{label}.</b> {escape(part.caption)}</figcaption>\n'
        f"<div><table>\n<thead><tr>{''.join(heads)}</tr></thead>\n"
        f"<tbody>\n{''.join(lines)}</tbody>\n</table></div>\n</figure>\n"
    )
