import numpy as np
import pytest

from squilla.errors import InputError
from squilla.optics.angle import blue_shift, fit_effective_index
from squilla.optics.filters import MeasuredFilters, StencilRecipe
from squilla.spectra import grid

WIDE = grid(480, 780)  # wider than the band, so that no shift reads beyond it
INSIDE = (WIDE >= 500) & (WIDE <= 750)
FIELD = {"centre": 0.0, "edge": 0.115, "corner": 0.163}  # rad, chief rays of the thesis' field


def pupil(chief, rings=3):
    """Angles and weights, cos^4, over the pupil of an F/4 lens; points of equal area."""
    x, y = [0.0], [0.0]
    for ring in range(1, rings + 1):
        turn = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        radius = np.sqrt(3 * ring**2 / (3 * rings * (rings + 1) + 1)) / 8
        x.extend(radius * np.cos(turn))
        y.extend(radius * np.sin(turn))
    angle = np.arctan(np.hypot(np.tan(chief) - np.array(x), y))
    weight = np.cos(angle) ** 4
    return angle, weight / weight.sum()


@pytest.fixture(scope="module")
def array():
    return StencilRecipe(filters=12).draw(13)


@pytest.fixture(scope="module")
def exact(array):
    """The stack's own response in each cone, by the transfer matrix at every point of the pupil."""
    seen = {}
    for name, chief in FIELD.items():
        angle, weight = pupil(chief)
        table = array.transmittance(WIDE, angle).numpy()
        seen[name] = np.einsum("a,amk->mk", weight, table)
    return seen


def difference(response, truth):
    return np.linalg.norm((response - truth)[:, INSIDE]) / np.linalg.norm(truth[:, INSIDE])


@pytest.mark.parametrize(
    ("where", "least", "left"),
    [("centre", 0.01, 0.004), ("edge", 0.04, 0.008), ("corner", 0.06, 0.013)],
)
def test_the_shift_explains_what_a_stack_does_in_a_cone(array, exact, where, least, left):
    collimated = array.transmittance(WIDE).numpy()
    cones = [pupil(chief) for chief in FIELD.values()]
    index = fit_effective_index(collimated, np.stack([*exact.values()]), WIDE, cones)
    assert 1.6 < index < 2.0
    assert difference(collimated, exact[where]) > least
    model = collimated @ blue_shift(WIDE, pupil(FIELD[where]), index).T
    assert difference(model, exact[where]) < left


def test_what_the_cone_on_the_axis_did_is_counted_once(array, exact):
    axis, cones = pupil(0.0), [pupil(FIELD["edge"]), pupil(FIELD["corner"])]
    tilted = np.stack([exact["edge"], exact["corner"]])
    index = fit_effective_index(exact["centre"], tilted, WIDE, cones, measured_in=axis)
    for cone, truth in zip(cones, tilted, strict=True):
        once = exact["centre"] @ blue_shift(WIDE, cone, index, measured_in=axis).T
        twice = exact["centre"] @ blue_shift(WIDE, cone, index).T
        assert difference(once, truth) < 0.01
        assert difference(once, truth) < 0.6 * difference(twice, truth)
    same = blue_shift(WIDE, axis, index, measured_in=axis)
    np.testing.assert_allclose(same, np.eye(len(WIDE)), atol=1e-12)


def test_a_planted_index_is_found():
    generator = np.random.default_rng(0)
    centre, width = generator.uniform(520, 740, (8, 1)), generator.uniform(8, 30, (8, 1))
    response = np.exp(-(((WIDE - centre) / width) ** 2))
    cones = [([0.1], [1.0]), pupil(0.2)]
    tilted = np.stack([response @ blue_shift(WIDE, cone, 1.63).T for cone in cones])
    assert fit_effective_index(response, tilted, WIDE, cones) == pytest.approx(1.63, abs=1e-3)


def test_every_row_of_the_matrix_is_a_weighted_mean():
    matrix = blue_shift(WIDE, pupil(0.1), 1.7, onto=grid(500, 750, 2.5))
    assert matrix.shape == (101, len(WIDE))
    assert matrix.min() >= 0
    np.testing.assert_allclose(matrix.sum(-1), 1)
    # a line of the response at 600 nm moves to the blue by the mean of its shifts
    angle, weight = pupil(0.1)
    shift = weight @ (1 - np.sqrt(1 - (np.sin(angle) / 1.7) ** 2))
    ramp = matrix @ WIDE  # of the response "wavelength": read at longer wavelengths
    assert ramp[40] - 600 == pytest.approx(600 * shift, rel=0.01)


def test_a_table_of_filters_shifts_by_the_same_matrix():
    table = MeasuredFilters(WIDE, np.exp(-(((WIDE[None] - 600) / 20) ** 2)), effective_index=1.8)
    seen = table.transmittance(grid(), [0.0, 0.2])
    matrix = blue_shift(WIDE, ([0.2], [1.0]), 1.8, onto=grid())
    np.testing.assert_allclose(seen[1], table.values @ matrix.T)


def test_bad_input():
    response = np.ones((3, len(WIDE)))
    with pytest.raises(InputError, match="effective index"):
        blue_shift(WIDE, ([0.1], [1.0]), 0.9)
    with pytest.raises(InputError, match="480-780 nm"):
        blue_shift(WIDE, ([0.1], [1.0]), 1.7, onto=[470.0])
    with pytest.raises(InputError, match="points of the pupil"):
        blue_shift(WIDE, pupil(0.1), 1.7, measured_in=([0.0, 0.1], [0.5, 0.5]))
    with pytest.raises(InputError, match="all are on the axis"):
        fit_effective_index(response, response[None], WIDE, [([0.0], [1.0])])
    with pytest.raises(InputError, match="2 cones"):
        fit_effective_index(response, response[None], WIDE, [([0.1], [1.0])] * 2)
