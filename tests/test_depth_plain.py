"""Plain areas: planted planes in noise, planted bounds, and a plain wall that the twin shows."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from squilla.calibration import plain, surfaces
from squilla.calibration.alignment import measure
from squilla.calibration.rehearsal import poster


def true_disparity(camera, depth):
    middle = slice((len(depth) - 60) // 2, (len(depth) + 60) // 2)
    return 0.7 * camera.design.focal / depth[middle, middle]


PLANES = np.linspace(0, 6, 41)


@pytest.fixture
def ramps():
    rows, columns = np.mgrid[-1:1:100j, -1:1:120j]
    return np.stack([np.ones(rows.size), rows.ravel(), columns.ravel()])


def faint_cost(truth: np.ndarray, depth: float, random) -> np.ndarray:
    """Costs that dip by `depth` at the true disparity, under noise that hides it in each point."""
    dip = depth * np.exp(-(((PLANES - truth[:, None]) / 0.4) ** 2) / 2)
    noise = gaussian_filter1d(random.standard_normal(dip.shape), 2, axis=1)
    return (0.3 - dip + 0.03 * noise / noise.std()).astype(np.float32)


def test_faint_texture_adds_up_to_a_plane(ramps):
    truth = np.array([3.1, 0.12, -0.2]) @ ramps
    cost = faint_cost(truth, 0.015, np.random.default_rng(0))
    alone = np.abs(PLANES[cost.argmin(1)] - truth) < 0.2
    assert alone.mean() < 0.2  # no point knows
    together = plain.told_plane(cost, ramps, PLANES, lean=0.05)
    assert together is not None
    np.testing.assert_allclose(together @ ramps, truth, atol=0.1)


@pytest.mark.parametrize("distance", [3.0, 3.03, 3.075, 3.12])
def test_a_plane_is_told_between_those_that_were_tried(ramps, distance):
    """They are 0.15 apart, and the one nearest to the truth is no better than any other."""
    truth = np.full(ramps.shape[1], distance)
    cost = faint_cost(truth, 0.015, np.random.default_rng(2))
    together = plain.told_plane(cost, ramps, PLANES, lean=0.001)
    assert together is not None
    assert abs(together[0] - distance) < 0.02


def test_few_points_lean_less_than_many(ramps):
    """Slants that the noise makes are shrunk to what is to be expected."""
    slants = []
    for count in (400, 12000):
        some = np.random.default_rng(0).choice(ramps.shape[1], count, replace=False)
        truth = np.array([3.0, 0.2, 0.0]) @ ramps[:, some]
        cost = faint_cost(truth, 0.015, np.random.default_rng(1))
        told = plain.told_plane(cost, ramps[:, some], PLANES, lean=0.01)
        assert told is not None
        slants.append(told[1])
    assert abs(slants[0]) < slants[1] < 0.25
    assert slants[1] > 0.12


@pytest.mark.parametrize("seed", range(5))
def test_noise_tells_no_plane(ramps, seed):
    """Nor do the edges around, which come in from both sides and leave a smooth valley."""
    cost = faint_cost(np.zeros(ramps.shape[1]), 0.0, np.random.default_rng(seed))
    assert plain.told_plane(cost, ramps, PLANES, lean=0.05) is None
    valley = (0.002 * (PLANES - 3.5) ** 2).astype(np.float32)
    assert plain.told_plane(cost + valley, ramps, PLANES, lean=0.05) is None


def test_the_bounding_plane_lies_behind_what_bounds():
    """Half of the rim is the slanted wall itself, half are nearer things before it."""
    random = np.random.default_rng(3)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ramps = np.stack([np.ones(200), np.sin(angle), np.cos(angle)])
    slanted = np.array([3.0, 0.05, -0.08])
    nearer = np.where(np.arange(200) % 10 < 5, random.uniform(0.1, 0.6, 200), 0)
    bounds = slanted @ ramps + nearer + random.normal(0, 0.01, 200)
    np.testing.assert_allclose(plain.bounding_plane(bounds, ramps), slanted, atol=0.03)
    bounds[::25] -= 1.0  # few are wrong
    np.testing.assert_allclose(plain.bounding_plane(bounds, ramps), slanted, atol=0.06)
    step = np.where(ramps[2] > 0, 2.5, 2.0)  # a nearer thing on one side is not taken for a slant
    np.testing.assert_allclose(plain.bounding_plane(step, ramps), [2, 0, 0], atol=0.06)


def disc_before(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A plain disc before a pattern, seen by a blurring lens: its mask and its noisy picture."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[:80, :80]
    disc = np.hypot(y - 40, x - 40) < 22
    pattern = gaussian_filter(random.standard_normal(disc.shape), 1.5)
    picture = gaussian_filter(np.where(disc, 0.5, 1 + 0.3 * pattern / pattern.std()), 1.0)
    return disc, picture + noise * random.standard_normal(disc.shape)


def test_a_plain_area_ends_where_the_picture_is_steepest():
    """And not where the blur of its edge sinks into the noise."""
    disc, picture = disc_before(noise=0.02)
    (area,) = plain.plain_areas(picture, 0.02, np.zeros(disc.shape))
    whole = np.zeros_like(disc)
    whole[area.around] = area.whole
    assert (whole ^ disc).sum() < 2 * np.pi * 22 * 0.9  # less than a pixel around
    assert (disc[area.around] & area.clear).sum() == area.clear.sum()
    assert area.clear.sum() < 0.75 * disc.sum()


def test_what_each_point_can_tell_is_not_plain():
    disc, picture = disc_before(noise=0.02)
    assert not plain.plain_areas(picture, 0.02, np.full(disc.shape, 100.0))


@pytest.mark.parametrize(("side", "apart"), [(80, 5), (30, 2)])
def test_areas_keep_as_far_from_edges_as_they_can_afford(side, apart):
    inside = np.zeros((100, 100), bool)
    inside[8 : 8 + side, 8 : 8 + side] = True
    picture = np.where(inside, 0.5, np.random.default_rng(2).uniform(0, 2, inside.shape))
    (area,) = plain.plain_areas(picture, 0.001, np.zeros(inside.shape))
    rows, columns = (np.nonzero(area.clear)[axis] + area.around[axis].start for axis in (0, 1))
    nearest = min(
        rows.min() - 8, columns.min() - 8, 7 + side - rows.max(), 7 + side - columns.max()
    )
    blur = 4 * 1.35  # of the picture's gradient, in which SciPy cuts the Gaussian
    assert apart + 1 <= nearest <= apart + blur + 2


def test_only_plain_areas_are_filled():
    """A silent disc on a wall takes the wall's disparity, and not that of its nearer half rim."""
    disc, picture = disc_before(noise=0.02)
    nearer = ~disc & (np.arange(80) > 40)
    rough = np.where(nearer, 2.5, 2.0).astype(np.float32)
    rough[disc] = np.random.default_rng(1).uniform(0, 6, disc.sum())
    evidence = np.where(disc, 0.0, 500.0)
    cost = np.full((*disc.shape, 41), 0.3, np.float32)
    believed = surfaces.trusted(np.where(nearer, 2.5, 2.0), evidence)
    areas = plain.plain_areas(picture, 0.02, evidence)
    found, trust, filled = plain.fill_plain(
        rough, believed, cost, PLANES, 0 * rough, areas, focal=1000.0
    )
    inside = filled > 0
    assert (inside ^ disc).sum() < 2 * np.pi * 22 * 0.9
    assert np.abs(found[inside] - 2.0).max() < 0.15
    assert (trust[inside] == 1).all()
    np.testing.assert_array_equal(found[~inside], rough[~inside])
    np.testing.assert_array_equal(trust[~inside], believed[~inside].astype(np.float32))


def test_nothing_settles_across_the_border_of_an_area():
    """Both sides look alike; yet what is believed on one side says nothing on the other."""
    areas = np.zeros((30, 40), int)
    areas[8:22, 10:30] = 1
    rough = np.where(areas, 3.0, 2.0)
    believed = np.where(areas, 1.0, 0.0)
    believed[:4] = 1.0
    found = surfaces.settled(rough, believed, np.ones(areas.shape), areas)
    np.testing.assert_allclose(found, rough, atol=1e-3)


def test_a_climb_between_surfaces_hardly_counts():
    rough = np.clip(np.linspace(-2, 4, 90), 0, 2) * np.ones((40, 1))  # 0.067 px a px in the middle
    counts = surfaces.trusted(rough, np.full(rough.shape, 500.0))
    assert counts[:, 40:50].max() < 0.1
    assert counts[:, :15].min() > 0.95
    assert counts[:, -15:].min() > 0.95


def test_a_plain_wall_is_as_far_as_its_texture_elsewhere(camera, calibration):
    """The wall has a pattern left and right and none between; there a square stands before it."""
    scene = poster(90, camera.design.wavelength, seed=4)
    scene.values[:, 30:62] = 0.5
    front = poster(90, camera.design.wavelength, seed=5).values[36:54, 38:54]
    depth = np.full((90, 90), 150.0)
    scene.values[36:54, 38:54], depth[36:54, 38:54] = front, 100.0
    noise = torch.Generator().manual_seed(5)
    raw = camera.capture(scene, depth=depth, snr=30.0, generator=noise)
    measurement = measure(raw, calibration, nearest=80.0, depth=True)
    plain_wall = np.zeros((60, 60), bool)
    plain_wall[:, 19:43] = True  # 4 px from its patterns
    plain_wall[18:42, 20:42] = False  # the square, and what lenses blur around it
    error = measurement.disparity.numpy() - true_disparity(camera, np.full((90, 90), 150.0))
    assert np.mean(np.abs(error[plain_wall]) < 0.1) > 0.9
    assert measurement.depth is not None
    assert measurement.depth.confident.numpy()[plain_wall].mean() < 0.2


def test_a_plain_thing_has_its_own_distance_up_to_its_edges(camera, calibration):
    """A card with a texture of 2 % far before a wall; what blurs at its edges tells of both."""
    scene = poster(90, camera.design.wavelength, seed=4)
    grain = gaussian_filter(np.random.default_rng(8).standard_normal((42, 42)), 0.8)
    card = 0.25 * (1 + 0.02 * grain / grain.std())
    depth = np.full((90, 90), 150.0)
    scene.values[24:66, 24:66], depth[24:66, 24:66] = card[..., None], 70.0
    noise = torch.Generator().manual_seed(5)
    raw = camera.capture(scene, depth=depth, snr=25.0, generator=noise)
    measurement = measure(raw, calibration, nearest=60.0, depth=True)
    assert measurement.depth is not None
    error = np.abs(measurement.disparity.numpy() - true_disparity(camera, depth))
    on_card = (depth == 70.0)[15:75, 15:75]
    assert np.median(error[on_card]) < 0.1
    assert np.mean(error[on_card] < 0.2) > 0.95
    beside = np.zeros((60, 60), bool)
    beside[4:56, 4:56] = True
    beside[8:52, 8:52] = False
    assert np.mean(error[beside] < 0.3) > 0.8
    assert measurement.depth.confident.numpy()[on_card].mean() < 0.1
