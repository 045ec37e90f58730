"""What a pixel of a cube is worth: chi-square against its law, and each reason to doubt."""

import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from squilla.calibration.alignment import Measurement, measure
from squilla.calibration.rehearsal import ideal_calibration
from squilla.cli.app import app
from squilla.files.cube import labelled, open_cube
from squilla.files.raw import Raw, write_raw
from squilla.reconstruction.judgement import Doubt, judge, told_of
from squilla.reconstruction.models import load_model


@pytest.fixture(scope="module")
def known(camera):
    """A calibration, spectra, and their measurement with noise of the sensor's own law."""
    calibration = ideal_calibration(camera)
    random = np.random.default_rng(0)
    shape, pixels, exposure = (64, 48), calibration.pixels, 1.0
    x = 0.2 + 0.6 * random.random((*shape, 1)) * np.ones(len(calibration.wavelength))
    cube = labelled(x.astype(np.float32), calibration.wavelength)
    angle = torch.full(shape, float(calibration.angle[2]))
    clean = calibration.project(torch.from_numpy(cube.values), angle).numpy() * exposure
    sigma = np.sqrt(clean / pixels.gain + (pixels.read_noise / pixels.gain) ** 2 + 1 / 12)
    y = clean + sigma * random.standard_normal(clean.shape)
    return calibration, cube, y, angle, exposure


def measurement(known, y=None, valid=None, snr=None) -> Measurement:
    _, _, seen, angle, exposure = known
    y = torch.from_numpy(np.asarray(seen if y is None else y, np.float32)) / exposure
    valid = torch.ones(y.shape, dtype=torch.bool) if valid is None else valid
    return Measurement(y, valid, angle, torch.zeros(angle.shape), snr, {"exposure": exposure})


def test_residual_is_a_reduced_chi_square(known):
    """Of true spectra: mean 1 and variance 2 / M, less what one percent of R is allowed."""
    calibration, cube, *_ = known
    residual = judge(cube, measurement(known), calibration)["residual"].values
    assert residual.mean() == pytest.approx(1, abs=0.08)
    assert residual.var() == pytest.approx(2 / calibration.filters, rel=0.25)


def test_each_doubt_is_flagged_where_it_is(known):
    calibration, cube, y, angle, _ = known
    y, valid = y.copy(), torch.ones(y.shape, dtype=torch.bool)
    y[5:10, :, 3] *= 3  # something that R does not know
    y[20:25, :, :4], valid[20:25, :, :4] = 4000.0, False
    valid[30:35, :, :6] = False
    snr = torch.full(angle.shape, 20.0)
    snr[40:45] = -3.0
    cube = cube.copy(deep=True)
    cube[50:55] = np.nan
    flags = judge(cube, measurement(known, y, valid, snr), calibration)["flags"].values
    for rows, doubt in (
        (slice(5, 10), Doubt.RESIDUAL),
        (slice(20, 25), Doubt.SATURATED),
        (slice(30, 35), Doubt.HIDDEN),
        (slice(40, 45), Doubt.DARK),
        (slice(50, 55), Doubt.EMPTY),
    ):
        assert (flags[rows] == doubt).mean() > 0.95
    others = np.delete(flags, [row for at in (5, 20, 30, 40, 50) for row in range(at, at + 5)], 0)
    assert (others == 0).all()


def test_a_response_alone_says_nothing_of_the_noise(known):
    from squilla.calibration.calibration import Calibration

    calibration, cube, *_ = known
    bare = Calibration.from_sensitivity(
        calibration.sensitivity, calibration.wavelength, calibration.angle
    )
    judged = judge(cube, measurement(known), bare)
    assert np.isnan(judged["residual"]).all()
    assert (judged["flags"] == 0).all()


def test_saturated_points_of_a_frame_are_flagged(camera, calibration, scene):
    from test_batch import scene_of

    rate = camera.rate(scene_of(scene, camera), distance=300.0)
    raw = camera.expose(rate, 6.0, torch.Generator().manual_seed(0))
    centre = np.rint(calibration.lattice.centre).astype(int)
    frame = raw.frame.copy()
    for y, x in centre:
        frame[y - 6 : y + 7, x - 6 : x + 7] = 4095
    measured = measure(Raw(frame, raw.exposure), calibration, distance=1e6)
    cube = load_model("ridge", calibration).reconstruct(measured)
    flags = judge(cube, measured, calibration)["flags"].values
    assert (flags[28:33, 28:33] & Doubt.SATURATED).all()
    assert not (flags[:10] & Doubt.SATURATED).any()


@pytest.mark.parametrize("suffix", [".nc", ".zarr", ".hdr"])
def test_layers_are_saved_read_shown_and_printed(camera, calibration, scene, tmp_path, suffix):
    from squilla.live.stored import StoredCube
    from test_batch import scene_of

    calibration.save(tmp_path / "camera.nc")
    rate = camera.rate(scene_of(scene, camera), distance=300.0)
    write_raw(tmp_path / "raw.tiff", camera.expose(rate, 6.0, torch.Generator().manual_seed(0)))
    cube = tmp_path / f"cube{suffix}"
    arguments = [str(tmp_path / "raw.tiff"), "--calibration", str(tmp_path / "camera.nc")]
    ran = CliRunner().invoke(app, ["reconstruct", *arguments, "-o", str(cube)])
    assert ran.exit_code == 0, ran.output
    opened, layers = open_cube(cube)
    assert {"residual", "flags"} <= set(layers)
    assert layers["flags"].attrs["flag_meanings"].startswith("saturated hidden")
    assert opened.attrs["usual_residual"] == pytest.approx(float(np.nanmedian(layers["residual"])))
    shown = StoredCube(opened, layers).describe()["layers"]
    assert {"residual", "flags"} <= {layer["name"] for layer in shown}
    printed = CliRunner().invoke(app, ["evaluate", str(cube)]).output
    for word in ("software", "calibration", "measurement_snr", "residual", "believable"):
        assert word in printed
    told = json.loads(CliRunner().invoke(app, ["evaluate", str(cube), "--json"]).stdout)
    assert told["provenance"]["model"] == "ridge"


def test_figures_for_the_journal(known):
    calibration, cube, *_ = known
    told = told_of(judge(cube, measurement(known), calibration))
    assert set(told) == {"usual_residual", "flagged"}
    assert told["flagged"] == 0
