"""Sparse recovery against brute force, scikit-learn and SciPy, and its gap against the optimum."""

from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from sklearn.linear_model import Lasso

from random_camera import smooth_camera
from squilla.calibration.calibration import Calibration
from squilla.priors import broad_spectra
from squilla.reconstruction.active_set import nonnegative_lasso
from squilla.reconstruction.sparse import (
    NonNegative,
    Sparse,
    gaussian_lines,
    two_step,
)


@pytest.fixture(scope="module")
def camera():
    return smooth_camera(1)


def measured(camera, count, snr, seed=0):
    generator = torch.Generator().manual_seed(seed)
    y = camera.project(broad_spectra(count, camera.wavelength, generator=generator))
    deviation = y.square().mean(-1, keepdim=True).sqrt() * 10 ** (-snr / 20)
    return y + deviation * torch.randn(y.shape, generator=generator)


def objective(matrix, y, heights, weight):
    return ((y - matrix @ heights) ** 2).sum() / 2 + weight * heights.sum()


def lasso(matrix, y, weight, tolerance, steps):
    model = Lasso(
        alpha=weight / len(y), positive=True, fit_intercept=False, tol=tolerance, max_iter=steps
    )
    return model.fit(matrix, y).coef_


def recover(matrix, y, ratio, tolerance=1e-12):
    """Solve for one matrix, (M, atoms), and pixels, (N, M); return heights and gaps."""
    return nonnegative_lasso(np.ascontiguousarray(matrix)[None], y, ratio, tolerance=tolerance)


def test_orthonormal_atoms_are_soft_thresholded():
    random = np.random.default_rng(0)
    matrix, _ = np.linalg.qr(random.normal(size=(8, 8)))
    y = random.normal(size=(40, 8))
    heights, _ = recover(matrix, y, 0.3)
    correlation = y @ matrix
    weight = 0.3 * correlation.max(-1, keepdims=True)
    np.testing.assert_allclose(heights, np.maximum(correlation - weight, 0), atol=1e-12)


@pytest.mark.parametrize("filters", [2, 4])
def test_brute_force_over_all_active_sets(filters):
    """Every subset of atoms is tried; the best feasible one is the optimum."""
    random = np.random.default_rng(filters)
    matrix = random.uniform(size=(filters, 7))
    y = random.normal(size=(30, filters)) + 0.5
    ratio = 0.05
    heights, gap = recover(matrix, y, ratio)
    for pixel in range(len(y)):
        weight = ratio * (matrix.T @ y[pixel]).max()
        if weight <= 0:
            assert not heights[pixel].any()
            continue
        best = objective(matrix, y[pixel], np.zeros(7), weight)
        for size in range(1, filters + 1):
            for subset in map(list, combinations(range(7), size)):
                part = matrix[:, subset]
                trial = np.zeros(7)
                trial[subset] = np.linalg.solve(part.T @ part, part.T @ y[pixel] - weight)
                if trial.min() >= 0:
                    best = min(best, objective(matrix, y[pixel], trial, weight))
        found = objective(matrix, y[pixel], heights[pixel], weight)
        assert found == pytest.approx(best, rel=1e-9)
        assert gap[pixel] < 1e-9


def test_scikit_learn_finds_the_same_objective():
    random = np.random.default_rng(7)
    matrix = random.normal(size=(36, 60))
    y = random.normal(size=(1000, 36))
    heights, gap = recover(matrix, y, 0.1)
    assert gap.max() < 1e-9
    for pixel in range(len(y)):
        weight = 0.1 * (matrix.T @ y[pixel]).max()
        reference = lasso(matrix, y[pixel], weight, 1e-10, 20_000)
        own = objective(matrix, y[pixel], heights[pixel], weight)
        assert own == pytest.approx(objective(matrix, y[pixel], reference, weight), rel=1e-6)


@pytest.mark.filterwarnings("ignore:Objective did not converge")
@pytest.mark.parametrize("snr", [15, 30])
def test_scikit_learn_finds_no_lower_objective(camera, snr):
    """Coordinate descent creeps among the nearly equal atoms of a camera, so it ends above."""
    model = Sparse(camera, tolerance=1e-9)
    y = measured(camera, 300, snr)
    decibel = torch.full((len(y),), float(snr))
    heights, gap = model.heights(y, None, decibel)
    assert heights.min() >= 0
    assert gap.max() <= 1e-9
    ratio = model.ratio(decibel, len(y))
    matrix = model.rows[-1]
    for pixel in range(len(y)):
        target = y[pixel].double().numpy()
        weight = ratio[pixel] * (matrix.T @ target).max()
        reference = lasso(matrix, target, weight, 1e-3, 300)
        own = objective(matrix, target, heights[pixel].numpy(), weight)
        assert own <= objective(matrix, target, reference, weight) * (1 + 1e-6)


def test_the_gap_bounds_the_distance_to_the_optimum(camera):
    y = measured(camera, 300, 25)
    exact, _ = Sparse(camera, tolerance=1e-12).heights(y)
    rough = Sparse(camera, tolerance=0.2)
    heights, gap = rough.heights(y)
    assert 1e-3 < gap.max() <= 0.2
    matrix = rough.rows[-1]
    for pixel in range(len(y)):
        target = y[pixel].double().numpy()
        weight = rough.ratio(None, 1)[0] * (matrix.T @ target).max()
        best = objective(matrix, target, exact[pixel].numpy(), weight)
        own = objective(matrix, target, heights[pixel].numpy(), weight)
        assert best <= own * (1 + 1e-12)
        assert own - best <= float(gap[pixel]) * own + 1e-12 * own


@pytest.mark.parametrize("filters", [1, 3])
def test_more_lines_fit_than_there_are_filters(filters):
    """With few filters every active set is full, and atoms have to be exchanged."""
    model = Sparse(smooth_camera(2, filters=filters))
    _, gap = model.heights(measured(model.calibration, 200, 50))
    assert gap.max() <= model.tolerance


def test_nonnegative_least_squares_is_scipys(camera):
    model = NonNegative(camera)
    y = measured(camera, 100, 20)
    heights, _ = model.heights(y)
    matrix = model.rows[-1]
    for pixel in range(len(y)):
        target = y[pixel].double().numpy()
        residual = np.linalg.norm(target - matrix @ heights[pixel].numpy())
        assert residual == pytest.approx(nnls(matrix, target, maxiter=5000)[1], rel=1e-6)


def test_two_step_reaches_the_same_optimum():
    random = np.random.default_rng(3)
    matrix, y = random.uniform(size=(12, 30)), random.uniform(size=(40, 12))
    best, _ = recover(matrix, y, 0.05)
    heights, gap = two_step(torch.from_numpy(matrix), torch.from_numpy(y), 0.05, 1e-4)
    assert gap.max() <= 1e-4
    for pixel in range(len(y)):
        weight = 0.05 * (matrix.T @ y[pixel]).max()
        lowest = objective(matrix, y[pixel], best[pixel], weight)
        own = objective(matrix, y[pixel], heights[pixel].numpy(), weight)
        assert lowest * (1 - 1e-9) <= own <= lowest * (1 + 1.1e-4)


def test_two_step_never_ascends(camera):
    matrix = torch.from_numpy(Sparse(camera).rows[-1])
    y = measured(camera, 5, 20).double()
    weight = 1e-3 * (y @ matrix).amax(-1)
    values = []
    for steps in range(1, 30):
        heights, _ = two_step(matrix, y, 1e-3, 0.0, most=steps)
        values.append((y - heights @ matrix.T).square().sum(-1) / 2 + weight * heights.sum(-1))
    assert (torch.stack(values).diff(dim=0) <= 1e-12).all()


def test_a_line_is_found_where_it_is(camera):
    wavelength = camera.wavelength
    centre = np.array([540.0, 600.0, 700.0])
    line = np.exp(-4 * np.log(2) * ((wavelength - centre[:, None]) / 4) ** 2)
    spectrum = Sparse(camera)(camera.project(torch.from_numpy(line).float()), snr=40.0)
    np.testing.assert_allclose(wavelength[spectrum.argmax(-1)], centre, atol=2)


def test_every_pixel_uses_the_sensitivity_of_its_angle():
    camera = smooth_camera(1, angles=5)
    angle = torch.linspace(float(camera.angle[0]), float(camera.angle[-1]), 60)
    generator = torch.Generator().manual_seed(0)
    spectra = broad_spectra(60, camera.wavelength, generator=generator)
    y = camera.project(spectra, angle)
    model = Sparse(camera)
    misfit = {}
    for name, given in (("own", angle), ("none", None)):
        rest = camera.project(model(y, given, 60.0), angle) - y
        misfit[name] = float(rest.norm() / y.norm())
    assert misfit["own"] < 0.5 * misfit["none"]


def test_lines_that_no_filter_sees_are_not_found(camera):
    response = camera.sensitivity[0].copy()
    response[:, 125:] = 0
    blind = Calibration.from_sensitivity(response, camera.wavelength)
    model = Sparse(blind)
    y = measured(blind, 20, 30)
    heights, _ = model.heights(y)
    unseen = np.linalg.norm(model.columns[-1], axis=-1) < 1e-9
    assert unseen.sum() > 50
    assert (heights[:, unseen] == 0).all()
    assert model(y).isfinite().all()


def test_threads_and_pieces_make_no_difference(camera):
    model = Sparse(camera)
    y = measured(camera, 1200, 20).double().numpy()
    one, _ = nonnegative_lasso(model.rows[-1:], y, 1e-3)
    two, _ = nonnegative_lasso(model.rows[-1:], y, 1e-3, threads=3)
    last, _ = nonnegative_lasso(model.rows[-1:], y[-1:], 1e-3)
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one[-1:], last)


def test_coarse_grids_have_no_line_between_their_bands():
    assert len(gaussian_lines(np.linspace(500, 750, 251))) == 339
    coarse = gaussian_lines(np.linspace(400, 700, 31))
    assert coarse.max(-1).min() > 0.4
    assert gaussian_lines(np.array([550.0])).shape == (1, 1)
