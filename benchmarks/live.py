"""Time the live view from a 12-megapixel raw frame to what a page has shown.

    python benchmarks/live.py [--calibration camera.nc] [-o experiments/results/live.json]

A client in a process of its own (`tests/watching.py`) talks to the real server over a real
WebSocket, watches colour, three bands and the spectra of two points and a region, and acknowledges
as the page does. Frames come ready from memory, from the twin that draws new noise for each, and
from the twin as a GenICam camera within the process (Mono12p, packed and unpacked). Without
--calibration the thesis' camera is calibrated first, which takes some minutes.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from statistics import median

import numba
import numpy as np
import torch

import squilla
from squilla.calibration.alignment import align, measure
from squilla.calibration.disparity import find_plane, plane_map
from squilla.calibration.edges import find_edges
from squilla.calibration.rehearsal import Rehearsal
from squilla.calibration.views import evened, sub_images
from squilla.camera.twin import Camera
from squilla.files.raw import Raw
from squilla.live.connection import Statistics
from squilla.live.pipeline import LiveSource
from squilla.live.source import FrameSource
from squilla.live.twin_camera import camera_within
from squilla.live.twin_frames import TwinFrames, views
from squilla.threads import single_threaded_products

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import watching
from browser import Browser, find
from serving import running


class Ready:
    """A camera whose frames lie in memory and cost nothing."""

    exposures = gains = gain = None

    def __init__(self, raws: list[Raw]):
        self.raws, self.statistics, self.report = raws, Statistics(), print
        self.exposure = raws[0].exposure

    def check_size(self, shape) -> None: ...
    def close(self) -> None: ...

    def read(self, *, timeout: float = 5.0) -> Raw:
        self.statistics.delivered += 1
        return self.raws[self.statistics.delivered % len(self.raws)]


class Drawn(Ready):
    """The twin before a scene that stands still: new noise for each frame."""

    def __init__(self, raws: list[Raw], frames: TwinFrames):
        super().__init__(raws)
        self.frames = frames

    def read(self, *, timeout: float = 5.0) -> Raw:
        self.statistics.delivered += 1
        frame = self.frames.draw(self.statistics.delivered, self.exposure)
        return Raw(frame, self.exposure, self.raws[0].metadata)


def watched(source, calibration, model, seconds: float) -> dict[str, float]:
    """Return frames a second and the median time of each stage, as a client over the wire sees."""
    with closing(LiveSource(source, calibration, model)) as live, running(live) as address:
        live.now()
        command = [sys.executable, watching.__file__, address, str(seconds)]
        told = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    times, stages = json.loads(told)
    result = {"frames_per_s": (len(times) - 1) / (times[-1] - times[0])}
    for name in ("frame", "measure", "decode", "answer", "send", "page"):
        result[name] = median(each.get(name, 0.0) for each in stages)
    return result


def painted(source, calibration, model, seconds: float) -> float:
    """Return pictures a second that headless Chromium has painted of three bands."""
    with closing(LiveSource(source, calibration, model)) as live, running(live) as address:
        live.now()
        with Browser() as browser:
            page = browser.page()
            page.open(f"http://{address}/")
            page.wait("performance.getEntriesByName('squilla first picture').length > 0", 60)
            page.click("#picture")
            time.sleep(seconds)
            return float(str(page.js("document.querySelector('#facts dd').innerText")).split()[0])


@contextmanager
def sources(raws: list[Raw], frames: TwinFrames) -> Iterator[dict[str, FrameSource]]:
    """Open the cameras."""
    with camera_within(frames, rate=100.0) as aravis:
        aravis.exposure = frames.bright_exposure / 20  # which the simulator waits for
        yield {
            "ready in memory": Ready(raws),
            "twin": Drawn(raws, frames),
            "twin over GenICam": aravis,
        }


def stages(calibration, raws: list[Raw], models: dict) -> dict[str, float]:
    """Return the time of each step of measuring and decoding by itself, ms."""
    lattice, pixels = calibration.lattice, calibration.pixels
    first = measure(raws[0], calibration)
    start = np.array([first.provenance["disparity"], 0, 0])
    margin = int(np.ceil((start[0] + 0.5) * np.abs(lattice.baseline).max())) + 8
    cut = sub_images(raws[1], lattice, pixels, margin)
    even = evened(cut, lattice, calibration)
    noise = even.image.mean((1, 2)).numpy() / pixels.gain + 1
    edges = find_edges(even.image.numpy(), even.bad.numpy(), noise, step=4)
    flat = plane_map(start, lattice)
    steps: dict[str, Callable] = {
        "cut out and correct": lambda: sub_images(raws[1], lattice, pixels, margin),
        "take the shading out": lambda: evened(cut, lattice, calibration),
        "edges": lambda: find_edges(even.image.numpy(), even.bad.numpy(), noise, step=4),
        "plane, from the frame before": lambda: find_plane(
            edges, lattice, even.margin + even.offset, (0, 3.0), start=start
        ),
        "resample": lambda: align(cut, lattice, flat),
        "measure, from the frame before": lambda: measure(raws[1], calibration, start=first),
        "measure, from nothing": lambda: measure(raws[1], calibration),
    }
    wanted = [*range(0, 251, 7), *watching.BANDS]
    for name, model in models.items():
        steps |= {
            f"{name}: colour and three bands": lambda m=model: m.look(first).bands(wanted),
            f"{name}: spectrum of a point": lambda m=model: m.look(first).spectra([100], [100]),
            f"{name}: whole cube": lambda m=model: m.look(first).cube(),
        }
    found = {}
    for name, call in steps.items():
        wall, work = [], []
        with single_threaded_products():  # as in `measure`
            for _ in range(10 if "cube" not in name or "ridge" in name else 2):
                begin, busy = time.perf_counter(), time.process_time()
                call()
                wall.append(1000 * (time.perf_counter() - begin))
                work.append(1000 * (time.process_time() - busy))
        found[name] = {"ms": median(wall[1:]), "cpu_ms": min(work[1:])}
        print(f"| {name} | {found[name]['ms']:.1f} | {found[name]['cpu_ms']:.1f} |", flush=True)
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--calibration", type=Path)
    options.add_argument("-o", "--output", type=Path)
    options.add_argument("--models", nargs="+", default=["ridge"])
    options.add_argument("--seconds", type=float, default=6.0)
    options.add_argument("--browser", action="store_true", help="Chromium's pictures too.")
    given = options.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    camera = Camera("thesis")
    if given.calibration:
        calibration = squilla.load_calibration(given.calibration)
    else:
        rehearsal = Rehearsal(camera, step=5.0, bandwidth=5.0)
        calibration = squilla.calibrate(
            camera.design, dark=rehearsal.dark(), flat=rehearsal.flat(), sweep=rehearsal.sweep(),
            target=rehearsal.target(), target_distance=rehearsal.distance,
        )  # fmt: skip
    frames = TwinFrames(camera, views(camera, "chart"))
    exposure = frames.bright_exposure
    raws = [Raw(frames.draw(n, exposure), exposure, {"camera": camera.serial}) for n in range(4)]
    models = {name: squilla.load_model(name, calibration) for name in given.models}
    machine = (
        f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch and "
        f"{numba.get_num_threads()} numba threads"
    )
    results = {"machine": machine, "load_before": os.getloadavg()[0]}
    print(f"{machine}, load {os.getloadavg()[0]:.1f}\n\n| step | ms | CPU ms |\n|---|---|---|")
    results["steps"] = stages(calibration, raws, models)
    torch.set_num_threads(max(1, torch.get_num_threads() // 2))  # as `squilla live` does
    print("\n| source, model | frames/s | read | measure | decode | answer | send | page |")
    print("|" + "---|" * 8)
    results["live"] = {}
    with sources(raws, frames) as there:
        for kind, source in there.items():
            for name, model in models.items():
                seen = watched(source, calibration, model, given.seconds)
                results["live"][f"{kind}, {name}"] = seen
                row = " | ".join(f"{value:.1f}" for value in seen.values())
                print(f"| {kind}, {name} | {row} |", flush=True)
    if given.browser and find():
        model = models[given.models[0]]
        rate = painted(Ready(raws), calibration, model, given.seconds)
        results["chromium_pictures_per_s"] = rate
        print(f"\nHeadless Chromium painted {rate:.1f} pictures/s.")
    results["load_after"] = os.getloadavg()[0]
    if given.output:
        given.output.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
