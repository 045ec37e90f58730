"""The command line, as a person uses it: steps on files, and one sentence for what went wrong."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
import tifffile
import xarray as xr
from typer.testing import CliRunner

from squilla.calibration.lessons import read_known, read_sweep
from squilla.camera.design import design_path
from squilla.cli.app import app
from squilla.errors import InputError
from squilla.files.cube import load_cube, open_cube
from squilla.files.depth import read_depth

SMALL = {
    "rows = 6 ": "rows = 4 ", "columns = 6 ": "columns = 4 ", "rows = 3000": "rows = 480",
    "columns = 4000": "columns = 500", "pixel = 1.85": "pixel = 7.4", "size = 250": "size = 60",
    "reference = 14": "reference = 5", "step = 1.0": "step = 5.0", "1e-5": "2e-5",
    'name = "thesis"': 'name = "small"',
}  # fmt: skip


def run(*arguments: object) -> str:
    """Run a command and return what it printed; errors come through."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with a small camera, its calibration and a raw frame, all made by commands."""
    folder = tmp_path_factory.mktemp("bench")
    text = design_path("thesis").read_text()
    for old, new in SMALL.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "small.toml").write_text(text)
    run("rehearse", "-o", folder / "frames", "--camera", folder / "small.toml", "--frames", 4)
    frames = folder / "frames"
    run(
        "calibrate", "--camera", folder / "small.toml", "--dark", frames / "dark",
        "--flat", frames / "flat", "--sweep", frames / "sweep", "--target", frames / "target.tiff",
        "--target-distance", 300, "-o", folder / "camera.nc",
    )  # fmt: skip
    run(
        "simulate", "chart", "-o", folder / "raw.tiff", "--camera", folder / "small.toml",
        "--snr", 25, "--truth", folder / "truth.nc",
    )  # fmt: skip
    return folder


def test_from_raw_frame_to_verdict(bench, tmp_path):
    run(
        "reconstruct", bench / "raw.tiff", "--calibration", bench / "camera.nc",
        "--model", "ridge", "-o", tmp_path / "cube.nc",
    )  # fmt: skip
    cube = load_cube(tmp_path / "cube.nc")
    assert cube.dims == ("y", "x", "wavelength")
    assert cube.wavelength.attrs["units"] == "nm"
    printed = run(
        "evaluate", tmp_path / "cube.nc", "--reference", bench / "truth.nc",
        "-o", tmp_path / "verdict", "--json",
    )  # fmt: skip
    metrics = json.loads(printed)
    assert metrics.pop("provenance")["model"] == "ridge"
    assert metrics == json.loads((tmp_path / "verdict" / "metrics.json").read_text())
    assert metrics["gfc"] > 0.9
    assert "<html" in (tmp_path / "verdict" / "report.html").read_text()


def test_an_interval_is_saved_beside_its_cube(bench, tmp_path):
    asked = "reconstruct", bench / "raw.tiff", "--calibration", bench / "camera.nc"
    for name in ("plain.nc", "told.nc", "told.zarr", "told.hdr"):
        interval = [] if name == "plain.nc" else ["--interval"]
        run(*asked, "--model", "compound", *interval, "-o", tmp_path / name)
    plain, layers = open_cube(tmp_path / "plain.nc")
    assert "uncertainty" not in layers
    for name in ("told.nc", "told.zarr", "told.hdr"):
        cube, layers = open_cube(tmp_path / name)
        np.testing.assert_allclose(cube, plain, rtol=1e-3, atol=1e-4)
        width = layers["uncertainty"]
        assert width.dims == ("y", "x", "wavelength")
        assert (width > 0).all()
        assert "90 %" in width.attrs["long_name"]
    truth = load_cube(bench / "truth.nc").values
    inside = np.abs(cube.values - truth) <= width.values
    assert inside[20:-20, 20:-20].mean() > 0.5


def test_many_captures_have_their_intervals_too(bench, tmp_path):
    for name in ("a.tiff", "b.tiff"):
        (tmp_path / name).write_bytes((bench / "raw.tiff").read_bytes())
    run(
        "reconstruct", tmp_path / "a.tiff", tmp_path / "b.tiff", "--calibration",
        bench / "camera.nc", "--model", "compound", "--interval", "--workers", 1,
        "-o", tmp_path / "both.zarr",
    )  # fmt: skip
    both = xr.open_zarr(tmp_path / "both.zarr", consolidated=False)
    assert both.uncertainty.dims == ("capture", "y", "x", "wavelength")
    np.testing.assert_array_equal(both.uncertainty[0], both.uncertainty[1])


def test_a_chart_and_lamps_instead_of_a_sweep(bench, tmp_path):
    run(
        "rehearse", "-o", tmp_path, "--camera", bench / "small.toml", "--frames", 2, "--known",
        "--step", 50,
    )  # fmt: skip
    printed = run(
        "calibrate", "--camera", bench / "small.toml", "--dark", tmp_path / "dark",
        "--flat", tmp_path / "flat", "--known", tmp_path / "known", "-o", tmp_path / "c.nc",
        "--json",
    )  # fmt: skip
    learnt = json.loads(printed)
    assert 116 <= learnt["known_spectra"] <= 120  # a defect may cost a patch of so few pixels
    assert 1 < learnt["effective_index"] < 3
    (tmp_path / "known" / "labels.png").write_text("no picture")
    with pytest.raises(InputError, match="labels"):
        next(iter(read_known(tmp_path / "known", np.array([500.0, 750.0]))))
    (tmp_path / "known" / "known.csv").write_text("file,spectra,labels\n000.tiff,000.txt,x\n")
    with pytest.raises(InputError, match="line 2"):
        read_known(tmp_path / "known", np.array([500.0, 750.0]))


def test_several_frames_go_into_a_folder(bench, tmp_path):
    second = tmp_path / "second.tiff"
    second.write_bytes((bench / "raw.tiff").read_bytes())
    out = tmp_path / "cubes"
    out.mkdir()
    run(
        "reconstruct", bench / "raw.tiff", second, "--calibration", bench / "camera.nc", "-o", out
    )  # fmt: skip
    one, other = (load_cube(out / name) for name in ("raw.nc", "second.nc"))
    np.testing.assert_array_equal(one, other)


def test_the_same_seed_gives_the_same_frame(bench, tmp_path):
    for name in ("one.tiff", "other.tiff"):
        run(
            "simulate", "chart", "-o", tmp_path / name, "--camera", bench / "small.toml",
            "--snr", 25, "--seed", 0,
        )  # fmt: skip
    one, other = (tifffile.imread(tmp_path / name) for name in ("one.tiff", "other.tiff"))
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(one, tifffile.imread(bench / "raw.tiff"))


def test_a_depth_map_moves_things(bench, tmp_path):
    np.save(tmp_path / "depth.npy", np.full((60, 60), 150.0))
    run(
        "simulate", "chart", "-o", tmp_path / "near.tiff", "--camera", bench / "small.toml",
        "--depth", tmp_path / "depth.npy", "--snr", 25,
    )  # fmt: skip
    printed = run(
        "reconstruct", tmp_path / "near.tiff", "--calibration", bench / "camera.nc",
        "-o", tmp_path / "near.nc", "--json",
    )  # fmt: skip
    assert json.loads(printed)["distance"] == pytest.approx(150, rel=0.02)


def test_a_depth_map_is_cut_and_resized_as_its_scene_is(tmp_path):
    np.save(tmp_path / "depth.npy", np.tile(np.arange(300.0, 320.0), (10, 1)))
    depth = read_depth(tmp_path / "depth.npy", (60, 60))
    # The middle ten columns, one to six pixels, and nothing new beyond the border.
    expected = np.clip(305 + (np.arange(60) + 0.5) / 6 - 0.5, 305, 314)
    np.testing.assert_allclose(depth, np.tile(expected, (60, 1)))


def test_one_frame_goes_into_a_folder_too(bench, tmp_path):
    run("reconstruct", bench / "raw.tiff", "--calibration", bench / "camera.nc", "-o", tmp_path)
    assert (tmp_path / "raw.nc").is_file()


def test_a_sweep_is_doubted_before_any_frame_is_read(tmp_path):
    for content, says in (
        ("file,wavelength,power,bandwidth\nnone.tiff,500,1,5\n", "no file"),
        ("file\nx\n", "line 2"),
    ):
        (tmp_path / "sweep.csv").write_text(content)
        with pytest.raises(InputError, match=says):
            read_sweep(tmp_path)


@pytest.mark.parametrize("seed", ["-1", "99999999999999999999"])
def test_seeds_that_cannot_be_are_refused(tmp_path, seed):
    result = CliRunner().invoke(
        app, ["simulate", "chart", "-o", str(tmp_path / "o.tiff"), "--seed", seed]
    )
    assert result.exit_code == 2
    assert "--seed" in result.output


def test_the_printed_design_is_a_design(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(run("camera", "thesis", "--toml"))
    assert "6 x 6" in run("camera", path)
    assert json.loads(run("camera", path, "--json"))["array"]["rows"] == 6


def test_models_and_help():
    assert "ridge" in json.loads(run("models", "--json"))
    helped = run("--help")
    assert "..." not in helped.split("Commands:")[1], "each is told in a whole sentence"
    commands = listed(helped)
    assert {"filters", "twin-camera"} <= set(commands)
    commands += [f"filters {command}" for command in listed(run("filters", "--help"))]
    for command in commands:
        assert re.search("Examples?:|Commands:", run(*command.split(), "--help")), command


def listed(helped: str) -> list[str]:
    return re.findall(r"^  ([a-z-]+) ", helped.split("Commands:")[1], re.M)


CAPTURE = "simulate chart -o {t}/raw.tiff --camera {b}/small.toml"
RECONSTRUCT = "reconstruct --calibration {b}/camera.nc -o {t}/c.nc"
CALIBRATE = "calibrate -o {t}/c.nc --flat {b}/frames/flat"
BAD = {
    "no such scene": "simulate nowhere.nc -o {t}/raw.tiff",
    "unwritable output": "simulate chart -o {t}/none/raw.tiff --camera {b}/small.toml",
    "unknown raw suffix": "simulate chart -o {t}/raw.doc --camera {b}/small.toml",
    "no such camera": "camera {t}/none.toml",
    "foreign camera": "camera {b}/raw.tiff",
    "SNR and exposure": CAPTURE + " --snr 20 --exposure 3",
    "zero exposure": CAPTURE + " --exposure 0",
    "SNR of no number": CAPTURE + " --snr nan",
    "truth of no kind": CAPTURE + " --truth {t}/truth.doc",
    "rehearsal too near": "rehearse -o {t}/r --camera {b}/small.toml --distance 1",
    "rehearsal without end": "rehearse -o {t}/r --camera {b}/small.toml --step nan",
    "no place for a demo": "demo -o {b}/raw.tiff --camera {b}/small.toml",
    "SNR out of reach": CAPTURE + " --snr 90",
    "too near": CAPTURE + " --distance 2",
    "too far": CAPTURE + " --distance inf",
    "foreign depth map": CAPTURE + " --depth {b}/small.toml",
    "empty depth map": CAPTURE + " --depth {t}/empty.npy",
    "impossible distance": RECONSTRUCT + " {b}/raw.tiff --distance 0",
    "two cubes of one name": "reconstruct --calibration {b}/camera.nc -o {t} {b}/raw.tiff"
    " {b}/raw.tiff",
    "foreign raw": RECONSTRUCT + " {b}/small.toml",
    "truncated raw": RECONSTRUCT + " {t}/cut.tiff",
    "wrong size": RECONSTRUCT + " {t}/small.tiff",
    "colour picture": RECONSTRUCT + " {t}/rgb.tiff",
    "dark frame": RECONSTRUCT + " {t}/dark.tiff",
    "saturated": RECONSTRUCT + " {t}/white.tiff",
    "infinitely far": RECONSTRUCT + " {b}/raw.tiff --distance inf",
    "no such model": RECONSTRUCT + " {b}/raw.tiff --model magic",
    "a model of another camera": RECONSTRUCT + " {b}/raw.tiff --model mlp",
    "an interval of no kind": RECONSTRUCT + " {b}/raw.tiff --interval",
    "many into a file": RECONSTRUCT + " {b}/raw.tiff {b}/raw.tiff",
    "foreign calibration": "reconstruct {b}/raw.tiff --calibration {b}/truth.nc -o {t}/c.nc",
    "unknown cube suffix": "reconstruct {b}/raw.tiff --calibration {b}/camera.nc -o {t}/c.doc",
    "empty folder of darks": CALIBRATE + " --dark {t} --sweep {b}/frames/sweep",
    "frames of another camera": CALIBRATE + " --dark {b}/frames/dark --sweep {b}/frames/sweep",
    "sweep without a table": CALIBRATE
    + " --camera {b}/small.toml --dark {b}/frames/dark --sweep {b}/frames/flat",
    "calibration of another kind": "calibrate -o {t}/c.json --dark {b}/x --flat {b}/x",
    "calibration into a folder": "calibrate -o {t} --dark {b}/x --flat {b}/x",
    "distance of no target": CALIBRATE + " --dark {b}/x --target-distance 300",
    "live, too near": "live --calibration {b}/camera.nc --distance -1",
    "memory of no size": "view {b}/truth.nc --memory nan",
    "views of no kind": "align {b}/raw.tiff --shape 2x2 -o {t}/views.doc",
    "empty filter table": "filters analyse {t}/empty.npz",
    "filters into a folder": "filters design -o {t}",
    "filters of no noise": "filters design -o {t}/a.toml --snr nan",
    "other reference": "evaluate {b}/truth.nc --reference {b}/camera.nc -o {t}/v",
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(bench, tmp_path, name):
    frame = tifffile.imread(bench / "raw.tiff")
    (tmp_path / "cut.tiff").write_bytes((bench / "raw.tiff").read_bytes()[:5000])
    np.save(tmp_path / "empty.npy", np.zeros((0, 5)))
    (tmp_path / "empty.npz").touch()
    tifffile.imwrite(tmp_path / "small.tiff", frame[:100])
    tifffile.imwrite(tmp_path / "rgb.tiff", np.zeros((480, 500, 3), np.uint8), photometric="rgb")
    tifffile.imwrite(tmp_path / "dark.tiff", np.full_like(frame, 64))
    tifffile.imwrite(tmp_path / "white.tiff", np.full_like(frame, 4095))
    arguments = BAD[name].format(b=bench, t=tmp_path).split()
    before = sorted(tmp_path.rglob("*"))
    if name == "empty folder of darks":
        for path in before:
            path.unlink()
        before = []
    with pytest.raises(InputError) as caught:
        run(*arguments)
    assert 1 <= len(re.findall(r"[.!]( |$)", str(caught.value))) <= 3
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_exit_codes(tmp_path):
    def exit_of(*arguments):
        code = "from squilla.cli import main; main()"
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False,
            env=os.environ, cwd=tmp_path,
        )  # fmt: skip
        return done.returncode, done.stderr

    assert exit_of("camera", "thesis")[0] == 0
    status, said = exit_of("camera", "nonesuch.toml")
    assert status == 2
    assert said.count("\n") == 1
    assert "Traceback" not in said
    assert exit_of("camera", "--nonesuch")[0] == 2
