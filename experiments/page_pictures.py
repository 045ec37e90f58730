"""Take the pictures of the page for the documentation, of a viewed cube and of the twin alive.

    python experiments/page_pictures.py FOLDER [viewer live]

FOLDER is what `squilla demo` wrote. Needs Chromium. The white patch of the chart is taken as white,
three others are pinned and one is selected, over which the scene's own spectrum is laid as a
reference. Writes docs/images/viewer.webp and live.webp.
"""

import argparse
import sys
import time
from contextlib import closing
from pathlib import Path

from PIL import Image

import squilla
from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.live.pipeline import LiveSource
from squilla.live.record import Recorder
from squilla.live.source import MovingTwin
from squilla.live.stored import StoredCube
from squilla.live.twin_frames import moved

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from browser import Browser
from serving import running

IMAGES = Path(__file__).parents[1] / "docs" / "images"

WHITE = (187, 21)
"""Row and column of the white patch."""

POINTS = ((103, 21), (145, 62), (145, 103), (62, 62))
"""Row and column of what is pinned, the last selected."""

SWING = 16
"""Columns by which the twin's chart is shifted at the end of its swing."""


class Still(MovingTwin):
    """The twin at one end of its scene's swing."""

    def _make(self) -> None: ...


def reference(scene, shift: int = 0) -> dict:
    """Return what a scene shows at the point selected."""
    row, column = POINTS[-1]
    values = scene.values[row, column + shift]
    return {
        "name": "the scene",
        "wavelength": scene.wavelength.values.tolist(),
        "values": values.tolist(),
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path)
    options.add_argument("which", nargs="*", default=["viewer", "live"])
    given = options.parse_args()
    for name in given.which:
        {"viewer": viewer, "live": live}[name](given.folder)


def viewer(folder: Path) -> None:
    names = ("chart", "corn-kernel", "doll")
    cubes = [StoredCube.open(folder / f"{name}-compound.nc") for name in names]
    told = reference(load_scene("chart", cubes[0].wavelength))
    take("viewer", *cubes, reference=told)


def live(folder: Path) -> None:
    calibration = squilla.load_calibration(folder / "calibration.nc")
    scene = moved(load_scene("chart", calibration.wavelength), -1.0)
    source = LiveSource(
        Still(Camera("thesis")), calibration, squilla.load_model("compound", calibration),
        title="twin", recorder=Recorder(folder),
    )  # fmt: skip
    with closing(source):
        source.now()
        take("live", source, reference=reference(scene, SWING), shift=SWING)


def take(name: str, *sources, reference: dict, shift: int = 0) -> None:
    """Open the page, choose white, pin and select, and keep what it looks like."""
    output = IMAGES / f"{name}.webp"
    picture = output.with_suffix(".png")
    with running(*sources, references=(reference,)) as address, Browser() as browser:
        page = browser.page()
        page.open(f"http://{address}/")
        page.wait("performance.getEntriesByName('squilla first picture').length > 0", 120)
        left, top, width, height = page.place("#picture")
        scale = min(width, height) / 250
        corner = left + (width - 250 * scale) / 2, top + (height - 250 * scale) / 2

        def select(row: int, column: int) -> None:
            x, y = column + shift + 0.5, row + 0.5
            page.drag([(corner[0] + x * scale, corner[1] + y * scale)])

        select(*WHITE)
        page.wait("document.querySelectorAll('#spectra tbody tr').length == 1")
        page.wait("!document.querySelector('#spectra tbody .number').innerText.match(/[^0-9.]/)")
        page.js(
            "(() => { const box = document.querySelector('#options select');"
            "box.value = 'selected'; box.dispatchEvent(new Event('change', {bubbles: true})) })()"
        )
        for number, place in enumerate(POINTS, 1):
            select(*place)
            page.wait(f"document.querySelectorAll('#spectra tbody tr').length == {number}")
            if number < len(POINTS):
                page.key("p")
        time.sleep(8)  # until the figures of the page are those of a steady stream
        page.screenshot(picture)
    Image.open(picture).convert("RGB").save(output, quality=88, method=6)
    picture.unlink()
    print(f"{output}: {output.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
