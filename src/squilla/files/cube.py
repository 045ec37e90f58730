"""Cubes on disk: NetCDF, ENVI, TIFF, Zarr by suffix, and scenes as others store them."""

import json
import re
from collections.abc import Callable, Mapping
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.arrays import assemble, read_mat, read_npy, read_npz
from squilla.files.disk import check_size, existing, reading, replacing, write_netcdf
from squilla.files.envi import DATA_SUFFIXES, read_envi, write_envi
from squilla.files.lazy import DIMS
from squilla.files.notebook import CubeAccessor
from squilla.files.tiff import open_tiff, write_tiff
from squilla.spectra import nanometres

CUBE_SUFFIXES = (".nc", ".hdr", ".tiff", ".tif", ".zarr")
"""What `save` writes and `load_cube` reads."""

SCENE_SUFFIXES = (*CUBE_SUFFIXES, *DATA_SUFFIXES, ".npz", ".npy", ".mat")
"""What `read_scene` reads."""

xr.register_dataarray_accessor("squilla")(CubeAccessor)

_CF = {"standard_name": "radiation_wavelength", "long_name": "wavelength", "units": "nm"}


def labelled(
    values: np.ndarray,
    wavelength: np.ndarray,
    *,
    name: str = "radiance",
    attributes: Mapping[str, Any] | None = None,
) -> DataArray:
    """Make a cube of numbers and their wavelengths.

    Parameters
    ----------
    values : array, (H, W, K)
    wavelength : array, (K,)
        nm.
    name : str
        What the values are.
    attributes : mapping, optional

    Returns
    -------
    DataArray, (y, x, wavelength), with the CF attributes of a wavelength in nm
    """
    coordinate = ("wavelength", nanometres(wavelength), _CF)
    return DataArray(values, {"wavelength": coordinate}, DIMS, name, dict(attributes or {}))


def save(
    cube: DataArray, path: str | Path, *, extra: Mapping[str, DataArray] | None = None
) -> None:
    """Write a cube as its suffix says: NetCDF .nc, ENVI .hdr, TIFF .tiff, Zarr .zarr.

    The file is whole or not there at all. Attributes that are no plain number, string or list are
    kept as JSON text.

    Parameters
    ----------
    cube : DataArray, (y, x, wavelength)
        With its wavelengths, nm, increasing; optionally a coordinate "fwhm" along them, nm.
    path : str or Path
    extra : mapping of name to DataArray, optional
        What belongs to the cube, such as its uncertainty; further variables of a NetCDF or Zarr,
        files beside it, ``doll-uncertainty.hdr``, for ENVI and TIFF.

    Raises
    ------
    InputError
        If the suffix is unknown, the cube has no usable wavelengths, or the place cannot be
        written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in CUBE_SUFFIXES:
        raise InputError(f"{path} must end in one of {', '.join(CUBE_SUFFIXES)} to be written.")
    if not isinstance(cube, DataArray):
        raise InputError("A cube to be saved has its wavelengths; make one with labelled.")
    arrays = {str(cube.name or "cube"): _checked(cube)}
    if extra and not arrays.keys().isdisjoint(extra):
        raise InputError(f"An extra has the name of the cube itself, {cube.name!r}; rename it.")
    arrays |= extra or {}
    arrays = {name: _plain(array.rename(name)) for name, array in arrays.items()}
    if suffix in (".nc", ".zarr"):
        dataset = xr.Dataset(arrays)
        dataset.attrs = {"Conventions": "CF-1.11", "cube": next(iter(arrays))}
        (write_netcdf if suffix == ".nc" else _write_zarr)(dataset, path)
        return
    first, *others = arrays
    for name in others:
        _write_single(arrays[name], path.with_stem(f"{path.stem}-{name}"))
    _write_single(arrays[first], path)


def load_cube(path: str | Path) -> DataArray:
    """Read a cube that `save` wrote, with its wavelengths and attributes.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    DataArray, (y, x, wavelength), in memory

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind, or holds no cube with wavelengths.
    """
    path = existing(path)
    if path.suffix.lower() not in CUBE_SUFFIXES:
        raise InputError(f"{path} must end in one of {', '.join(CUBE_SUFFIXES)} to be a cube.")
    return _read(path)


def open_cube(
    path: str | Path,
    *,
    wavelength: np.ndarray | str | Path | None = None,
    variable: str | None = None,
) -> tuple[DataArray, dict[str, DataArray]]:
    """Open a cube, ours or others', whose numbers stay on disk until they are used.

    ENVI, NetCDF, Zarr, NPY and plain TIFF are read by need; the other kinds at once.

    Parameters
    ----------
    path, wavelength, variable
        As in `read_scene`.

    Returns
    -------
    cube : DataArray, (y, x, wavelength)
        Each use reads anew; ``cube.encoding["together"]`` is the number of bands that the disk
        must bring when one is wanted.
    extra : dict of name to DataArray, (y, x) or (y, x, wavelength)
        What `save` wrote with it.

    Raises
    ------
    InputError
        As `read_scene`; values are not looked at.
    """
    path = existing(path)
    if path.suffix.lower() not in SCENE_SUFFIXES:
        raise InputError(f"{path} is none of the scenes known: {', '.join(SCENE_SUFFIXES)}.")
    if isinstance(wavelength, str | Path):
        wavelength = _read_vector(existing(wavelength))
    given = None if wavelength is None else np.asarray(wavelength, float).ravel()
    stored, extra = _open(path, variable, given)
    cube = _in_nanometres(stored, path)
    cube.encoding["together"] = stored.encoding["together"]
    order = np.argsort(stored["wavelength"].values, kind="stable")
    if (np.diff(order) != 1).any():
        extra = {
            name: each.isel(wavelength=order) if each.ndim == 3 else each
            for name, each in extra.items()
        }
    return cube, extra


def read_scene(
    path: str | Path,
    *,
    wavelength: np.ndarray | str | Path | None = None,
    variable: str | None = None,
) -> DataArray:
    """Read a scene as others store it: ENVI, NetCDF, NPZ, NPY, MATLAB, or one of our own cubes.

    Parameters
    ----------
    path : str or Path
        An ENVI header or its data, .nc, .npz, .npy, .mat (version 5 or 7.3), .tiff, .zarr.
    wavelength : array, (K,), or path, optional
        Wavelengths, nm or um, where the file has none; a path leads to a text file with one
        number a line, or to a .npy.
    variable : str, optional
        Name of the cube where a file holds several.

    Returns
    -------
    DataArray, (y, x, wavelength), float32
        Wavelengths in nm, increasing.

    Raises
    ------
    InputError
        If the file is missing, damaged or foreign; if there are no wavelengths, or one occurs
        twice; if values are NaN or infinite, or none is above zero.
    """
    scene = _read(path, variable=variable, wavelength=wavelength)
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(scene.values, np.float32)
    if not np.isfinite(values).all():
        raise InputError(f"{path} holds NaN or empty pixels; crop them away or fill them.")
    if values.max(initial=0) <= 0:
        raise InputError(f"{path} holds no value above zero; a scene is a radiance.")
    return scene.copy(data=values)


# --- wavelengths, attributes ----------------------------------------------------------------


def _checked(cube: DataArray) -> DataArray:
    """Return the cube as (y, x, wavelength) if it is one that can be written."""
    if set(cube.dims) != set(DIMS) or cube.size == 0:
        raise InputError(f"A cube has the dims {DIMS}; this one has {dict(cube.sizes)}.")
    if "wavelength" not in cube.coords:
        raise InputError('The cube has no coordinate "wavelength"; assign its wavelengths in nm.')
    if cube.dtype.kind not in "iuf":
        raise InputError(f"A cube holds real numbers; this one holds {cube.dtype}.")
    cube = cube.transpose(*DIMS)
    cube = cube.assign_coords(wavelength=cube["wavelength"].assign_attrs(_CF))
    if not (np.diff(cube["wavelength"]) > 0).all():
        raise InputError("The wavelengths of a cube must increase from band to band.")
    return cube


def _plain(array: DataArray) -> DataArray:
    """Return the array with attributes that every format can hold."""

    def plain(value):
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if isinstance(value, bool):
            return int(value)
        numbers = isinstance(value, list | tuple) and all(
            isinstance(each, int | float) and not isinstance(each, bool) for each in value
        )
        if isinstance(value, str | int | float) or (numbers and value):
            return list(value) if isinstance(value, tuple) else value
        return json.dumps(value, default=str)

    return array.assign_attrs({key: plain(value) for key, value in array.attrs.items()})


def _in_nanometres(cube: DataArray, path: Path) -> DataArray:
    """Return the cube with its wavelengths in nm, increasing; refuse it if they cannot be had."""
    if "wavelength" not in cube.coords:
        raise InputError(f"{path} tells no wavelengths; give them, one for each band, in nm.")
    stated = cube["wavelength"]
    factor = _unit(str(stated.attrs.get("units", "")), stated.values, path)
    wavelength = stated.values.astype(float) * factor
    if not (np.isfinite(wavelength).all() and 100 <= wavelength.min() <= wavelength.max() <= 5e4):
        raise InputError(
            f"{path}: wavelengths from {wavelength.min():g} to {wavelength.max():g} nm make no "
            "sense; give the right ones, in nm."
        )
    result = cube.assign_coords(wavelength=("wavelength", wavelength, _CF))
    if "fwhm" in cube.coords:
        width = cube["fwhm"]
        result = result.assign_coords(fwhm=(width.dims, width.values * factor, width.attrs))
    order = np.argsort(wavelength, kind="stable")
    twice = wavelength[order][:-1][np.diff(wavelength[order]) == 0]
    if len(twice):
        raise InputError(f"{path} has two bands at {twice[0]:g} nm; keep one of them.")
    return result if (np.diff(order) == 1).all() else result.isel(wavelength=order)


def _unit(units: str, values: np.ndarray, path: Path) -> float:
    """Return what turns these wavelengths into nm; where no unit is stated their size tells."""
    units = units.strip().lower()
    if re.fullmatch(r"nm|nanomet(er|re)s?", units):
        return 1.0
    if re.fullmatch(r"[uµμ]m|micromet(er|re)s?|microns?", units):
        return 1e3
    if re.fullmatch(r"m|met(er|re)s?", units):
        return 1e9
    if units in ("", "unknown"):
        return 1e3 if values.max(initial=0) < 20 else 1.0
    raise InputError(f"{path} states its wavelengths in {units!r}; nm or um was expected.")


def _read_vector(path: Path) -> np.ndarray:
    with reading(path, "list of wavelengths"):
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False)
        return np.array(path.read_text().replace(",", " ").split(), float)


# --- one reader and one writer for each kind --------------------------------------------------


def _read(path: str | Path, **how: Any) -> DataArray:
    cube, _ = open_cube(path, **how)
    with reading(Path(path), "cube"):
        return cube.load()


def _open(
    path: Path, variable: str | None, wavelength: np.ndarray | None
) -> tuple[DataArray, dict[str, DataArray]]:
    suffix = path.suffix.lower()
    if suffix == ".nc":
        return _open_dataset(path, variable, wavelength, kind="NetCDF")
    if suffix == ".zarr":
        need_zarr(path)
        return _open_dataset(
            path, variable, wavelength, kind="Zarr", engine="zarr", consolidated=False
        )
    if suffix in (".npz", ".npy", ".mat"):
        reader = {".npz": read_npz, ".npy": read_npy, ".mat": read_mat}[suffix]
        return assemble(reader(path), path, variable, wavelength), {}
    one = open_tiff if suffix in (".tif", ".tiff") else read_envi
    cube = one(path)
    if wavelength is not None:
        if len(wavelength) != cube.sizes["wavelength"]:
            raise InputError(
                f"{path} has {cube.sizes['wavelength']} bands, but {len(wavelength)} wavelengths "
                "are given."
            )
        cube = cube.drop_vars("fwhm", errors="ignore").assign_coords(wavelength=wavelength)
    return cube, _beside(path, cube, one)


def _open_dataset(
    path: Path, variable: str | None, wavelength: np.ndarray | None, *, kind: str, **how: Any
) -> tuple[DataArray, dict[str, DataArray]]:
    import h5py

    with reading(path, kind):
        if path.is_file():
            with path.open("rb") as stream:
                classic = stream.read(3) == b"CDF"  # NetCDF 3; others are HDF5 or nothing
            how["engine"] = "scipy" if classic else "h5netcdf"
            if not classic:
                h5py.File(
                    path, "r"
                ).close()  # says in plain words what is wrong with a damaged file
        dataset = xr.open_dataset(path, decode_times=False, cache=False, **how)
        if "sensitivity" in dataset and "cube" not in dataset.attrs:
            raise InputError(f"{path} is a calibration, no cube.")
        arrays = {str(name): dataset[name] for name in dataset.variables}
        arrays = {name: each for name, each in arrays.items() if each.dtype.kind in "iufb"}
        check_size(path, sum(each.nbytes for each in arrays.values()))
        variable = variable or dataset.attrs.get("cube")
        numbers = {name: each for name, each in arrays.items() if each.dtype.kind != "b"}
        cube = assemble(numbers, path, variable, wavelength)
        cube.attrs = dict(dataset[cube.name].attrs)
        for name, coordinate in dataset[cube.name].coords.items():
            if name != "wavelength" and set(coordinate.dims) <= set(DIMS):
                cube = cube.assign_coords({name: coordinate.load()})
        sizes = dataset[cube.name].sizes
        extra = {
            name: each
            for name, each in arrays.items()
            if name in dataset.data_vars and name != cube.name and each.dims in (DIMS[:2], DIMS)
            if all(each.sizes[dim] == sizes.get(dim) for dim in each.dims)
        }
    return cube, extra


def _beside(path: Path, cube: DataArray, one: Callable[[Path], DataArray]) -> dict[str, DataArray]:
    """Open what `save` wrote beside an ENVI or TIFF cube: doll-uncertainty.hdr beside doll.hdr."""
    extra = {}
    for other in sorted(path.parent.glob(f"{escape(path.stem)}-*{path.suffix}")):
        try:
            beside = one(other)
        except InputError:  # somebody else's file is none of ours to complain of
            continue
        if other.stem != f"{path.stem}-{beside.name}" or beside.shape[:2] != cube.shape[:2]:
            continue
        if "wavelength" not in beside.coords and beside.shape[2] == 1:
            beside = beside.isel(wavelength=0)
        extra[str(beside.name)] = beside
    return extra


def need_zarr(path: Path) -> None:
    try:
        import zarr  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"{path} needs the package zarr; install it with: pip install 'squilla[batch]'."
        ) from error


def _write_zarr(dataset: xr.Dataset, path: Path) -> None:
    need_zarr(path)
    if path.is_dir() and any(path.iterdir()) and not (path / "zarr.json").exists():
        raise InputError(f"{path} is a folder of other things; it is not replaced.")
    with replacing(path, folder=True) as temporary:
        dataset.to_zarr(
            temporary, zarr_format=3, consolidated=False, encoding=zarr_encoding(dataset)
        )


def zarr_encoding(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Return how the variables of a dataset are packed in a Zarr: tiles with their whole spectra.

    So a point is read without the rest of the picture, and a capture without the others.
    """
    from zarr.codecs import BloscCodec

    packed = BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle")
    tile = {"y": 128, "x": 128, "capture": 1}
    return {
        str(name): {
            "compressors": (packed,),
            "chunks": tuple(
                min(size, tile.get(str(dim), size)) for dim, size in array.sizes.items()
            ),
        }
        for name, array in dataset.data_vars.items()
    }


def _write_single(array: DataArray, path: Path) -> None:
    if array.dims[:2] != DIMS[:2] or array.ndim > 3:
        raise InputError(f"{path} cannot hold {array.name} of {array.dims}; use .nc or .zarr.")
    if array.dtype == bool:
        array = array.astype(np.uint8)
    (write_envi if path.suffix.lower() == ".hdr" else write_tiff)(array, path)
