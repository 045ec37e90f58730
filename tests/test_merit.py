"""Figures of merit: Monte Carlo, closed forms and NumPy say the same."""

import numpy as np
import pytest
import torch

from squilla.errors import InputError
from squilla.optics import merit
from squilla.optics.filters import StencilRecipe
from squilla.optics.merit import (
    PhotonNoise,
    Prior,
    WhiteNoise,
    estimator_error,
    expected_error,
    wiener,
)
from squilla.spectra import grid

BAND = grid(500, 750, 5)
NATURAL = Prior.draw("natural", BAND, count=4000)


def response(seed=0, filters=12):
    return StencilRecipe(filters=filters).draw(seed).transmittance(BAND)


# --- the error of the best linear estimate ------------------------------------------------------


def moment_root(prior):
    """A matrix F with F F' = S."""
    value, vector = torch.linalg.eigh(prior.moment)
    return vector * value.clamp_min(0).sqrt()


@pytest.mark.parametrize(
    "noise",
    [WhiteNoise(10.0), WhiteNoise(30.0), PhotonNoise(150.0, 3.0), PhotonNoise(1e4)],
)
def test_monte_carlo_agrees(noise):
    """Draw spectra of that second moment, add noise, reconstruct linearly, compare."""
    generator = torch.Generator().manual_seed(1)
    sensitivity, count = response(), 20_000
    spectra = torch.randn(count, len(BAND), dtype=torch.float64, generator=generator)
    # Signs drawn at random leave the second moment and keep the mean out of the way.
    spectra = spectra @ moment_root(NATURAL).T
    y = spectra @ sensitivity.T
    deviation = noise.variance(sensitivity, NATURAL).sqrt()
    y = y + deviation * torch.randn(y.shape, dtype=torch.float64, generator=generator)
    estimate = y @ wiener(sensitivity, NATURAL, noise=noise).mT
    each = (estimate - spectra).square().mean(-1)
    error = expected_error(sensitivity, NATURAL, noise=noise)
    assert each.mean() == pytest.approx(error.item(), abs=4 * (each.std() / count**0.5).item())


@pytest.mark.parametrize("snr", [15.0, 30.0])
def test_noise_drawn_for_each_spectrum_as_in_training(snr):
    """The thesis' noise, relative to each spectrum's own measurement, leaves the same error."""
    generator = torch.Generator().manual_seed(2)
    from squilla.priors import natural_spectra

    spectra = natural_spectra(20_000, BAND, generator=generator).double()
    prior = Prior.of(spectra, BAND)
    sensitivity = response(1)
    y = spectra @ sensitivity.T
    deviation = y.square().mean(-1, keepdim=True).sqrt() / 10 ** (snr / 20)
    y = y + deviation * torch.randn(y.shape, dtype=torch.float64, generator=generator)
    each = (y @ wiener(sensitivity, prior, noise=WhiteNoise(snr)).mT - spectra).square().mean(-1)
    error = expected_error(sensitivity, prior, noise=WhiteNoise(snr)).item()
    assert each.mean() == pytest.approx(error, abs=4 * (each.std() / 20_000**0.5).item())


def test_photons_that_are_counted():
    """Poisson photons and Gaussian read noise, drawn one by one, leave the error foretold."""
    generator = torch.Generator().manual_seed(3)
    from squilla.priors import natural_spectra

    spectra = natural_spectra(20_000, BAND, generator=generator).double()
    prior, sensitivity, noise = Prior.of(spectra, BAND), response(2), PhotonNoise(80.0, 2.0)
    per_unit = 80.0 / prior.mean.sum()  # a clear channel collects 80 electrons of the mean
    electrons = torch.poisson(per_unit * spectra @ sensitivity.T, generator=generator)
    electrons += 2.0 * torch.randn(electrons.shape, dtype=torch.float64, generator=generator)
    estimate = electrons / per_unit @ wiener(sensitivity, prior, noise=noise).mT
    each = (estimate - spectra).square().mean(-1)
    error = expected_error(sensitivity, prior, noise=noise).item()
    assert each.mean() == pytest.approx(error, abs=4 * (each.std() / 20_000**0.5).item())


def test_one_band_is_a_textbook_case():
    """One filter, one band: error = S N / (R^2 S + N)."""
    prior = Prior(np.array([600.0]), torch.tensor([0.5]).double(), torch.tensor([[0.4]]).double())
    noise = PhotonNoise(50.0, 2.0)
    variance = 0.3 * 0.5 * (0.5 / 50) + (2 * 0.5 / 50) ** 2
    error = expected_error(torch.tensor([[0.3]]), prior, noise=noise)
    assert error.item() == pytest.approx(0.4 * variance / (0.09 * 0.4 + variance))


def test_the_wiener_matrix_is_the_best_and_reaches_the_bound():
    sensitivity, noise = response(3), WhiteNoise(20)
    best = wiener(sensitivity, NATURAL, noise=noise)
    error = expected_error(sensitivity, NATURAL, noise=noise)
    own = estimator_error(best, sensitivity, NATURAL, noise=noise)
    torch.testing.assert_close(own, error)
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        other = best + 1e-3 * torch.randn(best.shape, dtype=best.dtype, generator=generator)
        assert estimator_error(other, sensitivity, NATURAL, noise=noise) > error
    nothing = torch.zeros_like(best)
    mean_square = NATURAL.moment.diagonal().mean()
    torch.testing.assert_close(
        estimator_error(nothing, sensitivity, NATURAL, noise=noise), mean_square
    )


@pytest.mark.parametrize("noise", [WhiteNoise(25), PhotonNoise(300.0)])
def test_monte_carlo_with_the_estimator_of_another_array(noise):
    generator = torch.Generator().manual_seed(4)
    true, believed, count = response(7), response(8), 20_000
    spectra = torch.randn(count, len(BAND), dtype=torch.float64, generator=generator)
    spectra = spectra @ moment_root(NATURAL).T
    deviation = noise.variance(true, NATURAL).sqrt()
    y = spectra @ true.T
    y = y + deviation * torch.randn(y.shape, dtype=torch.float64, generator=generator)
    estimator = wiener(believed, NATURAL, noise=noise)
    each = (y @ estimator.mT - spectra).square().mean(-1)
    error = estimator_error(estimator, true, NATURAL, noise=noise).item()
    assert each.mean() == pytest.approx(error, abs=4 * (each.std() / count**0.5).item())


def test_many_arrays_at_once():
    sensitivity = torch.stack([response(seed) for seed in range(6)]).reshape(2, 3, 12, -1)
    for noise in (WhiteNoise(25), PhotonNoise(200.0)):
        error = expected_error(sensitivity, NATURAL, noise=noise)
        estimator = wiener(sensitivity, NATURAL, noise=noise)
        swapped = estimator_error(estimator.flip(0), sensitivity, NATURAL, noise=noise)
        assert error.shape == swapped.shape == (2, 3)
        assert (swapped > error).all()
        alone = expected_error(sensitivity[1, 2], NATURAL, noise=noise)
        torch.testing.assert_close(error[1, 2], alone)


@pytest.mark.parametrize("noise", [WhiteNoise(20), PhotonNoise(100.0)])
def test_gradient(noise):
    sensitivity = response(4, filters=3).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda r: expected_error(r, NATURAL, noise=noise), sensitivity, atol=1e-7
    )


def test_white_noise_does_not_see_the_scale_and_photon_noise_does():
    sensitivity = response(5)
    error = expected_error(sensitivity, NATURAL, noise=WhiteNoise(20))
    half = expected_error(sensitivity / 2, NATURAL, noise=WhiteNoise(20))
    torch.testing.assert_close(error, half)
    bright = expected_error(sensitivity, NATURAL, noise=PhotonNoise(100.0))
    assert expected_error(sensitivity / 2, NATURAL, noise=PhotonNoise(100.0)) > bright
    # half the transmittance at twice the exposure is the same light; without read noise the unit
    # of the response does not matter either
    shot = PhotonNoise(100.0, 0.0, clear=torch.full((len(BAND),), 0.7))
    torch.testing.assert_close(
        expected_error(0.7 * sensitivity, NATURAL, noise=shot),
        expected_error(sensitivity, NATURAL, noise=PhotonNoise(100.0, 0.0)),
    )


def test_more_light_and_more_filters_never_hurt():
    sensitivity = response(6, filters=36)
    errors = [expected_error(sensitivity, NATURAL, noise=PhotonNoise(e)) for e in (10, 100, 1e4)]
    assert errors[0] > errors[1] > errors[2]
    fewer = expected_error(sensitivity[:20], NATURAL, noise=PhotonNoise(100.0))
    assert fewer > errors[1]


def test_bad_input():
    with pytest.raises(InputError, match="51"):
        expected_error(torch.ones(3, 7), NATURAL, noise=WhiteNoise(20))
    with pytest.raises(InputError, match="no prior 'nature'"):
        Prior.draw("nature")
    with pytest.raises(InputError, match="exposure"):
        PhotonNoise(0.0)
    for snr in (np.nan, np.inf, -4000.0):
        with pytest.raises(InputError, match="SNR"):
            WhiteNoise(snr)


def test_noise_lost_in_rounding_is_said():
    """Two equal filters leave no inverse but for the noise."""
    twice = response(7, filters=3)[[0, 0]]
    with pytest.raises(InputError, match="rounding"):
        expected_error(twice, NATURAL, noise=WhiteNoise(300.0))


# --- simpler figures ----------------------------------------------------------------------------


def test_merit_of_perfect_filters():
    """Ideal band-pass filters side by side: orthogonal, equally strong."""
    response = torch.eye(5, dtype=torch.float64).repeat_interleave(4, -1)  # (5, 20)
    assert merit.condition_number(response) == pytest.approx(1)
    assert merit.singular_values(response).tolist() == pytest.approx([1] * 5)
    assert merit.throughput(response) == pytest.approx(0.2)
    assert merit.mutual_coherence(response[:, ::4]) == 0
    assert merit.mutual_coherence(response) == pytest.approx(1)
    # of rows that are 1 on a fifth of the band: cov = -1/25, var = 4/25
    assert merit.mean_correlation(response) == pytest.approx(0.25)


def test_correlation_agrees_with_numpy_and_ignores_scale_and_offset():
    response = torch.rand(6, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    table = np.abs(np.corrcoef(response.numpy()))
    assert merit.mean_correlation(response) == pytest.approx(table[~np.eye(6, dtype=bool)].mean())
    assert merit.mean_correlation(3 * response + 1) == pytest.approx(
        float(merit.mean_correlation(response))
    )


def test_peaks_of_a_fringe_are_counted():
    wavelength = grid(500, 750)
    fringe = 0.5 + 0.4 * np.sin(2 * np.pi * (wavelength - 500) / 50)  # maxima at 512.5, 562.5 ...
    noise = 1e-3 * np.random.default_rng(0).standard_normal(251)
    response = torch.from_numpy(np.stack([fringe, fringe + noise]))
    assert merit.peak_density(response, wavelength) == pytest.approx(2.0)


def test_random_arrays_resemble_the_published_kind():
    """Mean transmittance near one half, filters weakly correlated, a peak or two per 100 nm."""
    figures = []
    for seed in range(12):
        response = StencilRecipe().draw(seed).transmittance(grid())
        figures.append(
            [
                float(merit.throughput(response)),
                float(merit.mean_correlation(response)),
                merit.peak_density(response, grid()),
            ]
        )
    through, correlation, peaks = np.median(figures, 0)
    assert 0.35 < through < 0.6
    assert 0.2 < correlation < 0.45
    assert 0.9 < peaks < 1.5
