"""Colour, against colour-science."""

import numpy as np
import pytest

from squilla.colour import composite, rgb, tristimulus
from squilla.spectra import CHART_LIGHT, chart_reflectances, grid, lights


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
