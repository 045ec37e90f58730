"""The camera's own faults in the twin against closed forms: leak, decentre, ghosts, walls."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from xarray import DataArray

from conftest import small_design
from squilla.calibration.alignment import measure
from squilla.calibration.geometry import lattice_from_flat, refine_with_target
from squilla.calibration.rehearsal import Rehearsal, ideal_calibration, poster
from squilla.camera import lens
from squilla.camera.design import CameraDesign, Effects
from squilla.camera.twin import Camera
from squilla.files.raw import Raw


def filters(**changes) -> dict:
    return {"size": 400.0, "distance": 0.0, "gap": 0.0, "decentre": (0.0, 0.0)} | changes


def only(*effects: str) -> dict:
    return Effects.none().model_dump() | dict.fromkeys(effects, True)


def plain(design, size, value=1.0) -> DataArray:
    return DataArray(
        np.full((size, size, len(design.wavelength)), value, np.float32),
        dims=("y", "x", "wavelength"),
        coords={"wavelength": design.wavelength},
    )


# --- light beside the filters -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "percent"), [(0.0, (20.8, 20.8, 20.8)), (500.0, (0.0, 7.0, 13.5))]
)
def test_leak_at_the_centre_the_edge_and_the_corner(distance, percent):
    """A pupil of 500 um over a filter of 400 um; the figures are those of a ray trace."""
    tree = CameraDesign.load("thesis").model_dump()
    tree["filters"] |= filters(distance=distance)
    y, x = np.array([0.0, 125.0, 125.0]), np.array([0.0, 0.0, 125.0])
    leak = 100 * (1 - lens.through_filter(CameraDesign.model_validate(tree), y, x))
    np.testing.assert_allclose(leak, percent, atol=0.3)


def test_leak_by_counting_rays():
    """Rays from all over the pupil to a pixel, counted where they cross the filter's plane."""
    decentre = (30.0, -80.0)
    design = small_design(filters=filters(distance=700.0, decentre=decentre))
    random = np.random.default_rng(0)
    start = random.uniform(-250, 250, (400_000, 2))
    start = start[(start**2).sum(1) < 250**2]
    for pixel in ((0.0, 0.0), (-30.0, 12.0), (20.0, 30.0)):
        crossing = start + (np.array(pixel) * design.sensor.pixel - start) * 700 / 2000 - decentre
        counted = (np.abs(crossing).max(1) < 200).mean()
        assert lens.through_filter(design, *np.array(pixel)) == pytest.approx(counted, abs=0.003)


def test_decentre_moves_the_leak():
    straight = small_design(filters=filters(distance=500.0))
    moved = small_design(filters=filters(distance=500.0, decentre=(40.0, -25.0)))
    y, x = np.mgrid[-30:31:6, -30:31:6]
    near = 500 / 2000 * straight.sensor.pixel
    np.testing.assert_allclose(
        lens.through_filter(moved, y + 40 / near, x - 25 / near),
        lens.through_filter(straight, y, x),
    )


def test_opaque_gaps_lose_light_and_nothing_else():
    angle = np.linspace(0, 0.15, 4)
    covering = Camera(small_design(effects=only("field_angle"))).sensitivity(angle)
    smaller = small_design(filters=filters(), effects=only("field_angle", "pupil_leak"))
    np.testing.assert_allclose(
        Camera(smaller).sensitivity(angle), (1 - 0.2082) * covering, rtol=1e-3
    )


@pytest.mark.parametrize("distance", [0.0, 500.0])
def test_clear_gaps_add_bare_glass(distance):
    """R = (1 - w) R_T + w 0.92 QE, seen in narrow-band flats pixel by pixel."""
    design = small_design(
        filters=filters(distance=distance, gap=0.92, decentre=(0.0, 60.0)),
        effects=only("pupil_leak"),
    )
    camera, band = Camera(design), 20
    light = np.eye(len(design.wavelength))[band]
    rate = camera.flat_rate(light)
    transmittance = camera.filters.transmittance(design.wavelength, 0.0).numpy()[:, band]
    photons = design.light.radiance * np.pi * 250**2 / 2000**2 * (7.4e-6) ** 2 * 5 / 1000
    photons *= design.quantum_efficiency[band]
    for place in ((0, 0), (12, -20), (-25, 25)):
        pixel = np.rint(design.centres).astype(int) + place
        through = lens.through_filter(design, *(pixel - design.centres).T)
        expected = photons * (through * transmittance + (1 - through) * 0.92)
        np.testing.assert_allclose(rate[tuple(pixel.T)], expected, rtol=2e-3)


def test_a_leaking_scene_is_a_flat():
    """The scene's path and the flat's agree where the leak varies over the field."""
    design = small_design(filters=filters(distance=500.0, gap=0.92), effects=only("pupil_leak"))
    camera = Camera(design)
    flat = camera.fields(camera.flat_rate(np.ones(len(design.wavelength))))
    scene = camera.fields(camera.rate(plain(design, 90)))
    np.testing.assert_allclose(scene, flat, rtol=5e-3)


def test_calibration_finds_the_leaking_response():
    """Narrow-band flats see what leaks at each field angle; it is inside the measured R."""
    design = small_design(filters=filters(distance=500.0, gap=0.92), band={"step": 10.0})
    camera = Camera(design)
    rehearsal = Rehearsal(camera, step=10.0, bandwidth=10.0)
    learnt = rehearsal.calibrate(target=None, target_distance=None)
    truth = camera.sensitivity(learnt.angle)
    closed = Camera(small_design(filters=filters(distance=500.0), band={"step": 10.0}))
    without = closed.sensitivity(learnt.angle)

    def apart(other):
        return np.sqrt(np.mean((other - truth)[-1] ** 2) / np.mean(truth[-1] ** 2))

    assert apart(learnt.sensitivity) < 0.02
    assert apart(without) > 0.08


# --- lateral colour -----------------------------------------------------------------------------


def test_lateral_colour_of_a_displaced_pupil():
    """0.54 px for 0.1 mm at 500 nm in a ray trace of N-BK7, whose dispersion is close."""
    tree = CameraDesign.load("thesis").model_dump()
    tree["lens"] |= {
        "diameter": 690.0,
        "defocus": 0.0,
    }  # wide enough for the filter to be the pupil
    tree["filters"] |= filters(decentre=(0.0, 100.0))
    tree["effects"] = only("lateral_colour", "chromatic_focus")
    shift = lens.lateral_colour(CameraDesign.model_validate(tree), np.zeros(1), 300.0)[0]
    np.testing.assert_allclose(shift[:, 0], 0, atol=1e-9)
    assert shift[100, 1] == pytest.approx(0, abs=1e-3)  # 600 nm is in focus
    assert shift[0, 1] == pytest.approx(-0.54, abs=0.04)
    assert shift[-1, 1] > 0.4


def test_a_dot_lands_where_its_colour_says():
    design = small_design(
        filters=filters(size=250.0, decentre=(60.0, -70.0)),
        sensor={"pixel": 3.7, "rows": 900, "columns": 900},
        band={"step": 10.0},
        effects=only("lateral_colour", "chromatic_focus", "diffraction"),
    )
    camera = Camera(design)
    found, expected = [], []
    shift = lens.lateral_colour(design, np.zeros(1), 300.0)[0]
    yy, xx = np.mgrid[:62, :62] - 30.5
    dot = np.exp(-(yy**2 + xx**2) / 8).astype(np.float32)
    y, x = np.rint(design.centres[design.field.reference]).astype(int)
    for band in (0, 12, 25):
        scene = plain(design, 62, 0.0)
        scene.values[..., band] = dot
        spot = camera.rate(scene)[y - 15 : y + 16, x - 15 : x + 16]
        found.append(ndimage.center_of_mass(spot))
        expected.append(shift[band])
    np.testing.assert_allclose(np.diff(found, axis=0), np.diff(expected, axis=0), atol=0.01)
    assert np.abs(np.diff(expected, axis=0)).max() > 0.05


def test_the_lattice_takes_in_each_filter_s_lateral_colour():
    """Narrow bands out of focus behind a displaced pupil: the target shows where they land."""
    design = small_design(
        filters=filters(recipe="band-pass", fwhm=30.0, size=250.0, decentre=(0.0, 90.0)),
        sensor={"pixel": 3.7, "rows": 900, "columns": 900},
        field={"size": 120},
        array={"position_error": 0.0},
        band={"step": 25.0},
        effects=only("lateral_colour", "chromatic_focus", "diffraction"),
    )
    camera = Camera(design)
    light = camera.flat_rate(np.ones(len(design.wavelength)))
    lattice = lattice_from_flat(light, design)
    share = np.where(light > 0, light / np.percentile(light, 99), 1)
    rate = camera.rate(poster(220, design.wavelength), distance=300.0)
    lattice, _ = refine_with_target(rate / np.maximum(share, 0.02), lattice, 300.0)
    response = camera.sensitivity(0.05)[0]
    shift = lens.lateral_colour(design, np.array([0.05]), 300.0)[0]
    expected = response @ shift / response.sum(1, keepdims=True)
    found = lattice.centre - design.centres
    spread = (expected - expected.mean(0))[:, 1]
    assert np.ptp(spread) > 0.2
    np.testing.assert_allclose((found - found.mean(0))[:, 1], spread, atol=0.03)


# --- ghosts -------------------------------------------------------------------------------------


def test_ghosts_of_a_bright_hemisphere_are_ten_times_the_signal():
    """The sum of cos^4 over all neighbours of a lens, on the mean of the thesis' array."""
    design = CameraDesign.load("thesis").model_copy(update={"stop": None})
    apart = design.centres[:, None] - design.centres[None]
    ghost = (1 + (apart**2).sum(-1) / design.focal**2) ** -2.0
    assert (ghost.sum(1) - 1).mean() == pytest.approx(10, rel=0.1)


def test_the_twin_adds_them_up(tmp_path):
    table = np.column_stack([np.linspace(400, 800, 81), np.full((81, 16), 0.5)])
    np.savetxt(tmp_path / "even.csv", table, delimiter=",")
    even = {"recipe": None, "table": tmp_path / "even.csv"}
    design = small_design(stop=None, filters=even, effects=only("vignetting"))
    rate = Camera(design).flat_rate(np.ones(len(design.wavelength)))
    at = np.rint(design.centres).astype(int)
    apart = at[:, None] - design.centres[None]
    light = ((1 + (apart**2).sum(-1) / design.focal**2) ** -2.0).sum(1)
    alone = Camera(small_design(filters=even, effects=only("vignetting")))
    own = alone.flat_rate(np.ones(len(design.wavelength)))
    np.testing.assert_allclose(rate[tuple(at.T)] / own[tuple(at.T)], light, rtol=0.01)


def test_a_scene_within_thirteen_degrees_makes_none():
    """The next lens' crop begins at 13.2 degrees."""
    few = {
        "array": {"rows": 2, "columns": 2},
        "field": {"reference": 0},
        "sensor": {"rows": 260, "columns": 260},
        "band": {"step": 50.0},
    }
    stopped, opened = small_design(**few), small_design(**few, stop=None)
    scene = plain(stopped, 420, 0.0)
    reach = int(stopped.focal * np.tan(np.radians(13.0)) / np.sqrt(2))
    scene.values[210 - reach : 210 + reach, 210 - reach : 210 + reach] = 1.0
    shut, wide = Camera(stopped), Camera(opened)
    seen = wide.fields(wide.rate(scene, distance=1e5))
    own = shut.fields(shut.rate(scene, distance=1e5))
    inner = (slice(None), slice(4, -4), slice(4, -4))  # the blur of the scene's edge
    np.testing.assert_allclose(seen[inner], own[inner], atol=0.02 * own.max())


@pytest.mark.parametrize(
    "barrier",
    [
        {"stop": {"width": 11.8, "distance": 33.7}},
        {"stop": {"width": 27.9, "distance": 68.0, "round": True}},
        {"stop": None, "walls": {"height": 1670.0}},
    ],
)
def test_proper_barriers_vignette_no_crop_and_let_no_ghost_in(barrier):
    tree = CameraDesign.load("thesis").model_dump()
    design = CameraDesign.model_validate(tree | barrier)
    half = design.field.size / 2
    inside, outside = np.array([-half, 0, half]), np.array([design.pitch - half])
    for unit in (0, 5, 14, 35):
        share = lens.vignetting(design, unit, inside, inside)
        fall = np.cos(np.arctan(np.hypot(*np.meshgrid(inside, inside)) / design.focal)) ** 4
        assert np.all(share > 0.9 * fall)
        for sign in (-1, 1):
            assert lens.vignetting(design, unit, sign * outside, inside).max() < 1e-3


@pytest.mark.parametrize("name", ["thesis", "band-pass", "tombo", "linear-variable"])
def test_the_stops_that_ship_light_every_crop_and_none_twice(name):
    """In focus, where parallax has moved the crops outwards."""
    design = CameraDesign.load(name)
    half = design.field.size / 2
    apart = (design.centres - design.centres[design.field.reference]) / design.pitch
    parallax = design.array.pitch / 1000 * design.focal / design.lens.focus_distance * apart
    for unit in range(design.units):
        crop = np.linspace(-half, half, 9)[:, None] + parallax[unit]
        share = lens.vignetting(design, unit, *crop.T)
        fall = (1 + (np.add.outer(*(crop.T**2))) / design.focal**2) ** -2.0
        assert np.all(share > 0.9 * fall)
        for side in (-1, 1):
            beyond = np.array([side * (design.pitch - half)])
            assert lens.vignetting(design, unit, beyond, crop[:, 1]).max() < 1e-3
            assert lens.vignetting(design, unit, crop[:, 0], beyond).max() < 1e-3


def test_shorter_walls_or_a_nearer_stop_let_ghosts_in():
    tree = CameraDesign.load("thesis").model_dump()
    for barrier in (
        {"stop": None, "walls": {"height": 1400.0}},
        {"stop": {"width": 11.8, "distance": 20.0}},
    ):
        design = CameraDesign.model_validate(tree | barrier)
        outside = np.array([design.pitch - design.field.size / 2])
        ghosts = [
            lens.vignetting(design, unit, sign * outside, np.zeros(1)).max()
            for unit in (0, 35)
            for sign in (-1, 1)
        ]
        assert max(ghosts) > 0.01


def test_walls_stand_where_rays_are_counted_out():
    """Rays from the whole pupil to pixels in the penumbra, stopped at the walls' lower ends."""
    design = small_design(stop=None, walls={"height": 1670.0, "thickness": 40.0})
    start = np.random.default_rng(0).uniform(-250, 250, (200_000, 2))
    start = start[(start**2).sum(1) < 250**2]
    for pixel in (0.0, 45.0, 50.0, 55.0, 60.0):
        end = np.array([pixel * design.sensor.pixel, 0.0])
        free = np.abs(start + (end - start) * 1670 / 2000).max(1) < 350 - 20
        share = lens.vignetting(design, 5, np.array([pixel]), np.zeros(1))[0, 0]
        fall = (1 + (pixel / design.focal) ** 2) ** -2.0
        assert share / fall == pytest.approx(free.mean(), abs=0.005)


def test_sub_images_between_walls_are_found():
    design = small_design(
        stop=None, walls={"height": 1950.0, "thickness": 60.0}, array={"position_error": 3.0}
    )
    lattice = lattice_from_flat(Camera(design).flat_rate(np.ones(51)), design)
    error = lattice.centre - design.centres
    assert np.sqrt((error**2).mean()) < 1.0


# --- ghosts noticed -----------------------------------------------------------------------------


def lamp_beside(design, degrees):
    """A dim texture with a lamp far outside the field, black beyond."""
    scene = plain(design, 400, 0.0)
    scene.values[140:260, 140:260] = poster(120, design.wavelength, seed=3).values
    at = 200 + int(design.focal * np.tan(np.radians(degrees)))
    scene.values[195:205, at - 5 : at + 5] = 30.0
    return scene


@pytest.fixture(scope="module")
def sealed():
    return small_design(band={"step": 50.0}, sensor={"rows": 560, "columns": 560})


@pytest.mark.parametrize("degrees", [18.0, 30.0])
def test_a_lamp_beside_the_field_is_noticed(sealed, degrees, generator):
    """Without the stop its light falls beside the sub-images; with it, it does not."""
    calibration = ideal_calibration(Camera(sealed))
    open_design = sealed.model_copy(update={"stop": None})
    lit = Camera(sealed).flat_rate(np.ones(len(sealed.wavelength))) > 0
    calibration = replace(calibration, pixels=replace(calibration.pixels, valid=lit))
    scene = lamp_beside(sealed, degrees)
    told = []
    for design in (sealed, open_design):
        raw = Camera(design).capture(scene, snr=20.0, distance=2000.0, generator=generator)
        measured = measure(Raw(raw.frame, raw.exposure), calibration, distance=2000.0)
        told.append(measured.provenance)
    assert told[0]["stray_light"] == "none seen"
    assert told[0]["stray_share"] < 0.01
    assert "beside the sub-images" in told[1]["stray_light"]


def test_calibration_says_that_the_dark_parts_are_dark(calibration):
    assert calibration.provenance["stray_light"] == "none seen"


def test_without_dark_parts_nothing_is_judged(calibration, camera, scene, generator):
    everywhere = np.ones_like(calibration.pixels.valid)
    full = replace(calibration, pixels=replace(calibration.pixels, valid=everywhere))
    raw = camera.capture(scene, snr=20.0, generator=generator)
    assert "not judged" in measure(raw, full).provenance["stray_light"]
    assert torch.isfinite(measure(raw, full).y).all()
