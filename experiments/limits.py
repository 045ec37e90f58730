"""What a few dozen numbers can tell: how many really count, how fine, and what stays unseen.

Usage: python experiments/limits.py

For the thesis' array, for 36 band-passes beside each other, and at several signal-to-noise ratios:
the number of independent numbers in a measurement, the width of what one wavelength is spread over,
and the distance at which two lines are told apart; the same for the band-passes with no more light
than the thesis' array has; and two spectra that no measurement at 30 dB tells from each other.
Writes experiments/results/limits.json and docs/images/limits.webp; a minute on one core.
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.optimize import brentq, lsq_linear

from squilla.calibration.calibration import Calibration
from squilla.calibration.rehearsal import ideal_calibration
from squilla.camera.design import CameraDesign
from squilla.camera.twin import Camera
from squilla.optics.merit import Noise, PhotonNoise, Prior, WhiteNoise, wiener
from squilla.reconstruction.models import load_model
from squilla.spectra import CHART_LIGHT, chart_reflectances, grid, lights

RESULTS = Path(__file__).parent / "results" / "limits.json"
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "limits.webp"
WAVELENGTH = grid()
RATIOS = (10.0, 20.0, 30.0, 40.0)
SEPARATIONS = (3, 4, 6, 8, 10, 12, 16, 20, 26, 32)
LINE = 2.0
"""Width of the lines that are to be told apart, nm FWHM."""


def arrays() -> dict[str, torch.Tensor]:
    """Return the responses that are compared, each (36, K)."""
    ours = ideal_calibration(Camera(CameraDesign.load("thesis"))).sensitivity[0]
    ours = np.asarray(ours, float)
    centres = np.linspace(WAVELENGTH[0], WAVELENGTH[-1], 36)
    pitch = centres[1] - centres[0]
    # As light as ours: a pass band takes what it takes at the same peak.
    passes = np.exp(-4 * np.log(2) * ((WAVELENGTH - centres[:, None]) / (1.2 * pitch)) ** 2)
    passes *= ours.max()
    return {"thesis": torch.from_numpy(ours), "band-passes": torch.from_numpy(passes)}


def independent_numbers(response: torch.Tensor, prior: Prior, noise: Noise) -> float:
    """Return the degrees of freedom of the best linear estimate, trace(R G).

    Each of the measurement's own directions counts by signal / (signal + noise).
    Source: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, eq. 3.50.
    """
    gain = wiener(response, prior, noise=noise)
    return float((response * gain.T).sum())


def widths(response: torch.Tensor, prior: Prior, noise: Noise) -> np.ndarray:
    """Return the full width at half maximum of what each wavelength is spread over, nm.

    A unit at one wavelength, measured without noise, is estimated as a column of G R.
    """
    spread = (wiener(response, prior, noise=noise) @ response).numpy()
    step = WAVELENGTH[1] - WAVELENGTH[0]
    found = []
    for at in range(10, len(WAVELENGTH) - 10):
        column = spread[:, at]
        peak = int(column.argmax())
        over = column >= column[peak] / 2
        left = peak - int(np.argmin(over[peak::-1]))
        right = peak + int(np.argmin(over[peak:]))
        found.append((right - left - 1) * step)
    return np.array(found)


def told_apart(response: torch.Tensor, snr: float, separation: float, draws: int = 200) -> float:
    """Return how often the sparse solver shows two equal lines as two, with a dip between them."""
    generator = torch.Generator().manual_seed(int(1000 * separation + snr))
    span = WAVELENGTH[-1] - WAVELENGTH[0] - separation - 40
    middle = WAVELENGTH[0] + 20 + separation / 2 + span * torch.rand(draws, generator=generator)
    sigma = LINE / 2.3548
    lines = [
        torch.exp(-(((torch.from_numpy(WAVELENGTH) - centre[:, None]) / sigma) ** 2) / 2)
        for centre in (middle - separation / 2, middle + separation / 2)
    ]
    y = (lines[0] + lines[1]) @ response.mT
    power = y.square().mean(1, keepdim=True).sqrt() * 10 ** (-snr / 20)
    y = y + power * torch.randn(y.shape, generator=generator, dtype=y.dtype)
    model = load_model("sparse", Calibration.from_sensitivity(response.numpy(), WAVELENGTH))
    shown = model(y.float(), snr=snr).numpy()
    good = 0
    for spectrum, centre in zip(shown, middle.numpy(), strict=True):
        half, near = separation / 2, max(separation / 4, 1.0)
        heights = [
            spectrum[np.abs(WAVELENGTH - place) <= near].max()
            for place in (centre - half, centre + half)
        ]
        dip = spectrum[np.abs(WAVELENGTH - centre) <= 1].min()
        good += dip < 0.735 * min(heights) and min(heights) > 0.3 * spectrum.max()
    return good / draws


def photon_ratio(response: torch.Tensor, prior: Prior, exposure: float) -> float:
    """Return the signal-to-noise ratio that an exposure gives an array, dB."""
    variance = PhotonNoise(exposure).variance(response, prior).mean()
    power = ((response @ prior.moment) * response).sum(-1).mean()
    return float(10 * torch.log10(power / variance))


def exposure_for(response: torch.Tensor, prior: Prior, snr: float) -> float:
    """Return the exposure that gives an array a signal-to-noise ratio, e- of a clear pixel."""

    def off(logarithm: float) -> float:
        return photon_ratio(response, prior, 10**logarithm) - snr

    return 10 ** brentq(off, 0, 9)


def unseen_pair(response: np.ndarray, truth: np.ndarray, snr: float) -> np.ndarray:
    """Return a non-negative spectrum that measures like the truth to a signal-to-noise ratio.

    A bump is added at 620 nm, and what it changes in the measurement is taken back elsewhere, no
    better than the noise demands.
    """
    bump = 0.6 * np.exp(-(((WAVELENGTH - 620) / 9) ** 2))
    seen = response / np.linalg.norm(response @ truth)

    def other(weight: float) -> np.ndarray:
        rows = np.concatenate([10**weight * seen, np.eye(len(truth))])
        wanted = np.concatenate([-(10**weight) * seen @ bump, np.zeros(len(truth))])
        return truth + bump + lsq_linear(rows, wanted, (-(truth + bump), np.inf)).x

    def off(weight: float) -> float:
        return -20 * np.log10(np.linalg.norm(seen @ (other(weight) - truth))) - snr

    return other(brentq(off, 0, 6, xtol=1e-2))


def judge(response: torch.Tensor, prior: Prior, noise: Noise, snr: float) -> dict:
    """Return one row of the table."""
    apart = {each: told_apart(response, snr, each) for each in SEPARATIONS}
    enough = [each for each in SEPARATIONS if apart[each] >= 0.9]
    return {
        "independent_numbers": independent_numbers(response, prior, noise),
        "width": float(np.median(widths(response, prior, noise))),
        "told_apart": apart,
        "resolved_from": min(enough, default=None),
    }


def main() -> None:
    torch.set_num_threads(1)
    prior = Prior.draw("broad", wavelength=WAVELENGTH)
    results: dict = {"arrays": {}}
    sets = arrays()
    for name, response in sets.items():
        results["arrays"][name] = {
            f"{snr:g} dB": judge(response, prior, WhiteNoise(snr), snr) for snr in RATIOS
        }
    results["arrays"]["band-passes, no more light"] = {}
    for snr in RATIOS:
        exposure = exposure_for(sets["thesis"], prior, snr)
        response, noise = sets["band-passes"], PhotonNoise(exposure)
        own = photon_ratio(response, prior, exposure)
        results["arrays"]["band-passes, no more light"][f"{snr:g} dB"] = judge(
            response, prior, noise, own
        ) | {"own_ratio": own}
    chart = chart_reflectances().on(WAVELENGTH)
    truth = chart[15] * lights().on(WAVELENGTH)[lights().name.index(CHART_LIGHT)]
    truth = truth / truth.max()
    response = sets["thesis"].numpy()
    other = unseen_pair(response, truth, 30.0)
    results["pair"] = {"snr": 30.0, "largest_difference": float(np.abs(other - truth).max())}
    RESULTS.write_text(json.dumps(results, indent=1))
    draw(results, truth, other)
    print(table(results))
    print(results["pair"])


def table(results: dict) -> str:
    lines = [
        "| array | SNR | independent numbers | width of one wavelength | two lines apart from |",
        "|---|---|---|---|---|",
    ]
    for name, rows in results["arrays"].items():
        for snr, row in rows.items():
            apart = row["resolved_from"]
            lines.append(
                f"| {name} | {snr} | {row['independent_numbers']:.1f} | {row['width']:.0f} nm | "
                + (f"{apart} nm |" if apart else f"more than {SEPARATIONS[-1]} nm |")
            )
    return "\n".join(lines)


def draw(results: dict, truth: np.ndarray, other: np.ndarray) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
    styles = ("-", "--", ":")
    for (name, rows), style in zip(results["arrays"].items(), styles, strict=True):
        axes[0].plot(
            RATIOS, [rows[f"{snr:g} dB"]["independent_numbers"] for snr in RATIOS],
            f"o{style}", color="#0f8b8d", label=name,
        )  # fmt: skip
    axes[0].set(xlabel="signal-to-noise ratio, dB", title="independent numbers of 36", ylim=(0, 52))
    axes[0].set_yticks([0, 12, 24, 36])
    axes[0].legend(frameon=False, loc="upper left", fontsize="small")
    for snr, colour in zip(RATIOS, ("#c7d9d9", "#7fb8b9", "#0f8b8d", "#08494a"), strict=True):
        apart = results["arrays"]["thesis"][f"{snr:g} dB"]["told_apart"]
        axes[1].plot(
            list(map(float, apart)), [100 * share for share in apart.values()],
            "o-", color=colour, label=f"{snr:g} dB",
        )  # fmt: skip
    axes[1].set(xlabel="distance of two lines, nm", title="told apart, %", ylim=(0, 103))
    axes[1].legend(frameon=False)
    axes[2].plot(WAVELENGTH, truth, color="black", label="one spectrum")
    axes[2].plot(WAVELENGTH, other, color="#d1495b", label="another")
    axes[2].set(xlabel="nm", title=f"the same 36 numbers, to {results['pair']['snr']:.0f} dB")
    axes[2].legend(frameon=False, loc="upper left", fontsize="small")
    axes[2].set_ylim(0, 1.9)
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURE, dpi=130, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    main()
