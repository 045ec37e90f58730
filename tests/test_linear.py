"""The Wiener estimator against its closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from random_camera import smooth_camera
from squilla.calibration.agreement import model_error
from squilla.calibration.calibration import Calibration
from squilla.priors import broad_spectra, second_moment
from squilla.reconstruction.linear import Ridge, complete


@pytest.fixture(scope="module")
def camera():
    return smooth_camera(3, filters=12, bands=51, angles=3)


@pytest.fixture(scope="module")
def moment(camera):
    return second_moment(camera.wavelength)


def noisy(y, snr, generator):
    deviation = y.square().mean(-1, keepdim=True).sqrt() * 10 ** (-snr / 20)
    return y + deviation * torch.randn(y.shape, generator=generator)


def test_as_many_filters_as_bands_without_noise_is_inversion(moment):
    random = np.random.default_rng(0)
    response = np.eye(51) + 0.1 * random.uniform(size=(51, 51))
    camera = Calibration.from_sensitivity(response, np.linspace(500, 750, 51))
    spectra = broad_spectra(50, camera.wavelength, generator=torch.Generator().manual_seed(1))
    estimate = Ridge(camera, moment)(camera.project(spectra), snr=90.0)
    torch.testing.assert_close(estimate, spectra, atol=2e-3, rtol=0)


def test_no_other_matrix_does_better_on_the_prior(camera, moment):
    generator = torch.Generator().manual_seed(2)
    spectra = broad_spectra(20_000, camera.wavelength, generator=generator)
    clean = camera.project(spectra)
    # The estimator's own noise: the same variance for every pixel.
    deviation = clean.square().mean().sqrt() * 10 ** (-20 / 20)
    y = clean + deviation * torch.randn(clean.shape, generator=generator)
    fitted = torch.linalg.lstsq(y.double(), spectra.double()).solution.float()
    wiener = Ridge(camera, moment).estimate(torch.eye(camera.filters))
    best = (y @ fitted - spectra).square().mean()
    assert (y @ wiener - spectra).square().mean() <= 1.01 * best


def test_noise_that_is_stated_right_is_reconstructed_best(camera, moment):
    generator = torch.Generator().manual_seed(4)
    spectra = broad_spectra(4000, camera.wavelength, generator=generator)
    for snr, wrong in ((15, 35), (35, 15)):
        y = noisy(camera.project(spectra), snr, generator)
        error = [
            (Ridge(camera, moment)(y, snr=stated) - spectra).square().mean()
            for stated in (snr, wrong)
        ]
        assert error[0] < error[1]


def test_each_angle_uses_its_matrix(camera, moment):
    whole = Ridge(camera, moment=moment)
    generator = torch.Generator().manual_seed(5)
    spectra = broad_spectra(20, camera.wavelength, generator=generator)
    for index, angle in enumerate(camera.angle):
        alone = Calibration.from_sensitivity(camera.sensitivity[index], camera.wavelength)
        y = alone.project(spectra)
        angles = torch.full((20,), float(angle))
        torch.testing.assert_close(whole(y, angles), Ridge(alone, moment=moment)(y))


def test_filled_channels_equal_channels_left_out(camera, moment):
    """Ridge after `complete` is the Wiener estimator of the valid channels alone."""
    one = Calibration.from_sensitivity(camera.sensitivity[1], camera.wavelength)
    generator = torch.Generator().manual_seed(6)
    spectra = broad_spectra(30, one.wavelength, generator=generator)
    y = one.project(spectra)
    valid = torch.rand(y.shape, generator=generator) < 0.8
    filled = complete(torch.where(valid, y, 1e6), valid, one)
    moment = second_moment(one.wavelength)
    estimate = filled @ Ridge(one, moment).estimate(torch.eye(one.filters))
    response = one.mean_sensitivity.double()
    noise = 10**-2 * (response @ moment @ response.T).diagonal().mean()
    enough = valid.sum(-1) >= 6
    assert enough.sum() > 20
    for pixel in torch.nonzero(enough)[:, 0]:
        keep = valid[pixel]
        kept = response[keep]
        covariance = kept @ moment @ kept.T + noise * torch.eye(int(keep.sum()))
        expected = moment @ kept.T @ torch.linalg.solve(covariance, y[pixel, keep].double())
        torch.testing.assert_close(estimate[pixel].double(), expected, atol=2e-4, rtol=1e-3)


def test_pixels_with_too_few_channels_become_nan(camera):
    y = torch.rand(3, 12)
    valid = torch.ones(3, 12, dtype=torch.bool)
    valid[1, :7] = False
    valid[2, :6] = False
    filled = complete(y, valid, camera)
    assert filled.isfinite().all(-1).tolist() == [True, False, True]
    torch.testing.assert_close(filled[0], y[0])


def test_an_uncertain_sensitivity_is_noise_of_its_own():
    """With R drawn from its errors, the estimator that knows them is nearly the best linear one."""
    camera = smooth_camera(0, filters=16, bands=51)
    random = np.random.default_rng(1)
    drawn = 0.03 * camera.sensitivity.mean() * random.standard_normal((40, 1, 16, 51))
    unsure = replace(camera, deviations=drawn)
    moment = second_moment(camera.wavelength)
    x = broad_spectra(4000, camera.wavelength, generator=torch.Generator().manual_seed(1))
    which = torch.from_numpy(random.integers(40, size=4000))
    true = camera.sensitivities[0] + torch.from_numpy(drawn[:, 0]).float()[which]
    y = torch.einsum("nmk,nk->nm", true, x)
    y = y + 1e-3 * y.square().mean(-1, keepdim=True).sqrt() * torch.randn(
        y.shape, generator=torch.Generator().manual_seed(2)
    )
    errors = [
        float(
            (Ridge(each, moment).estimate(y, None, torch.full((4000,), 60.0)) - x).square().mean()
        )
        for each in (camera, unsure)
    ]
    best = torch.linalg.lstsq(y.double(), x.double()).solution  # fitted to these very spectra
    least = float((y.double() @ best - x).square().mean())
    assert errors[1] < 1.1 * least
    assert errors[0] > 1.1 * errors[1]
    assert model_error(camera, moment).abs().max() == 0
