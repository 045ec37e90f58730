"""Priors: the distributions of random spectra."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare, kstest

from squilla import priors, spectra
from squilla.priors import PRIORS, gaussian_mixtures, line_spectra, natural_spectra, scaled
from squilla.spectra import CHART_LIGHT, chart_reflectances, grid, lights, reflectances


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def drawn(monkeypatch) -> dict[str, torch.Tensor]:
    """Lets a test see the lines that a prior draws before they are summed."""
    seen = {}
    summed = priors._sum_of_lines

    def watch(wavelength, centre, height, fwhm):
        seen.update(centre=centre, height=height, fwhm=fwhm)
        return summed(wavelength, centre, height, fwhm)

    monkeypatch.setattr(priors, "_sum_of_lines", watch)
    return seen


@pytest.mark.parametrize("fewest", [1, 2])
def test_number_of_lines_is_geometric(drawn, fewest):
    """Support from 0 or from 1 with p = 0.3, plus one, by a chi-squared test."""
    count = 40_000
    gaussian_mixtures(count, grid(), fewest=fewest, generator=seeded(1))
    lines = (drawn["height"] > 0).sum(1).numpy()
    assert lines.min() == fewest
    extra = lines - fewest
    bins = np.bincount(np.minimum(extra, 15), minlength=16)
    expected = 0.3 * 0.7 ** np.arange(16)
    expected[15] = 0.7**15
    assert chisquare(bins, count * expected).pvalue > 1e-3


def test_lines_follow_the_thesis(drawn):
    gaussian_mixtures(20_000, grid(), generator=seeded(2))
    there = drawn["height"] > 0
    centre, height, fwhm = (drawn[key][there].numpy() for key in ("centre", "height", "fwhm"))
    assert kstest(height, "uniform").pvalue > 1e-3
    assert kstest(fwhm, "uniform", (2, 48)).pvalue > 1e-3
    assert (centre == centre.round()).all()
    assert chisquare(np.bincount((centre - 500).astype(int), minlength=251)).pvalue > 1e-3


def test_single_line_has_its_width():
    """Half the height is reached at half the width, on a grid fine enough to see it."""
    wavelength = grid(500, 700, 0.01)
    for fwhm in (2.0, 10.0, 50.0):
        line = priors._sum_of_lines(
            wavelength, torch.tensor([[600.0]]), torch.tensor([[0.7]]), torch.tensor([[fwhm]])
        )[0].numpy()
        assert line.max() == pytest.approx(0.7)
        above = wavelength[line >= 0.35]
        assert above[-1] - above[0] == pytest.approx(fwhm, abs=0.03)
        expected = 0.7 * fwhm * np.sqrt(np.pi / np.log(2)) / 2  # area of a Gaussian
        if fwhm < 20:
            assert line.sum() * 0.01 == pytest.approx(expected, rel=1e-4)


def test_lines_add_up():
    random = np.random.default_rng(9)
    wavelength = grid(500, 600, 2)
    centre, fwhm = random.uniform(500, 600, (6, 4)), random.uniform(2, 50, (6, 4))
    height = random.random((6, 4)) * (np.arange(4) < random.integers(0, 5, (6, 1)))
    expected = sum(
        height[:, [line]] * 0.5 ** ((wavelength - centre[:, [line]]) / (fwhm[:, [line]] / 2)) ** 2
        for line in range(4)
    )
    found = priors._sum_of_lines(wavelength, *map(torch.tensor, (centre, height, fwhm)))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_lasers_and_leds(drawn):
    wavelength = grid()
    result = line_spectra(5_000, wavelength, generator=seeded(3))
    assert np.log(drawn["fwhm"].numpy()).min() >= -1e-6
    assert kstest(np.log(drawn["fwhm"].numpy().ravel()) / np.log(30), "uniform").pvalue > 1e-3
    lines = (drawn["height"] > 0).sum(1)
    assert chisquare(torch.bincount(lines)[1:].numpy()).pvalue > 1e-3
    assert result.median() < 0.05, "lines stand on a dark ground"


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("wavelength", [grid(), grid(520, 700, 5)])
def test_every_prior(name, wavelength):
    first = PRIORS[name](500, wavelength, generator=seeded(4))
    again = PRIORS[name](500, wavelength, generator=seeded(4))
    other = PRIORS[name](500, wavelength, generator=seeded(5))
    assert first.shape == (500, len(wavelength))
    assert first.dtype == torch.float32
    assert torch.isfinite(first).all()
    assert first.min() >= 0
    torch.testing.assert_close(first.amax(1), torch.ones(500))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert len(torch.unique(first, dim=0)) > 490
    for few in (0, 1, 3):
        assert PRIORS[name](few, wavelength, generator=seeded()).shape == (few, len(wavelength))


def test_scaled():
    line = torch.tensor([[2.0, 3.0, 6.0], [1.0, 1.0, 2.0]])
    torch.testing.assert_close(scaled(line), line / torch.tensor([[6.0], [2.0]]))
    stretched = scaled(line, "minmax")
    torch.testing.assert_close(stretched[0], torch.tensor([0, 0.25, 1]))
    both = gaussian_mixtures(200, grid(), normalise="minmax", generator=seeded(6))
    torch.testing.assert_close(both.amin(1), torch.zeros(200))
    torch.testing.assert_close(both.amax(1), torch.ones(200))
    assert torch.isfinite(scaled(torch.zeros(2, 5), "minmax")).all()


def test_training_never_sees_the_evaluation(monkeypatch):
    """No chart patch is among the training surfaces, no evaluation light among those drawn."""
    chart, surfaces = chart_reflectances().values, reflectances().values
    for patch in chart:
        assert np.abs(surfaces - patch).max(1).min() > 1e-4
    # With white surfaces a drawn spectrum is its light alone.
    white = spectra.SpectralTable(grid(), np.ones((2, 251)), ("a", "b"))
    monkeypatch.setattr(priors, "reflectances", lambda: white)
    shown = natural_spectra(6_000, grid(), generator=seeded(7)).double().numpy()
    kept = lights()[CHART_LIGHT] / lights()[CHART_LIGHT].max()
    assert np.abs(shown - kept).max(1).min() > 1e-4
    used = np.unique(shown.round(5), axis=0)
    assert len(used) > 600, "nearly all other lights are drawn"


def test_natural_spectra_are_stretched_to_a_band_beyond_the_tables():
    near, far = grid(500, 750, 5), grid(400, 1000, 12)
    drawn = [
        natural_spectra(5, band, generator=torch.Generator().manual_seed(1)) for band in (near, far)
    ]
    torch.testing.assert_close(*drawn)
