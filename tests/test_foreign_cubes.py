"""Scenes and cubes that others stored, with what they leave unsaid."""

from importlib.resources import files as package_files
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from squilla.errors import InputError
from squilla.files.cube import (
    labelled,
    load_cube,
    read_scene,
)

SCENES = Path(str(package_files("squilla"))) / "data" / "scenes"


WAVELENGTH = np.array([500.0, 501.5, 550.0, 649.9, 750.0])


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize(
    ("unit", "factor"), [("Nanometers", 1), ("Micrometers", 1e-3), (None, 1), (None, 1e-3)]
)
def test_others_envi(tmp_path, interleave, order, unit, factor):
    """What SPy writes, in every interleave and byte order, with bands out of order."""
    import spectral

    stored = np.random.default_rng(4).integers(0, 4000, (5, 6, 4), dtype=np.uint16)
    told = {"wavelength": [w * factor for w in (700.0, 500.0, 600.0, 550.0)], "Sensor": "X"}
    if unit:
        told["wavelength units"] = unit
    spectral.envi.save_image(
        str(tmp_path / "s.hdr"), stored, metadata=told, interleave=interleave, byteorder=order
    )
    for name in ("s.hdr", "s.img"):
        scene = read_scene(tmp_path / name)
        assert scene.dtype == np.float32
        np.testing.assert_allclose(scene["wavelength"], [500, 550, 600, 700])
        np.testing.assert_array_equal(scene, stored[..., [1, 3, 2, 0]])
        assert scene.values.flags.writeable


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_shipped_scene_agrees_with_gdal():
    rasterio = pytest.importorskip("rasterio")
    scene = read_scene(SCENES / "corn-kernel-hyperspectral.hdr")
    assert scene.shape == (31, 43, 580)
    assert scene["wavelength"].values[[0, -1]].tolist() == [366.551, 1048.421]
    with rasterio.open(SCENES / "corn-kernel-hyperspectral.raw") as opened:
        np.testing.assert_array_equal(scene, opened.read().transpose(1, 2, 0))


def test_shipped_npz():
    scene = read_scene(SCENES / "indian_pines.npz")
    assert scene.sizes == {"y": 145, "x": 145, "wavelength": 34}
    assert (np.diff(scene["wavelength"]) > 0).all()


def test_bad_bands_and_empty_pixels(tmp_path):
    import spectral

    stored = np.ones((2, 3, 3), np.int16)
    stored[..., 1] = -9999
    told = {"wavelength": [500, 600, 700], "fwhm": [5, 6, 7], "data ignore value": -9999}
    spectral.envi.save_image(str(tmp_path / "a.hdr"), stored, metadata=told | {"bbl": [1, 0, 1]})
    scene = read_scene(tmp_path / "a.hdr")
    assert scene["wavelength"].values.tolist() == [500, 700]
    assert scene["fwhm"].values.tolist() == [5, 7]
    spectral.envi.save_image(str(tmp_path / "b.hdr"), stored, metadata=told)
    with pytest.raises(InputError, match="empty"):
        read_scene(tmp_path / "b.hdr")


@pytest.mark.parametrize("version", ["5", "5z", "7.3"])
def test_matlab(tmp_path, version):
    import h5py
    from scipy.io import savemat

    stored = np.random.default_rng(5).random((4, 5, 3))
    told = np.array([[0.5, 0.6, 0.7]])
    path = tmp_path / "s.mat"
    if version == "7.3":
        with h5py.File(path, "w", userblock_size=512) as file:
            file["rad"] = stored.T
            file["wavelengths"] = told.T
            file["rgb"] = np.zeros((8, 4, 5))
        block = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        with path.open("rb+") as file:
            file.write(block)
    else:
        arrays = {"rad": stored, "wavelengths": told, "rgb": np.zeros((4, 5, 8)), "note": "corn"}
        savemat(path, arrays, do_compression=version == "5z")
    scene = read_scene(path)
    np.testing.assert_allclose(scene, stored, rtol=1e-6)
    np.testing.assert_allclose(scene["wavelength"], [500, 600, 700])


def test_arrays_with_wavelengths_apart(tmp_path):
    stored = np.random.default_rng(6).random((4, 5, 3))
    np.save(tmp_path / "s.npy", stored)
    (tmp_path / "w.txt").write_text("500\n600,\n700\n")
    np.save(tmp_path / "w.npy", np.array([500, 600, 700]))
    for wavelength in ([500, 600, 700], tmp_path / "w.txt", str(tmp_path / "w.npy")):
        scene = read_scene(tmp_path / "s.npy", wavelength=wavelength)
        np.testing.assert_array_equal(scene, stored.astype(np.float32))
        assert scene["wavelength"].values.tolist() == [500, 600, 700]
    assert scene.values.flags.writeable, "in memory, not on disk"
    np.save(tmp_path / "first.npy", np.moveaxis(stored, -1, 0))
    scene = read_scene(tmp_path / "first.npy", wavelength=[500, 600, 700])
    np.testing.assert_array_equal(scene, stored.astype(np.float32))


def test_several_cubes_need_a_choice(tmp_path):
    a, b = np.ones((2, 2, 3)), np.full((2, 2, 3), 2.0)
    np.savez(tmp_path / "s.npz", a=a, b=b, lambdas=[500.0, 600, 700])
    with pytest.raises(InputError, match="variable="):
        read_scene(tmp_path / "s.npz")
    assert float(read_scene(tmp_path / "s.npz", variable="b").max()) == 2
    with pytest.raises(InputError, match="'c'"):
        read_scene(tmp_path / "s.npz", variable="c")


def test_others_netcdf(tmp_path):
    """A classic NetCDF with bands first, in um, under names of its own."""
    stored = np.random.default_rng(7).random((3, 4, 5)).astype(np.float32)
    axis = ("band", [0.7, 0.6, 0.5], {"units": "um"})
    dataset = xr.Dataset({"L": (("band", "lat", "lon"), stored), "band_center": axis})
    dataset.to_netcdf(tmp_path / "s.nc", engine="scipy")
    scene = read_scene(tmp_path / "s.nc")
    np.testing.assert_allclose(scene["wavelength"], [500, 600, 700])
    np.testing.assert_array_equal(scene, stored.transpose(1, 2, 0)[..., ::-1])


@pytest.mark.parametrize("description", ["", "5", "[]", '{"shape": [3, 4, 5]}', "ImageJ=1.0"])
def test_others_tiff_need_wavelengths(tmp_path, description):
    import tifffile

    bands = np.random.default_rng(10).random((3, 4, 5), dtype=np.float32)
    path = tmp_path / "s.tif"
    tifffile.imwrite(path, bands, photometric="minisblack", description=description, metadata=None)
    with pytest.raises(InputError, match="tells no wavelengths"):
        read_scene(path)
    scene = read_scene(path, wavelength=[500, 600, 700])
    np.testing.assert_array_equal(scene, bands.transpose(1, 2, 0))
    with pytest.raises(InputError, match="2 wavelengths"):
        read_scene(path, wavelength=[500, 600])


def test_scenes_that_are_none(tmp_path):
    good = np.ones((3, 4, 2))
    wavelength = np.array([500.0, 600.0])
    wrong = {
        "nan": (np.where(np.arange(2) == 1, np.nan, good), wavelength, "NaN"),
        "infinite": (good * np.inf, wavelength, "NaN"),
        "too_large": (good * 1e300, wavelength, "NaN"),
        "negative": (-good, wavelength, "above zero"),
        "dark": (0 * good, wavelength, "above zero"),
        "twice": (good, np.array([500.0, 500.0]), "two bands at 500 nm"),
        "index": (good, np.array([40.0, 41.0]), "make no sense"),
        "nowhere": (good, np.array([500.0, np.nan]), "make no sense"),
        "short": (good, np.arange(500.0, 507.0), "7 wavelengths"),
        "flat": (good[0], wavelength, "three axes"),
    }
    for name, (values, axis, reason) in wrong.items():
        np.savez(tmp_path / f"{name}.npz", cube=values, wavelength=axis)
        with pytest.raises(InputError, match=reason) as caught:
            read_scene(tmp_path / f"{name}.npz")
        assert "\n" not in str(caught.value)
    np.save(tmp_path / "bare.npy", good)
    with pytest.raises(InputError, match="tells no wavelengths"):
        read_scene(tmp_path / "bare.npy")
    with pytest.raises(InputError, match="none of the scenes"):
        read_scene(SCENES.parent / "licences" / "imec-responses-MIT.txt")
    with pytest.raises(InputError, match="no file"):
        read_scene(tmp_path / "gone.hdr")
    bands = ("wavelength", wavelength, {"units": "Wavenumber"})
    dataset = xr.Dataset({"c": (("y", "x", "wavelength"), good)}, {"wavelength": bands})
    dataset.to_netcdf(tmp_path / "w.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="'wavenumber'"):
        read_scene(tmp_path / "w.nc")


def test_netcdf_3_is_read(tmp_path):
    cube = labelled(np.random.default_rng(3).random((3, 4, 3)), WAVELENGTH[:3])
    cube.to_dataset().to_netcdf(tmp_path / "old.nc", engine="scipy")
    np.testing.assert_array_equal(load_cube(tmp_path / "old.nc"), cube)
