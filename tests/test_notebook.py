"""`cube.squilla`: colours, spectra, and the picture of a notebook, clicked in a real browser."""

import json
import re
from base64 import b64decode
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from browser import MISSING, Browser, find
from squilla.colour import rgb
from squilla.errors import InputError
from squilla.files.cube import labelled

WAVELENGTH = np.linspace(500, 750, 251)


@pytest.fixture(scope="module")
def cube():
    """A ramp of Gaussian lines: column x peaks at 510 + x nm."""
    peak = 510 + np.arange(200)
    line = np.exp(-((WAVELENGTH - peak[:, None]) ** 2) / 200)
    height = 1 + np.arange(100)[:, None, None] / 100
    return labelled((height * line).astype(np.float32), WAVELENGTH)


def test_colours_are_those_of_the_observer(cube):
    seen = cube.squilla.rgb()
    assert seen.dims == ("y", "x", "channel")
    np.testing.assert_array_equal(seen, rgb(cube.values, WAVELENGTH))


def test_spectrum_is_the_mean_of_what_is_valid(cube):
    holed = cube.copy()
    holed[10, 21] = np.nan
    want = np.nanmean(holed.values[9:12, 19:22], (0, 1))
    np.testing.assert_allclose(holed.squilla.spectrum(10, 20, 1), want, rtol=1e-6)
    np.testing.assert_array_equal(cube.squilla.spectrum(0, 0), cube[0, 0])
    with pytest.raises(InputError, match="no pixel"):
        cube.squilla.spectrum(100, 0)


def test_what_is_no_cube_is_said_to_be_none(cube):
    with pytest.raises(InputError, match="dims"):
        _ = cube.mean("wavelength").squilla


def test_notebook_keeps_a_small_true_copy(cube):
    text = cube.squilla._repr_html_()
    assert len(text) < 900_000
    picture = b64decode(re.search(r"base64,([^\"]+)", text)[1])
    np.testing.assert_allclose(
        np.asarray(Image.open(BytesIO(picture))) / 255, cube.squilla.rgb(), atol=0.002
    )
    data = json.loads(re.search(r'\), (\{"wavelength.*\})\);', text)[1])
    share = np.frombuffer(b64decode(data["share"]), np.uint8).reshape(64, 64, -1)
    kept = share / 255 * np.reshape(data["largest"], (64, 64, 1))
    bands = np.isin(WAVELENGTH, data["wavelength"])
    true = cube.values[np.ix_(data["rows"], data["columns"], bands)]
    np.testing.assert_allclose(kept, true, atol=0.006)


@pytest.mark.skipif(find() is None, reason=MISSING)
def test_a_click_draws_the_spectrum_of_its_pixel(cube, tmp_path):
    (tmp_path / "page.html").write_text(f"<!doctype html>{cube.squilla._repr_html_()}")
    with Browser() as browser:
        page = browser.page()
        page.open(f"file://{tmp_path}/page.html")
        page.wait("document.querySelector('.plot path') !== null")
        where = "[...document.querySelectorAll('.plot text')].at(-1).textContent"
        left, top, width, height = page.place(".picture")
        page.js(
            "document.querySelector('.picture').dispatchEvent(new PointerEvent('pointerdown', "
            f"{{clientX: {left + width * 0.25}, clientY: {top + height * 0.5}}}))"
        )
        row, column = map(int, re.findall(r"\d+", str(page.js(where))))
        assert abs(row - 50) <= 1
        assert abs(column - 50) <= 2
        # The highest point of the curve stands at the wavelength at which this column peaks.
        curve = str(page.js("document.querySelector('.plot path').getAttribute('d')"))
        points = np.array(re.findall(r"([\d.]+),([\d.]+)", curve), float)
        peak = 500 + 250 * (points[points[:, 1].argmin(), 0] - 44) / (420 - 56)
        assert peak == pytest.approx(510 + column, abs=2)
        assert page.complaints() == []
