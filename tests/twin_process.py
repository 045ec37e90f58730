"""A twin camera in a process of its own, quick to start and fit to be killed."""

import multiprocessing
from contextlib import contextmanager

import numpy as np
import pytest

from conftest import small_design
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.live import aravis
from squilla.live.twin_camera import TwinCamera
from squilla.live.twin_frames import TwinFrames

try:
    aravis.load()
    missing = ""
except InputError as error:
    missing = str(error)
installed = pytest.mark.skipif(bool(missing), reason=missing)


def megapixel_frames() -> TwinFrames:
    """Return frames of a 1000 x 1000 px sensor that shows a ramp of 20 to 200 e-/ms."""
    camera = Camera(small_design(sensor={"rows": 1000, "columns": 1000}))
    ramp = np.linspace(20, 200, 1000, dtype=np.float32)
    return TwinFrames(camera, [np.tile(ramp, (1000, 1))])


def serve(ready, rate: float) -> None:
    with TwinCamera(megapixel_frames(), rate=rate):
        ready.send(True)
        ready.recv()


@contextmanager
def started(rate: float = 20.0):
    """Run a process that is a camera and answers already; at the end it is killed."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["squilla.live.twin_camera", "numba"])
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, rate), daemon=True)
    process.start()
    try:
        assert ours.poll(60)
        assert ours.recv()
        yield process
    finally:
        process.kill()
        process.join()
        ours.close()
