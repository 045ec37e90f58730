"""The reconstructors by name, and how one is made ready for a camera."""

import json
from collections.abc import Mapping
from importlib import import_module
from importlib.resources import files as package_files
from pathlib import Path

import numpy as np
from torch import Tensor

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.reconstruction.reconstructor import Reconstructor
from squilla.reconstruction.weights import foreign, read_weights

MODELS: Mapping[str, tuple[str, str, str]] = {
    "ridge": ("linear", "Ridge", "linear Wiener estimator, one matrix per field angle; at once"),
    "nnls": ("sparse", "NonNegative", "non-negative least squares over Gaussian line shapes"),
    "sparse": ("sparse", "Sparse", "non-negative l1 over Gaussian line shapes; best for lines"),
    "twist": ("sparse", "Twist", "the problem of `sparse` solved by monotone TwIST; slow"),
    "mlp": ("networks", "MLP", "fully connected network of the BEST camera; 1.1 M weights"),
    "cnn": ("networks", "CNN", "the thesis' convolutional network; 1.0 M weights"),
    "rescnn": ("networks", "ResCNN", "convolutional correction of a linear estimate; 3.6 M"),
    "unet": ("networks", "UNet", "residual U-Net along the wavelengths; 18.5 M weights"),
    "respecnn": ("networks", "ReSpecNN", "the thesis' proposal; 4.1 M weights"),
    "compound": ("compound", "Compound", "spatial and spectral, for every camera; with intervals"),
}
"""Every reconstructor by name: its file in this room, its class, and one line about it."""

TOLERANCE = 0.05
"""Largest relative RMS change of the sensitivity at which trained weights still hold."""


def models() -> dict[str, str]:
    """Return the names of all reconstructors, each with one line about it."""
    return {name: description for name, (_, _, description) in MODELS.items()}


def model_class(name: str) -> type[Reconstructor]:
    """Return the class of a reconstructor; each is made as ``model_class(name)(calibration)``."""
    if name not in MODELS:
        raise InputError(f"There is no model named {name!r}; there are {', '.join(MODELS)}.")
    module, attribute, _ = MODELS[name]
    return getattr(import_module(f"squilla.reconstruction.{module}"), attribute)


def load_model(
    name: str | Path, calibration: Calibration, engine: str | None = None
) -> Reconstructor:
    """Return a reconstructor, ready for this camera.

    Parameters
    ----------
    name : str or path
        A name of `models`, or a file written by `Reconstructor.save`.
    calibration : Calibration
        The camera. Weights are accepted when the sensitivity that they were trained for differs
        from this one, after a common factor, by at most 5 % (relative RMS): a re-measured
        calibration of the same camera.
    engine : str, optional
        What runs the networks; see `Reconstructor.with_engine`. Default: PyTorch.

    Raises
    ------
    InputError
        If the name is unknown, the file is damaged or foreign, or made for another camera; if the
        engine is unknown or its packages are missing.
    """
    model = _loaded(name, calibration)
    return model if engine is None else model.with_engine(engine)


def _loaded(name: str | Path, calibration: Calibration) -> Reconstructor:
    if not isinstance(calibration, Calibration):
        raise InputError(
            "A model is loaded for a Calibration: read one with load_calibration, or make one "
            "with Calibration.from_sensitivity."
        )
    if isinstance(name, str) and name in MODELS:
        kind = model_class(name)
        if not kind.trained:
            return kind(calibration)
        path = Path(str(package_files("squilla"))) / "data" / "weights" / f"{name}.safetensors"
        if not path.is_file():
            raise InputError(f"No weights ship for `{name}`; train it for your camera first.")
    else:
        path = Path(name)
        if not path.is_file():
            raise InputError(
                f"{str(name)!r} is neither a model file nor the name of a model; the names are "
                f"{', '.join(MODELS)}."
            )
    return _read(path, calibration)


def _read(path: Path, calibration: Calibration) -> Reconstructor:
    tensors, metadata = read_weights(path)
    name = metadata.get("name", "")
    if name not in MODELS:
        raise foreign(path)
    try:
        provenance = json.loads(metadata["provenance"])
        sensitivity, wavelength = tensors.pop("sensitivity"), tensors.pop("wavelength")
    except (KeyError, ValueError) as error:
        raise foreign(path) from error
    if not model_class(name).universal:
        _check_camera(path, sensitivity, wavelength.numpy(), calibration)
    weights = {key.removeprefix("weights."): value for key, value in tensors.items()}
    model = model_class(name).for_weights(calibration, weights)
    expected = model.state_dict()
    if not model.trained or {k: v.shape for k, v in weights.items()} != {
        k: v.shape for k, v in expected.items()
    }:
        raise InputError(f"{path} holds other weights than `{name}` has; train it again.")
    if not all(value.isfinite().all() for value in weights.values()):
        raise InputError(f"{path} holds weights that are not finite; train it again.")
    model.load_state_dict(weights)
    model.provenance = provenance
    return model.eval()


def _check_camera(
    path: Path, sensitivity: Tensor, wavelength: np.ndarray, calibration: Calibration
) -> None:
    """Refuse weights that were trained for another camera than `calibration`."""
    own = calibration.mean_sensitivity.double()
    if sensitivity.shape != own.shape or not np.allclose(
        wavelength, calibration.wavelength, rtol=0, atol=1e-3
    ):
        raise InputError(
            f"{path} was trained for {' channels and '.join(map(str, sensitivity.shape))} bands, "
            f"{wavelength[0]:g}-{wavelength[-1]:g} nm; the calibration has {own.shape[0]} channels "
            f"and {own.shape[1]} bands, {calibration.wavelength[0]:g}-"
            f"{calibration.wavelength[-1]:g} nm. Train a model for this camera."
        )
    theirs = sensitivity.double()
    factor = (own * theirs).sum() / theirs.square().sum().clamp_min(1e-300)
    difference = float((own - factor * theirs).norm() / own.norm())
    if not difference <= TOLERANCE:
        raise InputError(
            f"{path} was trained for a sensitivity that differs from the calibration's by "
            f"{difference:.1%} (at most {TOLERANCE:.0%} is allowed). Train a model for this camera."
        )
