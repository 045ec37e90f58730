"""Cubes on disk: every kind there and back, and opened by others; read by need."""

import json
import os
import sys

import numpy as np
import pytest
import xarray as xr

from squilla.errors import InputError
from squilla.files.cube import (
    CUBE_SUFFIXES,
    labelled,
    load_cube,
    open_cube,
    read_scene,
    save,
)

WAVELENGTH = np.array([500.0, 501.5, 550.0, 649.9, 750.0])


@pytest.fixture
def cube() -> xr.DataArray:
    values = np.random.default_rng(2).random((6, 7, 5), dtype=np.float32)
    told = {"light": "LED-B3", "snr": 20.5, "shape": [6, 6], "note": 'braces {} = "quoted"\nµm'}
    cube = labelled(values, WAVELENGTH, name="radiance", attributes=told)
    return cube.assign_coords(fwhm=("wavelength", np.array([2.0, 3.0, 4.0, 5.0, 6.25])))


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
