"""Metrics: each against another implementation or a closed form."""

import numpy as np
import pytest

from squilla.camera.scenes import CHART_SHAPE, chart_layout, chart_scene
from squilla.errors import InputError
from squilla.evaluation.chart import COLOURS, patch_errors, patch_means
from squilla.evaluation.metrics import ciede2000, evaluate, gfc, mae, mse, psnr, rmse, sam, ssim
from squilla.files.cube import labelled
from squilla.spectra import chart_reflectances, grid, lights


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    truth = random.random((24, 31, 9)).cumsum(0) / 20 + 0.2
    return (truth + 0.05 * random.standard_normal(truth.shape)).astype("f4"), truth.astype("f4")


def test_errors_of_a_constant_offset():
    truth = np.random.default_rng(2).random((4, 5, 100))
    for offset in (0.1, -0.3):
        np.testing.assert_allclose(mse(truth + offset, truth), offset**2)
        np.testing.assert_allclose(rmse(truth + offset, truth), abs(offset))
        np.testing.assert_allclose(mae(truth + offset, truth), abs(offset))
        np.testing.assert_allclose(psnr(truth + offset, truth), -20 * np.log10(abs(offset)))
    assert np.isinf(psnr(truth, truth)).all()


def test_errors_agree_with_scikit(pair):
    from skimage.metrics import peak_signal_noise_ratio
    from sklearn.metrics import mean_absolute_error, mean_squared_error

    estimate, truth = (each.reshape(-1, 9) for each in pair)
    assert mse(estimate, truth).mean() == pytest.approx(mean_squared_error(truth, estimate))
    assert mae(estimate, truth).mean() == pytest.approx(mean_absolute_error(truth, estimate))
    expected = peak_signal_noise_ratio(truth[0], estimate[0], data_range=2.0)
    assert psnr(estimate, truth, peak=2.0)[0] == pytest.approx(expected)


def test_spectral_angle_agrees_with_spy(pair):
    import spectral

    estimate, truth = pair
    members = truth[0, :3].astype(float)
    expected = spectral.spectral_angles(estimate.astype(float), members)
    for member in range(3):
        np.testing.assert_allclose(sam(estimate, members[member]), expected[..., member], atol=1e-6)


def test_angle_and_fit_of_known_vectors():
    """Turned by a known angle in a plane; scale changes nothing, not even at tiny angles."""
    for angle in (1e-5, 0.01, 0.5, 2.0):
        turned = np.array([np.cos(angle), np.sin(angle), 0, 0])
        assert sam(7 * turned, [3, 0, 0, 0]) == pytest.approx(angle, rel=1e-5)
        assert gfc(7 * turned, [3, 0, 0, 0]) == pytest.approx(abs(np.cos(angle)))
    assert sam(np.zeros(4), np.ones(4)) == pytest.approx(np.pi / 2)


def test_structural_similarity_agrees_with_scikit_image(pair):
    from skimage.metrics import structural_similarity

    estimate, truth = pair
    expected = [
        structural_similarity(truth[..., k], estimate[..., k], data_range=truth[..., k].max())
        for k in range(9)
    ]
    np.testing.assert_allclose(ssim(estimate, truth), expected, rtol=1e-4)
    np.testing.assert_allclose(ssim(truth, truth), 1, rtol=1e-6)
    whole = structural_similarity(
        truth[..., 4], estimate[..., 4], data_range=truth[..., 4].max(), full=True
    )[1]
    half = np.zeros(truth.shape[:2], bool)
    half[:, 16:] = True
    assert ssim(estimate, truth, half)[4] == pytest.approx(whole[3:-3, 16:-3].mean(), rel=1e-4)
    with pytest.raises(InputError, match="7 x 7"):
        ssim(truth[:6], truth[:6])


def test_colour_difference_agrees_with_colour():
    """Over the whole visible band, through colour-science's own spectral classes."""
    import colour

    wavelength = grid(380, 780)
    random = np.random.default_rng(3)
    surfaces = np.clip(random.standard_normal((2, 4, len(wavelength))).cumsum(-1) / 60 + 0.4, 0, 1)
    power = colour.SDS_ILLUMINANTS["D65"].copy().align(colour.SpectralShape(380, 780, 1)).values
    light = power * wavelength
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]

    def lab(reflectance):
        sd = colour.SpectralDistribution(reflectance, wavelength)
        lamp = colour.SpectralDistribution(power, wavelength)
        xyz = colour.sd_to_XYZ(sd, observer, lamp, method="Integration") / 100
        white = colour.sd_to_XYZ(colour.sd_ones(sd.shape), observer, lamp, method="Integration")
        return colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(white))

    expected = [
        colour.delta_E(lab(a), lab(b), method="CIE 2000") for a, b in zip(*surfaces, strict=True)
    ]
    found = ciede2000(surfaces[0] * light, surfaces[1] * light, wavelength, light)
    np.testing.assert_allclose(found, expected, atol=0.02)


# --- the summary ---------------------------------------------------------------------------------


def test_summary_follows_its_parts(pair):
    from skimage.metrics import peak_signal_noise_ratio

    estimate, truth = pair
    peak = truth.max(-1, keepdims=True)
    summary = evaluate(estimate, truth)
    assert summary["mse"] == pytest.approx(mse(estimate / peak, truth / peak).mean(), rel=1e-5)
    assert summary["rmse"] == pytest.approx(np.sqrt(summary["mse"]))
    every = mse(estimate / peak, truth / peak)
    assert summary["mse_median"] == pytest.approx(np.median(every), rel=1e-5)
    assert summary["mae"] == pytest.approx(mae(estimate / peak, truth / peak).mean(), rel=1e-5)
    assert summary["sam_deg"] == pytest.approx(np.degrees(sam(estimate, truth)).mean(), rel=1e-5)
    assert summary["gfc"] == pytest.approx(gfc(estimate, truth).mean(), rel=1e-5)
    assert summary["ssim"] == pytest.approx(ssim(estimate, truth).mean(), rel=1e-5)
    expected = peak_signal_noise_ratio(truth, estimate, data_range=float(truth.max()))
    assert summary["psnr_db"] == pytest.approx(expected, rel=1e-5)
    assert (summary["pixels"], summary["left_out"]) == (24 * 31, 0)


def test_summary_of_perfection(pair):
    summary = evaluate(pair[1], pair[1])
    assert summary["mse"] == summary["mae"] == 0
    assert summary["psnr_db"] == np.inf
    assert summary["sam_deg"] == pytest.approx(0, abs=1e-5)
    assert summary["gfc"] == pytest.approx(1)
    assert summary["ssim"] == pytest.approx(1)


def test_scale_is_taken_pixel_by_pixel(pair):
    """Dimming a pixel in both cubes changes no relative error."""
    estimate, truth = pair
    dim = np.linspace(0.2, 1, 31, dtype=np.float32)[None, :, None]
    before, after = evaluate(estimate, truth), evaluate(dim * estimate, dim * truth)
    for key in ("mse", "mae", "sam_deg", "gfc"):
        assert after[key] == pytest.approx(before[key], rel=1e-4)


def test_dark_empty_and_masked_pixels_are_left_out(pair):
    estimate, truth = (each.copy() for each in pair)
    before = evaluate(estimate[2:], truth[2:])
    truth[0] *= 1e-4
    estimate[1, :, 3] = np.nan
    after = evaluate(estimate, truth)
    assert after["left_out"] == 2 * 31
    for key in ("mse", "mae", "sam_deg", "gfc", "psnr_db"):
        assert after[key] == pytest.approx(before[key], rel=1e-6)
    assert np.isfinite(after["ssim"])
    mask = np.zeros((24, 31), bool)
    mask[5] = True
    row = evaluate(estimate, truth, mask=mask)
    assert row["pixels"] == 31
    assert row["mse"] == pytest.approx(evaluate(estimate[5], truth[5])["mse"])
    for wrong in (np.zeros((24, 31), bool), np.ones(31, bool)):
        with pytest.raises(InputError):
            evaluate(estimate, truth, mask=wrong)


def test_reference_is_brought_onto_the_cube():
    """A straight line is the same on any grid; a reference that ends too early is refused."""
    line = np.linspace(0.5, 1, 251)
    truth = labelled(np.tile(line, (8, 8, 1)), grid())
    cube = labelled(np.tile(line[::10], (8, 8, 1)), grid()[::10])
    assert evaluate(cube, truth)["mse"] == pytest.approx(0, abs=1e-15)
    assert evaluate(cube.transpose("wavelength", "y", "x"), truth)["mse"] < 1e-15
    with pytest.raises(InputError, match="dimension"):
        evaluate(cube.rename(wavelength="band"), truth)
    with pytest.raises(InputError, match="extrapolated"):
        evaluate(cube, truth.isel(wavelength=slice(0, 100)))
    with pytest.raises(InputError, match="reference is"):
        evaluate(cube.values, truth.values)


def test_dimensions_are_known_by_their_names():
    random = np.random.default_rng(0).random((9, 8, 251))
    cube = labelled(random, grid())
    assert evaluate(cube.transpose("x", "wavelength", "y"), cube)["mse"] == 0
    assert evaluate(cube, cube.transpose("x", "y", "wavelength"))["mse"] == 0


# --- the chart -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("height", "width"), [(250, 250), (100, 200), (300, 120)])
def test_chart_lies_centred_and_whole(height, width):
    labels = chart_layout(height, width)
    rows, columns = CHART_SHAPE
    assert set(np.unique(labels)) == {-1, *range(rows * columns)}
    sizes = np.bincount(labels[labels >= 0])
    assert sizes.max() / sizes.min() < 1.3
    turned = labels[::-1, ::-1]  # half a turn puts the last patch in the place of the first
    np.testing.assert_array_equal(turned >= 0, labels >= 0)
    np.testing.assert_array_equal(turned[labels >= 0], 23 - labels[labels >= 0])
    with pytest.raises(InputError):
        chart_layout(10, 250)


def test_chart_scene_holds_its_patches():
    scene, labels = chart_scene(), chart_layout(250, 250)
    assert scene.shape == (250, 250, 251)
    light = lights()["LED-B3"]
    means = patch_means(scene, labels, margin=0)
    np.testing.assert_allclose(means, chart_reflectances().values * light, rtol=1e-5)
    np.testing.assert_allclose(scene[0, 0], 0.03 * light, rtol=1e-5)
    with pytest.raises(InputError, match="no spectrum"):
        chart_scene("candle")


def test_patches_without_their_borders():
    """Light that leaks across the borders of the patches is seen without, not with, a margin."""
    labels = chart_layout(250, 250)
    clean = np.where(labels >= 0, 1.0, 0.2)[..., None] * np.ones(3)
    blurred = (clean + np.roll(clean, 2, 0) + np.roll(clean, -2, 0)) / 3
    assert patch_errors(blurred, clean, labels, margin=0).min() > 1e-5
    np.testing.assert_allclose(patch_errors(blurred, clean, labels, margin=2), 0, atol=1e-20)
    offset = patch_errors(clean + 0.1, clean, labels)
    np.testing.assert_allclose(offset[:COLOURS], 0.01)
    with pytest.raises(InputError, match="leaves nothing"):
        patch_means(clean, labels, margin=40)
    with pytest.raises(InputError, match="labels"):
        patch_means(clean[:10], labels)
