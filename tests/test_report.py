"""Figures hold the numbers that they claim to show; the report is one sound page."""

from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
from scipy.ndimage import shift

from squilla.calibration.calibration import Lattice
from squilla.camera.scenes import chart_layout, chart_scene
from squilla.errors import InputError
from squilla.evaluation.captures import (
    alignment_figure,
    disparity_figure,
    raw_figure,
)
from squilla.evaluation.metrics import mse
from squilla.evaluation.plots import (
    band_figure,
    colour_figure,
    distinct_points,
    error_figure,
    points_figure,
    show,
    spectra_figure,
)
from squilla.evaluation.report import (
    Illustration,
    Section,
    Table,
    Trial,
    results_section,
    scene_section,
    write_report,
)
from squilla.files.cube import labelled
from squilla.files.raw import Raw
from squilla.spectra import CHART_LIGHT, chart_reflectances, grid, lights

LIGHT = lights()[CHART_LIGHT]


@pytest.fixture(scope="module")
def truth():
    return chart_scene(size=60)


@pytest.fixture(scope="module")
def estimates(truth):
    noise = np.random.default_rng(1).standard_normal(truth.shape).astype(np.float32)
    return {"ridge": truth + 0.05 * noise, "a <b> & c": 0.9 * truth}


def pictures(figure) -> list[np.ndarray]:
    """Return what the axes of a figure show, in their order."""
    return [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images]


# --- cubes ---------------------------------------------------------------------------------------


def test_colours_share_one_exposure(truth):
    figure = colour_figure(truth, {"same": truth.copy(), "half": 0.5 * truth}, LIGHT)
    first, same, half, bands, *_ = pictures(figure)
    np.testing.assert_array_equal(first, same)
    assert half.mean() < first.mean()
    frame = bands[0, 0]  # 3 % grey under any light
    np.testing.assert_allclose(frame, frame[0] * np.ones(3), atol=1e-6)
    assert [axes.get_title() for axes in figure.axes[:3]] == ["truth", "same", "half"]


def test_bands_are_those_of_the_cube(truth, estimates):
    figure = band_figure(truth, estimates, bands=(400, 500, 620.4, 750))
    shown = pictures(figure)
    assert len(shown) == 9, "a band that the cube does not have is not drawn"
    for number, band in enumerate((0, 120, 250)):
        np.testing.assert_array_equal(shown[number], truth.values[..., band])
        np.testing.assert_array_equal(shown[3 + number], estimates["ridge"].values[..., band])
        scales = {figure.axes[row * 3 + number].images[0].get_clim() for row in range(3)}
        assert len(scales) == 1, "a column has one scale"


def test_error_map_is_the_error(truth, estimates):
    dark = truth.copy()
    dark[:5] = 0
    figure = error_figure(dark, estimates)
    shown = pictures(figure)[0]
    peak = truth.values.max(-1)
    expected = 100 * np.sqrt(mse(estimates["ridge"].values, truth.values)) / peak
    np.testing.assert_allclose(shown[5:], expected[5:], rtol=1e-5)
    assert np.isnan(np.ma.filled(shown[:5], np.nan)).all()


def test_spectra_and_their_errors():
    wavelength = grid(500, 700, 50)
    true = np.array([[1.0, 2, 4, 2, 1], [3, 3, 3, 3, 3]])
    figure = spectra_figure(wavelength, true, {"off": true + 0.4}, ["one", "two"])
    for number, peak in enumerate((4, 3)):
        axes = figure.axes[number]
        black, coloured = axes.get_lines()
        np.testing.assert_array_equal(black.get_xdata(), wavelength)
        np.testing.assert_allclose(black.get_ydata(), true[number] / peak)
        np.testing.assert_allclose(coloured.get_ydata(), (true[number] + 0.4) / peak)
        assert axes.get_xlabel() == "wavelength (nm)"
        written = axes.artists[0].findobj(matplotlib.text.Text)
        assert f"{1000 * (0.4 / peak) ** 2:.2g}" in [text.get_text() for text in written]


def test_points_show_the_pixels_they_mark(truth, estimates):
    figure = points_figure(truth, estimates, points=[(20, 5), (40, 30)], light=LIGHT)
    place, first, second, *_ = figure.axes
    marks = {tuple(np.ravel(line.get_xydata())) for line in place.get_lines()}
    assert marks == {(5, 20), (30, 40)}
    for axes, (row, column) in ((first, (20, 5)), (second, (40, 30))):
        spectrum = truth.values[row, column]
        np.testing.assert_allclose(axes.get_lines()[0].get_ydata(), spectrum / spectrum.max())


def test_distinct_points_find_each_colour():
    """Five flat areas of different spectra on a dark ground: one point well inside each."""
    values = np.full((80, 80, 5), 1e-3)
    for number in range(5):
        values[8 + 13 * number : 19 + 13 * number, 15:65, number] = 1 - 0.1 * number
    values += 1e-4 * np.random.default_rng(2).standard_normal(values.shape)
    points = distinct_points(labelled(values, grid(500, 540, 10)), count=5)
    assert sorted(int(values[point].argmax()) for point in points) == [0, 1, 2, 3, 4]
    assert min(values[point].max() for point in points) > 0.5


# --- captures ------------------------------------------------------------------------------------


def test_raw_figure_marks_the_fields():
    centres = np.array([[50.0, 60.5], [50, 140.25]])
    frame = np.random.default_rng(3).integers(0, 4096, (100, 200), dtype=np.uint16)
    figure = raw_figure(frame, centres, (40, 30))
    boxes = [patch.get_bbox().bounds for patch in figure.axes[0].patches]
    np.testing.assert_allclose(boxes, [(45.5, 30, 30, 40), (125.25, 30, 30, 40)])
    close = figure.axes[1]
    left, right, lower, upper = close.images[0].get_extent()
    part = frame[round(upper + 0.5) : round(lower + 0.5), round(left + 0.5) : round(right + 0.5)]
    shown = np.asarray(close.images[0].get_array(), float)
    np.testing.assert_allclose(np.corrcoef(shown.ravel() ** 2, part.ravel())[0, 1], 1)


def test_mosaic_puts_each_unit_in_its_place():
    images = np.arange(1, 7, dtype=float)[:, None, None] * np.ones((6, 8, 10)) / 6
    mosaic = pictures(alignment_figure(images, images, (2, 3)))[0]
    assert mosaic.shape == (2 * 8 + 2, 3 * 10 + 2 * 2)
    assert mosaic[4, 4] < mosaic[4, 16] < mosaic[4, 28] < mosaic[14, 4] < mosaic[14, 28]
    np.testing.assert_array_equal(mosaic[8:10], 1)


def test_alignment_makes_black_lines_and_agreement():
    scene = np.zeros((60, 60))
    scene[20:40, 15:45] = 1
    gains = 0.3 + np.random.default_rng(4).random(9)
    after = gains[:, None, None] * scene
    moves = [(3 * row, 3 * column) for row in (-1, 0, 1) for column in (-1, 0, 1)]
    before = np.stack([shift(each, move) for each, move in zip(after, moves, strict=True)])
    figure = alignment_figure(before, after, (3, 3))
    apart, together = pictures(figure)[2:]
    assert np.ptp(together, axis=-1).max() < 1e-6, "colourless where all agree"
    assert np.ptp(apart, axis=-1).max() > 0.9
    low, high = (float(figure.axes[number].get_title().split()[-1]) for number in (2, 3))
    assert high == pytest.approx(1)
    assert low < 0.6


def test_disparity_map():
    disparity = np.linspace(1, 3, 400).reshape(20, 20)
    disparity[0, 0] = np.nan
    figure = disparity_figure(disparity)
    np.testing.assert_array_equal(np.ma.filled(pictures(figure)[0], np.nan), disparity)
    assert "px per lens pitch" in figure.axes[-1].get_ylabel()


# --- manners ------------------------------------------------------------------------------------


def test_no_trace_is_left(truth, estimates):
    import matplotlib.pyplot as plt

    matplotlib.get_backend()  # settles what is decided at the first use
    before = matplotlib.rcParams.copy()
    colour_figure(truth, estimates)
    assert matplotlib.rcParams == before
    assert plt.get_fignums() == []


def test_window_shows_the_spectrum_under_the_click(truth, monkeypatch):
    import matplotlib.pyplot as plt
    from matplotlib.backend_bases import MouseEvent

    monkeypatch.setattr(plt, "show", lambda: None)
    show(truth)
    figure = plt.gcf()
    try:
        figure.canvas.draw()
        left, right = figure.axes[:2]
        x, y = left.transData.transform((12, 20))
        event = MouseEvent("button_press_event", figure.canvas, x, y, button=1)
        figure.canvas.callbacks.process("button_press_event", event)
        np.testing.assert_array_equal(right.get_lines()[-1].get_ydata(), truth.values[20, 12])
    finally:
        plt.close(figure)


def test_only_cubes_are_shown(truth):
    for wrong in (truth.values, truth[0], truth.drop_vars("wavelength")):
        with pytest.raises(InputError, match=r"squilla\.labelled"):
            show(wrong)


# --- the report ----------------------------------------------------------------------------------


class Page(HTMLParser):
    """Reads a page and insists that it is well nested and needs nothing from elsewhere."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.pictures, self.words = [], [], []
        self.links, self.targets, self.bold = set(), set(), []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        told = dict(attrs)
        assert tag not in ("script", "link", "iframe")
        for key in ("src", "href"):
            assert told.get(key, "#").startswith(("data:image/", "#"))
        if tag == "img":
            assert told["alt"]
            self.pictures.append(told["src"])
        if "id" in told:
            self.targets.add("#" + told["id"])
        if tag == "a":
            self.links.add(told["href"])
        if tag not in ("img", "meta"):
            self.open.append(tag)
        if told.get("class") == "best":
            self.bold.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if self.bold and not self.bold[-1]:
            self.bold[-1] = data


@pytest.fixture(scope="module")
def trial(truth, estimates):
    wavelength = truth["wavelength"].values
    filters = 0.5 + 0.4 * np.sin(wavelength / np.array([[20.0], [35], [50], [90]]))
    after = np.moveaxis(truth.values @ filters.T, -1, 0)
    after = after / after.max()
    before = np.stack([np.roll(each, 4 * unit, 1) for unit, each in enumerate(after)])
    baseline = np.array([[0.0, 0], [0, 1], [1, 0], [1, 1]])
    lattice = Lattice(
        (2, 2), 50 + 100 * baseline, baseline, 0, truth.shape[:2],
        focal=1000.0, pitch=400.0, pixel=1.75, usual=300.0,
    )  # fmt: skip
    frame = np.random.default_rng(5).integers(0, 4096, (200, 200), dtype=np.uint16)
    return Trial(
        "Chart <1>", truth, estimates, {"ridge": 0.0123}, "What it is.", LIGHT, Raw(frame, 12.5),
        lattice, before, after, np.linspace(1.9999, 2.0001, 3600).reshape(60, 60),
        chart_layout(60, 60),
    )  # fmt: skip


def test_report_is_one_sound_page(trial, tmp_path):
    own = Section(
        "More", "One.\n\nTwo.", [Table(["a", "b\nnm"], [("x", [np.nan])], [".1f"], ["low"], "t")]
    )
    sections = [results_section([trial]), scene_section(trial), own]
    path = tmp_path / "report.html"
    write_report(path, sections, title="A & B", text="Why.", facts={"camera": "<6 x 6>"})
    text = path.read_text()
    page = Page(text)
    words = " ".join(page.words)
    assert len(page.pictures) == 8
    assert len(set(page.pictures)) == 8
    assert page.links == page.targets == {"#part-1", "#part-2", "#part-3"}
    for expected in ("A & B", "<6 x 6>", "Chart <1>", "a <b> & c", "exposed for 12.5 ms", "350 mm"):
        assert expected in words
    for number in range(1, 9):
        assert f"Figure {number}." in words
    assert "Table 3." in words
    assert path.stat().st_size < 8e6
    metrics = trial.metrics
    best = min(metrics.values(), key=lambda each: each["colours_mse"])
    assert page.bold[0] == f"{best['colours_mse']:.5f}"
    closest = max(metrics.values(), key=lambda each: each["gfc"])
    assert f"{closest['gfc']:.4f}" in page.bold
    assert "–" in page.words, "what is not known is a dash"


def test_chart_error_is_that_of_the_colours(trial):
    """All of a chart dimmed by a tenth: each patch is wrong by its own spectrum's tenth."""
    patches = chart_reflectances().values[:18] * LIGHT
    shapes = patches / patches.max(-1, keepdims=True)
    expected = np.square(0.1 * shapes).mean()
    assert trial.metrics["a <b> & c"]["colours_mse"] == pytest.approx(expected, rel=1e-4)


def test_report_with_little_to_show(truth, estimates, tmp_path):
    bare = Trial("bare", truth, estimates)
    parts = scene_section(bare).parts
    assert sum(isinstance(part, Illustration) for part in parts) == 4
    write_report(tmp_path / "r.html", [Section("Empty")], title="t")
    Page((tmp_path / "r.html").read_text())
    with pytest.raises(InputError, match="no folder"):
        write_report(tmp_path / "gone" / "r.html", [], title="t")
    with pytest.raises(InputError, match="Nothing"):
        Trial("x", truth, {})
    with pytest.raises(InputError, match="resample"):
        Trial("x", truth, {"m": truth[..., ::2]})
    with pytest.raises(InputError, match="30 x 60 px"):
        Trial("x", truth, {"m": truth[::2]})


@pytest.mark.parametrize(
    ("side", "wavelength"),
    [(2, grid()), (9, np.array([600.0])), (9, np.linspace(900, 1000, 11))],
    ids=["tiny", "one band", "infrared"],
)
def test_every_cube_can_be_shown(side, wavelength):
    values = np.random.default_rng(0).random((side, side, len(wavelength)))
    cube = labelled(values.astype(np.float32), wavelength)
    assert len(scene_section(Trial("small", cube, {"same": cube})).parts) == 5
