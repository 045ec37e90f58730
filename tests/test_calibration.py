"""Closed loops: the twin plants a truth, the calibration finds it in frames alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from conftest import small_design
from squilla.calibration.alignment import align, measure
from squilla.calibration.calibrate import calibrate
from squilla.calibration.calibration import Calibration
from squilla.calibration.geometry import find_windows
from squilla.calibration.pixels import Darks, Stack, noise_of
from squilla.calibration.rehearsal import Rehearsal, poster
from squilla.calibration.resample import SINC, sinc_kernel
from squilla.calibration.store import load_calibration
from squilla.calibration.views import sub_images
from squilla.camera.design import CameraDesign, Effects
from squilla.camera.lens import cone
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.optics.angle import blue_shift, pupil_cone
from squilla.optics.filters import StencilRecipe
from squilla.spectra import grid


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def true_positions(design, disparity):
    """Where every unit sees the middle of a plane, against the reference, px."""
    apart = design.centres - design.centres[design.field.reference]
    return apart * (1 + disparity / design.pitch)


def found_positions(lattice, disparity):
    position = lattice.centre + disparity * lattice.baseline
    return position - position[lattice.reference]


def test_centres_are_found(calibration, design):
    assert rms(calibration.lattice.centre - design.centres) < 0.1


def test_sensitivity_is_found(calibration, camera):
    truth = camera.sensitivity(calibration.angle)
    assert rms(calibration.sensitivity - truth) / rms(truth) < 0.01


def test_noise_is_found(calibration, design):
    assert calibration.pixels.gain == pytest.approx(design.sensor.gain, rel=0.03)
    assert calibration.pixels.read_noise == pytest.approx(design.sensor.read_noise, rel=0.1)


def test_the_response_of_every_pixel_is_found(camera, calibration):
    """What is left of the planted PRNU, 0.5 %, is the noise of eight flats."""
    response = camera.fields(camera.sensor.response)
    assert response.std() == pytest.approx(0.005, rel=0.05)
    found = camera.fields(calibration.pixels.flat)
    assert np.corrcoef(found.ravel(), response.ravel())[0, 1] > 0.4


def test_hot_pixels_are_found(camera, calibration):
    hot = camera.sensor.dark_rate > 10 * np.median(camera.sensor.dark_rate)
    assert hot.any()
    assert not calibration.pixels.valid[hot].any()


@pytest.mark.parametrize("snr", [20.0, 30.0])
@pytest.mark.parametrize("distance", [100.0, 300.0, 1000.0])
def test_alignment_is_found(camera, calibration, scene, distance, snr):
    generator = torch.Generator().manual_seed(11)
    raw = camera.capture(scene, distance=distance, snr=snr, generator=generator)
    measurement = measure(raw, calibration)
    disparity = float(measurement.disparity.mean())
    truth = 0.7 * camera.design.focal / distance
    error = found_positions(calibration.lattice, disparity) - true_positions(camera.design, truth)
    assert rms(error) < 0.1
    assert measurement.provenance["snr"] == pytest.approx(snr, abs=1.0)
    assert float(measurement.snr.median()) == pytest.approx(snr, abs=3.0)


def test_measurement_explains_the_scene():
    """Without noise and blur y = R x: twin, calibration, alignment and scale agree to 1e-3."""
    design = small_design(
        sensor={"bits": 16, "full_well": 1e10},  # so much light that its noise is nothing
        effects=Effects.none().model_dump()
        | {"field_angle": True, "cone": True, "vignetting": True, "shot_noise": True},
    )
    camera = Camera(design)
    learnt = Rehearsal(camera, step=2.5, bandwidth=2.5, frames=2).calibrate()
    light = 0.2 + 0.6 * np.exp(-((design.wavelength - 610) ** 2) / 2 / 60**2)
    shade = 0.5 + 0.3 * np.sin(np.linspace(0, 9, 90))[:, None, None]
    scene = poster(90, design.wavelength)
    scene = scene.copy(data=np.broadcast_to(shade * light, scene.shape).astype(np.float32))
    rate = camera.rate(scene, distance=2000.0)
    raw = camera.expose(rate, 0.7 * design.sensor.full_well / rate.max())
    y = measure(raw, learnt, distance=2000.0).y
    x = torch.from_numpy(camera.truth(scene, distance=2000.0).cube.values)
    predicted = learnt.project(x, torch.from_numpy(learnt.lattice.field_angle()))
    middle = (slice(5, -5), slice(5, -5))
    assert float((y - predicted)[middle].norm() / y[middle].norm()) < 1e-3


def test_the_shift_of_the_zones_is_told_by_one_index(calibration, camera):
    """The index found from frames shifts the true axis to the true corner, and is near the true."""
    index = calibration.provenance["effective_index"]
    truth = camera.response(calibration.angle)
    axis, corner = (cone(camera.design, one) for one in calibration.angle[[0, -1]])
    shifted = truth[0] @ blue_shift(calibration.wavelength, corner, index, measured_in=axis).T
    assert rms(shifted - truth[-1]) < 0.35 * rms(truth[0] - truth[-1])


def test_a_saturated_step_is_left_out(camera):
    rehearsal = Rehearsal(camera, step=5.0, bandwidth=5.0)
    sweep = list(rehearsal.sweep())
    bright = camera.flat_rate(np.ones(len(camera.design.wavelength)))
    sweep[20] = replace(sweep[20], raw=camera.expose(bright, sweep[20].raw.exposure))

    learnt = rehearsal.calibrate(sweep=sweep)
    assert learnt.provenance["saturated_steps"] == f"{sweep[20].wavelength:g} nm"
    truth = camera.sensitivity(learnt.angle)
    assert rms(learnt.sensitivity - truth) / rms(truth) < 0.01
    for number in range(10, 18):
        sweep[number] = replace(sweep[number], raw=sweep[20].raw)
    with pytest.raises(InputError, match="saturated"):
        rehearsal.calibrate(sweep=sweep)


def test_a_single_shot_is_not_passed_over(camera):
    rehearsal = Rehearsal(camera, frames=2, step=50.0, bandwidth=50.0)
    with pytest.raises(InputError, match="One hand-held shot"):
        rehearsal.calibrate(target=None, target_distance=None, shots=[rehearsal.target()])


def test_either_a_sweep_or_known_scenes(design):
    with pytest.raises(InputError, match="either"):
        calibrate(design, dark=[], flat=[])


def test_calibration_survives_the_disk(calibration, tmp_path):
    calibration.save(tmp_path / "camera.nc")
    back = load_calibration(tmp_path / "camera.nc")
    np.testing.assert_array_equal(back.sensitivity, calibration.sensitivity)
    np.testing.assert_array_equal(back.deviations, calibration.deviations)
    np.testing.assert_array_equal(back.lattice.centre, calibration.lattice.centre)
    np.testing.assert_allclose(back.pixels.flat, calibration.pixels.flat, atol=2e-4)
    np.testing.assert_allclose(back.pixels.bias, calibration.pixels.bias, atol=0.05)
    assert back.provenance == calibration.provenance
    assert back.lattice.field == calibration.lattice.field


def test_a_matrix_alone_survives_the_disk(tmp_path):
    plain = Calibration.from_sensitivity(np.ones((4, 7)), np.linspace(400, 700, 7))
    plain.save(tmp_path / "matrix.nc")
    assert load_calibration(tmp_path / "matrix.nc").lattice is None


# --- one matrix at all angles -----------------------------------------------------------------


def test_a_tilted_matrix_is_the_exact_stack_in_its_cone():
    """From the collimated table of the filters alone to the corner of an F/4 lens, within 1.3 %."""
    wavelength, corner = grid(500, 750, 1), 0.16
    array = StencilRecipe(filters=8).draw(13)
    flat = Calibration.from_sensitivity(array.transmittance(wavelength).numpy(), wavelength)
    tilted = flat.tilted(1.85, f_number=4.0, corner=corner, vignetting=False)
    assert len(tilted.angle) == 5
    for node, angle in enumerate(tilted.angle):
        angles, weights = pupil_cone(angle, 4.0)
        exact = np.einsum("a,amk->mk", weights, array.transmittance(wavelength, angles).numpy())
        error = (tilted.sensitivity[node] - exact)[:, :245]  # no table tells what lies beyond
        assert rms(error) < 0.013 * rms(exact)
    assert rms(flat.sensitivity[0] - exact) > 0.06 * rms(exact)
    assert tilted.provenance["effective_index"] == 1.85
    dimmed = flat.tilted(1.85, f_number=4.0, corner=corner)
    falloff = np.cos(dimmed.angle) ** 4
    np.testing.assert_allclose(dimmed.sensitivity, tilted.sensitivity * falloff[:, None, None])


def test_errors_are_tilted_and_resampled_as_the_matrix_is():
    random = np.random.default_rng(0)
    wavelength = grid(500, 750, 5)
    matrix, error = random.random((1, 4, 51)), random.random((3, 1, 4, 51))
    known = Calibration(wavelength, matrix, np.zeros(1), deviations=error)
    moved = Calibration(wavelength, matrix + error[1], np.zeros(1))
    for change in (
        lambda camera: camera.tilted(1.7, f_number=4.0, corner=0.1),
        lambda camera: camera.on(grid(510, 740, 2)),
    ):
        both = change(known).sensitivity + change(known).deviations[1]
        np.testing.assert_allclose(both, change(moved).sensitivity)


def test_tilts_that_cannot_be_are_refused(calibration):
    plain = Calibration.from_sensitivity(np.ones((4, 7)), np.linspace(400, 700, 7))
    for camera, figures, says in (
        (calibration, {"f_number": 4.0}, "several field angles already"),
        (plain, {"f_number": 4.0}, "no lattice"),
        (plain, {"f_number": 4.0, "corner": -1.0}, "corner"),
        (plain, {"f_number": 0.0, "corner": 0.1}, "F-number"),
    ):
        with pytest.raises(InputError, match=says):
            camera.tilted(1.7, **figures)
    with pytest.raises(InputError, match="effective index"):
        plain.tilted(0.5, f_number=4.0, corner=0.1)
    with pytest.raises(InputError, match="deviations"):
        replace(plain, deviations=np.ones((2, 4, 7)))


def test_one_flipped_bit_anywhere_in_the_tables_is_noticed(tmp_path):
    random = np.random.default_rng(1)
    plain = Calibration.from_sensitivity(random.random((36, 251)), np.linspace(500, 750, 251))
    path = tmp_path / "matrix.nc"
    plain.save(path)
    content = bytearray(path.read_bytes())
    for place in range(len(content) // 3, 2 * len(content) // 3, len(content) // 20):
        broken = content.copy()
        broken[place] ^= 1
        path.write_bytes(broken)
        with pytest.raises(InputError):
            load_calibration(path)


@pytest.mark.parametrize("spoil", ["cut", "flip", "foreign", "absent"])
def test_damaged_calibrations_are_refused(calibration, tmp_path, spoil):
    path = tmp_path / "camera.nc"
    calibration.save(path)
    content = bytearray(path.read_bytes())
    if spoil == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif spoil == "flip":  # in the middle of a packed frame, which is most of the file
        content[len(content) // 2] ^= 0xFF
        path.write_bytes(content)
    elif spoil == "foreign":
        path.write_text("no calibration")
    else:
        path.unlink()
    with pytest.raises(InputError):
        load_calibration(path)


# --- the parts --------------------------------------------------------------------------------


@pytest.mark.parametrize("rotation", [-2.0, 0.0, 1.5])
def test_windows_are_found_at_any_rotation_and_offset(rotation):
    design = small_design(array={"rotation": rotation, "offset": (12.4, -20.7)})
    flat = Camera(design).flat_rate(np.ones(len(design.wavelength)))
    wider = 1 + 2.0 / 33.7
    found = find_windows(flat, (4, 4), design.pitch * wider)
    middle = design.centres.mean(0)
    assert rms(found - (middle + (design.centres - middle) * wider)) < 0.1


def test_a_dark_filter_is_filled_in(design):
    flat = Camera(design).flat_rate(np.ones(len(design.wavelength)))
    expected = find_windows(flat, (4, 4), design.pitch * (1 + 2.0 / 33.7))
    y, x = np.rint(expected[6]).astype(int)
    flat[y - 48 : y + 49, x - 48 : x + 49] = 0
    found = find_windows(flat, (4, 4), design.pitch * (1 + 2.0 / 33.7))
    assert rms(found[6] - expected[6]) < 1.5  # the lens' own position error is unknown there
    assert rms(np.delete(found - expected, 6, 0)) < 0.05


def test_resampling_keeps_the_picture():
    """The filter passes frequencies up to 0.3 cycles per px at any shift within 0.6 %."""
    tap = np.arange(8) - 3
    for fraction in (0.0, 0.1, 0.25, 0.5, 0.9):
        kernel = sinc_kernel(fraction)
        by_powers = SINC @ (fraction - 0.5) ** np.arange(6)
        np.testing.assert_allclose(by_powers, kernel, atol=5e-5)
        for frequency in (0.0, 0.1, 0.2, 0.3):
            response = (kernel * np.exp(2j * np.pi * frequency * (tap - fraction))).sum()
            assert abs(response - 1) < 0.006, (fraction, frequency)


def test_alignment_moves_a_ramp_exactly(calibration, design):
    """A linear ramp is resampled without error, wherever the sub-images lie."""
    lattice, pixels = calibration.lattice, calibration.pixels
    y, x = np.mgrid[: design.sensor.rows, : design.sensor.columns]
    ramp = Raw((64 + y + 2 * x).astype(np.uint16), 0.0)
    clean = type(pixels)(
        np.full_like(pixels.bias, 64.0), 0 * pixels.dark_rate, np.ones_like(pixels.flat),
        np.ones_like(pixels.valid), 1e9, 1.0, 0.0,
    )  # fmt: skip
    views = sub_images(ramp, lattice, clean, 12)
    aligned, valid = align(views, lattice, 0.6)
    half = (design.field.size - 1) / 2
    start = lattice.centre + 0.6 * lattice.baseline - half
    for unit in (0, 7, 15):
        row, column = np.mgrid[: design.field.size, : design.field.size]
        expected = start[unit, 0] + row + 2 * (start[unit, 1] + column)
        np.testing.assert_allclose(aligned[..., unit].numpy(), expected, atol=0.05)
    assert valid.all()
    row, column = np.mgrid[: design.field.size, : design.field.size]
    tilted = 0.6 + 0.004 * (row - half) - 0.006 * (column - half)
    aligned, _ = align(views, lattice, tilted)
    origin = lattice.centre - half
    for unit in (0, 7, 15):
        y = origin[unit, 0] + row + tilted * lattice.baseline[unit, 0]
        x = origin[unit, 1] + column + tilted * lattice.baseline[unit, 1]
        np.testing.assert_allclose(aligned[..., unit].numpy(), y + 2 * x, atol=0.05)


def test_a_saturated_pixel_is_marked_and_healed(camera, calibration, scene):
    raw = camera.capture(scene, snr=30, generator=torch.Generator().manual_seed(3))
    frame = raw.frame.copy()
    y, x = np.rint(calibration.lattice.centre[9]).astype(int)
    frame[y, x] = 4095
    whole = measure(raw, calibration, distance=300.0)
    healed = measure(Raw(frame, raw.exposure, raw.metadata), calibration, distance=300.0)
    changed = whole.valid & ~healed.valid
    assert 1 <= int(changed.sum()) <= 4
    assert bool(changed[..., 9].any())
    error = (whole.y - healed.y)[..., 9].abs().max() / whole.y[..., 9].max()
    assert float(error) < 0.25


def test_scenes_without_texture_are_said_to_be(camera, calibration, design):
    flat = poster(90, design.wavelength)
    flat = flat.copy(data=np.full(flat.shape, 0.5, np.float32))
    raw = camera.capture(flat, snr=25, generator=torch.Generator().manual_seed(4))
    measurement = measure(raw, calibration)
    assert "no texture" in measurement.provenance["alignment"]
    assert measurement.provenance["distance"] == pytest.approx(300.0)


@pytest.mark.parametrize(("level", "says"), [(64, "dark"), (4095, "saturated")])
def test_frames_that_are_no_picture_get_a_verdict(calibration, design, level, says):
    raw = Raw(np.full(design.sensor_shape, level, np.uint16), 10.0)
    with pytest.raises(InputError, match=says):
        measure(raw, calibration)


def test_frames_of_another_depth_are_refused(camera, calibration, scene):
    """Eight of twelve bits lie far below the black level, and are yet no bright picture."""
    raw = camera.capture(scene, snr=30, generator=torch.Generator().manual_seed(6))
    with pytest.raises(InputError, match="bit depth"):
        measure(Raw(raw.frame >> 4, raw.exposure), calibration)


@pytest.mark.parametrize("distance", [0.0, -100.0, np.nan, 0.5])
def test_impossible_distances_are_refused(camera, calibration, scene, distance):
    raw = camera.capture(scene, snr=20, generator=torch.Generator().manual_seed(6))
    with pytest.raises(InputError, match="distance"):
        measure(raw, calibration, distance=distance)
    with pytest.raises(InputError, match="distance"):
        measure(raw, calibration, nearest=distance)


def test_frames_of_another_camera_are_refused(camera, calibration, scene):
    raw = camera.capture(scene, snr=20)
    with pytest.raises(InputError, match="different"):
        measure(Raw(raw.frame[:-2], raw.exposure), calibration)
    with pytest.raises(InputError, match="of camera"):
        measure(Raw(raw.frame, raw.exposure, {"camera": "another"}), calibration)
    plain = Calibration.from_sensitivity(np.ones((16, 3)), np.array([500.0, 600.0, 700.0]))
    with pytest.raises(InputError, match="no camera geometry"):
        measure(raw, plain)


@pytest.mark.parametrize(
    ("part", "says"),
    [
        ("none", None),
        ("flat exposure", "exposure"),
        ("target size", "target has"),
        ("sweep size", "525 nm has"),
        ("wavelength", "positive wavelength"),
        ("power", "positive wavelength"),
        ("bandwidth", "positive wavelength"),
    ],
)
def test_frames_that_do_not_belong_together_are_refused(design, part, says):
    rehearsal = Rehearsal(Camera(design), frames=2, step=25.0, bandwidth=25.0)
    flat, sweep, target = list(rehearsal.flat()), list(rehearsal.sweep()), rehearsal.target()
    odd = sweep[1].raw
    if part == "flat exposure":
        flat[1] = Raw(flat[1].frame, 2 * flat[1].exposure)
    elif part == "target size":
        target = Raw(target.frame[:-1], target.exposure)
    elif part == "sweep size":
        sweep[1] = replace(sweep[1], raw=Raw(odd.frame[:-1], odd.exposure))
    elif part != "none":
        sweep[1] = replace(sweep[1], **{part: np.nan if part == "wavelength" else -1.0})

    if says is None:
        learnt = rehearsal.calibrate(flat=flat, sweep=sweep, target=None, target_distance=None)
        assert "target_score" not in learnt.provenance
        return
    with pytest.raises(InputError, match=says):
        rehearsal.calibrate(flat=flat, sweep=sweep, target=target)


def test_photon_transfer_finds_gain_and_read_noise():
    random = np.random.default_rng(0)
    shape, gain, read = (300, 400), 3.0, 4.0

    def frames(electrons):
        for _ in range(6):
            level = random.poisson(electrons, shape) + read * random.standard_normal(shape)
            yield Raw(np.rint(100 + level / gain).astype(np.uint16), 1.0)

    dark, flat = Stack.of(frames(0), "dark"), Stack.of(frames(3000), "flat")
    found = noise_of(dark, flat, np.ones(shape, bool))
    np.testing.assert_allclose(found, (gain, read), rtol=0.02)


def test_darks_of_two_exposures_give_the_rate():
    frames = [Raw(np.full((4, 5), 60 + 3 * t, np.uint16), float(t)) for t in (2, 2, 10, 10)]
    darks = Darks.of(frames)
    np.testing.assert_allclose(darks.at(7.0), 81.0, atol=1e-4)


@pytest.mark.slow
def test_the_whole_camera_at_full_size():
    """The thesis' camera, 12 MP and 36 units: centres, R and alignment from frames alone."""
    camera = Camera(CameraDesign.load("thesis"))
    learnt = Rehearsal(camera, step=5.0, bandwidth=5.0).calibrate()
    assert rms(learnt.lattice.centre - camera.design.centres) < 0.1
    truth = camera.sensitivity(learnt.angle)
    assert rms(learnt.sensitivity - truth) / rms(truth) < 0.01
    raw = camera.capture(
        poster(350, camera.design.wavelength, seed=9),
        distance=300.0, snr=30, generator=torch.Generator().manual_seed(1),
    )  # fmt: skip
    disparity = float(measure(raw, learnt).disparity.mean())
    error = found_positions(learnt.lattice, disparity) - true_positions(
        camera.design, 0.7 * camera.design.focal / 300
    )
    assert rms(error) < 0.1
