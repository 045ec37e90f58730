"""Time the viewer in headless Chromium: the first picture, a band, a spectrum.

Usage: python benchmarks/viewer.py [-o FILE.json]

Times are those that the page itself notes: from the start of navigation until the first picture
is painted; from the slider's event until the band is painted; from letting the mouse go until the
spectrum stands in plot and table. `command` is the time from starting `squilla view` in the
terminal until it answers.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from browser import MISSING, Browser, Page, find
from squilla.files.cube import labelled, save
from squilla.spectra import grid


@contextmanager
def viewing(path: Path, *options: str) -> Iterator[tuple[str, float]]:
    """Run `squilla view` on a file; yields its address and the seconds until it answered."""
    code = "from squilla.cli import main; main()"
    command = [sys.executable, "-c", code, "view", "--no-browser", "--port", "0", *options]
    start = time.perf_counter()
    process = subprocess.Popen([*command, str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        while True:
            try:
                urllib.request.urlopen(address).close()
                break
            except OSError:
                time.sleep(0.005)
        yield address, time.perf_counter() - start
    finally:
        process.kill()
        process.wait()


def noted(page: Page, name: str) -> list[float]:
    """Return the times that the page noted, ms."""
    times = page.js(f"performance.getEntriesByName('squilla {name}').map(e => e.duration)")
    assert isinstance(times, list)
    return times


def first_picture(browser: Browser, path: Path, repeats: int) -> dict[str, list[float]]:
    """Open a new viewer and a new page again and again."""
    times: dict[str, list[float]] = {"command": [], "first picture": []}
    for _ in range(repeats):
        with viewing(path) as (address, seconds):
            page = browser.page()
            page.open(address)
            page.wait("performance.getEntriesByName('squilla first picture').length > 0", 60)
            times["command"].append(1000 * seconds)
            times["first picture"] += noted(page, "first picture")
            page.close()
    return times


def hands(browser: Browser, path: Path, *options: str, repeats: int) -> dict[str, list[float]]:
    """Slide to the next band and jump to any; click here and there."""
    random = np.random.default_rng(0)
    with viewing(path, *options) as (address, _):
        page = browser.page()
        page.open(address)
        page.wait("performance.getEntriesByName('squilla first picture').length > 0", 60)
        times = {}
        for name, bands in (
            ("next band", range(20, 20 + repeats)),
            ("any band", random.permutation(250)[:repeats].tolist()),
        ):
            page.js("performance.clearMeasures()")
            for count, band in enumerate(bands, 1):
                page.js(
                    f"(s => {{ s.value = {band}; s.dispatchEvent(new Event('input')); }})"
                    "(document.querySelector('#slider'))"
                )
                page.wait(f"performance.getEntriesByName('squilla band').length >= {count}", 60)
                time.sleep(0.04)  # a hand is no faster
            times[name] = noted(page, "band")[2:]
        page.js("performance.clearMeasures()")
        left, top, width, height = page.place("#picture")
        for count, (x, y) in enumerate(random.uniform(-0.3, 0.3, (repeats, 2)), 1):
            page.drag([(left + width * (0.5 + x * 0.6), top + height * (0.5 + y))])
            page.wait(f"performance.getEntriesByName('squilla spectrum').length >= {count}", 60)
            time.sleep(0.04)
        times["click to spectrum"] = noted(page, "spectrum")[2:]
        page.close()
    return times


def main(output: Path | None, repeats: int) -> None:
    if find() is None:
        sys.exit(f"This benchmark {MISSING}.")
    random = np.random.default_rng(0)
    cube = labelled(random.random((250, 250, 251), dtype=np.float32), grid())
    load = os.getloadavg()[0]
    rows: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as place, Browser() as browser:
        for suffix in (".nc", ".hdr"):
            save(cube, Path(place) / f"cube{suffix}")
        netcdf = Path(place) / "cube.nc"
        rows |= first_picture(browser, netcdf, max(3, repeats // 8))
        rows |= hands(browser, netcdf, repeats=repeats)
        by_need = hands(browser, Path(place) / "cube.hdr", "--memory", "0", repeats=repeats)
        rows |= {f"{name}, by need": times for name, times in by_need.items()}
    machine = f"{platform.machine()}, {os.cpu_count()} cores, load {load:.1f} at the start"
    print(f"cube 250 x 250 x 251 float32 (63 MB), headless Chromium; {machine}; ms\n")
    print(f"{'':30}{'median':>8}{'90 %':>8}{'n':>5}")
    result = {"machine": machine, "unit": "ms"}
    for name, times in rows.items():
        worst = float(np.quantile(times, 0.9))
        result[name] = {"median": round(median(times), 2), "p90": round(worst, 2), "n": len(times)}
        print(f"{name:30}{median(times):8.1f}{worst:8.1f}{len(times):5d}")
    if output is not None:
        output.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="Also write the figures as JSON.")
    parser.add_argument("--repeats", type=int, default=40)
    given = parser.parse_args()
    main(given.output, given.repeats)
