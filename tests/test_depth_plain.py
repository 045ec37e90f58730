"""Plain areas: planted planes in noise, planted bounds, and a plain wall that the twin shows."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from squilla.calibration import plain, surfaces
from squilla.calibration.alignment import measure
from squilla.calibration.rehearsal import poster

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
    together = plain.told_plane(cost, ramps, PLANES)
    assert together is not None
    np.testing.assert_allclose(together, truth, atol=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_noise_tells_no_plane(ramps, seed):
    """Nor do the edges around, which come in from both sides and leave a smooth valley."""
    cost = faint_cost(np.zeros(ramps.shape[1]), 0.0, np.random.default_rng(seed))
    assert plain.told_plane(cost, ramps, PLANES) is None
    valley = (0.002 * (PLANES - 3.5) ** 2).astype(np.float32)
    assert plain.told_plane(cost + valley, ramps, PLANES) is None


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


def test_only_plain_areas_are_filled():
    """A silent disc on a wall takes the wall's disparity, and not that of its nearer half rim."""
    y, x = np.mgrid[:60, :60]
    radius = np.hypot(y - 30, x - 30)
    rough = np.where((radius > 15) & (x > 30), 2.5, 2.0).astype(np.float32)
    evidence = np.where(radius > 15, 500.0, 0.0)
    rough[radius <= 15] = np.random.default_rng(1).uniform(0, 6, (radius <= 15).sum())
    cost = np.full((60, 60, 41), 0.3, np.float32)
    believed = surfaces.trusted(np.where(x > 30, 2.5, 2.0), evidence)
    filled, trust = plain.fill_plain(rough, believed, evidence, cost, PLANES, 0 * rough)
    inside = radius < 11
    assert np.abs(filled[inside] - 2.0).max() < 0.15
    assert (trust[inside] == 1).all()
    outside = radius > 22
    np.testing.assert_array_equal(filled[outside], rough[outside])
    np.testing.assert_array_equal(trust[outside], believed[outside].astype(np.float32))


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
    error = measurement.disparity.numpy() - 0.7 * camera.design.focal / 150.0
    assert np.mean(np.abs(error[plain_wall]) < 0.1) > 0.9
    assert measurement.depth is not None
    assert measurement.depth.confident.numpy()[plain_wall].mean() < 0.2
