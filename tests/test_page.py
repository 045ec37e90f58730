"""The viewer's page in a real browser, used as a person uses it."""

import csv
import io
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from browser import MISSING, Browser, Page, find
from serving import running
from squilla.evaluation.metrics import sam
from squilla.files.cube import labelled, save
from squilla.live.reference import parse_references
from squilla.live.server import Broken
from squilla.live.stored import StoredCube
from squilla.spectra import grid

pytestmark = pytest.mark.skipif(find() is None, reason=MISSING)

FIRST = "performance.getEntriesByName('squilla first picture').length > 0"


@pytest.fixture(scope="module")
def cube() -> xr.DataArray:
    """40 x 50 px, 26 bands: smooth spectra whose height tells the place."""
    y, x = np.mgrid[:40, :50]
    wavelength = grid(step=10)
    line = np.exp(-(((wavelength - 560 - 2 * x[..., None]) / 40) ** 2))
    return labelled(((1 + y[..., None] / 10) * (0.2 + line)).astype(np.float32), wavelength)


@pytest.fixture(scope="module")
def address(cube, tmp_path_factory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("cubes")
    valid = (cube.isel(wavelength=0, drop=True) > 0.5).rename("valid")
    save(cube, folder / "doll.nc", extra={"valid": valid, "uncertainty": cube / 10})
    save(cube * 2, folder / "twice.hdr")
    reference = {"name": "paint", "wavelength": [490.0, 600.0, 770.0], "values": [1.0, 3.0, 2.0]}
    sources = (
        StoredCube.open(folder / "doll.nc"),
        StoredCube.open(folder / "twice.hdr"),
        Broken("notes.txt", "notes.txt is none of the scenes known."),
    )
    with running(*sources, references=(reference,)) as place:
        yield f"http://{place}/"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as browser:
        yield browser


@pytest.fixture
def page(browser, address) -> Iterator[Page]:
    page = browser.page()
    page.open(address)
    page.wait(FIRST)
    yield page
    assert page.complaints() == []
    page.close()


def click(page: Page, x: int, y: int, to: tuple[int, int] | None = None) -> None:
    """Click a pixel of the cube, or drag to another, and wait for the spectrum."""
    left, top, width, height = page.place("#picture")
    scale = min(width / 50, height / 40)
    corner = left + (width - 50 * scale) / 2, top + (height - 40 * scale) / 2

    def place(x: float, y: float) -> tuple[float, float]:
        return corner[0] + (x + 0.5) * scale, corner[1] + (y + 0.5) * scale

    count = "performance.getEntriesByName('squilla spectrum').length"
    before = page.js(count)
    page.drag([place(x, y)] if to is None else [place(x, y), place(x, y + 1), place(*to)])
    page.wait(f"{count} > {before} && document.querySelector('#spectra').ariaBusy == 'false'")


def exported(page: Page, folder: Path, button: str, name: str) -> Path:
    """Press an entry of the export menu and return the file that arrives."""
    page.browser.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    page.click("#export")
    page.click(button)
    file = folder / name
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if file.exists():
            return file
        time.sleep(0.02)
    raise AssertionError(f"{name} never arrived; there is {list(folder.iterdir())}")


def test_click_reads_the_spectrum_of_the_file(page, cube, tmp_path):
    """Point, region and pins reach the exported table with the file's own values."""
    click(page, 12, 30)
    page.key("p")
    click(page, 40, 5)
    page.key("Enter")
    click(page, 10, 10, to=(19, 17))
    file = exported(page, tmp_path, "#export-csv", "doll-spectra.csv")
    head, *rows = csv.reader(io.StringIO(file.read_text()))
    table = dict(zip(head, np.array(rows, np.float32).T, strict=True))
    np.testing.assert_array_equal(table["wavelength nm"], cube.wavelength)
    np.testing.assert_array_equal(table["pin 1 (x 12 y 30)"], cube.values[30, 12])
    np.testing.assert_array_equal(table["pin 2 (x 40 y 5)"], cube.values[5, 40])
    region = cube.values[10:18, 10:20].reshape(-1, 26).astype(float)
    name = "selection (x 10-19 y 10-17)"
    np.testing.assert_allclose(table[name], region.mean(0), rtol=1e-6)
    np.testing.assert_allclose(table[f"{name} standard deviation"], region.std(0), rtol=1e-6)
    np.testing.assert_allclose(
        table["paint"], np.interp(cube.wavelength, [490, 600, 770], [1, 3, 2]), rtol=1e-6
    )
    # The page's own table is a table of references to it.
    names = [each["name"] for each in parse_references(file.read_text(), file.name)]
    assert names == head[1:]


def test_references_are_judged(page, cube):
    click(page, 12, 30)
    spectrum = cube.values[30, 12].astype(float)
    paint = np.interp(cube.wavelength, [490, 600, 770], [1, 3, 2])

    def judged() -> tuple[float, float]:
        rows = "[...document.querySelectorAll('#references tbody tr')]"
        row = page.js(f"{rows}.find(row => row.innerText.includes('paint')).innerText")
        _, error, angle = str(row).split()
        return float(error), float(angle.rstrip("°"))

    error, angle = judged()
    scaled = spectrum / spectrum.max() - paint / paint.max()
    assert error == pytest.approx(np.mean(scaled**2), rel=6e-3)
    assert angle == pytest.approx(np.degrees(sam(spectrum, paint)), abs=6e-3)
    page.key("n")  # in the file's own unit, the maximum of the reference being one
    error, angle = judged()
    assert error == pytest.approx(np.mean((spectrum - paint) ** 2) / 9, rel=6e-3)
    assert angle == pytest.approx(np.degrees(sam(spectrum, paint)), abs=6e-3)


def test_files_of_references_are_read(page):
    drop = """(text) => { const transfer = new DataTransfer();
      transfer.items.add(new File([text], 'leaf.csv'));
      document.querySelector('#lists').dispatchEvent(
        new DragEvent('drop', {dataTransfer: transfer, bubbles: true, cancelable: true})); }"""
    page.js(f"({drop})('nm,leaf\\n500,1\\n750,2\\n')")
    page.wait("document.querySelector('#references').innerText.includes('leaf')")
    page.js(f"({drop})('no table')")
    page.wait("document.querySelector('#banner').innerText.includes('leaf.csv')")


def shown_pixel(page: Page, x: int, y: int) -> list[int]:
    """Return the colour in which the picture shows a pixel of the cube, read off the screen."""
    left, top, width, height = page.place("#picture")
    scale = min(width / 50, height / 40)
    page.screenshot(Path(page.browser.home) / "shown.png")
    with Image.open(Path(page.browser.home) / "shown.png") as picture:
        seen = picture.convert("RGB").getpixel(
            (
                round(left + (width - 50 * scale) / 2 + (x + 0.5) * scale),
                round(top + (height - 40 * scale) / 2 + (y + 0.5) * scale),
            )
        )
    return list(seen)


def test_bands_slide_and_play(page, cube):
    """The grey of a pixel is its value between the ends of the contrast."""
    page.js("(s => { s.value = 4; s.dispatchEvent(new Event('input')); })"
            "(document.querySelector('#slider'))")  # fmt: skip
    page.wait("performance.getEntriesByName('squilla band').length > 0")
    assert page.js("document.querySelector('#wavelength').value") == "540 nm"
    low, high = (
        float(str(page.js(f"document.querySelector('#{n}').value"))) for n in ("low", "high")
    )
    for x, y in [(5, 5), (25, 20), (45, 35), (2, 38)]:
        expected = np.clip((cube.values[y, x, 4] - low) / (high - low), 0, 1) * 255
        np.testing.assert_allclose(shown_pixel(page, x, y), expected, atol=3)
    page.key("]")
    page.wait("document.querySelector('#wavelength').value == '550 nm'")
    page.key(" ")
    page.wait("document.querySelector('#wavelength').value != '550 nm'")
    assert page.js("document.querySelector('#play').getAttribute('aria-pressed')") == "true"
    page.key(" ")


def test_every_picture_has_a_key(page, cube):
    click(page, 25, 20)
    for key, label in zip("ctbrsm", page.js(
        "[...document.querySelectorAll('#modes button')].map(b => b.innerText)"
    ), strict=True):  # fmt: skip
        page.key(key)
        page.wait(
            f"document.querySelector('#modes [aria-checked=true]').innerText == '{label}' "
            "&& document.querySelector('#waiting').hidden"
        )
        assert page.js("document.querySelector('#banner').hidden")
    assert page.js("document.querySelector('#options select').value") == "valid"
    page.wait("document.querySelector('#high').value == '1'")
    page.key("s")
    page.wait("document.querySelector('#high').value.endsWith('°')")


def test_keyboard_alone(page, cube):
    """From the picture's middle the arrows lead to every pixel; Enter keeps it."""
    page.js("document.querySelector('#picture').focus()")
    page.key("ArrowRight")
    page.key("ArrowUp", shift=True)
    page.wait("document.querySelector('#spectra').innerText.includes('x 26, y 10')")
    page.key("Enter")
    page.wait("document.querySelector('#spectra .chip').innerText == '1'")
    expected = cube.values[10, 26, int(page.js("document.querySelector('#slider').value"))]
    value = "document.querySelector('#spectra td.number').innerText"
    page.wait(f"Math.abs({value} - {expected}) < 1e-3")
    page.key("?")
    assert page.js("document.querySelector('#help').open")
    page.key("Escape")
    before = page.js("document.documentElement.dataset.theme")
    page.js("document.activeElement.blur()")
    page.js("document.querySelector('#help').close()")
    page.key("d")
    assert page.js("document.documentElement.dataset.theme") != before


def test_zoom_keeps_the_place(page, cube):
    """After zooming by the wheel the pixel under the mouse is the same, and so is its spectrum."""
    left, top, width, height = page.place("#picture")
    scale = min(width / 50, height / 40)
    at = left + (width - 50 * scale) / 2 + 30.5 * scale, top + 12.5 * scale
    wheel = {"x": at[0], "y": at[1], "deltaX": 0, "deltaY": -200}
    for _ in range(4):
        page.send("Input.dispatchMouseEvent", type="mouseWheel", **wheel)
    page.wait(f"parseFloat(document.querySelector('#zoom').value) > {150 * scale}")
    page.drag([at])
    page.wait("document.querySelector('#spectra').innerText.includes('x 30, y 12')")


def test_pictures_are_exported_pixel_for_pixel(page, cube, tmp_path):
    page.key("b")
    file = exported(page, tmp_path, "#export-picture", "doll-band.png")
    with Image.open(file) as picture:
        assert picture.width % 50 == picture.height % 40 == 0
        times = picture.width // 50
        grey = np.asarray(picture.convert("L"))[times // 2 :: times, times // 2 :: times]
    band = cube.values[..., int(page.js("document.querySelector('#slider').value"))]
    order = np.argsort(band, axis=None)
    assert (np.diff(grey.ravel()[order].astype(int)) >= 0).all()
    assert grey.min() == 0
    assert grey.max() == 255


def test_looking_closely_at_a_large_cube(browser, tmp_path):
    """Of a long picture every third pixel is shown; zoomed in, every one, read from the disk."""
    random = np.random.default_rng(1)
    values = random.random((60, 2500, 3), dtype=np.float32)
    values[:] = values[:1]  # one value a column, easy to find again
    save(labelled(values, np.array([500.0, 550, 600])), tmp_path / "long.hdr")
    with running(StoredCube.open(tmp_path / "long.hdr", held=0)) as place:
        page = browser.page()
        page.open(f"http://{place}/")
        page.wait(FIRST)
        page.key("b")
        wheel = {"type": "mouseWheel", "x": 400, "y": 360, "deltaX": 0, "deltaY": -60}
        for _ in range(40):
            page.send("Input.dispatchMouseEvent", **wheel)

        def under(x: int) -> tuple[int, float]:
            page.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=360)
            readout = "document.querySelector('#readout').value.trim().split(/\\s+/)"
            _, column, _, _, value = page.wait(f"{readout}.length == 5 && {readout}")
            return int(column), float(value)

        for x in range(80, 760, 70):
            end = time.monotonic() + 60
            while values[0, (found := under(x))[0], 2] != pytest.approx(found[1], rel=1e-3):
                assert time.monotonic() < end, found
        assert under(80)[0] + 9 < under(710)[0] + 1
        assert page.complaints() == []
        page.close()


def test_another_cube_and_one_that_is_none(page, cube):
    click(page, 12, 30)
    page.click("#tab-1")
    band = int(page.js("document.querySelector('#slider').value"))
    page.wait("document.title.startsWith('twice.hdr')")
    expected = 2 * float(cube.values[30, 12, band])
    page.wait(
        f"Math.abs(document.querySelector('#spectra td.number').innerText - {expected}) < 0.01"
    )
    page.click("#tab-2")
    page.wait("document.querySelector('#cover').innerText.includes('none of the scenes')")
    page.click("#tab-0")
    page.wait("document.querySelector('#cover').hidden")


def test_on_a_phone_nothing_is_cut_off(browser, address):
    page = browser.page(390, 844, phone=True)
    page.open(address)
    page.wait(FIRST)
    assert page.js("document.documentElement.scrollWidth") == 390
    for control in ("#picture", "#slider", "#plot", "#export"):
        left, _, width, _ = page.place(control)
        assert left >= 0
        assert left + width <= 390
    assert page.complaints() == []
    page.close()


def test_the_end_of_the_viewer_is_said_and_its_return_noticed(browser, cube):
    with running(StoredCube(cube)) as place:
        page = browser.page()
        page.open(f"http://{place}/")
        page.wait(FIRST)
    page.wait("document.querySelector('#banner').innerText.includes('does not answer')")
    page.close()
