"""Files: each format there and back, others' readers on our files, our readers on theirs."""

import contextlib
import json
import os
import sys
import tracemalloc
from importlib.resources import files as package_files
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from squilla.errors import InputError
from squilla.files.cube import (
    CUBE_SUFFIXES,
    labelled,
    load_cube,
    open_cube,
    read_scene,
    save,
)
from squilla.files.disk import replacing
from squilla.files.raw import Raw, read_raw, read_raws, write_raw

SCENES = Path(str(package_files("squilla"))) / "data" / "scenes"
RAW_SUFFIXES = [".tiff", ".png", ".npy", ".raw"]
WAVELENGTH = np.array([500.0, 501.5, 550.0, 649.9, 750.0])


@pytest.fixture
def frame() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 65536, (30, 41), dtype=np.uint16)


@pytest.fixture
def cube() -> xr.DataArray:
    values = np.random.default_rng(2).random((6, 7, 5), dtype=np.float32)
    told = {"light": "LED-B3", "snr": 20.5, "shape": [6, 6], "note": 'braces {} = "quoted"\nµm'}
    cube = labelled(values, WAVELENGTH, name="radiance", attributes=told)
    return cube.assign_coords(fwhm=("wavelength", np.array([2.0, 3.0, 4.0, 5.0, 6.25])))


# --- raw frames ------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", RAW_SUFFIXES)
def test_raw_there_and_back(tmp_path, frame, suffix):
    told = {"gain": np.float32(1.5), "shape": [6, 6], "deep": {"note": "µm"}}
    write_raw(tmp_path / f"frame{suffix}", Raw(frame, 12.5, told))
    back = read_raw(tmp_path / f"frame{suffix}")
    assert back.frame.dtype == np.uint16
    np.testing.assert_array_equal(back.frame, frame)
    assert back.exposure == 12.5
    assert back.metadata == {"gain": 1.5, "shape": [6, 6], "deep": {"note": "µm"}}


@pytest.mark.parametrize("suffix", RAW_SUFFIXES)
def test_raw_without_exposure(tmp_path, frame, suffix):
    write_raw(tmp_path / f"frame{suffix}", Raw(frame))
    back = read_raw(tmp_path / f"frame{suffix}")
    assert back.exposure is None
    assert back.metadata == {}


def test_others_read_our_raw_frames(tmp_path, frame):
    """Pillow and NumPy, which know nothing of us, see the same numbers."""
    from PIL import Image

    for suffix in (".tiff", ".png"):
        write_raw(tmp_path / f"frame{suffix}", Raw(frame, 3.0))
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / f"frame{suffix}")), frame)
    write_raw(tmp_path / "frame.raw", Raw(frame, 3.0))
    flat = np.frombuffer((tmp_path / "frame.raw").read_bytes(), "<u2")
    np.testing.assert_array_equal(flat.reshape(frame.shape), frame)


def test_sidecar_tells_exposure_of_others_frames(tmp_path, frame):
    import tifffile
    from PIL import Image

    tifffile.imwrite(tmp_path / "a.tif", frame)
    Image.fromarray(frame).save(tmp_path / "b.png")
    np.save(tmp_path / "c.npy", frame.astype(">u2"))
    for name in ("a.tif", "b.png", "c.npy"):
        (tmp_path / name).with_suffix(".json").write_text('{"exposure": 8, "camera": "IMX226"}')
        raw = read_raw(tmp_path / name)
        np.testing.assert_array_equal(raw.frame, frame)
        assert raw.frame.flags.writeable
        assert (raw.exposure, raw.metadata) == (8.0, {"camera": "IMX226"})


@pytest.mark.parametrize(("order", "code"), [("big", ">u2"), ("little", "<u2")])
def test_binary_byte_order(tmp_path, frame, order, code):
    (tmp_path / "f.raw").write_bytes(frame.astype(code).tobytes())
    facts = {"rows": 30, "columns": 41, "byte_order": order, "exposure": 1}
    (tmp_path / "f.json").write_text(json.dumps(facts))
    np.testing.assert_array_equal(read_raw(tmp_path / "f.raw").frame, frame)


def test_eight_bits_are_widened_not_scaled(tmp_path):
    from PIL import Image

    small = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.fromarray(small).save(tmp_path / "f.png")
    np.testing.assert_array_equal(read_raw(tmp_path / "f.png").frame, small)


def test_stack_and_folder_one_by_one(tmp_path):
    """Frames come in their natural order, and only one is in memory at a time."""
    import tifffile

    stack = np.zeros((12, 400, 500), np.uint16) + np.arange(12, dtype=np.uint16)[:, None, None]
    tifffile.imwrite(tmp_path / "stack.tiff", stack, photometric="minisblack")
    with pytest.raises(InputError, match="several frames"):
        read_raw(tmp_path / "stack.tiff")
    del stack
    next(read_raws(tmp_path / "stack.tiff"))
    tracemalloc.start()
    assert [int(raw.frame[0, 0]) for raw in read_raws(tmp_path / "stack.tiff")] == list(range(12))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 400 * 500 * 2

    folder = tmp_path / "sweep"
    folder.mkdir()
    for number in (10, 2, 1):
        write_raw(folder / f"frame{number}.npy", Raw(np.full((2, 2), number, np.uint16), 1.0))
    (folder / ".half-written.tiff").write_bytes(b"II")
    assert [int(raw.frame[0, 0]) for raw in read_raws(folder)] == [1, 2, 10]
    with pytest.raises(InputError, match="folder"):
        read_raw(folder)


def test_wrong_frames_are_refused(tmp_path, frame):
    import tifffile
    from PIL import Image

    tifffile.imwrite(tmp_path / "float.tiff", frame.astype(np.float32))
    Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(tmp_path / "rgb.png")
    Image.fromarray(np.zeros((4, 5), np.uint8)).convert("P").save(tmp_path / "palette.tiff")
    np.save(tmp_path / "nan.npy", np.full((4, 5), np.nan))
    np.save(tmp_path / "long.npy", frame.astype(np.int64))
    np.save(tmp_path / "empty.npy", np.zeros((0, 5), np.uint16))
    np.save(tmp_path / "object.npy", np.array([{}], object), allow_pickle=True)
    (tmp_path / "text.tiff").write_text("no picture")
    (tmp_path / "other.jpg").write_bytes(b"\xff\xd8")
    (tmp_path / "lonely.raw").write_bytes(frame.tobytes())
    (tmp_path / "short.raw").write_bytes(frame.tobytes()[:-2])
    (tmp_path / "short.json").write_text('{"rows": 30, "columns": 41}')
    (tmp_path / "odd.raw").write_bytes(frame.tobytes())
    (tmp_path / "odd.json").write_text('{"rows": 30, "columns": 41, "dtype": "float32"}')
    names = "float.tiff rgb.png nan.npy long.npy empty.npy object.npy text.tiff other.jpg"
    for name in [*names.split(), "lonely.raw", "short.raw", "odd.raw", "gone.tiff"]:
        with pytest.raises(InputError) as caught:
            read_raw(tmp_path / name)
        assert "\n" not in str(caught.value)
    for text in ('{"exposure": "8 ms"}', '{"exposure": NaN}', '{"exposure": -1}', "[8]", "{"):
        np.save(tmp_path / "f.npy", frame)
        (tmp_path / "f.json").write_text(text)
        with pytest.raises(InputError):
            read_raw(tmp_path / "f.npy")
    with pytest.raises(InputError):
        Raw(frame.astype(float))
    with pytest.raises(InputError, match="plain"):
        write_raw(tmp_path / "f.tiff", Raw(frame, 1.0, {"path": tmp_path}))
    with pytest.raises(InputError):
        write_raw(tmp_path / "f.jpg", Raw(frame))


def test_header_that_promises_too_much(tmp_path):
    """Small files that claim to be enormous are refused before memory is taken."""
    import tifffile

    tifffile.imwrite(tmp_path / "f.tiff", np.zeros((100, 100), np.uint16))
    with tifffile.TiffFile(tmp_path / "f.tiff", mode="r+b") as tiff:
        tiff.pages.first.tags["ImageWidth"].overwrite(60000)
        tiff.pages.first.tags["ImageLength"].overwrite(60000)
    (tmp_path / "f.raw").write_bytes(b"\0" * 100)
    (tmp_path / "f.json").write_text('{"rows": 60000, "columns": 60000}')
    header = "{'descr': '<u2', 'fortran_order': False, 'shape': (60000, 60000), }"
    packed = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    (tmp_path / "f.npy").write_bytes(packed + b"\0" * 100)
    tracemalloc.start()
    for name in ("f.tiff", "f.raw", "f.npy"):
        with pytest.raises(InputError):
            read_raw(tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6


# --- cubes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", CUBE_SUFFIXES)
def test_cube_there_and_back(tmp_path, cube, suffix):
    path = tmp_path / f"doll{suffix}"
    save(cube.transpose("wavelength", "y", "x"), path)
    for back in (load_cube(path), read_scene(path)):
        assert back.dims == ("y", "x", "wavelength")
        assert back.dtype == np.float32
        np.testing.assert_array_equal(back.values, cube.values)
        np.testing.assert_array_equal(back["wavelength"], WAVELENGTH)
        np.testing.assert_array_equal(back["fwhm"], cube["fwhm"])
        assert back["wavelength"].attrs["units"] == "nm"
        assert back.name == "radiance"
        assert dict(back.attrs, shape=list(back.attrs["shape"])) == cube.attrs
    assert not list(tmp_path.glob(".*")), "a temporary file was left behind"


@pytest.mark.parametrize("suffix", CUBE_SUFFIXES)
@pytest.mark.parametrize("kind", ["uint8", "int16", "uint16", "int64", "float16", "float64"])
def test_kinds_of_numbers(tmp_path, suffix, kind):
    values = np.arange(2 * 3 * 2).reshape(2, 3, 2).astype(kind)
    save(labelled(values, WAVELENGTH[:2]), tmp_path / f"c{suffix}")
    np.testing.assert_array_equal(load_cube(tmp_path / f"c{suffix}"), values)


@pytest.mark.parametrize("suffix", [".nc", ".hdr", ".tiff", ".zarr"])
def test_one_band_and_one_pixel(tmp_path, suffix):
    for shape in ((1, 1, 1), (1, 4, 1), (3, 1, 2), (2, 2, 3), (2, 2, 4)):
        values = np.random.default_rng(3).random(shape, dtype=np.float32)
        wavelength = np.arange(500.0, 500 + shape[2])
        save(labelled(values, wavelength), tmp_path / f"c{suffix}")
        np.testing.assert_array_equal(load_cube(tmp_path / f"c{suffix}"), values)


def test_attributes_of_any_kind_survive_as_json(tmp_path, cube):
    cube = cube.assign_attrs(deep={"a": [1, None]}, nothing=None, yes=True, path=tmp_path)
    for suffix in (".nc", ".hdr", ".tiff", ".zarr"):
        save(cube, tmp_path / f"c{suffix}")
        attrs = load_cube(tmp_path / f"c{suffix}").attrs
        assert json.loads(attrs["deep"]) == {"a": [1, None]}
        assert attrs["yes"] == 1


def test_extra_goes_along(tmp_path, cube):
    doubt = (0.1 * cube).drop_attrs()
    disparity = xr.DataArray(np.ones((6, 7), np.float32), dims=("y", "x"))
    extra = {"uncertainty": doubt, "disparity": disparity, "valid": disparity > 0}
    for suffix in (".nc", ".zarr"):
        save(cube, tmp_path / f"c{suffix}", extra=extra)
        np.testing.assert_array_equal(load_cube(tmp_path / f"c{suffix}"), cube)
        how = {"engine": "zarr", "consolidated": False} if suffix == ".zarr" else {}
        with xr.open_dataset(tmp_path / f"c{suffix}", **how) as dataset:
            np.testing.assert_array_equal(dataset["uncertainty"], doubt)
            np.testing.assert_array_equal(dataset["disparity"], disparity)
            np.testing.assert_array_equal(dataset["valid"], disparity > 0)
    for suffix in (".hdr", ".tiff"):
        save(cube, tmp_path / f"c{suffix}", extra=extra)
        np.testing.assert_array_equal(load_cube(tmp_path / f"c-uncertainty{suffix}"), doubt)
        np.testing.assert_array_equal(load_cube(tmp_path / f"c{suffix}"), cube)
        assert (tmp_path / f"c-disparity{suffix}").exists()
        assert (tmp_path / f"c-valid{suffix}").exists()


def test_xarray_opens_our_netcdf(tmp_path, cube):
    save(cube, tmp_path / "c.nc")
    with xr.open_dataset(tmp_path / "c.nc") as dataset:
        assert dataset.attrs["Conventions"] == "CF-1.11"
        axis = dataset["radiance"]["wavelength"]
        assert (axis.attrs["units"], axis.attrs["standard_name"]) == ("nm", "radiation_wavelength")
        np.testing.assert_array_equal(
            dataset["radiance"].sel(wavelength=550), cube.sel(wavelength=550)
        )


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_gdal_opens_our_envi(tmp_path, cube):
    rasterio = pytest.importorskip("rasterio")
    save(cube, tmp_path / "c.hdr")
    with rasterio.open(tmp_path / "c.img") as opened:
        assert opened.driver == "ENVI"
        np.testing.assert_array_equal(opened.read().transpose(1, 2, 0), cube)
        for band, wavelength in enumerate(WAVELENGTH, 1):
            tags = opened.tags(band)
            assert float(tags["wavelength"]) == wavelength
            assert tags["wavelength_units"] == "Nanometers"
        image = opened.tags(1, ns="IMAGERY")
        assert float(image["CENTRAL_WAVELENGTH_UM"]) == pytest.approx(0.5)
        assert float(image["FWHM_UM"]) == pytest.approx(0.002)


def test_spy_opens_our_envi(tmp_path, cube):
    import spectral

    save(cube, tmp_path / "c.hdr")
    image = spectral.open_image(str(tmp_path / "c.hdr"))
    np.testing.assert_array_equal(np.asarray(image.load()), cube)
    np.testing.assert_array_equal(image.bands.centers, WAVELENGTH)
    np.testing.assert_array_equal(image.bands.bandwidths, cube["fwhm"])
    assert image.bands.band_unit == "Nanometers"
    assert image.metadata["default bands"] == ["4", "3", "1"]


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
    with pytest.raises(InputError, match="wavelength="):
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
    with pytest.raises(InputError, match="wavelength="):
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


def test_cubes_that_cannot_be_saved(tmp_path, cube):
    for wrong, reason in (
        (cube.drop_vars("wavelength"), "wavelength"),
        (cube.isel(wavelength=slice(None, None, -1)), "increase"),
        (cube.isel(y=0), "dims"),
        (cube.astype(complex), "real"),
    ):
        with pytest.raises(InputError, match=reason):
            save(wrong, tmp_path / "c.nc")
    with pytest.raises(InputError, match="end in"):
        save(cube, tmp_path / "c.xlsx")
    with pytest.raises(InputError, match="rename"):
        save(cube, tmp_path / "c.nc", extra={"radiance": cube})
    (tmp_path / "file").touch()
    (tmp_path / "folder.nc").mkdir()
    (tmp_path / "things.zarr").mkdir()
    (tmp_path / "things.zarr" / "letter.txt").touch()
    for place in ("gone/c.nc", "file/c.hdr", "folder.nc", "things.zarr"):
        with pytest.raises(InputError):
            save(cube, tmp_path / place)
    assert {each.name for each in tmp_path.rglob("*")} == {
        "file", "folder.nc", "things.zarr", "letter.txt",
    }  # fmt: skip


def test_zarr_missing(tmp_path, cube, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(InputError, match=r"squilla\[batch\]"):
        save(cube, tmp_path / "c.zarr")


@pytest.mark.parametrize("suffix", [".nc", ".hdr", ".tiff", ".zarr"])
def test_replaced_whole_or_not_at_all(tmp_path, cube, suffix, monkeypatch):
    """The disk fails while the second cube is written: the first one stands, or nothing does."""
    path = tmp_path / f"c{suffix}"
    save(cube, path)
    save(cube + 1, path)
    np.testing.assert_array_equal(load_cube(path), cube + 1)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        save(cube, path)
    np.testing.assert_array_equal(load_cube(path), cube + 1)
    assert not list(tmp_path.glob(".*"))


def test_envi_header_never_beside_other_numbers(tmp_path, cube, monkeypatch):
    """Stopped between the two files of a pair: no header, so no cube, rather than a wrong one."""
    save(cube, tmp_path / "c.hdr")
    replace, done = os.replace, []

    def stops_after_one(*names):
        if done:
            raise KeyboardInterrupt
        done.append(names)
        replace(*names)

    monkeypatch.setattr(os, "replace", stops_after_one)
    with pytest.raises(KeyboardInterrupt):
        save(cube + 1, tmp_path / "c.hdr")
    assert not (tmp_path / "c.hdr").exists()


def test_replacing_keeps_links_and_rights(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with replacing(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"
    (tmp_path / "plain.txt").write_text("")
    assert (tmp_path / "real.txt").stat().st_mode == (tmp_path / "plain.txt").stat().st_mode


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> Path:
    """A folder with one small file of each kind, to be damaged."""
    import h5py
    from scipy.io import savemat

    folder = tmp_path_factory.mktemp("samples")
    values = np.random.default_rng(8).random((5, 4, 3), dtype=np.float32)
    cube = labelled(values, WAVELENGTH[:3])
    for name in ("c.nc", "c.hdr", "c.tiff"):
        save(cube, folder / name)
    np.savez_compressed(folder / "c.npz", cube=values, wavelength=WAVELENGTH[:3])
    savemat(folder / "c.mat", {"cube": values, "wavelength": WAVELENGTH[:3]}, do_compression=True)
    with h5py.File(folder / "h.mat", "w") as file:
        file["cube"], file["wavelength"] = values, WAVELENGTH[:3]
    frame = np.random.default_rng(9).integers(0, 4096, (20, 25), dtype=np.uint16)
    write_raw(folder / "f.png", Raw(frame, 1.0))
    write_raw(folder / "f.tiff", Raw(frame, 1.0))
    write_raw(folder / "f.npy", Raw(frame, 1.0))
    return folder


DAMAGED = ["c.nc", "c.hdr", "c.img", "c.tiff", "c.npz", "c.mat", "h.mat"]
DAMAGED += ["f.png", "f.tiff", "f.npy"]


def _damage(samples: Path, folder: Path, name: str, damaged: bytes) -> Raw | xr.DataArray:
    for other in samples.glob(f"{name[:2]}*"):
        (folder / other.name).write_bytes(other.read_bytes())
    (folder / name).write_bytes(damaged)
    return (read_raw if name.startswith("f") else read_scene)(folder / name)


def test_an_empty_file_is_called_empty(tmp_path):
    for name, read in (("c.nc", read_scene), ("c.nc", load_cube), ("f.tiff", read_raw)):
        (tmp_path / name).touch()
        with pytest.raises(InputError, match=f"{name} is empty"):
            read(tmp_path / name)
    (tmp_path / "c.nc").write_text("something else")
    with pytest.raises(InputError, match="signature not found") as caught:
        load_cube(tmp_path / "c.nc")
    assert "install" not in str(caught.value)


def test_netcdf_3_is_read(tmp_path):
    cube = labelled(np.random.default_rng(3).random((3, 4, 3)), WAVELENGTH[:3])
    cube.to_dataset().to_netcdf(tmp_path / "old.nc", engine="scipy")
    np.testing.assert_array_equal(load_cube(tmp_path / "old.nc"), cube)


@pytest.mark.parametrize("name", DAMAGED)
@pytest.mark.parametrize("share", [0, 0.1, 0.5, 0.9])
def test_cut_short_is_refused(samples, tmp_path, name, share):
    whole = (samples / name).read_bytes()
    with pytest.raises(InputError) as caught:
        _damage(samples, tmp_path, name, whole[: int(share * len(whole))])
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of h5netcdf
@pytest.mark.parametrize("name", DAMAGED)
@settings(
    max_examples=20,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_wrong_bytes_do_no_harm(samples, tmp_path, name, data):
    """With wrong bytes anywhere: read all the same, or an InputError, nothing else."""
    whole = (samples / name).read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    wrong = data.draw(st.binary(min_size=1, max_size=8))
    with contextlib.suppress(InputError):
        _damage(samples, tmp_path, name, whole[:place] + wrong + whole[place + len(wrong) :])


# --- read by need --------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", CUBE_SUFFIXES)
def test_opened_cubes_are_read_by_need(tmp_path, cube, suffix):
    path = tmp_path / f"doll{suffix}"
    uncertainty = (cube / 10).rename("uncertainty")
    valid = (cube.isel(wavelength=0, drop=True) > 0.5).rename("valid")
    save(cube, path, extra={"uncertainty": uncertainty, "valid": valid})
    opened, extra = open_cube(path)
    assert not opened.variable._in_memory
    assert opened.shape == cube.shape
    part = opened[1:5:2, 3, ::-1]
    np.testing.assert_array_equal(part, cube[1:5:2, 3, ::-1])
    np.testing.assert_array_equal(opened, cube)
    assert not opened.variable._in_memory, "using a part must not keep the whole"
    assert set(extra) == {"uncertainty", "valid"}
    np.testing.assert_array_equal(extra["uncertainty"], uncertainty)
    np.testing.assert_array_equal(np.asarray(extra["valid"], bool), valid)


@pytest.mark.parametrize(("interleave", "together"), [("bsq", 1), ("bil", 1), ("bip", 5)])
def test_opened_envi_of_any_order(tmp_path, cube, interleave, together):
    """Bands backwards, one of them bad, an empty pixel: as when the cube is read whole."""
    import spectral

    values = cube.values[..., ::-1].copy()
    values[2, 3] = -9999
    told = {"wavelength": cube.wavelength.values[::-1].tolist(), "wavelength units": "nm"}
    told |= {"bbl": [1, 1, 0, 1, 1], "data ignore value": -9999}
    path = tmp_path / "other.hdr"
    spectral.envi.save_image(str(path), values, metadata=told, interleave=interleave, force=True)
    opened, extra = open_cube(path)
    expected = cube.values[..., [0, 1, 3, 4]].copy()
    expected[2, 3] = np.nan
    np.testing.assert_array_equal(opened, expected)
    np.testing.assert_array_equal(opened[2, 2:4, 1], expected[2, 2:4, 1])
    assert not opened.variable._in_memory
    assert opened.encoding["together"] == together
    assert extra == {}
