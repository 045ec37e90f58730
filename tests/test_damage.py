"""What is written is whole or not there; what is damaged is refused, without harm."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from squilla.errors import InputError
from squilla.files.cube import (
    labelled,
    load_cube,
    read_scene,
    save,
)
from squilla.files.disk import replacing
from squilla.files.raw import Raw, read_raw, write_raw

WAVELENGTH = np.array([500.0, 501.5, 550.0, 649.9, 750.0])


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
