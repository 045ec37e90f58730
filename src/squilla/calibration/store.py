"""A calibration as one NetCDF file."""

import json
from pathlib import Path
from zlib import crc32

import numpy as np
import xarray as xr

from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.errors import InputError
from squilla.files.disk import check_size, existing, reading, write_netcdf

_KIND = "squilla calibration"
_FRAMES = ("bias", "dark_rate", "flat")


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration, whole or not at all.

    The frames (bias, dark rate, flat) are packed to 16 bits over their range; everything else is
    kept to the bit. Every block of every table has a checksum.

    Parameters
    ----------
    calibration : Calibration
    path : str or Path
        Ending in .nc.

    Raises
    ------
    InputError
        If the name ends otherwise or cannot be written.
    """
    if Path(path).suffix != ".nc":
        raise InputError(f"A calibration is a NetCDF file; give a name ending in .nc, not {path}.")
    nm, px = {"units": "nm", "standard_name": "radiation_wavelength"}, {"units": "px"}
    variables: dict = {
        "sensitivity": (("angle", "unit", "wavelength"), calibration.sensitivity),
        "wavelength": ("wavelength", calibration.wavelength, nm),
        "angle": ("angle", calibration.angle, {"units": "rad", "long_name": "field angle"}),
    }
    if calibration.deviations is not None:
        errors = calibration.deviations.astype(np.float32)
        variables["deviations"] = (("draw", "angle", "unit", "wavelength"), errors)
    if calibration.white is not None:
        variables["white"] = ("unit", calibration.white, {"long_name": "level of the flats"})
    attributes: dict = {
        "Conventions": "CF-1.11",
        "kind": _KIND,
        "provenance": json.dumps(calibration.provenance),
    }
    lattice, pixels = calibration.lattice, calibration.pixels
    if lattice is not None:
        variables["centre"] = (("unit", "yx"), lattice.centre, px)
        variables["baseline"] = (("unit", "yx"), lattice.baseline, {"units": "lens pitches"})
        if lattice.bend is not None:
            variables["bend"] = (("unit", "yx", "power"), lattice.bend, px)
        numbers = ("reference", "focal", "pitch", "pixel", "usual")
        attributes |= {f"lattice_{name}": getattr(lattice, name) for name in numbers}
        attributes |= {"lattice_shape": list(lattice.shape), "lattice_field": list(lattice.field)}
    checked = {"fletcher32": True, "zlib": True, "complevel": 1, "shuffle": True}
    if pixels is not None:
        for name in _FRAMES:
            variables[name] = (("row", "column"), *_packed(getattr(pixels, name)))
        variables["valid"] = (("row", "column"), pixels.valid.astype(np.uint8))
        for name in ("saturation", "gain", "read_noise"):
            attributes[f"pixels_{name}"] = float(getattr(pixels, name))
    dataset = xr.Dataset(variables, attrs=attributes)
    dataset.attrs["checksum"] = _digest(dataset)
    write_netcdf(dataset, path, encoding=dict.fromkeys(variables, checked))


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration that `save_calibration` wrote.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If the file is missing, damaged, or no calibration.
    """
    path = existing(path)
    with (
        reading(path, "calibration"),
        xr.open_dataset(path, engine="h5netcdf", mask_and_scale=False) as packed,
    ):
        facts = packed.attrs
        stated = facts.pop("checksum", None)
        if facts.get("kind") != _KIND:
            raise InputError(
                f"{path} is no calibration; make one with `squilla calibrate` or "
                "Calibration.from_sensitivity(...).save(...)."
            )
        check_size(path, sum(each.nbytes for each in packed.variables.values()))
        if stated is not None and stated != _digest(packed):
            raise InputError(f"{path} is damaged: it is not what its checksum says; copy it again.")
        dataset = xr.decode_cf(packed, decode_times=False)
        lattice = pixels = None
        if "centre" in dataset:
            lattice = Lattice(
                shape=_pair(facts["lattice_shape"]),
                centre=dataset["centre"].values,
                baseline=dataset["baseline"].values,
                reference=int(facts["lattice_reference"]),
                field=_pair(facts["lattice_field"]),
                focal=float(facts["lattice_focal"]),
                pitch=float(facts["lattice_pitch"]),
                pixel=float(facts["lattice_pixel"]),
                usual=float(facts["lattice_usual"]),
                bend=dataset["bend"].values if "bend" in dataset else None,
            )
        if "flat" in dataset:
            pixels = Pixels(
                *(dataset[name].values.astype(np.float32) for name in _FRAMES),
                valid=dataset["valid"].values.astype(bool),
                saturation=float(facts["pixels_saturation"]),
                gain=float(facts["pixels_gain"]),
                read_noise=float(facts["pixels_read_noise"]),
            )
        return Calibration(
            dataset["wavelength"].values.astype(float),
            dataset["sensitivity"].values.astype(float),
            dataset["angle"].values.astype(float),
            lattice,
            pixels,
            dataset["deviations"].values if "deviations" in dataset else None,
            dataset["white"].values.astype(float) if "white" in dataset else None,
            json.loads(facts["provenance"]),
        )


def _digest(dataset: xr.Dataset) -> str:
    """Return a checksum of all values as they are stored, and of all that is said about them."""
    total = 0
    parts = [("", dataset.attrs, None)]
    parts += [(str(name), each.attrs, each) for name, each in sorted(dataset.variables.items())]
    for name, attributes, values in parts:
        told = {key: np.asarray(value).tolist() for key, value in attributes.items()}
        told.pop("_FillValue", None)  # written by xarray
        total = crc32(json.dumps([name, told], sort_keys=True).encode(), total)
        if values is not None:
            stored = np.ascontiguousarray(values.values)
            total = crc32(f"{stored.dtype.str[1:]} {stored.shape}".encode(), total)
            total = crc32(stored.reshape(-1).view(np.uint8).data, total)
    return f"{total:08x}"


def _pair(values: np.ndarray) -> tuple[int, int]:
    first, second = values
    return int(first), int(second)


def _packed(frame: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    """Pack a frame to 16 bits over its range, with the attributes that readers unpack it by."""
    low, high = float(frame.min()), float(frame.max())
    scale = max(high - low, 1e-12) / 65535
    packed = np.rint((frame - low) / scale).astype(np.uint16)
    return packed, {"scale_factor": scale, "add_offset": low}
