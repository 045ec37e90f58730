"""Cubes that others left among named arrays, NPZ, NPY or MATLAB, and the search for their bands."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.disk import check_size, reading
from squilla.files.lazy import OnDisk, lazy

_SPECTRAL = re.compile(r"wave|lambda|wvl|^wl|^bands?$|band_?(cent|wave)|cent(er|re)s?$", re.I)
"""Names that others give to a vector of wavelengths."""


def assemble(
    arrays: Mapping[str, Any], path: Path, variable: str | None, wavelength: np.ndarray | None
) -> DataArray:
    """Find the cube among named arrays, and the axis along which its wavelengths run.

    Parameters
    ----------
    arrays : mapping
        Arrays, or DataArrays, whose dims then tell the spectral axis.
    path : Path
        Where they came from.
    variable : str or None
        Name of the cube; needed where there are several.
    wavelength : array, (K,), or None
        Wavelengths that the file itself does not tell.

    Returns
    -------
    DataArray, (y, x, wavelength), of the type in the file; not yet read
    """
    vectors = [(None, wavelength)] if wavelength is not None else _vectors(arrays)
    cubes = {name: each for name, each in arrays.items() if len(each.shape) == 3}
    if variable is not None:
        if variable not in cubes:
            raise InputError(f"{path} holds no cube {variable!r}; it holds {sorted(cubes)}.")
        cubes = {variable: cubes[variable]}
    if not cubes:
        raise InputError(f"{path} holds no cube: no array in it has three axes.")
    if not vectors:
        raise InputError(f"{path} tells no wavelengths; give them, one for each band, in nm.")
    fits = [
        (name, axis, vector)
        for name, cube in cubes.items()
        for label, vector in vectors
        if (axis := _spectral_axis(cube, label, vector)) is not None
    ]
    if not fits:
        shapes = ", ".join(f"{name} {tuple(each.shape)}" for name, each in cubes.items())
        raise InputError(
            f"{path} has {'/'.join(str(np.size(each)) for _, each in vectors)} wavelengths, but "
            f"no axis of {shapes} is of that length."
        )
    names = {name for name, _, _ in fits}
    if len(names) > 1:
        raise InputError(f"{path} holds several cubes, {sorted(names)}; choose one with variable=.")
    name, axis, vector = fits[0]
    units = str(vector.attrs.get("units", "")) if isinstance(vector, DataArray) else ""
    spectral = ("wavelength", np.asarray(vector, float).ravel(), {"units": units})
    each = arrays[name]
    stored = each.variable if isinstance(each, DataArray) else np.asarray(each)
    axes = (*(other for other in range(3) if other != axis), axis)
    return lazy(OnDisk(stored, axes), {"wavelength": spectral}, name, {})


def _vectors(arrays: Mapping[str, Any]) -> list[tuple[str | None, Any]]:
    return [
        (name, each)
        for name, each in arrays.items()
        if _SPECTRAL.search(name) and 0 < np.size(each) == max(each.shape, default=0)
    ]


def _spectral_axis(cube: Any, label: str | None, vector: Any) -> int | None:
    """Return the axis that has the vector's name or, the last one first, its length."""
    if isinstance(cube, DataArray) and label in cube.dims:
        return cube.dims.index(label)
    axes = [axis for axis in (2, 0, 1) if cube.shape[axis] == np.size(vector)]
    return axes[0] if axes else None


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read the numeric arrays of a .npz."""
    with reading(path, "NPZ"), np.load(path, allow_pickle=False) as archive:
        check_size(path, sum(entry.file_size for entry in archive.zip.infolist()))
        return _numeric({name: archive[name] for name in archive.files})


def read_npy(path: Path) -> dict[str, np.ndarray]:
    """Read the one array of a .npy, under the name "cube"."""
    with reading(path, "NPY"):  # mapped, so that a header without its data is refused
        return _numeric({"cube": np.load(path, mmap_mode="r", allow_pickle=False)})


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """Read the cubes and vectors of a MATLAB file of version 5 or 7.3."""
    from scipy.io import loadmat, whosmat

    with reading(path, "MATLAB"):
        if _is_hdf5(path):
            return _read_hdf5_mat(path)
        wanted = [
            (name, shape)
            for name, shape, kind in whosmat(str(path))
            if kind in ("double", "single", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32)))
            and (len(shape) == 3 or _SPECTRAL.search(name))
        ]
        check_size(path, sum(int(np.prod(shape)) for _, shape in wanted))
        names = [name for name, _ in wanted]
        return _numeric({name: loadmat(str(path), variable_names=[name])[name] for name in names})


def _is_hdf5(path: Path) -> bool:
    import h5py

    return bool(h5py.is_hdf5(path))


def _read_hdf5_mat(path: Path) -> dict[str, np.ndarray]:
    import h5py

    with h5py.File(path, "r") as file:
        datasets = {name: each for name, each in file.items() if isinstance(each, h5py.Dataset)}
        check_size(path, sum(each.nbytes for each in datasets.values()))
        # MATLAB counts the first axis fastest, HDF5 the last.
        return _numeric({name: np.asarray(each).T for name, each in datasets.items()})


def _numeric(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: each for name, each in arrays.items() if each.dtype.kind in "iuf"}
