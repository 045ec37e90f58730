"""Our files in other people's programs (GDAL and SPy stand in test_files.py)."""

import numpy as np
import pytest

from squilla.files.cube import labelled, save

HOW = "pip install {} to see our TIFF opened by it"


@pytest.fixture(scope="module")
def cube():
    values = np.random.default_rng(0).random((20, 30, 11), dtype=np.float32)
    return labelled(values, np.linspace(500, 750, 11))


def test_hyperspy_opens_our_tiff(tmp_path, cube):
    hyperspy = pytest.importorskip("hyperspy.api", reason=HOW.format("hyperspy"))
    save(cube, tmp_path / "c.tiff")
    signal = hyperspy.load(str(tmp_path / "c.tiff")).T
    np.testing.assert_array_equal(signal.data, cube)


def test_napari_opens_our_tiff(tmp_path, cube):
    reader = pytest.importorskip("napari_builtins.io", reason=HOW.format("napari"))
    save(cube, tmp_path / "c.tiff")
    layer = reader.magic_imread([str(tmp_path / "c.tiff")])
    np.testing.assert_array_equal(np.moveaxis(layer, 0, -1), cube)


def test_xarray_opens_our_netcdf_and_zarr(tmp_path, cube):
    import xarray as xr

    for name in ("c.nc", "c.zarr"):
        save(cube, tmp_path / name)
        how = {"consolidated": False} if name.endswith("zarr") else {}
        with xr.open_dataset(tmp_path / name, **how) as found:
            np.testing.assert_array_equal(found["radiance"], cube)
            assert found["wavelength"].attrs["units"] == "nm"
            assert found["wavelength"].attrs["standard_name"] == "radiation_wavelength"
