"""Depth for every point: the twin plants it, the sweep finds it; its parts against brute force."""

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
import torch
import xarray as xr

from squilla.calibration import depth as room
from squilla.calibration import surfaces
from squilla.calibration.alignment import measure
from squilla.calibration.depth import Depth
from squilla.calibration.rehearsal import poster
from squilla.calibration.resample import monomials
from squilla.calibration.views import SubImages
from squilla.camera import warp
from squilla.camera.solid import solid_scene
from squilla.errors import InputError
from squilla.files.cube import load_cube, save
from squilla.reconstruction.models import load_model


def true_disparity(camera, depth):
    middle = slice((len(depth) - 60) // 2, (len(depth) + 60) // 2)
    return 0.7 * camera.design.focal / depth[middle, middle]


def captured(camera, scene, depth, snr=30.0):
    return camera.capture(scene, depth=depth, snr=snr, generator=torch.Generator().manual_seed(5))


@pytest.fixture(scope="module")
def steps(camera, calibration):
    """A square at 70 mm before a wall that leans from 130 to 200 mm, found at 30 dB."""
    scene = poster(90, camera.design.wavelength, seed=4)
    front = poster(90, camera.design.wavelength, seed=5).values[30:62, 26:58]
    depth = np.linspace(130, 200, 90)[:, None] * np.ones(90)
    scene.values[30:62, 26:58], depth[30:62, 26:58] = front, 70.0
    measurement = measure(captured(camera, scene, depth), calibration, nearest=60.0, depth=True)
    return true_disparity(camera, depth), measurement


def test_depth_of_every_point_is_found(steps):
    truth, measurement = steps
    error = np.abs(measurement.disparity.numpy() - truth)
    inside = np.ones((60, 60), bool)  # all but the rim of the square, where lenses blur both
    inside[10:52, 6:48] = False
    inside[20:42, 16:38] = True
    assert np.mean(error[inside] < 0.1) > 0.95
    assert np.mean(error < 0.5) > 0.85
    confident = measurement.depth.confident.numpy()
    assert confident.mean() > 0.5
    assert np.mean(error[confident & inside] < 0.1) > 0.97


def test_what_the_square_hides_is_marked(steps, calibration):
    """A unit to the left sees the square moved left over the wall, and the other way round."""
    _, measurement = steps
    hidden = ~measurement.valid.numpy()
    across = calibration.lattice.baseline[:, 1]
    beside = {"left": hidden[18:42, 5:11], "right": hidden[18:42, 43:49]}
    # A nearer point moves with the baseline, so it covers what lies there in the reference.
    for side, units in (("left", across < -0.5), ("right", across > 0.5)):
        other = "left" if side == "right" else "right"
        assert beside[side][..., units].mean() > 5 * beside[other][..., units].mean()


def test_hidden_channels_do_not_reach_the_cube(steps, calibration):
    _, measurement = steps
    spoiled = measurement.y.clone()
    spoiled[~measurement.valid] = 1e6
    model = load_model("ridge", calibration)
    clean = model.reconstruct(measurement).values
    np.testing.assert_allclose(
        model.reconstruct(replace(measurement, y=spoiled, snr=measurement.snr)).values, clean,
        rtol=1e-4, atol=1e-6,
    )  # fmt: skip


def test_a_plain_surface_is_flagged(camera, calibration):
    scene = poster(90, camera.design.wavelength, seed=4)
    scene.values[:, 45:] = 0.5
    raw = captured(camera, scene, np.full((90, 90), 120.0))
    confident = measure(raw, calibration, depth=True).depth.confident.numpy()
    assert confident[:, :26].mean() > 0.8
    assert confident[:, 36:].mean() < 0.05


def test_a_flat_scene_is_no_worse_off(camera, calibration, scene):
    raw = camera.capture(scene, distance=150.0, snr=30, generator=torch.Generator().manual_seed(6))
    dense = measure(raw, calibration, depth=True)
    known = measure(raw, calibration, distance=150.0)
    both = dense.valid & known.valid
    change = (dense.y - known.y)[both].norm() / known.y[both].norm()
    noise = 10 ** (-30 / 20)
    assert float(change) < 0.3 * noise
    assert float(dense.valid.float().mean()) > 0.98 * float(known.valid.float().mean())


def test_a_distance_and_depth_exclude_each_other(camera, calibration, scene):
    raw = captured(camera, scene, np.full((90, 90), 120.0))
    with pytest.raises(InputError, match="either"):
        measure(raw, calibration, distance=100.0, depth=True)


@pytest.mark.parametrize("name", ["cube.nc", "cube.zarr", "cube.hdr", "cube.tiff"])
def test_depth_is_saved_with_the_cube(tmp_path, name):
    cube = xr.DataArray(
        np.ones((4, 5, 3), np.float32),
        {"wavelength": [500.0, 600.0, 700.0]}, ("y", "x", "wavelength"), "radiance",
    )  # fmt: skip
    distance = torch.arange(20.0).reshape(4, 5) + 100
    found = Depth(distance, distance / 100, distance > 110)
    save(cube, tmp_path / name, extra=found.arrays())
    assert load_cube(tmp_path / name).shape == cube.shape
    if name.endswith(("nc", "zarr")):
        with xr.open_dataset(tmp_path / name) as back:
            np.testing.assert_array_equal(back["depth"], distance)
            assert back["depth"].attrs["units"] == "mm"
            np.testing.assert_array_equal(back["depth_confident"], distance > 110)
    else:
        assert (tmp_path / name.replace("cube", "cube-depth")).is_file()


def test_distance_and_error_follow_the_disparity(calibration):
    """z = f B / d, so a small change of d moves z by its derivative."""
    lattice = calibration.lattice
    disparity = np.array([[0.5, 1.0, 3.0]], np.float32)
    found = Depth.of(disparity, np.full_like(disparity, 1e-3), lattice)
    for column, d in enumerate(disparity[0]):
        assert float(found.distance[0, column]) == pytest.approx(lattice.distance(d), rel=1e-5)
        moved = lattice.distance(d - 5e-4) - lattice.distance(d + 5e-4)
        assert float(found.error[0, column]) == pytest.approx(moved, rel=1e-3)


# --- the parts --------------------------------------------------------------------------------


def test_paths_are_shortest_paths():
    """On a single row the two directions along it make the exact cost of the best path."""
    random = np.random.default_rng(0)
    cost = random.random((1, 5, 4)).astype(np.float32)
    slant, jump = 0.15, 0.4
    total = np.zeros((2, *cost.shape), np.float32)
    surfaces._semi_global(cost, np.float32(slant), np.full((1, 5), jump, np.float32), total)
    step = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    price = np.where(step == 0, 0, np.where(step == 1, min(slant, jump), jump))
    best = np.full((5, 4), np.inf)
    for path in product(range(4), repeat=5):
        whole = sum(cost[0, x, k] for x, k in enumerate(path))
        whole += sum(price[a, b] for a, b in pairwise(path))
        for x, k in enumerate(path):
            best[x, k] = min(best[x, k], whole)
    # Six of the eight directions find nothing before them and add the bare cost.
    found = total.sum(0)[0] - 7 * cost[0]
    difference = found - best
    np.testing.assert_allclose(difference, difference[:, :1] * np.ones(4), atol=1e-5)


def test_rows_are_solved_exactly():
    random = np.random.default_rng(1)
    field, bond = random.random((1, 1, 9)).astype(np.float32), random.random((1, 8))
    matrix = np.eye(9)
    for x in range(8):
        matrix[x : x + 2, x : x + 2] += 7.0 * bond[0, x] * np.array([[1, -1], [-1, 1]])
    expected = np.linalg.solve(matrix, field[0, 0])
    surfaces._along_rows(field, bond.astype(np.float32), np.float32(7.0))
    np.testing.assert_allclose(field[0, 0], expected, rtol=1e-4)


def test_bent_views_are_straightened(calibration):
    """On a ramp a point tells its own place: after unbending it is off by the polynomial."""
    field, margin = calibration.lattice.field, 10
    bend = 0.3 * np.random.default_rng(3).standard_normal((16, 2, 9))
    lattice = replace(calibration.lattice, bend=bend)
    rows, columns = np.mgrid[: field[0] + 2 * margin, : field[1] + 2 * margin].astype(np.float32)
    for axis, ramp in enumerate((rows, columns)):
        image = torch.from_numpy(np.repeat(ramp[None], 16, 0))
        views = SubImages(image, torch.zeros(image.shape, dtype=torch.bool), np.zeros((16, 2)),
                          margin, 0.0)  # fmt: skip
        inner = slice(margin, -margin)
        moved = (room._unbent(views, lattice).numpy() - ramp)[:, inner, inner]
        expected = np.tensordot(bend[:, axis], monomials(*field)[1:], 1)
        np.testing.assert_allclose(moved, expected, atol=0.01)  # px, of the sinc


@pytest.mark.parametrize("baseline", [(0.0, 1.0), (0.0, -2.0), (1.0, 0.0), (2.0, 1.0)])
def test_hidden_points_are_those_that_a_painter_covers(baseline):
    """Whole shifts: the square is painted over the wall, and what it covers is hidden."""
    disparity = np.ones((40, 40), np.float32)
    disparity[12:26, 14:28] = 3.0
    seen = surfaces.unhidden(disparity, np.array([[0.0, 0.0], baseline]))
    moved = np.zeros((40, 40), bool)  # where the unit sees the square, in the wall's coordinates
    shift = [round(2.0 * each) for each in baseline]
    moved[12 + shift[0] : 26 + shift[0], 14 + shift[1] : 28 + shift[1]] = True
    hidden = moved & (disparity == 1)
    assert seen[..., 0].all()
    wrong = seen[..., 1] == hidden
    assert wrong.sum() <= 0.15 * hidden.sum()  # the rim, at half a pixel a step


@pytest.mark.parametrize("across", [1.0, -2.0])
def test_the_twin_paints_the_near_over_the_far(across):
    """A square over a wall, seen from aside by whole pixels, is what a painter would paint."""
    random = np.random.default_rng(2)
    wall, square = random.random((2, 40, 40))
    mask = np.zeros((40, 40), bool)
    mask[10:30, 12:28] = True
    scene = np.where(mask, square, wall)
    disparity = np.where(mask, 2.0, 0.0)
    view, hit = warp.relief(
        np.pad(scene, 8, mode="symmetric")[None], disparity, np.array([-8, -8]), np.zeros(2),
        0.0, np.array([0.0, across]), (40, 40),
    )  # fmt: skip
    shift = round(2.0 * across)
    front = np.roll(mask, shift, 1)
    sure = front & np.roll(front, 2, 1) & np.roll(front, -2, 1)
    np.testing.assert_allclose(view[0][sure], np.roll(square, shift, 1)[sure], atol=1e-6)
    np.testing.assert_allclose(hit[sure], 2.0, atol=1e-6)
    clear = ~(front | mask)
    clear &= np.roll(clear, 2, 1) & np.roll(clear, -2, 1)
    np.testing.assert_allclose(view[0][clear], wall[clear], atol=1e-6)


def test_each_depth_has_its_own_defocus(camera, scene):
    """Far from the step the reference unit sees each half as sharp as a plane at its distance."""
    depth = np.full((90, 90), 60.0)
    depth[:, 45:] = 600.0
    unit = camera.design.field.reference
    both, near, far = (
        camera.fields(each)[unit]
        for each in (
            camera.rate(scene, depth=depth),
            camera.rate(scene, distance=60.0),
            camera.rate(scene, distance=600.0),
        )
    )
    apart = np.abs(near - far).mean()
    assert np.abs(both - near)[:, 5:22].mean() < 0.3 * apart
    assert np.abs(both - far)[:, 38:55].mean() < 0.3 * apart


# --- the doll ---------------------------------------------------------------------------------


def test_the_doll_stands_in_its_relief():
    wavelength = np.linspace(500, 750, 26)
    scene, depth = solid_scene(wavelength, 100, distance=200.0, relief=40.0)
    assert scene.shape == (100, 100, 26)
    assert scene.values.min() >= 0
    assert 180 <= depth.min() < 183
    assert 217 < depth.max() <= 220
    again, _ = solid_scene(wavelength, 100)
    np.testing.assert_array_equal(again.values, scene.values)


def test_a_doll_that_cannot_be_is_refused():
    with pytest.raises(InputError, match="relief"):
        solid_scene(np.linspace(500, 750, 26), distance=20.0, relief=60.0)
    with pytest.raises(InputError, match="40 px"):
        solid_scene(np.linspace(500, 750, 26), 20)
