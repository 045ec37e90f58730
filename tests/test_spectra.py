"""Spectra: grids, resampling, shipped tables."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from squilla.errors import InputError
from squilla.spectra import (
    CHART_LIGHT,
    chart_reflectances,
    grid,
    lights,
    nanometres,
    reflectances,
    resample,
)


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


@pytest.mark.parametrize(
    ("wavelength", "said"),
    [
        ([0.5, 0.6], "multiply micrometres"),
        ([5e-7, 6e-7], "cannot be in nm"),
        ([500, np.nan], "finite"),
        ([], "list of finite"),
    ],
)
def test_wavelengths_that_are_none(wavelength, said):
    with pytest.raises(InputError, match=said):
        nanometres(wavelength)
    np.testing.assert_array_equal(nanometres([500, 510]), [500.0, 510.0])
