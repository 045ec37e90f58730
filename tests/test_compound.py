"""The compound model: exact posteriors, averaging that knows its noise, and what it learns from."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, norm

from random_camera import smooth_camera
from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.priors import natural_spectra
from squilla.reconstruction.compound import Compound
from squilla.reconstruction.evidence import (
    TOLD,
    Camera,
    View,
    _telling,
    coarser,
    inherit,
    kinship,
    noise_factor,
)
from squilla.reconstruction.models import load_model
from squilla.reconstruction.prior import Estimators, Prior, broad_prior, fit_mixture, line_sheet
from squilla.spectra import CHART_LIGHT, grid, lights
from squilla.training.compound import Recipe, Studio, from_checkpoint, misaligned, train_compound
from squilla.training.noise import add_noise
from squilla.training.prior import Palette, draw_scenes

CAMERA = smooth_camera(0, filters=20, bands=126)


@pytest.fixture(scope="module")
def model():
    return load_model("compound", CAMERA)


def two_colours(size=48, seed=0):
    """Return a picture of two natural spectra, left and right."""
    spectra = natural_spectra(2, CAMERA.wavelength, generator=torch.Generator().manual_seed(seed))
    return spectra[(torch.arange(size) >= size // 2).long()].expand(size, -1, -1).contiguous()


# --- the prior and its posteriors ---------------------------------------------------------------


def tiny_prior(clusters, size=5):
    random = np.random.default_rng(3)
    mean = torch.from_numpy(random.uniform(0.5, 1.5, (clusters, size)))
    root = torch.from_numpy(random.normal(0, 0.4, (clusters, size, size)))
    return Prior(
        np.linspace(500, 750, size),
        torch.eye(size, dtype=torch.float64),
        torch.eye(size, dtype=torch.float64),
        torch.full((clusters,), 1 / clusters, dtype=torch.float64),
        mean,
        root @ root.mT + 0.05 * torch.eye(size, dtype=torch.float64),
        clusters,
    )


@pytest.mark.parametrize("clusters", [1, 3])
def test_the_mixture_is_bayes_theorem(clusters):
    """Beside the textbook's conditional mean and covariance, and scipy's densities."""
    prior = tiny_prior(clusters)
    random = np.random.default_rng(4)
    seen = torch.from_numpy(random.uniform(0, 1, (4, 5)))
    amplitude = torch.full((5,), 0.2, dtype=torch.float64)
    noise, y = 0.01, torch.from_numpy(random.uniform(1, 4, (1, 4)))
    mean, variance, _ = Estimators(seen, amplitude, 4, prior).mixture(
        y.float(), torch.tensor([noise])
    )
    likely, means, squares = [], [], []
    for centre, spread in zip(prior.mean, prior.covariance, strict=True):
        unit = 1 / float(centre @ amplitude)
        centre = centre * unit
        spread = spread * unit**2 + 0.01 * torch.outer(centre, centre)
        among = seen @ spread @ seen.T + noise * torch.eye(4)
        likely.append(multivariate_normal((seen @ centre).numpy(), among.numpy()).pdf(y[0].numpy()))
        gain = spread @ seen.T @ torch.linalg.inv(among)
        means.append(centre + gain @ (y[0] - seen @ centre))
        squares.append((spread - gain @ seen @ spread).diagonal() + means[-1].square())
    weight = torch.tensor(likely) / sum(likely)
    expected = (weight[:, None] * torch.stack(means)).sum(0)
    torch.testing.assert_close(mean[0].double(), expected, rtol=1e-3, atol=1e-3)
    expected_variance = (weight[:, None] * torch.stack(squares)).sum(0) - expected.square()
    torch.testing.assert_close(variance[0].double(), expected_variance, rtol=0.02, atol=1e-4)


def test_the_linear_estimate_is_the_textbooks():
    prior = tiny_prior(1)
    seen = torch.rand(4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    y = torch.rand(3, 4, generator=torch.Generator().manual_seed(2))
    found = Estimators(seen, torch.ones(5).double(), 4, prior).wiener(y, torch.full((3,), 0.1), 5)
    moment = prior.moment * 4 / (seen @ prior.moment @ seen.T).trace()
    gain = moment @ seen.T @ torch.linalg.inv(seen @ moment @ seen.T + 0.1 * torch.eye(4))
    torch.testing.assert_close(found.double(), y.double() @ gain.T, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("fwhm", [6.0, 15.0, 28.0])
def test_single_lines_are_found_to_a_nanometre(fwhm):
    """By the prior alone; pieces of the sheet stay away from other spectra."""
    prior = broad_prior()
    wavelength = prior.wavelength
    camera = Camera(smooth_camera(0, filters=30).sensitivities, prior)
    response = smooth_camera(0, filters=30).sensitivities[0]
    centre = torch.linspace(520, 730, 43, dtype=torch.float64)[:, None]
    spectra = (-4 * np.log(2) * ((torch.from_numpy(wavelength) - centre) / fwhm) ** 2).exp()
    few = natural_spectra(200, wavelength, generator=torch.Generator().manual_seed(2))
    projected = torch.cat([spectra.float(), few]) @ response.T @ camera.project
    shape = projected[:, :-1] / projected[:, -1:]
    noise = torch.full((len(shape),), 2e-5)
    (zone,) = camera.zones
    mean, _, _ = zone.mixture(shape, noise)
    found = (mean[:43].double() @ prior.basis.T).argmax(1)
    off = torch.from_numpy(wavelength)[found] - centre[:, 0]
    assert off.abs().max() <= 1.5
    assert off.abs().mean() < 0.6
    near = zone.near(shape, noise)
    assert near[:43].any(1).all()
    assert near[:43].sum(1).max() < 40
    assert near[43:].any(1).float().mean() < 0.1


def test_no_lines_are_looked_for_between_bands_that_are_far_apart():
    middle, spread = line_sheet(np.arange(500.0, 751, 25), torch.eye(11, dtype=torch.float64))
    assert middle.shape == (0, 11)
    assert spread.shape == (0, 11, 11)


def test_expectation_maximisation_finds_planted_clusters():
    random = torch.Generator().manual_seed(0)
    points = torch.randn(3000, 2, generator=random, dtype=torch.float64) * 0.2
    points[:1000] += torch.tensor([3.0, 0.0])
    points[1000:] += torch.tensor([0.0, 2.0])
    share, mean, covariance = fit_mixture(points, 2)
    order = share.argsort()
    sizes = torch.tensor([1 / 3, 2 / 3]).double()
    torch.testing.assert_close(share[order], sizes, atol=0.01, rtol=0)
    planted = torch.tensor([[3.0, 0.0], [0.0, 2.0]]).double()
    torch.testing.assert_close(mean[order], planted, atol=0.03, rtol=0)
    spread = covariance.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(spread, torch.full((2, 2), 0.04).double(), atol=0.01, rtol=0)


def test_the_prior_survives_its_file():
    prior = broad_prior()
    again = Prior.from_tensors(prior.tensors())
    torch.testing.assert_close(again.covariance, prior.covariance)
    assert (torch.linalg.eigvalsh(prior.covariance) > -1e-4).all()


# --- averaging ----------------------------------------------------------------------------------


def test_telling_apart_is_the_likelihood_ratio():
    camera = Camera(CAMERA.sensitivities, broad_prior().on(CAMERA.wavelength))
    noise, difference = 0.02, torch.linspace(-0.5, 0.5, TOLD)
    scale, against = _telling(torch.tensor(noise), camera)
    found = float((difference.square() * scale).sum() - against)
    wide = np.sqrt(noise + 2 * camera.power.numpy())
    expected = norm.logpdf(difference, 0, wide) - norm.logpdf(difference, 0, np.sqrt(noise))
    assert found == pytest.approx(expected.sum(), rel=1e-4)


def test_coarser_cells_show_what_most_of_them_show():
    """Three of four cells of one colour: their weighted mean, as sure as they are together."""
    camera = Camera(CAMERA.sensitivities, broad_prior().on(CAMERA.wavelength))
    projected = CAMERA.project(two_colours(8))[0, [0, 7]] @ camera.project
    one, other = projected[:, :-1] / projected[:, -1:]
    random = torch.Generator().manual_seed(0)
    shape = one + 1e-4 * torch.randn(1, 4, 4, 32, generator=random)
    shape[0, 0, 1] = other
    noise = 1e-6 * (1 + torch.rand(1, 4, 4, generator=random))
    view = coarser(View(shape, noise, 2 * torch.ones(1, 4, 4)), camera)
    weight = 1 / noise
    weight[0, 0, 1] = 0
    weight = weight[0, :2, :2, None]
    expected = (shape[0, :2, :2] * weight).sum((0, 1)) / weight.sum()
    torch.testing.assert_close(view.shape[0, 0, 0], expected, rtol=0, atol=1e-5)
    assert float(view.noise[0, 0, 0] * weight.sum()) == pytest.approx(1, rel=0.02)
    torch.testing.assert_close(view.amplitude, 2 * torch.ones(1, 2, 2))


def test_shares_sum_to_one_and_a_flat_picture_stays():
    camera = Camera(CAMERA.sensitivities, broad_prior().on(CAMERA.wavelength))
    fine = View(torch.ones(1, 8, 8, 32), torch.full((1, 8, 8), 0.01), torch.ones(1, 8, 8))
    kin, alone = kinship(fine, fine, coarser(fine, camera), camera)
    torch.testing.assert_close(kin.sum(-1), torch.ones(1, 8, 8))
    assert (alone < 0).all()  # sixteen times more is known of the four together
    coarse = torch.full((1, 4, 4, 3), 2.5)
    torch.testing.assert_close(inherit(kin, coarse), torch.full((1, 8, 8, 3), 2.5))


def test_each_side_of_an_edge_takes_from_its_own():
    camera = Camera(CAMERA.sensitivities, broad_prior().on(CAMERA.wavelength))
    projected = CAMERA.project(two_colours(8))[None] @ camera.project
    amplitude = projected[..., -1]
    fine = View(projected[..., :-1] / amplitude[..., None], torch.full((1, 8, 8), 1e-3), amplitude)
    kin, _ = kinship(fine, fine, coarser(fine, camera), camera)
    label = (torch.arange(4) >= 2).float().expand(1, 4, -1)[..., None]
    mixed = inherit(kin, label.contiguous())[0, ..., 0]
    assert (mixed[:, :4] < 1e-3).all()
    assert (mixed[:, 4:] > 1 - 1e-3).all()


@pytest.mark.parametrize("wrong", [-6.0, 0.0, 6.0])
def test_noise_that_is_stated_wrong_is_measured(wrong):
    camera = Camera(CAMERA.sensitivities, broad_prior().on(CAMERA.wavelength))
    generator = torch.Generator().manual_seed(1)
    y = add_noise(CAMERA.project(two_colours()), 20.0, generator)[None]
    stated = torch.full(y.shape[:-1], 10 ** (-(20.0 + wrong) / 10))
    factor = float(noise_factor(y, stated, camera))
    assert 10 * np.log10(factor) == pytest.approx(wrong, abs=0.5)


# --- the model ----------------------------------------------------------------------------------


@torch.no_grad()
def test_neighbours_help(model):
    truth = two_colours()
    y = add_noise(CAMERA.project(truth), 20.0, torch.Generator().manual_seed(5))
    together = (model(y, snr=20.0) - truth).square().mean()
    alone = (model(y.reshape(-1, 20), snr=20.0).view(truth.shape) - truth).square().mean()
    assert together < alone / 3


@torch.no_grad()
def test_edges_stay_where_they_are(model):
    truth = two_colours()
    y = add_noise(CAMERA.project(truth), 30.0, torch.Generator().manual_seed(5))
    error = (model(y, snr=30.0) - truth).square().mean((0, 2))
    assert error[23:25].max() < 5 * error.mean() + 1e-4


@torch.no_grad()
def test_a_shifted_scene_is_a_shifted_cube(model):
    """By 16 px, the size of the coarsest cell; away from the border."""
    generator = torch.Generator().manual_seed(2)
    y = add_noise(CAMERA.project(two_colours(112)), 25.0, generator)
    x, moved = model(y[:96, :96], snr=25.0), model(y[16:112, :96], snr=25.0)
    inner = slice(40, 56)
    torch.testing.assert_close(x[56:72, inner], moved[inner, inner], rtol=0.05, atol=0.02)


@torch.no_grad()
def test_holes_in_a_picture_do_not_spread(model):
    y = CAMERA.project(two_colours(32))
    y[10, 10] = torch.nan
    y[20, 5] = 0
    x = model(y)
    assert x[10, 10].isnan().all()
    assert (x[20, 5] == 0).all()
    assert x.isfinite().all(-1).sum() == 32 * 32 - 1


def test_a_dead_channel_is_a_camera_without_it(model):
    y = add_noise(CAMERA.project(two_colours(32)), 25.0, torch.Generator().manual_seed(1))
    valid = torch.ones(y.shape, dtype=torch.bool)
    valid[..., 7] = False
    broken = torch.where(valid, y, 1e4)
    flat = torch.zeros(32, 32)
    cube = model.reconstruct(Measurement(broken, valid, flat, flat, torch.full((32, 32), 25.0)))
    rest = np.arange(20) != 7
    other = Calibration.from_sensitivity(CAMERA.sensitivity[0, rest], CAMERA.wavelength)
    with torch.no_grad():
        expected = load_model("compound", other)(y[..., rest], snr=25.0)
    np.testing.assert_allclose(cube.values, expected, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_pixels_in_a_corner_meet_the_corners_sensitivity():
    tilted = smooth_camera(0, filters=20, bands=126, angles=5)
    model = load_model("compound", tilted)
    field = float(tilted.angle[-1])
    truth = two_colours(32)
    y = tilted.project(truth, torch.full((32, 32), field))
    alone = Calibration.from_sensitivity(tilted.sensitivity[-1], tilted.wavelength)
    expected = load_model("compound", alone)(y, snr=40.0)
    found = model(y, torch.full((32, 32), field), 40.0)
    error, least = ((x - truth).square().mean() for x in (found, expected))
    assert error < 1.5 * least + 1e-5


@torch.no_grad()
def test_the_interval_is_wide_where_the_camera_is_blind(model):
    response = CAMERA.sensitivity[0] * (CAMERA.wavelength < 640)
    blind = load_model("compound", Calibration.from_sensitivity(response, CAMERA.wavelength))
    generator = torch.Generator().manual_seed(3)
    hidden, widths = CAMERA.wavelength > 680, []
    for one in (model, blind):
        y = add_noise(one.calibration.project(two_colours()), 30.0, generator)
        x, width = one.with_interval(y, snr=30.0)
        assert x.shape == width.shape == (48, 48, 126)
        widths.append(float(width[..., hidden].mean()))
    assert widths[1] > 1.5 * widths[0]


@torch.no_grad()
def test_more_noise_is_a_wider_interval(model):
    generator = torch.Generator().manual_seed(3)
    widths = []
    for snr in (10.0, 20.0, 35.0):
        y = add_noise(CAMERA.project(two_colours()), snr, generator)
        widths.append(float(model.with_interval(y, snr=snr)[1].mean()))
    assert widths[0] > widths[1] > widths[2]


# --- what it is trained on ----------------------------------------------------------------------


def test_a_scene_measures_as_its_cube():
    palette = Palette(grid(), count=50)
    scenes = draw_scenes(2, 32, palette, torch.Generator().manual_seed(0))
    response = torch.rand(9, 251, generator=torch.Generator().manual_seed(1))
    pixels = torch.tensor([[0, 500, 1023], [7, 31, 600]])
    expected = scenes.cubes(pixels) @ response.T
    measured = scenes.measured(response).flatten(1, 2)
    found = measured.gather(1, pixels[..., None].expand(-1, -1, 9))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert (expected >= 0).all()


def test_nobody_trains_on_what_is_held_out():
    trained, held = Palette(grid(), count=10), Palette(grid(), count=10, held_out=True)
    for one, other in ((trained.surface, held.surface), (trained.lamp, held.lamp)):
        assert len(other) > 50
        # A few lamps stand in the tables twice, under two names.
        assert (torch.cdist(other, one).amin(1) > 1e-3).float().mean() > 0.9
    chart_light = torch.from_numpy(lights()[CHART_LIGHT]).float()
    assert torch.cdist(chart_light[None], trained.lamp).min() > 0


def test_misalignment_moves_channels_by_what_it_says():
    """A ramp of slope one changes by the displacement."""
    ramp = torch.arange(40.0).expand(1, 40, 40)[..., None].expand(-1, -1, -1, 400)
    moved = misaligned(ramp.contiguous(), 0.3, torch.Generator().manual_seed(0))
    by = (moved - ramp)[0, 20, 20]
    assert float(by.std()) == pytest.approx(0.3, rel=0.1)
    assert abs(float(by.mean())) < 0.05


def test_an_interrupted_training_goes_on(tmp_path, monkeypatch):
    files = {"checkpoint": tmp_path / "run.checkpoint", "log": tmp_path / "log"}
    recipe = Recipe(steps=4, scenes=2, cameras=1)
    setting = {"recipe": recipe, "prior": broad_prior().on(CAMERA.wavelength), "progress": False}
    straight = train_compound(CAMERA, **setting)
    take = Studio.take

    def take_twice(self, step, *rest):
        if step == 2:
            raise KeyboardInterrupt
        return take(self, step, *rest)

    monkeypatch.setattr("squilla.training.compound.CHECKPOINT_EVERY", 2)
    with monkeypatch.context() as patch:
        patch.setattr(Studio, "take", take_twice)
        with pytest.raises(KeyboardInterrupt):
            train_compound(CAMERA, **setting, **files)
    resumed = train_compound(CAMERA, **setting, **files)
    for key, value in straight.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[key]), key
    assert len(files["log"].read_text().splitlines()) == 2
    assert isinstance(resumed, Compound)
    whole = files["checkpoint"].read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"no checkpoint"):
        files["checkpoint"].write_bytes(content)
        with pytest.raises(InputError, match="not a checkpoint"):
            train_compound(CAMERA, **setting, **files)
        with pytest.raises(InputError, match="not a checkpoint"):
            from_checkpoint(files["checkpoint"], setting["prior"])


def test_a_checkpoint_serves_only_the_cameras_that_it_was_trained_for(tmp_path):
    setting = {"recipe": Recipe(steps=1, scenes=1, cameras=1), "progress": False}
    setting |= {"prior": broad_prior().on(CAMERA.wavelength), "checkpoint": tmp_path / "one"}
    train_compound(CAMERA, **setting)
    other = Calibration.from_sensitivity(1.1 * CAMERA.sensitivity, CAMERA.wavelength, CAMERA.angle)
    with pytest.raises(InputError, match="checkpoint of another training"):
        train_compound(other, **setting)


def test_few_bands_are_refused_before_anything_is_learnt():
    camera = Calibration.from_sensitivity(np.ones((8, 26)), np.linspace(500, 750, 26))
    with pytest.raises(InputError, match="needs 32 bands or more, not 26"):
        train_compound(camera)
