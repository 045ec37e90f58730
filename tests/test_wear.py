"""A camera that has worn: noticed from its frames alone, never without cause, and lived with."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from squilla.calibration.agreement import compare
from squilla.calibration.alignment import measure
from squilla.calibration.calibrate import calibrate
from squilla.calibration.check import check
from squilla.calibration.pixels import Darks, Stack
from squilla.calibration.rehearsal import Rehearsal
from squilla.calibration.store import load_calibration
from squilla.camera.scenes import load_scene
from squilla.camera.solid import solid_scene
from squilla.camera.wear import Dust, Wear, WornCamera, drop_rows
from squilla.cli.app import app
from squilla.errors import InputError
from squilla.files.raw import write_raw
from squilla.reconstruction.models import load_model


def capture(camera, source="corn-kernel", snr=30.0, seed=1):
    """Return a frame and the truth; exposed as the sound camera would be."""
    wavelength, size = camera.design.wavelength, camera.design.field.size
    picture, depth = load_scene("chart" if source == "doll" else source, wavelength, size), None
    if source == "doll":
        picture, depth = solid_scene(wavelength, size)
    rate = camera.rate(picture, depth=depth)
    exposure = camera.sensor.exposure_for(camera.fields(rate), snr)
    raw = camera.expose(rate, exposure, torch.Generator().manual_seed(seed))
    return raw, camera.truth(picture, depth=depth).cube.values


def quietly(raw, calibration):
    """Return the measurement and what was warned of."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        measurement = measure(raw, calibration)
    return measurement, " ".join(str(each.message) for each in told)


def worn(design, **wear) -> WornCamera:
    return WornCamera(design, Wear(**wear))


def error(measurement, calibration, truth) -> float:
    cube = load_model("ridge", calibration).reconstruct(measurement).values
    return float(np.sqrt(np.nanmean((cube - truth) ** 2) / np.mean(truth**2)))


@pytest.mark.parametrize("snr", [20.0, 30.0])
@pytest.mark.parametrize("source", ["chart", "corn-kernel", "indian-pines", "doll"])
def test_a_healthy_camera_is_not_suspected(camera, calibration, source, snr):
    for seed in (1, 2, 3):
        measurement, told = quietly(capture(camera, source, snr, seed)[0], calibration)
        assert told == ""
        facts = measurement.provenance
        assert facts["worn_units"] == "none"
        assert facts["lost_rows"] == 0
        assert facts["odd_pixels"] < 10  # of 57 600
        assert facts["dark_risen"] < 0.3


@pytest.mark.parametrize("source", ["chart", "corn-kernel", "indian-pines", "doll"])
def test_covered_and_dusty_units_are_left_out(design, calibration, source):
    camera = worn(design, dust=(Dust(3), Dust(9, transmittance=0.8)))
    raw, _ = capture(camera, source)
    measurement, told = quietly(raw, calibration)
    assert "Some units do not see what the others do" in told
    assert "of their light): 3 (0%), 9 (8" in told
    assert not measurement.valid[..., [3, 9]].any()
    assert measurement.valid[..., [0, 5, 14]].float().mean() > 0.9
    assert measurement.provenance["misalignment"] < 0.1


def test_each_model_does_without_a_covered_unit(design, camera, calibration):
    for model in ("ridge", "sparse", "compound"):
        errors = []
        for other in (camera, worn(design, dust=(Dust(3),))):
            raw, truth = capture(other)
            cube = load_model(model, calibration).reconstruct(quietly(raw, calibration)[0]).values
            assert np.isfinite(cube).all()
            errors.append(np.sqrt(np.mean((cube - truth) ** 2)))
        assert errors[1] < 1.1 * errors[0]


def test_a_speck_over_a_part_of_a_unit_is_noticed(design, calibration):
    raw, _ = capture(worn(design, dust=(Dust(9, (10, 5), 15, 0.3),)))
    assert quietly(raw, calibration)[0].provenance["worn_units"].startswith("9 (")


def test_response_is_the_transmittance(camera, calibration):
    """A measurement whose channel 6 is dimmed by hand: the response found is that factor."""
    measurement, _ = quietly(capture(camera)[0], calibration)
    y = measurement.y * measurement.provenance["exposure"]
    for factor in (0.5, 0.9, 1.2):
        dimmed = y.clone()
        dimmed[..., 6] *= factor
        pixels = calibration.pixels
        found = compare(dimmed, measurement.valid, measurement.angle, calibration, pixels)
        assert np.flatnonzero(found.worn).tolist() == [6]
        assert found.response[6] == pytest.approx(factor, abs=0.02)


def test_when_most_units_disagree_the_calibration_is_wrong_not_they(camera, calibration):
    measurement, _ = quietly(capture(camera)[0], calibration)
    wild = torch.linspace(0.3, 2, calibration.filters)[torch.randperm(calibration.filters)]
    y = measurement.y * measurement.provenance["exposure"] * wild
    found = compare(y, measurement.valid, measurement.angle, calibration, calibration.pixels)
    assert not found.worn.any()


@pytest.mark.parametrize("repeated", [False, True])
def test_lost_rows_are_noticed_and_left_out(camera, calibration, repeated):
    raw, truth = capture(camera)
    whole = error(quietly(raw, calibration)[0], calibration, truth)
    measurement, told = quietly(drop_rows(raw, 150, 12, repeated=repeated), calibration)
    assert told.startswith("12 rows of the frame were lost")
    assert measurement.provenance["lost_rows"] == 12
    assert error(measurement, calibration, truth) < 1.05 * whole


def test_hot_pixels_are_found_where_they_are(design, calibration):
    camera = worn(design, hot_pixels=1e-3)
    raw, truth = capture(camera)
    measurement, told = quietly(raw, calibration)
    assert "hot or dead since" in told
    sound = error(quietly(capture(worn(design))[0], calibration)[0], calibration, truth)
    assert error(measurement, calibration, truth) < 1.05 * sound


@pytest.mark.parametrize("wear", [{"leak": 60.0}, {"warmer": 80.0}])
def test_a_risen_dark_level_is_taken_off(design, calibration, wear):
    raw, truth = capture(worn(design, **wear))
    measurement, told = quietly(raw, calibration)
    assert "The dark level lies" in told
    sound = error(quietly(capture(worn(design))[0], calibration)[0], calibration, truth)
    assert error(measurement, calibration, truth) < 1.15 * sound


# --- the morning check ------------------------------------------------------------------------


def checked(camera, calibration):
    rehearsal = Rehearsal(camera, seed=5, frames=4)
    return check(calibration, dark=rehearsal.dark(), flat=rehearsal.flat())


def test_a_healthy_camera_passes_the_check(camera, calibration):
    found = checked(camera, calibration)
    assert found.says == []
    assert abs(found.drift) < 0.15
    assert found.lamp == pytest.approx(1, abs=0.005)


@pytest.mark.parametrize("drift", [1.0, -2.0])
def test_drifted_filters_are_measured_also_under_dust(design, calibration, drift):
    found = checked(worn(design, drift=drift, dust=(Dust(3, transmittance=0.8),)), calibration)
    assert found.drift == pytest.approx(drift, abs=0.3)
    assert found.moved
    assert found.response[3] == pytest.approx(0.8, abs=0.02)
    assert "The filters have moved by" in found.says[0]


def test_drift_moves_the_response():
    wavelength = np.linspace(500, 700, 201)
    from squilla.calibration.calibration import Calibration

    def peak(at):
        return np.exp(-(((wavelength - np.array(at)[:, None]) / 20) ** 2))

    moved = Calibration.from_sensitivity(peak([560, 620]), wavelength).drifted(1.5)
    np.testing.assert_allclose(moved.sensitivity[0], peak([561.5, 621.5]), atol=2e-3)


def test_a_speck_is_divided_out_after_the_check(design, calibration):
    dusty = worn(design, dust=(Dust(9, (10, 5), 8, 0.4),))
    raw, truth = capture(dusty)
    sound = error(quietly(capture(worn(design))[0], calibration)[0], calibration, truth)
    found = checked(dusty, calibration)
    assert any("Dust lies before" in sentence for sentence in found.says)
    mended = found.mended(calibration)
    measurement, told = quietly(raw, mended)
    assert "Units" not in told
    assert error(measurement, mended, truth) < 1.05 * sound


def test_the_check_on_the_command_line(design, calibration, tmp_path):
    calibration.save(tmp_path / "camera.nc")
    rehearsal = Rehearsal(worn(design, drift=1.0, hot_pixels=1e-3), seed=5, frames=2)
    for kind in ("dark", "flat"):
        (tmp_path / kind).mkdir()
        for number, raw in enumerate(getattr(rehearsal, kind)()):
            write_raw(tmp_path / kind / f"{number}.tiff", raw)
    today = tmp_path / "today.nc"
    arguments = [tmp_path / "camera.nc", "--dark", tmp_path / "dark", "--flat", tmp_path / "flat"]
    ran = CliRunner().invoke(app, ["check", *map(str, arguments), "-o", str(today), "--json"])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["drift"] == pytest.approx(1, abs=0.3)
    assert "checked" in load_calibration(today).provenance


def test_a_calibration_without_flats_says_so(calibration):
    with pytest.raises(InputError, match="keeps no flats"):
        check(replace(calibration, white=None), dark=[], flat=[])


def test_a_lamp_that_flickers_is_evened_out(camera, calibration):
    """The gain that variance teaches would be wrong by a factor."""
    rehearsal = Rehearsal(camera, frames=8)
    rate = camera.flat_rate(np.ones(len(camera.design.wavelength)))
    exposure = 0.7 * camera.design.sensor.full_well / float(rate.max())

    def flats():
        for number in range(8):
            level = 1 + 0.05 * np.sin(number)
            yield camera.expose(rate * level, exposure, torch.Generator().manual_seed(number))

    with pytest.warns(UserWarning, match="light of the flats changed"):
        learnt = calibrate(
            camera.design, dark=rehearsal.dark(), flat=flats(),
            sweep=Rehearsal(camera, step=25.0, bandwidth=25.0).sweep(),
        )  # fmt: skip
    assert learnt.pixels.gain == pytest.approx(camera.design.sensor.gain, rel=0.05)
    darks = Darks.of(rehearsal.dark())
    assert Stack.of(rehearsal.flat(), "flat", darks).light_change == 0


def test_dust_that_cannot_be_is_refused(design):
    with pytest.raises(InputError, match="no unit 16"):
        worn(design, dust=(Dust(16),))
    with pytest.raises(InputError, match="transmittance"):
        Dust(0, transmittance=2.0)


@pytest.mark.parametrize("times", [1.6, 5.0])
def test_nothing_of_a_pixel_gone_hot_stays(camera, calibration, times):
    """One pixel in every other unit is brightened; what is measured is what it was before."""
    scene = load_scene("chart", camera.design.wavelength, camera.design.field.size)
    scene = scene.copy(data=np.full(scene.shape, 0.5, np.float32))
    whole = camera.capture(scene, snr=35, generator=torch.Generator().manual_seed(5))
    frame = whole.frame.copy()
    places = np.rint(calibration.lattice.centre[: len(calibration.lattice.centre) : 2]).astype(int)
    black = camera.design.sensor.black_level
    for y, x in places + 5:
        frame[y, x] = black + (frame[y, x] - black) * times
    before = measure(whole, calibration, distance=300.0)
    after = measure(replace(whole, frame=frame), calibration, distance=300.0)
    difference = (after.y - before.y).abs() / before.y.median()
    assert float(difference.max()) < 0.2


def test_flats_that_are_none_are_refused(camera, calibration):
    covered = [camera.capture_dark(5.0) for _ in range(4)]
    with pytest.raises(InputError, match="no brighter than the darks"):
        check(calibration, dark=Rehearsal(camera).dark(), flat=covered)
