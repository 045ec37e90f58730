"""The compound model: exact posteriors, averaging that knows its noise, honest intervals."""

import numpy as np
import pytest
import torch
from scipy.stats import cauchy, multivariate_normal, norm

from random_camera import smooth_camera
from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.priors import natural_spectra
from squilla.reconstruction.estimators import Estimators
from squilla.reconstruction.evidence import (
    LEVELS,
    MISFITS,
    SHADED,
    TOLD,
    UNALIKE,
    Brightness,
    Camera,
    View,
    _alike_in_brightness,
    _telling,
    brightened,
    coarser,
    gather_evidence,
    inherit,
    kinship,
    measured_misfit,
    noise_factor,
)
from squilla.reconstruction.interval import unlikeness
from squilla.reconstruction.models import load_model
from squilla.reconstruction.prior import (
    KNOTS,
    Prior,
    around_knots,
    broad_prior,
    fit_mixture,
    line_sheet,
)
from squilla.spectra import CHART_LIGHT, grid, lights
from squilla.training import fit
from squilla.training.fit import train
from squilla.training.noise import add_noise
from squilla.training.prior import LEARNT, Palette, learn_prior

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
        torch.zeros(0, KNOTS, dtype=torch.float64),
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
        squares.append(spread - gain @ seen @ spread + torch.outer(means[-1], means[-1]))
    weight = torch.tensor(likely) / sum(likely)
    expected = (weight[:, None] * torch.stack(means)).sum(0)
    torch.testing.assert_close(mean[0].double(), expected, rtol=1e-3, atol=1e-3)
    whole = (weight[:, None, None] * torch.stack(squares)).sum(0) - torch.outer(expected, expected)
    knots = around_knots(5)
    expected_variance = (knots @ whole @ knots.T).diagonal()
    torch.testing.assert_close(variance[0].double(), expected_variance, rtol=0.02, atol=1e-4)


def test_the_linear_estimate_is_the_textbooks():
    prior = tiny_prior(1)
    seen = torch.rand(4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    y = torch.rand(3, 4, generator=torch.Generator().manual_seed(2))
    found = Estimators(seen, torch.ones(5).double(), 4, prior).wiener(y, torch.full((3,), 0.1), 5)
    moment = prior.moment * 4 / (seen @ prior.moment @ seen.T).trace()
    gain = moment @ seen.T @ torch.linalg.inv(seen @ moment @ seen.T + 0.1 * torch.eye(4))
    torch.testing.assert_close(found.double(), y.double() @ gain.T, rtol=1e-4, atol=1e-5)
    left = Estimators(seen, torch.ones(5).double(), 4, prior).wiener_variance(torch.tensor([0.1]))
    expected = (prior.knots @ (moment - gain @ seen @ moment) @ prior.knots.T).diagonal()
    torch.testing.assert_close(left[0].double(), expected, rtol=0.02, atol=1e-4)


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
    parts = line_sheet(np.arange(500.0, 751, 25), torch.eye(11, dtype=torch.float64))
    assert [len(part) for part in parts] == [0, 0, 0]


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


def test_differences_of_brightness_are_a_likelihood_ratio():
    bright, dark = torch.tensor(3.0), torch.tensor([0.1, 1.0, 2.9, 3.0])
    apart = (2 * (bright - dark) / (bright + dark)).numpy()
    expected = cauchy.pdf(apart, scale=SHADED) / cauchy.pdf(apart, scale=UNALIKE)
    np.testing.assert_allclose(_alike_in_brightness(bright, dark), expected, rtol=1e-5)
    np.testing.assert_allclose(_alike_in_brightness(dark, bright), expected, rtol=1e-5)


def test_telling_counts_only_what_differs_at_one_amplitude():
    """Spectra drawn with the prior's moments: what their amplitude does not explain of them."""
    prior = broad_prior().on(CAMERA.wavelength)
    camera = Camera(CAMERA.sensitivities, prior)
    root = torch.linalg.cholesky(prior.moment + 1e-12 * torch.eye(len(prior.moment)))
    random = torch.Generator().manual_seed(0)
    drawn = torch.randn(40_000, len(root), generator=random, dtype=torch.float64) @ root.T
    seen = drawn @ (CAMERA.sensitivities[0].double() @ prior.basis).T @ camera.project.double()
    amplitude, seen = seen[:, -1:], seen[:, :TOLD]
    left = seen - amplitude * (seen * amplitude).mean(0) / amplitude.square().mean()
    expected = left.var(0) * CAMERA.filters / seen.square().sum(1).mean()
    torch.testing.assert_close(camera.power[1:], expected[1:].float(), rtol=0.05, atol=1e-7)
    assert expected[0] < 1e-3 * expected[1]  # there they are all alike, so it does not count
    assert camera.power[0] == 0


@pytest.mark.parametrize("texture", [0.0, 0.1])
def test_brightness_keeps_texture_and_leaves_noise_out(texture):
    camera = Camera(CAMERA.sensitivities, broad_prior().on(CAMERA.wavelength))
    random = torch.Generator().manual_seed(0)
    variance = 1e-4  # of the brightness
    truth = 2 * (1 + texture * torch.randn(1, 64, 64, generator=random))
    measured = truth * (1 + variance**0.5 * torch.randn(1, 64, 64, generator=random))
    view = View(
        torch.ones(1, 64, 64, 1), torch.full((1, 64, 64), variance * CAMERA.filters), measured
    )
    kin = torch.full((1, 64, 64, 4), 0.25)
    known = Brightness(torch.full((1, 32, 32), 2.0), torch.full((1, 32, 32), variance / 100))
    found = brightened(view, kin, known, camera)
    off = (found.amplitude / truth - 1).square().mean()
    assert off < (1.1 if texture else 0.06) * variance
    assert off < 2 * found.variance.mean() < 6 * off


@torch.no_grad()
def test_brightness_beside_what_was_not_measured_is_as_good(model):
    """At the border, where the picture is filled up, and around holes."""
    truth = two_colours(90)[0, 0].expand(90, 90, -1)
    y = add_noise(CAMERA.project(truth), 20.0, torch.Generator().manual_seed(3))
    holes = torch.zeros(90, 90, dtype=torch.bool)
    holes[8:80:6, 8:80:6] = True
    y[holes] = torch.nan
    off = (model(y, snr=20.0).sum(-1) / truth.sum(-1) - 1).square()
    beside = torch.nn.functional.max_pool2d(holes[None].float(), 3, 1, 1)[0] > 0
    inside = off[:84, :84][~beside[:84, :84]].mean()
    assert inside < 1e-4 / 2  # of a pixel alone it is 5e-4
    assert off[beside & ~holes].mean() < 4 * inside
    assert off[-1].mean() < 4 * inside


@torch.no_grad()
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_single_pixel_keeps_its_brightness(model, factor):
    truth = two_colours(64)[0, 0].expand(64, 64, -1).clone()
    truth[20, 30] *= factor
    y = add_noise(CAMERA.project(truth), 0.0, torch.Generator().manual_seed(3))
    x = model(y, snr=0.0)  # its own amplitude is known to a quarter
    assert float(x[20, 30].sum() / truth[20, 30].sum()) == pytest.approx(1, abs=0.35)


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
def test_a_dark_bar_keeps_its_colour_beside_a_bright_one(model):
    """Their shapes differ by less than the noise of a pixel, their brightness ten times."""
    spectra = natural_spectra(2, CAMERA.wavelength, generator=torch.Generator().manual_seed(0))
    spectra[1] = 0.1 * spectra.mean(0)
    bar = ((torch.arange(96) >= 44) & (torch.arange(96) < 52)).long()
    truth = spectra[bar].expand(96, -1, -1).contiguous()
    projected = CAMERA.project(spectra) @ model._camera(None, False).project
    shape = projected[:, :-1] / projected[:, -1:]
    assert (shape[0] - shape[1]).square().sum() < 0.5 * 0.01 * TOLD
    x = model(add_noise(CAMERA.project(truth), 20.0, torch.Generator().manual_seed(5)), snr=20.0)
    inside = x[:, 45:51].mean((0, 1))
    assert (inside - spectra[1]).norm() < (inside - 0.1 * spectra[0]).norm() / 2


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
    assert error < 2 * least + 1e-5


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


@torch.no_grad()
@pytest.mark.parametrize("snr", [20.0, 35.0])
def test_nine_in_ten_values_lie_within_the_interval(model, snr):
    generator = torch.Generator().manual_seed(8)
    spectra = natural_spectra(49, CAMERA.wavelength, generator=generator)
    place = torch.arange(112) // 16
    truth = spectra[7 * place[:, None] + place]
    x, width = model.with_interval(add_noise(CAMERA.project(truth), snr, generator), snr=snr)
    cover = float(((x - truth).abs() <= width).float().mean())
    assert 0.82 < cover < 0.98
    halved = float(((x - truth).abs() <= width / 2).float().mean())
    assert halved < cover - 0.1  # and they fill it


@torch.no_grad()
def test_lines_that_the_basis_cannot_hold_are_within_the_interval(model):
    within = []
    for centre in (540.2, 611.3, 650.9, 683.7, 721.1):
        away = torch.from_numpy(CAMERA.wavelength - centre)
        truth = (-4 * np.log(2) * (away / 3) ** 2).exp().float().expand(32, 32, -1)
        y = add_noise(CAMERA.project(truth), 30.0, torch.Generator().manual_seed(1))
        x, width = model.with_interval(y, snr=30.0)
        missed = (truth - x).abs()
        assert missed.max() > 0.1
        within.append((missed <= width)[..., away.abs() < 15].float().mean())
    assert sum(within) / 5 > 0.8


# --- what a picture tells of its camera and its scene -------------------------------------------


def evidence_of(model, y, snr):
    ratio = torch.full((1, *y.shape[:2]), 10 ** (-snr / 10))
    camera = model._camera(None, False)
    return gather_evidence(y[None], ratio, camera, LEVELS), camera


@torch.no_grad()
@pytest.mark.parametrize(
    ("filters", "wrong"), [(20, 0.0), (20, 0.01), (20, 0.03), (9, 0.0), (9, 0.03), (40, 0.03)]
)
def test_a_calibration_that_is_wrong_is_noticed(filters, wrong):
    """To a factor of five in power; without it the posterior would be wrong, and far too sure."""
    camera = smooth_camera(0, filters=filters, bands=126)
    model, generator = load_model("compound", camera), torch.Generator().manual_seed(4)
    spectra = natural_spectra(36, camera.wavelength, generator=generator)
    place = torch.arange(96) // 16
    truth = spectra[6 * place[:, None] + place]
    gain = 1 + wrong * torch.randn(filters, generator=generator)
    y = add_noise(camera.project(truth) * gain, 35.0, generator)
    seen, front = evidence_of(model, y, 35.0)
    found = float(measured_misfit(seen.spectral, front, None))
    if wrong:
        assert wrong**2 / 5 < found < wrong**2 * 3
    else:
        assert found == pytest.approx(MISFITS[0])
    x, width = model.with_interval(y, snr=35.0)
    assert (x - truth).square().mean() < 0.05 * truth.square().mean()
    assert ((x - truth).abs() <= width).float().mean() > 0.8


@torch.no_grad()
def test_kin_that_differ_less_than_the_noise_are_noticed(model):
    """By their planted variance in the directions that show it."""
    generator = torch.Generator().manual_seed(6)
    first, second = natural_spectra(2, CAMERA.wavelength, generator=generator)
    share = 0.06 * torch.randn(128, 128, 1, generator=generator)
    truth = (1 - share) * first + share * second
    y = add_noise(CAMERA.project(truth), 30.0, generator)
    seen, camera = evidence_of(model, y, 30.0)
    projected = CAMERA.project(truth) @ camera.project
    planted = (projected[..., :-1] / projected[..., -1:]).flatten(0, 1).var(0)[:TOLD]
    assert planted.max() < 1e-3 / 2  # less than the noise
    found = unlikeness(seen, camera)[0]
    most = int(planted.argmax())
    assert float(found[most]) == pytest.approx(float(planted[most]), rel=0.35)
    calm, _ = evidence_of(
        model, add_noise(CAMERA.project(first).expand(128, 128, -1), 30.0, generator), 30.0
    )
    assert unlikeness(calm, camera).sum() < planted.sum() / 20


# --- what it learns from ------------------------------------------------------------------------


def test_nobody_learns_from_what_is_held_out():
    trained, held = Palette(grid(), count=10), Palette(grid(), count=10, held_out=True)
    for one, other in ((trained.surface, held.surface), (trained.lamp, held.lamp)):
        assert len(other) > 50
        # A few lamps stand in the tables twice, under two names.
        assert (torch.cdist(other, one).amin(1) > 1e-3).float().mean() > 0.9
    chart_light = torch.from_numpy(lights()[CHART_LIGHT]).float()
    assert torch.cdist(chart_light[None], trained.lamp).min() > 0


@pytest.fixture(scope="module")
def learnt():
    camera = smooth_camera(0, filters=20, bands=40)
    return camera, train("compound", camera, count=3000, seed=1)


@torch.no_grad()
def test_a_prior_learnt_anew_reconstructs(learnt, tmp_path):
    """About as well as the one that ships, which has seen twenty times as much."""
    camera, model = learnt
    truth = natural_spectra(2, camera.wavelength, generator=torch.Generator().manual_seed(3))
    truth = truth[(torch.arange(48) >= 24).long()].expand(48, -1, -1)
    y = add_noise(camera.project(truth), 25.0, torch.Generator().manual_seed(1))
    x, width = model.with_interval(y, snr=25.0)
    shipped = load_model("compound", camera)(y, snr=25.0)
    assert (x - truth).square().mean() < 3 * (shipped - truth).square().mean()
    assert width.isfinite().all()
    model.save(tmp_path / "own.safetensors")
    again = load_model(tmp_path / "own.safetensors", camera)
    torch.testing.assert_close(again(y, snr=25.0), x, rtol=1e-3, atol=1e-4)
    assert again.provenance == {"count": 3000, "seed": 1, "clusters": 48}


def test_the_same_seed_learns_the_same_prior(learnt):
    camera, model = learnt
    again = learn_prior(camera.wavelength, count=3000, seed=1)
    for key, value in again.tensors().items():
        torch.testing.assert_close(model.state_dict()[f"prior_{key}"], value, rtol=0, atol=0)


@torch.no_grad()
def test_a_prior_is_learnt_on_the_cameras_own_band(tmp_path):
    """And read there again: what was learnt at 400-1000 nm is not stretched a second time."""
    wavelength = np.linspace(400, 1000, 61)
    response = 0.5 + 0.4 * np.sin(np.linspace(1, 9, 16)[:, None] * wavelength / 60)
    camera = Calibration.from_sensitivity(response, wavelength)
    truth = natural_spectra(1, wavelength, generator=torch.Generator().manual_seed(3))
    y = add_noise(camera.project(truth.expand(32, 32, -1)), 30.0, torch.Generator().manual_seed(1))
    train("compound", camera, count=3000).save(tmp_path / "own.safetensors")
    x = load_model(tmp_path / "own.safetensors", camera)(y, snr=30.0)
    assert (x - truth).square().mean() < 0.005 * truth.square().mean()


def test_as_many_spectra_are_learnt_from_as_told(monkeypatch):
    asked = []
    monkeypatch.setattr(
        fit, "learn_prior", lambda *_, count, **__: asked.append(count) or broad_prior()
    )
    for count in (None, 8000):
        train("compound", CAMERA, count=count)
    assert asked == [LEARNT, 8000]


def test_too_few_spectra_teach_nothing():
    with pytest.raises(InputError, match="too few to learn from; give 1000 or more"):
        train("compound", CAMERA, count=50)


@torch.no_grad()
def test_the_dark_is_dark_and_certain(model):
    x, width = model.with_interval(torch.zeros(32, 32, 20), snr=20.0)
    assert (x == 0).all()
    assert (width == 0).all()


def test_few_bands_are_refused_before_anything_is_learnt():
    camera = Calibration.from_sensitivity(np.ones((8, 26)), np.linspace(500, 750, 26))
    with pytest.raises(InputError, match="needs 32 bands or more, not 26"):
        train("compound", camera)


@torch.no_grad()
def test_few_bands_have_an_interval_too():
    camera = smooth_camera(0, filters=12, bands=26)
    y = camera.project(natural_spectra(1, camera.wavelength).expand(24, 24, -1))
    x, width = load_model("compound", camera).with_interval(y, snr=30.0)
    assert x.isfinite().all()
    assert (width > 0).all()
