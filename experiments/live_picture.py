"""Take the picture of the live page for the documentation: the twin before the chart.

    python experiments/live_picture.py camera.nc [-o docs/images/live.webp] [--model compound]

Needs Chromium. The white patch is taken as white, three others are pinned, and one is selected,
over which the scene's own spectrum is laid as a reference.
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
from squilla.live.twin_frames import moved

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from browser import Browser
from serving import running

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "live.webp"

WHITE = (186, 29)
"""Row and column of the white patch."""

POINTS = ((101, 37), (150, 74), (153, 115), (64, 82))
"""Row and column of what is pinned, the last selected."""


class Still(MovingTwin):
    """The twin at one end of its scene's swing."""

    def _make(self) -> None: ...


def references(wavelength) -> list[dict]:
    """Return what the scene shows at the point selected."""
    row, column = POINTS[-1]
    spectrum = moved(load_scene("chart", wavelength), -1.0).values[row, column]
    return [
        {"name": "the scene", "wavelength": wavelength.tolist(), "values": spectrum.tolist()},
    ]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("calibration", type=Path)
    options.add_argument("-o", "--output", type=Path, default=PICTURE)
    options.add_argument("--model", default="compound")
    given = options.parse_args()
    calibration = squilla.load_calibration(given.calibration)
    model = squilla.load_model(given.model, calibration)
    picture = given.output.with_suffix(".png")
    live = LiveSource(
        Still(Camera("thesis")), calibration, model, title="twin",
        recorder=Recorder(given.output.parent),
    )  # fmt: skip
    told = tuple(references(calibration.wavelength))
    with closing(live), running(live, references=told) as address, Browser() as browser:
        live.now()
        page = browser.page()
        page.open(f"http://{address}/")
        page.wait("performance.getEntriesByName('squilla first picture').length > 0", 120)
        left, top, width, height = page.place("#picture")
        scale = min(width, height) / 250
        corner = left + (width - 250 * scale) / 2, top + (height - 250 * scale) / 2

        def select(row: int, column: int) -> None:
            page.drag([(corner[0] + (column + 0.5) * scale, corner[1] + (row + 0.5) * scale)])

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
    Image.open(picture).convert("RGB").save(given.output, quality=88, method=6)
    picture.unlink()
    print(f"{given.output}: {given.output.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
