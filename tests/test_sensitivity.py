"""R from measurement: planted sensitivities, lights of every fault, and what the inference says."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from squilla.calibration.calibration import Calibration
from squilla.calibration.inference import infer_sensitivity
from squilla.calibration.known import sensitivity_from_spectra
from squilla.calibration.sensitivity import (
    Responses,
    gaussian_bands,
    sweep_sensitivity,
)
from squilla.errors import InputError
from squilla.optics.angle import pupil_cone
from squilla.optics.filters import StencilRecipe
from squilla.priors import gaussian_mixtures
from squilla.spectra import grid, lights, reflectances

GRID = grid(500, 750, 2.5)
CORNER = 0.163


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def truth():
    """The exact stack in the cone of an F/4 lens at three field angles, (A, M, K)."""
    array, seen = StencilRecipe(filters=36).draw(13), []
    for angle in (0.0, 0.7 * CORNER, CORNER):
        angles, weights = pupil_cone(angle, 4.0, rings=2)
        seen.append(np.einsum("a,amk->mk", weights, array.transmittance(GRID, angles).numpy()))
    return np.stack(seen)[:, :12] * (0.8 - 0.4 * (GRID - 500) / 250)


def swept(truth, *, seed=0, power=0.01, noise=1e-3, steps=None, stray=0.0, drift=0.0):
    random = np.random.default_rng(seed)
    steps = np.delete(np.arange(500, 751, 5.0), [17, 34]) if steps is None else np.asarray(steps)
    light = (1 - stray) * gaussian_bands(steps, np.full(len(steps), 5.0), GRID)
    response = np.einsum("sk,amk->sam", light + stray / len(GRID), truth)
    level = (
        1 + power * random.standard_normal(len(steps)) + drift * np.linspace(-0.5, 0.5, len(steps))
    )
    response *= level[:, None, None]
    response += noise * rms(response) * random.standard_normal(response.shape)
    return Responses(steps, np.full(len(steps), 5.0), response)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_sweep_with_faults_gives_the_sensitivity_and_its_error(truth, seed):
    """5 nm source, 1 % power noise, two steps missing: found to 1.2 %, mostly one common factor."""
    found, facts = sweep_sensitivity(swept(truth, seed=seed), GRID)
    error = found.sensitivity - truth
    assert rms(error) < 0.012 * rms(truth)
    common = (error * truth).sum((0, 1)) / (truth**2).sum((0, 1))
    assert rms(error - common * truth) < 0.004 * rms(truth)
    normalised = rms(error / np.sqrt(np.mean(np.square(found.deviations), 0)))
    assert 0.5 < normalised < 1.6
    assert facts["power_noise"] == pytest.approx(0.01, rel=0.6)
    assert facts["stray_light"] is None
    assert facts["power_drift"] is None


@pytest.mark.parametrize("bandwidth", [3.0, 5.0, 8.0])
def test_the_bandwidth_is_undone(bandwidth):
    """Gaussian features convolve to Gaussians of known width and height."""
    fine = grid(500, 750, 1)
    steps, wide = np.arange(500, 751, 4.0), np.hypot(16.0, bandwidth / 2.3548)
    centres = np.array([560.0, 600.0, 650.0, 690.0])
    measured = 16.0 / wide * np.exp(-((steps[:, None] - centres) ** 2) / 2 / wide**2)
    sweep = Responses(steps, np.full(len(steps), bandwidth), measured[:, None])
    found, _ = sweep_sensitivity(sweep, fine)
    expected = np.exp(-((fine - centres[:, None]) ** 2) / 2 / 16.0**2)
    assert rms(found.sensitivity[0] - expected) < 0.01 * rms(expected)


def test_uneven_and_unordered_steps_serve_as_well(truth):
    random = np.random.default_rng(2)
    steps = random.permutation(
        np.r_[500, 750, np.arange(505, 746, 5.0) + random.uniform(-2, 2, 49)]
    )
    found, _ = sweep_sensitivity(swept(truth, steps=steps, power=0.0), GRID)
    assert rms(found.sensitivity - truth) < 0.005 * rms(truth)


def test_stray_light_shows_outside_the_band_and_is_taken_out(truth):
    steps = np.r_[480, 485, np.arange(500, 751, 5.0), 765, 770]
    found, facts = sweep_sensitivity(swept(truth, steps=steps, stray=0.02, power=0.0), GRID)
    assert facts["stray_light"] == pytest.approx(0.02, rel=0.05)
    with_it, _ = sweep_sensitivity(swept(truth, steps=steps[2:-2], stray=0.02, power=0.0), GRID)
    assert rms(found.sensitivity - truth) < 0.5 * rms(with_it.sensitivity - truth)


def test_drift_shows_where_a_wavelength_comes_back(truth):
    parts = np.array_split(np.arange(500, 751, 5.0), 8)
    steps = np.r_[np.concatenate([np.r_[625.0, part] for part in parts]), 625.0]
    found, facts = sweep_sensitivity(swept(truth, steps=steps, drift=0.05, power=0.002), GRID)
    assert facts["power_drift"] == pytest.approx(0.05, abs=0.01)
    assert rms(found.sensitivity - truth) < 0.006 * rms(truth)


def test_a_misread_power_is_doubted(truth):
    sweep = swept(truth, power=0.002)
    sweep.response[20] *= 1.3
    found, facts = sweep_sensitivity(sweep, GRID)
    assert facts["doubted_steps"] == f"{sweep.wavelength[20]:g} nm"
    assert rms(found.sensitivity - truth) < 0.006 * rms(truth)


def test_nonsense_is_refused(truth):
    sweep = swept(truth)
    random = Responses(sweep.wavelength, sweep.bandwidth, sweep.response.copy())
    random.response[::5] *= np.linspace(0.3, 3, 10)[:, None, None]
    with pytest.raises(InputError, match="powers"):
        sweep_sensitivity(random, GRID)
    few = Responses(sweep.wavelength[:21], sweep.bandwidth[:21], sweep.response[:21])
    with pytest.raises(InputError, match="covers 500-605"):
        sweep_sensitivity(few, GRID)
    with pytest.raises(InputError, match="dark"):
        sweep_sensitivity(replace(sweep, response=0 * sweep.response), GRID)
    seeing = np.r_[485, np.arange(500, 751, 5.0)]
    wide = swept(truth, steps=seeing)
    wide.response[0] = wide.response[1]
    with pytest.raises(InputError, match="widen the design's band"):
        sweep_sensitivity(wide, GRID)
    with pytest.raises(InputError, match="at least 3"):
        infer_sensitivity(np.ones((2, 5)), np.ones((2, 1, 4)), grid(500, 504))


# --- known spectra ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shown():
    """Twelve surfaces under four lamps and nine single-colour LEDs, and their field angles."""
    lamps = [lights().one(name, GRID) for name in ("A", "FL11", "LED-B1", "D65")]
    lamps += [np.exp(-(((GRID - c) / 12) ** 2)) for c in np.linspace(505, 745, 9)]
    surfaces = reflectances().on(GRID)[60:180:10]
    spectra = np.concatenate([surfaces * lamp for lamp in lamps])
    return spectra, np.tile(np.linspace(0.02, CORNER, len(surfaces)), len(lamps))


def test_a_chart_and_lamps_teach_the_sensitivity(truth, shown):
    spectra, angle = shown
    random = np.random.default_rng(0)
    nodes = np.array([0.0, 0.7 * CORNER, CORNER])
    falloff = np.cos(nodes)[:, None, None] ** 4
    exact = Calibration.from_sensitivity(truth * falloff, GRID, nodes)
    weights = exact.angle_weights(torch.from_numpy(angle)).numpy()
    measured = np.einsum("na,amk,nk->nm", weights, exact.sensitivity, spectra)
    measured *= 1 + 0.005 * random.standard_normal((len(measured), 1))
    measured += 1e-3 * measured.mean(1, keepdims=True) * random.standard_normal(measured.shape)
    found = sensitivity_from_spectra(measured, spectra, GRID, angle=angle, f_number=4.0)
    assert 1.5 < found.provenance["effective_index"] < 2.2
    assert found.angle[-1] == pytest.approx(CORNER)
    error = found.sensitivity[[0, -1]] - exact.sensitivity[[0, -1]]
    assert rms(error) < 0.06 * rms(truth)
    normalised = rms(error / found.uncertainty[[0, -1]])
    assert 0.4 < normalised < 2.5


def test_enough_independent_spectra_give_any_matrix():
    """With more spectra than bands and no noise the answer is least squares."""
    band = grid(500, 750, 10)
    spectra = gaussian_mixtures(100, band).double().numpy()
    truth = StencilRecipe(filters=6).draw(1).transmittance(band).numpy()
    found = sensitivity_from_spectra(spectra @ truth.T, spectra, band)
    expected = np.linalg.lstsq(spectra, spectra @ truth.T, rcond=None)[0].T
    assert rms(found.sensitivity[0] - expected) < 0.01 * rms(expected)


def test_measurements_that_do_not_fit_are_refused(shown):
    spectra, angle = shown
    measured = np.ones((len(spectra), 4))
    for arguments, says in (
        ((measured[1:], spectra, GRID), "do not belong together"),
        ((measured, np.where(spectra > 0.5, np.nan, spectra), GRID), "NaN"),
        ((measured, 0 * spectra, GRID), "dark"),
    ):
        with pytest.raises(InputError, match=says):
            sensitivity_from_spectra(*arguments)
    with pytest.raises(InputError, match="field angles"):
        sensitivity_from_spectra(measured, spectra, GRID, angle=angle[:3])
    with pytest.raises(InputError, match="SNRs"):
        sensitivity_from_spectra(measured, spectra, GRID, snr=angle[:3])
