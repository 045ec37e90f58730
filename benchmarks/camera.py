"""Time the way from a live camera to numbers: unpacking, the twin's frames, and both together.

    python benchmarks/camera.py [--faults] [-o experiments/results/camera.json]

Unpacking stands beside NumPy. Frames of 1 and 12 megapixels go from the twin to a client in another
process over 127.0.0.1, and within one process through the simulated device of libaravis. Times are
medians after warm-up; the load of the machine is printed, for others may be at work on it.

With --faults instead: a minute with 5 % of the packets lost, and how long a stream takes to go on
after its camera was killed and started again.
"""

import argparse
import json
import multiprocessing
import os
import platform
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from timing import seconds

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import twin_process
from squilla.camera.twin import Camera
from squilla.live.connection import Region
from squilla.live.genicam import LiveCamera, open_camera
from squilla.live.pixel_format import FORMATS
from squilla.live.twin_camera import TwinCamera, camera_within
from squilla.live.twin_frames import TwinFrames

SHAPE = (3000, 4000)
SECONDS = 6.0
HERE = "genicam:127.0.0.1"


def milliseconds(call) -> float:
    return 1000 * seconds(call, 15)


def by_numpy(data: np.ndarray) -> np.ndarray:
    """Unpack Mono12p as one would in NumPy."""
    triple = data.reshape(-1, 3).astype(np.uint16)
    pixels = np.empty((len(triple), 2), np.uint16)
    pixels[:, 0] = triple[:, 0] | (triple[:, 1] & 0xF) << 8
    pixels[:, 1] = triple[:, 1] >> 4 | triple[:, 2] << 4
    return pixels.reshape(SHAPE)


def unpacking() -> dict[str, float]:
    data = np.random.default_rng(0).integers(0, 256, 24_000_000, dtype=np.uint8)
    times = {}
    for name, known in FORMATS.items():
        part = data[: known.bytes_for(SHAPE[0] * SHAPE[1])]
        times[name] = milliseconds(lambda known=known, part=part: known.unpack(part, SHAPE))
    part = data[:18_000_000]
    assert np.array_equal(by_numpy(part), FORMATS["Mono12p"].unpack(part, SHAPE))
    times["Mono12p by NumPy"] = milliseconds(lambda: by_numpy(part))
    pixels = np.empty(SHAPE, np.uint16)
    times["a copy of 24 MB into new memory"] = milliseconds(pixels.copy)
    return times


def frames_of(camera: Camera) -> TwinFrames:
    ramp = np.linspace(5, 100, SHAPE[1], dtype=np.float32)
    return TwinFrames(camera, [np.tile(ramp, (SHAPE[0], 1))])


def drawing(frames: TwinFrames) -> dict[str, float]:
    camera = Camera("thesis")
    rate = frames.means[0]
    return {
        "frame of the twin camera": milliseconds(lambda: frames.draw(1, 10.0), 7),
        "frame by ImageSensor.expose": milliseconds(lambda: camera.sensor.expose(rate, 10.0), 5),
    }


def serve(pipe, rate: float, small: bool) -> None:
    frames = twin_process.megapixel_frames() if small else frames_of(Camera("thesis"))
    with TwinCamera(frames, rate=rate) as twin:
        pipe.send(True)
        pipe.recv()
        pipe.send(twin.sent)


def watch(camera: LiveCamera) -> dict[str, float]:
    """Read for some seconds; return the rate and what became of the frames."""
    for _ in range(3):
        camera.read(timeout=30)
    before, start = camera.statistics.delivered, time.perf_counter()
    while time.perf_counter() - start < SECONDS:
        camera.read(timeout=30)
    counts = camera.statistics
    rate = (counts.delivered - before) / (time.perf_counter() - start)
    return {"frames_per_s": rate, **asdict(counts)}


def over_loopback(name: str, rate: float, small: bool = False) -> dict[str, float]:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=serve, args=(theirs, rate, small))
    process.start()
    ours.recv()
    with open_camera(HERE, pixel_format=name) as camera:
        camera.exposure = 1.0
        seen = watch(camera)
    ours.send(None)
    seen["sent"] = ours.recv()
    process.join()
    return seen


def in_process(frames: TwinFrames) -> dict[str, float]:
    with camera_within(frames, rate=100.0) as camera:
        camera.exposure = 1.0
        return watch(camera)


def lossy(seconds: float = 60.0) -> dict[str, float]:
    """Read from a camera that loses 5 % of its packets; whole frames must be as they were sent."""
    frames = twin_process.megapixel_frames()
    with TwinCamera(frames, rate=25.0, lost=0.05) as twin, open_camera(HERE) as camera:
        camera.region = Region(100, 1000)  # 19 packets of data: one frame in three is whole
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            raw = camera.read()
            facts = raw.metadata
            sent = frames.draw(facts["frame"], raw.exposure, facts["gain"], camera.region)
            assert np.array_equal(raw.frame, sent)
        camera.close()
        return {"seconds": seconds, "sent": twin.sent, **asdict(camera.statistics)}


def restarted() -> float:
    """Return the seconds from the start of a camera that was killed to its next frame."""
    with twin_process.started() as process, open_camera(HERE) as camera:
        camera.read(timeout=30)
        process.kill()
        process.join()
        with twin_process.started():  # answers already
            begin = time.monotonic()
            while camera.statistics.reconnected == 0:
                camera.read()
            return time.monotonic() - begin


def faults() -> dict:
    return {"lost_packets": lossy(), "restart_seconds": [restarted() for _ in range(3)]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--faults", action="store_true")
    given = parser.parse_args()
    output = given.output
    before = json.loads(output.read_text()) if output and output.exists() else {}
    if given.faults:
        found = {"faults": faults() | {"load": os.getloadavg()[0]}}
        print(json.dumps(found, indent=2))
        if output is not None:
            output.write_text(json.dumps(before | found, indent=2) + "\n")
        return
    frames = frames_of(Camera("thesis"))
    results = before | {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "threads": os.environ.get("NUMBA_NUM_THREADS", "default"),
        "load_before": os.getloadavg()[0],
        "milliseconds": unpacking() | drawing(frames),
        "live": {
            "1 MP loopback Mono12p, 20 sent": over_loopback("Mono12p", 20.0, small=True),
            "1 MP loopback Mono12p, 100 sent": over_loopback("Mono12p", 100.0, small=True),
            "12 MP loopback Mono12p, 2 sent": over_loopback("Mono12p", 2.0),
            "12 MP loopback Mono12p, 100 sent": over_loopback("Mono12p", 100.0),
            "12 MP in process Mono12p, 100 sent": in_process(frames),
        },
        "load_after": os.getloadavg()[0],
    }
    print(f"{results['machine']}; load {results['load_before']:.1f}, {results['load_after']:.1f}")
    print("\n| 4000 x 3000 px | ms | megapixels/s |\n|---|---|---|")
    for name, value in results["milliseconds"].items():
        print(f"| {name} | {value:.1f} | {12000 / value:.0f} |")
    print("\n| camera to reader | frames/s | delivered | skipped | incomplete | lost |")
    print("|---|---|---|---|---|---|")
    for name, seen in results["live"].items():
        counts = " | ".join(
            str(seen[key]) for key in ("delivered", "skipped", "incomplete", "lost")
        )
        print(f"| {name} | {seen['frames_per_s']:.1f} | {counts} |")
    if output is not None:
        output.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
