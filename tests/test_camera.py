"""The twin against closed forms: photons, noise, geometry, blur."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from xarray import DataArray

from conftest import small_design
from squilla.camera import lens
from squilla.camera.design import CameraDesign, Effects, design_path
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.optics.materials import refractive_index


def flat_scene(design, size=90, value=1.0):
    return DataArray(
        np.full((size, size, len(design.wavelength)), value, np.float32),
        dims=("y", "x", "wavelength"),
        coords={"wavelength": design.wavelength},
    )


def test_thesis_design_holds_the_thesis_figures():
    design = CameraDesign.load("thesis")
    assert (design.units, design.array.pitch, design.lens.focal_length) == (36, 700, 2000)
    assert design.lens.focal_length / design.lens.diameter == 4
    assert design.sensor_shape == (3000, 4000)
    assert len(design.wavelength) == 251
    assert design.pitch == pytest.approx(378.4, abs=0.05)


def test_rotation_turns_the_lattice_about_its_middle():
    straight = small_design(array={"position_error": 0.0}).centres
    turned = small_design(array={"position_error": 0.0, "rotation": 2.0}).centres
    middle = straight.mean(0)
    np.testing.assert_allclose(turned.mean(0), middle, atol=1e-9)
    arm, other = (straight - middle)[3], (turned - middle)[3]
    cosine = arm @ other / np.linalg.norm(arm) / np.linalg.norm(other)
    assert np.rad2deg(np.arccos(cosine)) == pytest.approx(2.0, abs=1e-6)
    assert turned[3, 0] > turned[0, 0]  # the right end of a row goes down: clockwise as shown


@pytest.mark.parametrize(
    ("section", "changes", "says"),
    [
        ("field", {"size": 200}, "overlap"),
        ("sensor", {"rows": 300}, "leave the sensor"),
        ("sensor", {"bits": 40}, "bits"),
        ("field", {"reference": 99}, "reference"),
        ("filters", {"recipe": None}, "recipe or a table"),
        ("lens", {"colour": "red"}, "colour"),
        ("lens", {"focal_length": np.inf}, "finite"),
        ("array", {"offset": (np.nan, 0.0)}, "finite"),
        ("filters", {"seed": -1}, "seed"),
        ("band", {"step": 7.0}, "divide"),
        ("band", {"step": 600.0}, "divide"),
        ("band", {"step": 1e-9}, "step"),
        ("band", {"stop": 400.0}, "above start"),
        ("sensor", {"black_level": 5000.0}, "black_level"),
        ("sensor", {"quantum_efficiency": {"wavelength": (400, 900), "value": (0, 2)}}, "0..1"),
    ],
)
def test_impossible_designs_are_refused(section, changes, says):
    with pytest.raises(ValueError, match=says):
        small_design(**{section: changes})


def test_design_file_errors_are_one_sentence(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text("name = 'x'\n[array]\nrows = -1\n")
    with pytest.raises(InputError, match=r"camera\.toml"):
        CameraDesign.load(path)
    own = design_path("thesis").read_text().replace("size = 250", "size = 400")
    path.write_text(own)
    with pytest.raises(InputError, match=r"camera\.toml: the sub-images overlap"):
        CameraDesign.load(path)
    path.write_text("name = [")
    with pytest.raises(InputError, match="cannot be read"):
        CameraDesign.load(path)
    with pytest.raises(InputError, match="no camera design"):
        CameraDesign.load("nonesuch")


def test_a_camera_is_known_by_its_filters_wherever_their_file_lies(tmp_path):
    table = np.column_stack([np.linspace(400, 800, 81), np.full((81, 16), 0.5)])
    serials = []
    for folder, level in (("one", 1.0), ("other", 1.0), ("third", 0.9)):
        path = tmp_path / folder / "filters.csv"
        path.parent.mkdir()
        np.savetxt(path, table * ([1.0] + [level] * 16), delimiter=",")
        serials.append(Camera(small_design(filters={"recipe": None, "table": path})).serial)
    assert serials[0] == serials[1] != serials[2]


def test_photons_by_hand(camera):
    """Radiance x solid angle x pixel area x band x T Q, with a filter seen without its cone."""
    design = small_design(effects=Effects.none().model_dump())
    twin = Camera(design)
    rate = twin.flat_rate(np.ones(len(design.wavelength)))
    transmittance = twin.filters.transmittance(design.wavelength, 0.0).numpy()
    solid = np.pi * 250.0**2 / 2000.0**2
    area = (design.sensor.pixel * 1e-6) ** 2
    expected = design.light.radiance * solid * area * 5.0 / 1000
    expected *= (transmittance * design.quantum_efficiency).sum(1)
    y, x = np.rint(design.centres).astype(int).T
    np.testing.assert_allclose(rate[y, x], expected, rtol=1e-5)


def test_an_even_scene_is_a_flat(camera):
    """The scene path and the flat path are the same light, but for the blur of the filters' change
    with the field angle, which these coarse pixels exaggerate."""
    scene = camera.rate(flat_scene(camera.design))
    flat = camera.flat_rate(np.ones(len(camera.design.wavelength)))
    np.testing.assert_allclose(scene, flat, rtol=0, atol=0.01 * flat.max())
    assert scene.sum() == pytest.approx(flat.sum(), rel=1e-3)


def test_light_adds_up(camera, scene):
    one, other = camera.rate(scene), camera.rate(flat_scene(camera.design, 90, 0.3))
    both = camera.rate(scene + 0.3)
    np.testing.assert_allclose(both, one + other, atol=1e-4 * both.max())


@pytest.mark.parametrize("distance", [100.0, 300.0, 5000.0])
def test_parallax_is_pitch_times_focal_over_distance(design, distance):
    """A bright dot lies where the thin lens says, in every sub-image."""
    twin = Camera(design)
    scene = flat_scene(design, 62, 0.0)
    yy, xx = np.mgrid[:62, :62] - 30.5
    scene.values += np.exp(-(yy**2 + xx**2) / 8)[..., None].astype(np.float32)
    rate = twin.rate(scene, distance=distance)
    parallax = 700.0 * 2.0 / distance / design.sensor.pixel
    reference = design.centres[design.field.reference]
    for centre in design.centres:
        expected = centre + parallax * (centre - reference) / design.pitch
        y, x = np.rint(expected).astype(int)
        spot = rate[y - 12 : y + 13, x - 12 : x + 13]
        found = np.add(ndimage.center_of_mass(spot), [y - 12, x - 12])
        np.testing.assert_allclose(found, expected, atol=0.03)


def test_a_plane_depth_map_is_the_plane(camera, scene):
    plane = camera.rate(scene, distance=250.0)
    relief = camera.rate(scene, depth=np.full(scene.shape[:2], 250.0))
    inner = camera.fields(relief) - camera.fields(plane)
    assert np.sqrt((inner**2).mean()) < 0.01 * plane.max()


@pytest.mark.parametrize("size", [60, 61, 90, 91, 35])
def test_the_truth_is_what_the_reference_unit_sees(size):
    """Sample for sample, whether scene and field are even or odd, larger or smaller."""
    design = small_design(
        effects=Effects.none().model_dump(),
        array={"position_error": 0.0, "pitch": 95 * 7.4, "offset": (0.5, 0.5)},  # on whole pixels
    )
    twin = Camera(design)
    yy, xx = np.mgrid[:size, :size]
    scene = flat_scene(design, size, 1.0)
    scene.values *= (2 + np.sin(yy / 3) + np.cos(xx / 4 + yy / 9))[..., None].astype(np.float32)
    truth = twin.truth(scene).cube.values[..., 0]
    centre = design.centres[design.field.reference]
    start = np.rint(centre - (design.field.size - 1) / 2).astype(int)
    np.testing.assert_allclose(start, centre - (design.field.size - 1) / 2, atol=1e-6)
    seen = twin.rate(scene)[start[0] : start[0] + 60, start[1] : start[1] + 60]
    np.testing.assert_allclose(seen / seen.mean(), truth / truth.mean(), atol=0.02)


def test_a_stop_narrower_than_the_field_leaves_dark_corners():
    angles = Camera(small_design(stop={"width": 3.0, "distance": 33.7})).angles
    assert np.all(np.diff(angles) > 0)


def test_near_things_hide_far_ones(design):
    """A bright strip before a dark ground moves by its own disparity and hides what is behind."""
    twin = Camera(design)
    scene = flat_scene(design, 90, 0.0)
    scene.values[:, 40:50] = 1.0
    depth = np.full((90, 90), 400.0)
    depth[:, 40:50] = 100.0
    rate = twin.rate(scene, depth=depth)
    reference = design.centres[design.field.reference]
    for unit in (4, 7):  # to the left and to the right of the reference
        centre = design.centres[unit]
        baseline = (centre - reference)[1] / design.pitch
        edge = centre[1] + 700.0 * 2.0 / 100.0 / design.sensor.pixel * baseline
        edge += 5 * np.sign(baseline)  # the strip's outer edge; its inner flank is seen from beside
        y, x = np.rint([centre[0], edge]).astype(int)
        profile = rate[y - 5 : y + 6, x - 4 : x + 5].mean(0)[:: int(np.sign(baseline))]
        level = rate[y, x - 5 * int(np.sign(baseline))] / 2
        fallen = int(np.argmax(profile < level))
        part = (profile[fallen - 1] - level) / (profile[fallen - 1] - profile[fallen])
        found = x + np.sign(baseline) * (fallen - 1 + part - 4)
        assert found == pytest.approx(edge, abs=0.7)


@pytest.mark.parametrize("snr", [15.0, 20.0, 30.0])
def test_snr_is_what_was_asked_for(camera, scene, snr):
    rate = camera.rate(scene)
    generator = torch.Generator().manual_seed(1)
    frames = [camera.capture(scene, snr=snr, generator=generator) for _ in range(2)]
    one, other = (
        camera.fields(raw.frame.astype(float) - camera.design.sensor.black_level) for raw in frames
    )
    noise = (one - other).std() / np.sqrt(2)
    signal = np.sqrt(np.mean(one * other))
    assert 20 * np.log10(signal / noise) == pytest.approx(snr, abs=0.2)
    assert frames[0].exposure == pytest.approx(camera.sensor.exposure_for(camera.fields(rate), snr))


def test_variance_grows_with_the_mean_by_the_gain(camera):
    """The photon transfer curve: slope 1 / gain in DN, whatever way the noise is drawn."""
    sensor, gain = camera.sensor, camera.design.sensor.gain
    for electrons in (0.1, 3.0, 11.0, 50.0, 3000.0):
        rate = np.full((400, 500), electrons, np.float32)
        sensor_of = Camera(
            small_design(sensor={"rows": 480, "prnu": 0.0, "hot_pixels": 0.0})
        ).sensor
        sensor_of.__dict__["response"] = np.ones_like(rate)
        sensor_of.__dict__["dark_rate"] = np.zeros_like(rate)
        frame = sensor_of.expose(rate, 1.0, generator=torch.Generator().manual_seed(2)).astype(
            float
        )
        expected = electrons / gain**2 + (2.5 / gain) ** 2 + 1 / 12
        assert frame.var() == pytest.approx(expected, rel=0.02)
        assert frame.mean() == pytest.approx(64 + electrons / gain, abs=0.03 + 2e-5 * electrons)
    assert sensor.expose(np.full((480, 500), 1e6, np.float32), 1.0).max() == 2**12 - 1


def test_noise_is_reproducible(camera, scene):
    def frame(threads):
        torch.set_num_threads(threads)
        return camera.capture(scene, snr=20, generator=torch.Generator().manual_seed(5)).frame

    before = torch.get_num_threads()
    try:
        np.testing.assert_array_equal(frame(1), frame(2))
    finally:
        torch.set_num_threads(before)


def test_transfer_function_without_aberrations_is_the_airy_one():
    """In focus, on the axis: (2/pi)(arccos v - v sqrt(1 - v^2)), v = frequency / cut-off."""
    design = small_design(
        lens={"defocus": 0.0, "focus_distance": 300.0},
        effects=Effects.none().model_dump() | {"diffraction": True},
    )
    cycles = np.linspace(0, 0.5, 40)
    transfer = lens.transfer_function(design, np.zeros(1), 300.0, cycles)[0]
    for band in (0, 25, 50):
        v = cycles / design.sensor.pixel * design.wavelength[band] / 1000 * 4.0
        v = np.minimum(v, 1)
        airy = 2 / np.pi * (np.arccos(v) - v * np.sqrt(1 - v**2))
        np.testing.assert_allclose(transfer[band], airy, atol=0.02)


def test_field_curvature_blurs_as_ray_traces_say():
    """RMS spot radii of the thesis' lens in focus on the axis: 1.1-2.6 px at the edge of the field,
    2.7-4.3 px in its corner, where the chief ray is inclined by 6.6 and 9.3 degrees."""
    design = CameraDesign.load("thesis")
    lens_in_focus = design.lens.model_copy(update={"defocus": 0.0})
    design = design.model_copy(update={"lens": lens_in_focus})
    sagittal, tangential = lens.defocus(design, np.deg2rad([6.6, 9.3]), 300.0)
    axes = np.array([sagittal[:, 100], tangential[:, 100]]) / 8 / design.sensor.pixel
    edge, corner = np.sqrt((axes**2).sum(0) / 4)  # of an evenly filled ellipse
    assert 1.1 < edge < 2.6
    assert 2.7 < corner < 4.3


def test_chromatic_focus_is_the_glass():
    """Focus shift f (n0 - n) / (n - 1) for the glass of the design; microns over the band."""
    design = small_design(effects=Effects.none().model_dump() | {"chromatic_focus": True})
    sagittal, tangential = lens.defocus(design, np.zeros(1), 300.0)
    np.testing.assert_allclose(sagittal, tangential)
    shift = -(sagittal[0] - np.interp(600, design.wavelength, sagittal[0]))
    # The figures of N-BK7, whose dispersion is close: -20, -9, 0, 7, 13, 17 um.
    got = np.interp([500, 550, 600, 650, 700, 750], design.wavelength, shift)
    np.testing.assert_allclose(got, [-20, -9, 0, 7, 13, 17], atol=2.5)


def test_astigmatism_obeys_seidel_and_petzval():
    """From the Petzval surface, of curvature 1 / (n f), the tangential image lies three times as
    far as the sagittal; both bend towards the lens, in front of the sensor."""
    design = small_design(
        effects=Effects.none().model_dump() | {"field_curvature": True}, lens={"defocus": 0.0}
    )
    angle = np.array([0.0, 0.05, 0.1])
    sagittal, tangential = (focus[:, 0] for focus in lens.defocus(design, angle, 300.0))
    index = np.real(refractive_index(design.lens.glass, np.array([600.0])))[0]
    petzval = (2000 * np.tan(angle)) ** 2 / (2 * index * 2000)
    np.testing.assert_allclose(tangential - petzval, 3 * (sagittal - petzval), atol=1e-9)
    assert np.all(np.diff(sagittal) > 0)
    assert np.all(sagittal >= petzval)


def test_cone_conserves_light_and_widens():
    design = small_design(effects={"pupil_leak": False})
    angles, weights = lens.cone(design, 0.0)
    assert weights.sum() == pytest.approx(1)
    # A disc of slope 1/8 evenly filled has the mean square slope of half its edge's.
    assert (weights * np.tan(angles) ** 2).sum() == pytest.approx(1 / 128, rel=0.05)
    tilted, _ = lens.cone(design, 0.15)
    assert tilted.max() > 0.15 > tilted.min()


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda s: s.where(s.x != 3), "NaN"),
        (lambda s: s - 5, "negative"),
        (lambda s: s.isel(wavelength=slice(5, None)), "extrapolated"),
        (lambda s: s.rename(wavelength="band"), "dimensions"),
    ],
)
def test_bad_scenes_are_refused(camera, scene, spoil, says):
    scene = scene.assign_coords(x=np.arange(scene.sizes["x"]))
    with pytest.raises(InputError, match=says):
        camera.capture(spoil(scene), snr=20)


def test_impossible_captures_are_refused(camera, scene):
    with pytest.raises(InputError, match="either"):
        camera.capture(scene)
    with pytest.raises(InputError, match="saturates"):
        camera.capture(scene, snr=60)
    with pytest.raises(InputError, match="must be a number of dB"):
        camera.capture(scene, snr=np.nan)
    with pytest.raises(InputError, match="no light"):
        camera.capture(scene * 0, snr=20)
    for distance in (3.0, np.inf, np.nan):
        with pytest.raises(InputError, match="distance"):
            camera.capture(scene, snr=20, distance=distance)
    with pytest.raises(InputError, match="depth map"):
        camera.capture(scene, snr=20, depth=np.full((4, 4), 300.0))
