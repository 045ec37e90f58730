"""Reading pictures between their pixels: in one step at any places, in two at smooth ones."""

import numpy as np
import pytest

from squilla.calibration.resample import SINC, resample, resample_smoothly

FIELD, MARGIN, UNITS = (60, 70), 20, 3


def waves(y, x):
    """Return a smooth picture at any place."""
    rng = np.random.default_rng(3)
    waves = rng.uniform(-0.8, 0.8, (8, 2))  # rad per px
    phase = rng.uniform(0, 6, 8)
    return sum(np.sin(a * y + b * x + c) for (a, b), c in zip(waves, phase, strict=True))


def read(plane, bend):
    """Return pictures read in one step and in two, the truth, and which points both could read."""
    rng = np.random.default_rng(5)
    rows, columns = (size + 2 * MARGIN for size in FIELD)
    image = np.broadcast_to(waves(*np.mgrid[:rows, :columns]), (UNITS, rows, columns))
    image, bad = image.astype(np.float32), rng.random((UNITS, rows, columns)) < 0.01
    place = np.zeros((UNITS, 2, 10))
    place[..., 0] = MARGIN + rng.uniform(-4, 4, (UNITS, 2))
    place[..., 1:] = bend * rng.normal(size=(UNITS, 2, 9))
    baseline = rng.uniform(-3, 3, (UNITS, 2))
    y, x = np.meshgrid(*(np.linspace(-1, 1, size) for size in FIELD), indexing="ij")
    disparity = plane[0] + plane[1] * y + plane[2] * x
    powers = np.stack([y ** (a - b) * x**b for a in range(4) for b in range(a + 1)])
    shift = np.tensordot(place, powers, 1) + baseline[..., None, None] * disparity
    pixel = np.mgrid[: FIELD[0], : FIELD[1]]
    truth = waves(*np.moveaxis(shift + pixel, 1, 0))
    once, twice = np.zeros((2, UNITS, *FIELD), np.float32)
    seen, also = np.zeros((2, UNITS, *FIELD), bool)
    resample(image[None], bad, place, baseline, disparity, SINC, once[None], seen)
    place[..., :3] += baseline[..., None] * plane
    assert resample_smoothly(image, bad, place, twice, also)
    np.testing.assert_array_equal(seen, also)
    return once, twice, truth, seen


@pytest.mark.parametrize(
    ("plane", "bend"),
    [((2, 0, 0), 0), ((1, 0.02, -0.1), 0), ((6, 0.2, -0.3), 0), ((2, 0.02, 0), 0.02)],
)
def test_two_steps_are_as_true_as_one(plane, bend):
    once, twice, truth, seen = read(plane, bend)
    assert 0.5 < seen.mean() < 1
    error = [np.sqrt(np.mean((found - truth)[seen] ** 2)) for found in (once, twice)]
    assert error[0] < 0.01
    assert error[1] < 1.01 * error[0]


def test_two_steps_are_one_where_all_points_shift_alike():
    once, twice, _, seen = read((2, 0, 0), 0)
    np.testing.assert_allclose(twice[seen], once[seen], atol=2e-4 * once.std())


def test_what_no_polynomial_tells_is_left_alone():
    place = np.zeros((1, 2, 10))
    place[0, 0, 1:], place[0, 1, 1:] = 12, -12  # each row is seen through many
    image = np.ones((1, 100, 110), np.float32)
    values, seen = np.full((1, *FIELD), -1, np.float32), np.zeros((1, *FIELD), bool)
    assert not resample_smoothly(image, image == 0, place, values, seen)
    assert (values == -1).all()
    assert not seen.any()
