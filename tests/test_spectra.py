"""Spectra: resampling, the distributions of random spectra, shipped tables, colour."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare, kstest

from squilla import spectra
from squilla.errors import InputError
from squilla.spectra import (
    CHART_LIGHT,
    PRIORS,
    chart_reflectances,
    composite,
    gaussian_mixtures,
    grid,
    lights,
    line_spectra,
    natural_spectra,
    reflectances,
    resample,
    rgb,
    scaled,
    tristimulus,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    "ends", [(500, 750, 0), (500, 750, -1), (750, 500, 1), (500, np.inf, 1), (500, np.nan, 1),
             (500, 750, 1e-12)]
)  # fmt: skip
def test_bands_that_make_no_grid(ends):
    with pytest.raises(InputError, match="no grid"):
        grid(*ends)


def test_grid_has_both_ends():
    assert len(grid()) == 251
    assert grid()[[0, -1]].tolist() == [500, 750]
    np.testing.assert_allclose(np.diff(grid(400, 700, 0.5)), 0.5)


# --- resampling ----------------------------------------------------------------------------------


@given(st.integers(2, 40), st.integers(1, 50), st.integers(0, 2**32 - 1))
def test_resample_agrees_with_numpy(known, wanted, seed):
    random = np.random.default_rng(seed)
    wavelength = 500 + random.uniform(0.1, 10, known).cumsum()
    values = random.standard_normal((3, known))
    onto = np.sort(random.uniform(wavelength[0], wavelength[-1], wanted))
    expected = [np.interp(onto, wavelength, each) for each in values]
    np.testing.assert_allclose(resample(values, wavelength, onto), expected, atol=1e-9)
    np.testing.assert_array_equal(resample(values, wavelength, wavelength), values)


def test_resample_keeps_type_and_shape():
    wavelength, onto = grid(500, 600, 10), grid(505, 595, 5)
    for kind, expected in (("float32", "float32"), ("float64", "float64"), ("int32", "float64")):
        values = np.arange(11, dtype=kind) * np.ones((2, 3, 1), kind)
        result = resample(values, wavelength, onto)
        assert result.dtype == expected
        np.testing.assert_allclose(result[1, 2], (onto - 500) / 10, rtol=1e-6)
        assert resample(values, wavelength, wavelength).dtype == expected
    assert resample(np.ones((4, 1)), np.array([550.0]), np.array([550.0])).shape == (4, 1)


@pytest.mark.parametrize(
    ("values", "wavelength", "onto", "reason"),
    [
        (np.ones(3), [500, 510, 520], [495, 510], "extrapolated"),
        (np.ones(3), [500, 510, 520], [510, 520.1], "extrapolated"),
        (np.ones(1), [500], [510], "extrapolated"),
        (np.ones(3), [500, 510, 520], [505, np.nan], "extrapolated"),
        (np.ones(3), [500, 520, 510], [505], "increase"),
        (np.ones(3), [500, 510, 510], [505], "increase"),
        (np.ones(4), [500, 510, 520], [505], "4 bands but 3"),
    ],
)
def test_resample_refuses(values, wavelength, onto, reason):
    with pytest.raises(InputError, match=reason):
        resample(values, np.array(wavelength), np.array(onto))


# --- random spectra ------------------------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch) -> dict[str, torch.Tensor]:
    """Lets a test see the lines that a prior draws before they are summed."""
    seen = {}
    summed = spectra._sum_of_lines

    def watch(wavelength, centre, height, fwhm):
        seen.update(centre=centre, height=height, fwhm=fwhm)
        return summed(wavelength, centre, height, fwhm)

    monkeypatch.setattr(spectra, "_sum_of_lines", watch)
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
        line = spectra._sum_of_lines(
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
    found = spectra._sum_of_lines(wavelength, *map(torch.tensor, (centre, height, fwhm)))
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


# --- shipped tables ---------------------------------------------------------------------------


def test_tables_are_physical():
    for table in (reflectances(), chart_reflectances()):
        assert table.values.shape == (len(table.name), 251)
        np.testing.assert_array_equal(table.wavelength, grid())
        assert table.values.min() >= 0
        assert table.values.max() < 1.6
    assert lights().values.shape == (629, 251)
    assert lights().values.min() >= 0
    np.testing.assert_allclose(lights().values.max(1), 1, rtol=1e-5)
    for table in (chart_reflectances(), lights(), reflectances()):
        assert len(set(table.name)) == len(table.name), "a name must find one spectrum"
    with pytest.raises(InputError, match="no spectrum"):
        lights()["candle"]
    with pytest.raises(InputError, match="candle"):
        lights().one("candle", grid())
    np.testing.assert_array_equal(lights().one(CHART_LIGHT, grid()), lights()[CHART_LIGHT])


def test_training_never_sees_the_evaluation(monkeypatch):
    """No chart patch is among the training surfaces, no evaluation light among those drawn."""
    chart, surfaces = chart_reflectances().values, reflectances().values
    for patch in chart:
        assert np.abs(surfaces - patch).max(1).min() > 1e-4
    # With white surfaces a drawn spectrum is its light alone.
    white = spectra.SpectralTable(grid(), np.ones((2, 251)), ("a", "b"))
    monkeypatch.setattr(spectra, "reflectances", lambda: white)
    shown = natural_spectra(6_000, grid(), generator=seeded(7)).double().numpy()
    kept = lights()[CHART_LIGHT] / lights()[CHART_LIGHT].max()
    assert np.abs(shown - kept).max(1).min() > 1e-4
    used = np.unique(shown.round(5), axis=0)
    assert len(used) > 600, "nearly all other lights are drawn"


# --- colour -----------------------------------------------------------------------------------


def test_tristimulus_agrees_with_colour():
    """Over the whole visible band; power there, photons here."""
    import colour

    wavelength = grid(380, 780, 5)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    for name in ("D65", "A", "FL2"):
        power = colour.SDS_ILLUMINANTS[name].copy().align(colour.SpectralShape(380, 780, 5))
        expected = colour.sd_to_XYZ(
            power, observer.copy().align(power.shape), method="Integration", k=1
        )
        found = tristimulus(power.values * wavelength, wavelength)
        np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert tristimulus(np.ones((2, 3, 81)), wavelength).shape == (2, 3, 3)


def test_metamers_look_the_same():
    """Two spectra that differ by what no receptor sees have one colour."""
    wavelength = grid()
    receptors = np.stack([tristimulus(each, wavelength) for each in np.eye(251)])
    difference = np.random.default_rng(8).standard_normal(251)
    difference -= receptors @ np.linalg.lstsq(receptors, difference, rcond=None)[0]
    base = np.full(251, 0.5)
    other = base + 0.1 * difference / np.abs(difference).max()
    assert np.abs(other - base).max() > 0.05
    np.testing.assert_allclose(
        rgb(other, wavelength, exposure=1), rgb(base, wavelength, exposure=1), atol=1e-6
    )


def test_white_is_white_and_colours_are_named_right():
    wavelength, light = grid(), lights()[CHART_LIGHT]
    grey = rgb(np.array([0.2, 0.5, 1])[:, None] * light, wavelength, white=light, exposure=1)
    np.testing.assert_allclose(grey, grey[:, :1] * np.ones(3), atol=2e-3)
    np.testing.assert_allclose(grey[2], 1, atol=2e-3)
    assert grey[1, 0] == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055, abs=2e-3)  # sRGB's curve
    chart = chart_reflectances()
    shown = dict(zip(chart.name, rgb(chart.values, wavelength), strict=True))
    assert shown["red"].argmax() == 0
    assert shown["green"].argmax() == 1
    assert shown["blue"].argmax() == 2


@pytest.mark.filterwarnings("ignore:Aligning")
def test_rgb_agrees_with_colour_over_the_whole_band():
    import colour

    wavelength = grid(380, 780)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    power = colour.SDS_ILLUMINANTS["A"].copy().align(colour.SpectralShape(380, 780, 1))
    surface = np.linspace(0.1, 0.8, 401)
    reflectance = colour.SpectralDistribution(surface, wavelength)
    xyz = colour.sd_to_XYZ(reflectance, observer, power, method="Integration") / 100
    white = colour.xy_to_XYZ(colour.XYZ_to_xy(colour.sd_to_XYZ(power, observer)))
    expected = colour.XYZ_to_sRGB(
        xyz, colour.XYZ_to_xy(white), chromatic_adaptation_transform="XYZ Scaling"
    )
    light = power.values * wavelength
    found = rgb(surface * light, wavelength, white=light, exposure=1)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_composite_takes_the_thesis_bands():
    cube = np.zeros((2, 2, 251))
    cube[..., 150], cube[..., 50], cube[..., 0] = 1.0, 0.5, 0.25
    np.testing.assert_allclose(composite(cube, grid())[0, 0], [1, 0.5, 0.25])
    np.testing.assert_allclose(composite(cube, grid(), scale=2.0)[0, 0], [0.5, 0.25, 0.125])
    assert composite(np.zeros((2, 2, 251)), grid()).max() == 0
    light = lights()[CHART_LIGHT]
    np.testing.assert_allclose(composite(0.3 * light, grid(), white=light, scale=1), 0.3)


def test_natural_spectra_are_stretched_to_a_band_beyond_the_tables():
    near, far = grid(500, 750, 5), grid(400, 1000, 12)
    drawn = [
        natural_spectra(5, band, generator=torch.Generator().manual_seed(1)) for band in (near, far)
    ]
    torch.testing.assert_close(*drawn)
