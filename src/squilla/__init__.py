"""Snapshot computational hyperspectral cameras, from filter design to the finished cube.

The public names are handed on lazily: ``import squilla`` loads no heavy library.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOME = {
    "InputError": "errors",
    "Raw": "files.raw",
    "read_raw": "files.raw",
    "read_scene": "files.cube",
    "labelled": "files.cube",
    "load_cube": "files.cube",
    "save": "files.cube",
    "StencilRecipe": "optics.filters",
    "CameraDesign": "camera.design",
    "Camera": "camera.twin",
    "load_scene": "camera.scenes",
    "Calibration": "calibration.calibration",
    "calibrate": "calibration.calibrate",
    "load_calibration": "calibration.store",
    "Measurement": "calibration.alignment",
    "measure": "calibration.alignment",
    "align_stack": "calibration.stack",
    "Reconstructor": "reconstruction.reconstructor",
    "load_model": "reconstruction.models",
    "train": "training.fit",
    "evaluate": "evaluation.metrics",
    "show": "evaluation.plots",
}

__all__ = ["__version__", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from squilla.calibration.alignment import Measurement, measure
    from squilla.calibration.calibrate import calibrate
    from squilla.calibration.calibration import Calibration
    from squilla.calibration.stack import align_stack
    from squilla.calibration.store import load_calibration
    from squilla.camera.design import CameraDesign
    from squilla.camera.scenes import load_scene
    from squilla.camera.twin import Camera
    from squilla.errors import InputError
    from squilla.evaluation.metrics import evaluate
    from squilla.evaluation.plots import show
    from squilla.files.cube import labelled, load_cube, read_scene, save
    from squilla.files.raw import Raw, read_raw
    from squilla.optics.filters import StencilRecipe
    from squilla.reconstruction.models import load_model
    from squilla.reconstruction.reconstructor import Reconstructor
    from squilla.training.fit import train


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'squilla' has no attribute {name!r}")
    value = getattr(import_module(f"squilla.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
