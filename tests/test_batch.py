"""Many captures: the same cubes however they are worked on, and none lost when a run is killed."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
import tifffile
import torch
import xarray as xr

from squilla.batch.captures import Recipe, reconstruct_all
from squilla.errors import InputError
from squilla.files.cube import load_cube
from squilla.files.raw import list_frames, read_raw, write_raw


@pytest.fixture(scope="module")
def night(camera, calibration, scene, tmp_path_factory):
    """A calibration and a folder of six captures, one of them dark."""
    folder = tmp_path_factory.mktemp("night")
    calibration.save(folder / "camera.nc")
    (folder / "raw").mkdir()
    rate = camera.rate(scene_of(scene, camera), distance=300.0)
    for number in range(6):
        generator = torch.Generator().manual_seed(number)
        exposure = 1e-4 if number == 3 else 6.0 + number
        write_raw(folder / "raw" / f"shot{number}.tiff", camera.expose(rate, exposure, generator))
    return folder


def scene_of(values, camera):
    return xr.DataArray(
        values, dims=("y", "x", "wavelength"), coords={"wavelength": camera.design.wavelength}
    )


def recipe(night, **changes) -> Recipe:
    return Recipe(**({"calibration": night / "camera.nc", "distance": 300.0} | changes))


@pytest.fixture(scope="module")
def serial(night, tmp_path_factory):
    output = tmp_path_factory.mktemp("serial") / "cubes.zarr"
    summary = reconstruct_all(list_frames(night / "raw"), recipe(night), output, workers=1)
    return output, summary


def test_each_capture_is_its_own_cube_in_the_stack(night, serial):
    from squilla.calibration.alignment import measure
    from squilla.calibration.store import load_calibration
    from squilla.reconstruction.models import load_model

    output, summary = serial
    assert len(summary.done) == 5
    assert list(summary.failed) == ["shot3"]
    assert "dark" in summary.failed["shot3"]
    stack = xr.open_zarr(output, consolidated=False)
    assert stack.radiance.dims == ("capture", "y", "x", "wavelength")
    assert stack.wavelength.attrs["units"] == "nm"
    assert np.isnan(stack.radiance.sel(capture="shot3")).all()
    assert str(stack.failed.sel(capture="shot3").values) == summary.failed["shot3"]
    camera = load_calibration(night / "camera.nc")
    raw = read_raw(night / "raw" / "shot4.tiff")
    alone = load_model("ridge", camera).reconstruct(measure(raw, camera, distance=300.0))
    np.testing.assert_allclose(stack.radiance.sel(capture="shot4"), alone, rtol=1e-4, atol=1e-5)
    assert float(stack.snr.sel(capture="shot4")) == pytest.approx(alone.measurement_snr)


def test_processes_give_the_same_bits(night, serial, tmp_path):
    frames = list_frames(night / "raw")
    reconstruct_all(frames, recipe(night), tmp_path / "two.zarr", workers=2)
    one, two = (
        xr.open_zarr(path, consolidated=False).radiance.values
        for path in (serial[0], tmp_path / "two.zarr")
    )
    np.testing.assert_array_equal(one, two)


def test_a_folder_gets_a_file_for_each(night, serial, tmp_path):
    frames = list_frames(night / "raw")
    summary = reconstruct_all(frames, recipe(night), tmp_path, workers=1)
    assert sorted(path.name for path in tmp_path.glob("*.nc")) == [
        f"shot{number}.nc" for number in (0, 1, 2, 4, 5)
    ]
    stack = xr.open_zarr(serial[0], consolidated=False).radiance
    for name in summary.done:
        np.testing.assert_array_equal(load_cube(tmp_path / f"{name}.nc"), stack.sel(capture=name))


def test_what_is_there_is_not_done_again(night, tmp_path):
    frames = list_frames(night / "raw")
    reconstruct_all(frames[:2], recipe(night), tmp_path, workers=1)
    before = (tmp_path / "shot0.nc").stat().st_mtime_ns
    summary = reconstruct_all(frames[:3], recipe(night), tmp_path, workers=1)
    assert summary.found == 2
    assert len(summary.done) == 3
    assert (tmp_path / "shot0.nc").stat().st_mtime_ns == before


def test_a_new_picture_under_an_old_name_is_done_again(night, tmp_path):
    shots = tmp_path / "shots"
    shots.mkdir()
    raw = read_raw(night / "raw" / "shot0.tiff")
    write_raw(shots / "a.tiff", raw)
    (tmp_path / "cubes").mkdir()
    reconstruct_all(list_frames(shots), recipe(night), tmp_path / "cubes", workers=1)
    write_raw(shots / "a.tiff", read_raw(night / "raw" / "shot1.tiff"))
    summary = reconstruct_all(list_frames(shots), recipe(night), tmp_path / "cubes", workers=1)
    assert summary.found == 0


def test_a_run_with_another_recipe_is_refused(night, tmp_path):
    frames = list_frames(night / "raw")[:1]
    reconstruct_all(frames, recipe(night), tmp_path, workers=1)
    with pytest.raises(InputError, match="begun with another distance"):
        reconstruct_all(frames, recipe(night, distance=250.0), tmp_path, workers=1)


def test_a_stack_of_other_captures_is_refused(night, serial):
    with pytest.raises(InputError, match="other captures"):
        reconstruct_all(list_frames(night / "raw")[:2], recipe(night), serial[0], workers=1)


def test_a_folder_of_other_things_is_refused(night, tmp_path):
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="give another output"):
        reconstruct_all(list_frames(night / "raw"), recipe(night), tmp_path / "mine.zarr")


def test_two_runs_do_not_write_to_one_place(night, tmp_path):
    from squilla.files.journal import Journal

    with Journal(tmp_path / "journal.jsonl", {}), pytest.raises(InputError, match="Another run"):
        reconstruct_all(list_frames(night / "raw"), recipe(night), tmp_path, workers=1)


def test_a_line_cut_short_by_a_kill_is_forgotten(night, tmp_path):
    frames = list_frames(night / "raw")[:2]
    reconstruct_all(frames, recipe(night), tmp_path, workers=1)
    journal = tmp_path / "journal.jsonl"
    journal.write_text(journal.read_text()[:-30])
    summary = reconstruct_all(frames, recipe(night), tmp_path, workers=1)
    assert summary.found == 1
    names = [json.loads(line).get("name") for line in journal.read_text().splitlines()]
    assert names == [None, "shot0", "shot1"]


def test_pages_of_a_tiff_are_captures(night, tmp_path):
    raws = [read_raw(night / "raw" / f"shot{number}.tiff") for number in (0, 1)]
    described = [json.dumps({"exposure": raw.exposure, "metadata": raw.metadata}) for raw in raws]
    with tifffile.TiffWriter(tmp_path / "film.tiff") as tiff:
        for raw, description in zip(raws, described, strict=True):
            tiff.write(raw.frame, description=description, metadata=None)
    frames = list_frames(tmp_path / "film.tiff")
    assert [frame.name for frame in frames] == ["film-00000", "film-00001"]
    np.testing.assert_array_equal(frames[1].read().frame, raws[1].frame)
    assert frames[1].read().exposure == raws[1].exposure


def run_in_background(night, output) -> subprocess.Popen:
    code = (
        "import sys; from pathlib import Path; from squilla.batch.captures import *; "
        "from squilla.files.raw import list_frames\n"
        "if __name__ == '__main__': reconstruct_all(list_frames(Path(sys.argv[1]) / 'raw'), "
        "Recipe(Path(sys.argv[1]) / 'camera.nc', distance=300.0), Path(sys.argv[2]), workers=2)"
    )
    script = output.parent / "run.py"
    script.write_text(code)
    return subprocess.Popen([sys.executable, script, night, output], start_new_session=True)


@pytest.mark.slow
def test_ten_kills_lose_nothing(night, serial, tmp_path):
    """Killed at random moments, again and again; in the end the stack is the serial one."""
    output, rng = tmp_path / "killed.zarr", np.random.default_rng(0)
    for _ in range(10):
        process = run_in_background(night, output)
        time.sleep(rng.uniform(2, 12))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        deadline = time.monotonic() + 10  # its workers follow it
        while any_left(process.pid) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not any_left(process.pid)
    process = run_in_background(night, output)
    assert process.wait(120) == 0
    one, many = (
        xr.open_zarr(path, consolidated=False).radiance.values for path in (serial[0], output)
    )
    np.testing.assert_array_equal(one, many)
    journal = (tmp_path / "killed.journal.jsonl").read_text()
    lines = [json.loads(line) for line in journal.splitlines()]
    names = [line["name"] for line in lines[1:] if "failed" not in line]
    assert len(names) == len(set(names)) == 5  # none was done again once it was whole


def any_left(session: int) -> bool:
    """Whether a process of a session is still alive."""
    found = subprocess.run(["pgrep", "-s", str(session)], capture_output=True, text=True)
    return bool(found.stdout.strip())


@pytest.mark.slow
def test_dask_gives_the_same_bits(night, serial, tmp_path):
    distributed = pytest.importorskip("distributed", reason="pip install 'squilla[batch]'")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        output = tmp_path / "dask.zarr"
        frames = list_frames(night / "raw")
        summary = reconstruct_all(
            frames, recipe(night), output, scheduler=cluster.scheduler_address
        )
    assert list(summary.failed) == ["shot3"]
    one, many = (
        xr.open_zarr(path, consolidated=False).radiance.values for path in (serial[0], output)
    )
    np.testing.assert_array_equal(one, many)


@pytest.fixture
def small_disk(tmp_path):
    """A disk of its own on which hardly anything fits, and a way to make it larger."""
    place = tmp_path / "disk"
    place.mkdir()

    def mount(*options: str) -> bool:
        command = ["mount", "-t", "tmpfs", *options, "tmpfs", str(place)]
        return (
            shutil.which("mount") is not None
            and not subprocess.run(command, check=False, capture_output=True).returncode
        )

    if not mount("-o", "size=2400k"):
        pytest.skip("a disk of its own cannot be mounted; run as root")
    yield place, lambda: mount("-o", "remount,size=64m")
    subprocess.run(["umount", str(place)], check=False)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["zarr", "folder"])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disk_loses_nothing(night, serial, small_disk, kind, workers):
    place, enlarge = small_disk
    output = place / ("cubes.zarr" if kind == "zarr" else "cubes")
    frames = list_frames(night / "raw")
    with pytest.raises(InputError, match="No space left"):
        reconstruct_all(frames, recipe(night), output, workers=workers)
    for cube in place.rglob("*.nc"):
        xr.load_dataset(cube).close()  # each is whole
    before = journalled(place)
    assert len(before) < 5
    assert enlarge()
    summary = reconstruct_all(frames, recipe(night), output, workers=workers)
    assert summary.found == len(before)
    assert sorted(journalled(place)) == sorted(summary.done)  # none twice
    one = xr.open_zarr(serial[0], consolidated=False).radiance
    for name in summary.done:
        if kind == "zarr":
            cube = xr.open_zarr(output, consolidated=False).radiance.sel(capture=name)
        else:
            cube = xr.load_dataset(output / f"{name}.nc").radiance
        np.testing.assert_array_equal(cube, one.sel(capture=name))


def journalled(place) -> list[str]:
    """Return the names of the captures that a journal calls whole."""
    lines = [json.loads(line) for path in place.rglob("*.jsonl") for line in path.open()]
    return [line["name"] for line in lines if "name" in line and "failed" not in line]


def test_a_scheduler_that_is_no_address_is_said_to_be_none(night, tmp_path):
    with pytest.raises(InputError, match="No Dask scheduler answers at nowhere"):
        reconstruct_all(
            list_frames(night / "raw"), recipe(night), tmp_path / "o.zarr", scheduler="nowhere"
        )
    # and nothing that is worked out later asks there
    assert float(xr.DataArray(np.ones(4)).chunk(2).sum()) == 4


@pytest.mark.slow
def test_the_command_with_a_scheduler_and_workers_of_their_own(night, serial, tmp_path):
    """One film of many pages, through `dask scheduler` and two `dask worker` processes."""
    distributed = pytest.importorskip("distributed", reason="pip install 'squilla[batch]'")
    with tifffile.TiffWriter(tmp_path / "film.tiff") as tiff:
        for number in range(3):
            raw = read_raw(night / "raw" / f"shot{number}.tiff")
            facts = {"exposure": raw.exposure, "metadata": raw.metadata}
            tiff.write(raw.frame, description=json.dumps(facts), metadata=None)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, quiet = f"tcp://127.0.0.1:{port}", {"stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    place = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    alone = ["--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path)]
    processes = [subprocess.Popen([*dask, "scheduler", *place], **quiet)]
    processes += [subprocess.Popen([*dask, "worker", address, *alone], **quiet) for _ in range(2)]
    try:
        with distributed.Client(address, timeout=60) as client:
            client.wait_for_workers(2, timeout=60)
        squilla = [sys.executable, "-c", "from squilla.cli import main; main()", "reconstruct"]
        asked = ["--calibration", night / "camera.nc", "--distance", "300", "--scheduler", address]
        output = tmp_path / "film.zarr"
        subprocess.run([*squilla, tmp_path / "film.tiff", *asked, "-o", output], check=True)
    finally:
        for process in processes:
            process.terminate()
            process.wait(30)
    many = xr.open_zarr(output, consolidated=False).radiance
    assert many.capture.values.tolist() == [f"film-0000{number}" for number in range(3)]
    one = xr.open_zarr(serial[0], consolidated=False).radiance
    for number in range(3):
        np.testing.assert_array_equal(many[number], one.sel(capture=f"shot{number}"))
