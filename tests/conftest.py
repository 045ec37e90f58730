"""A small camera for the tests: everything the thesis' camera has, on a hundredth of the pixels."""

import fcntl
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from squilla.calibration.rehearsal import Rehearsal, poster
from squilla.camera.design import CameraDesign
from squilla.camera.twin import Camera


def small_design(**sections) -> CameraDesign:
    """Return a 4 x 4 camera with coarse pixels, 51 bands; sections given as dicts of changes."""
    tree = CameraDesign.load("thesis").model_dump()
    tree["array"] |= {"rows": 4, "columns": 4}
    tree["sensor"] |= {"pixel": 7.4, "rows": 480, "columns": 500, "hot_pixels": 2e-5}
    tree["field"] |= {"size": 60, "reference": 5}
    tree["band"] |= {"step": 5.0}
    for name, changes in sections.items():
        tree[name] = changes if tree[name] is None or changes is None else tree[name] | changes
    return CameraDesign.model_validate(tree)


@pytest.fixture(scope="session")
def design() -> CameraDesign:
    return small_design(array={"rotation": 1.2, "offset": (7.3, -11.8), "position_error": 3.0})


@pytest.fixture(scope="session")
def camera(design) -> Camera:
    return Camera(design)


@pytest.fixture(scope="session")
def calibration(camera):
    """Learnt from frames alone."""
    return Rehearsal(camera, step=5.0, bandwidth=5.0, distance=300.0).calibrate()


@pytest.fixture(scope="session")
def scene(design):
    """A coloured texture, 90 x 90."""
    texture = poster(90, design.wavelength, seed=3)
    tint = np.linspace(0.4, 1, len(design.wavelength))
    return (texture * tint).astype(np.float32)


@pytest.fixture
def port():
    """Lend the one port of GigE Vision: tests in other processes wait."""
    with (Path(tempfile.gettempdir()) / "squilla-gige-vision.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)
