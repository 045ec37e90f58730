"""A live view that has a hard time: lost, dark and saturated frames, clients of every kind.

For ten minutes, or for those that the environment variable SQUILLA_SOAK_MINUTES says.
"""

import asyncio
import gc
import json
import os
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import websockets

from serving import Line, running
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.live.pipeline import LiveSource
from squilla.live.record import Recorder
from squilla.live.source import MovingTwin
from squilla.reconstruction.models import load_model

MINUTES = float(os.environ.get("SQUILLA_SOAK_MINUTES", "10"))
GONE = (OSError, TimeoutError, websockets.WebSocketException)


class Moody(MovingTwin):
    """A twin whose frames are lost, dark, saturated, cut short or of a broken camera at times."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.random = np.random.default_rng(5)

    def read(self, *, timeout: float = 5.0) -> Raw:
        raw = super().read(timeout=timeout)
        mood = self.random.random()
        if mood < 0.02:
            self.statistics.lost += 1
            raise InputError("The camera does not answer any more.")
        if mood < 0.04:
            return Raw(np.full_like(raw.frame, 64), raw.exposure, raw.metadata)
        if mood < 0.06:
            return Raw(np.full_like(raw.frame, 4095), raw.exposure, raw.metadata)
        if mood < 0.07:
            return Raw(raw.frame[:-2], raw.exposure, raw.metadata)
        if mood < 0.075:
            raise RuntimeError("a driver's fault")
        return raw


def visit(address: str, random: np.random.Generator, ended: threading.Event) -> None:
    """Be one client after the other: an attentive one, a hasty, a deaf, a rude, a meddling one."""
    while not ended.is_set():
        try:
            line = Line(address)
        except GONE:
            ended.wait(0.2)
            continue
        try:
            kinds = [attend, haste, sleep, rave, meddle]
            kinds[random.choice(5, p=[0.4, 0.2, 0.1, 0.2, 0.1])](line, random, ended)
        except GONE:
            pass
        finally:
            if random.random() < 0.5:
                line.socket.close()
            else:  # without a word
                with suppress(OSError):
                    line.socket.socket.shutdown(socket.SHUT_RDWR)


def wishes(random) -> dict:
    pictures = [{"kind": "colour"}, {"kind": "layer", "layer": "valid"}]
    pictures += [{"kind": "band", "band": int(band)} for band in random.integers(0, 60, 3)]
    regions = [[0, 0, int(size), int(size)] for size in random.integers(1, 70, 3)]
    return {"ask": "watch", "wanted": [*pictures, {"ask": "spectra", "regions": regions}]}


def attend(line, random, ended) -> None:
    """Watch and acknowledge, as the page does."""
    line.socket.send(json.dumps(wishes(random)))
    for _ in range(random.integers(5, 60)):
        while not (header := line.receive()[0]).get("last"):
            if "frame" not in header and "error" in header:  # no frame yet
                return
        line.socket.send(json.dumps({"ask": "acknowledge", "frame": header["frame"]}))
        if ended.is_set():
            return


def haste(line, random, ended) -> None:
    """Change the mind all the time."""
    for _ in range(30):
        line.socket.send(json.dumps(wishes(random)))
        ended.wait(0.01 * random.random())


def sleep(line, random, ended) -> None:
    """Ask for much and read nothing."""
    line.socket.recv_bufsize = 1
    for _ in range(40):
        line.socket.send(json.dumps(wishes(random)))
        line.socket.send(json.dumps({"ask": "picture", "kind": "colour"}))
    ended.wait(3 + 25 * random.random() ** 4)


def rave(line, random, ended) -> None:
    """Send what nobody understands."""
    for _ in range(20):
        text = random.choice(["{", "[]", '{"ask": "watch"}', "\x00" * 5000, '{"id": 1e99}', ""])
        line.socket.send(text if random.random() < 0.7 else random.bytes(2000))
    if random.random() < 0.3:
        line.socket.send("x" * (3 << 20))
    ended.wait(0.1)


def meddle(line, random, ended) -> None:
    """Turn every knob."""
    for _ in range(10):
        name, value = [
            ("exposure", float(10 ** random.uniform(-2, 2))), ("exposure", -1.0), ("gain", 0.0),
            ("gain", 99.0), ("automatic", True), ("frozen", True), ("step", True),
            ("frozen", False), ("recording", True), ("recording", False),
        ][random.integers(10)]  # fmt: skip
        line.ask(ask="control", name=name, value=value)
        ended.wait(0.1)
    for name, value in (("frozen", False), ("recording", False), ("automatic", True)):
        line.ask(ask="control", name=name, value=value)


def memory() -> float:
    """Return the memory that this process holds, MB."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def tasks() -> int:
    return sum(type(each) is asyncio.Task and not each.done() for each in gc.get_objects())


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_a_hard_time_leaves_nothing_behind(camera, scene, calibration, tmp_path, capsys):
    twin = Moody(camera, scene, rate=30)
    source = LiveSource(
        twin, calibration, load_model("ridge", calibration), recorder=Recorder(tmp_path / "raw")
    )
    ended, held = threading.Event(), []
    with running(source) as address:
        source._first.wait(120)
        before = threading.active_count(), tasks()
        seeds = np.random.SeedSequence(1).spawn(6)
        clients = [
            threading.Thread(target=visit, args=(address, np.random.default_rng(seed), ended))
            for seed in seeds
        ]
        for client in clients:
            client.start()
        start, end = time.monotonic(), time.monotonic() + 60 * MINUTES
        while time.monotonic() < end:
            time.sleep(min(2.0, MINUTES))
            held.append(memory())
            for file in (tmp_path / "raw").glob("frame-*.tiff"):
                file.unlink()
        numbered = source._number
        ended.set()
        for client in clients:  # each ends what it was at; on a machine at work that takes a while
            client.join(300)
            assert not client.is_alive()
        attentive = Line(address)  # after all that it is served as ever
        source.control("frozen", False)
        source.control("recording", False)
        source.control("exposure", twin._frames.bright_exposure)
        attend(attentive, np.random.default_rng(2), threading.Event())
        attentive.socket.close()
        end = time.monotonic() + 120  # the server's own threads, eight at most, stay
        left = tasks(), threading.active_count() - 8
        while (left[0] > before[1] or left[1] > before[0]) and time.monotonic() < end:
            time.sleep(0.1)
            left = tasks(), threading.active_count() - 8
        assert left[0] <= before[1]
        assert left[1] <= before[0]
    source.close()
    warm = held[len(held) // 4 :]
    with capsys.disabled():
        print(
            f"\n{(time.monotonic() - start) / 60:.1f} min, {numbered} frames: "
            f"{min(warm):.0f} to {max(warm):.0f} MB after {len(held) // 4 * 2} s"
        )
    assert numbered > 60 * MINUTES  # at least one a second, whatever happened
    assert max(warm) - min(warm) < 50
    assert not any(thread.name.startswith("Thread") and "_run" in thread.name and thread.is_alive()
                   for thread in threading.enumerate())  # fmt: skip
