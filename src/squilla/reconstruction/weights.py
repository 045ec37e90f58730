"""Files of weights: safetensors with a checksum, which hold numbers and text and run no code."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from squilla import __version__
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.files.disk import replacing

_FORMAT = "squilla model 1"


def fingerprint(calibration: Calibration) -> str:
    """Return twelve hexadecimal digits that tell this sensitivity from every other."""
    digest = hashlib.sha256()
    for part in (calibration.wavelength, calibration.angle, calibration.sensitivity):
        digest.update(np.ascontiguousarray(part, np.float32).tobytes())
    return digest.hexdigest()[:12]


def digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """Return a checksum of named tensors and text."""
    digest = hashlib.sha256(json.dumps(dict(metadata), sort_keys=True).encode())
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def write_weights(
    path: str | Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write named tensors and text to a file, which is replaced only when the new one is whole."""
    from safetensors.torch import save

    contiguous = {key: value.contiguous() for key, value in tensors.items()}
    told = {"format": _FORMAT, "software": f"squilla {__version__}", **metadata}
    told["checksum"] = digest(contiguous, told)
    content = save(contiguous, told)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the text of a file.

    Raises
    ------
    InputError
        If it is not whole, not what its checksum says, or no model of squilla.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is not a whole model file ({error}).") from error
    stated = metadata.pop("checksum", None)
    if stated is not None and stated != digest(tensors, metadata):
        raise InputError(f"{path} is damaged: it is not what its checksum says; copy it again.")
    if metadata.get("format") != _FORMAT:
        raise foreign(path)
    return tensors, metadata


def foreign(path: Path) -> InputError:
    """Return the error of a file that is no model."""
    return InputError(f"{path} is not a model of squilla; make one with train.")
