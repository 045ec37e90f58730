"""What each pixel of a cube is worth: how well it explains its measurement, and what spoke against.

No truth is needed for it. A spectrum x that is right gives R x, which differs from the measurement
by no more than the noise; where it differs by far more, something was there that the model does not
know: a wrong distance, dust, light from elsewhere, a saturated neighbour.
"""

from enum import IntFlag
from typing import TYPE_CHECKING

import numba
import numpy as np
import torch
from torch import Tensor

from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration

if TYPE_CHECKING:
    from xarray import DataArray

_ZONES = 24
"""Field angles, even in their square, at one of which R is taken for each tile."""

_TILE = 16
"""Side of the tiles, px."""

_MODEL = 0.01
"""What a calibrated R may be wrong by, against the signal of a pixel; counted as noise."""

_FAR = 9.0
"""Residual from which on a pixel is not to be believed: three times the noise, RMS."""

_LACKING = 0.25
"""Share of channels without which a pixel is not to be believed."""

_SATURATED = 0.125
"""Share of saturated channels from which on that is the reason."""


class Doubt(IntFlag):
    """Why a pixel should not be believed."""

    SATURATED = 1
    HIDDEN = 2
    RESIDUAL = 4
    DARK = 8
    EMPTY = 16

    @property
    def meaning(self) -> str:
        """In one sentence."""
        return {
            Doubt.SATURATED: "an eighth of its channels or more are saturated",
            Doubt.HIDDEN: "a quarter of its channels or more are hidden, broken or lost",
            Doubt.RESIDUAL: "its spectrum explains the measurement three times worse than noise",
            Doubt.DARK: "its signal does not rise above the noise",
            Doubt.EMPTY: "fewer than half of its channels are there: it has no spectrum",
        }[self]


def judge(
    cube: "DataArray", measurement: Measurement, calibration: Calibration
) -> "dict[str, DataArray]":
    """Judge every pixel of a cube by its measurement.

    Parameters
    ----------
    cube : DataArray, (y, x, wavelength)
        What a model made of the measurement.
    measurement : Measurement
    calibration : Calibration
        With the sensor's noise; with a response matrix alone nothing is known of it.

    Returns
    -------
    dict of DataArray, (y, x)
        residual : reduced chi-square, the mean over the valid channels of the squared difference
        of y and R x over the noise's variance; about 1, or less where a model follows its noise.
        flags : uint8, the sum of the `Doubt` that speaks against a pixel; 0 where nothing does.
        To be saved with the cube, `squilla.files.cube.save(extra=)`.
    """
    from xarray import DataArray

    y, valid = measurement.y, torch.as_tensor(measurement.valid, dtype=torch.bool)
    x = torch.from_numpy(np.ascontiguousarray(cube.values, np.float32))
    exposure = float(measurement.provenance.get("exposure", 0.0)) or 1.0
    pixels = calibration.pixels
    residual = torch.full(y.shape[:2], torch.nan)
    full = np.inf
    if pixels is not None:
        fixed = (pixels.read_noise / pixels.gain) ** 2 + 1 / 12
        residual = _residual(
            x, y, valid, measurement.angle, calibration, exposure, 1 / pixels.gain, fixed
        )
        black = float(np.median(pixels.bias[::16, ::16]))
        full = 0.9 * (pixels.saturation - black) / exposure
    # A worn unit is missed by all pixels alike; it does not speak against single ones.
    used = valid.flatten(0, 1).float().mean(0) > 0.02
    flags = torch.zeros(y.shape[:2], dtype=torch.uint8)
    _flag_lacking(
        y.flatten(0, 1).numpy(), valid.flatten(0, 1).numpy(), used.numpy(), np.float32(full),
        flags.view(-1).numpy(),
    )  # fmt: skip
    flags |= (residual > _FAR) * Doubt.RESIDUAL
    if measurement.snr is not None:
        flags |= (measurement.snr < 0) * Doubt.DARK
    flags |= x[..., 0].isnan() * Doubt.EMPTY  # all bands or none
    told = {
        "long_name": "why not to believe a pixel",
        "flag_masks": [int(doubt) for doubt in Doubt],
        "flag_meanings": " ".join(str(doubt.name).lower() for doubt in Doubt),
    }
    chi = {"long_name": "residual: mean squared difference of R x and y over the noise's variance"}
    return {
        "residual": DataArray(residual.numpy(), dims=("y", "x"), name="residual", attrs=chi),
        "flags": DataArray(flags.numpy(), dims=("y", "x"), name="flags", attrs=told),
    }


def told_of(judged: "dict[str, DataArray]") -> dict[str, float]:
    """Return the figures for the provenance: usual residual and share of flagged pixels."""
    residual, flags = judged["residual"].values, judged["flags"].values
    usual = float(np.nanmedian(residual)) if np.isfinite(residual).any() else float("nan")
    return {"usual_residual": usual, "flagged": float((flags > 0).mean())}


def _residual(
    x: Tensor, y: Tensor, valid: Tensor, angle: Tensor, calibration: Calibration,
    exposure: float, shot: float, fixed: float,
) -> Tensor:  # fmt: skip
    """Return the reduced chi-square of every pixel, (H, W).

    In tiles, each with the R of its middle, so that it costs a fraction of a reconstruction.
    shot, fixed : variance of the noise in DN^2, for each DN of signal and of every pixel.
    """
    nodes = torch.linspace(0, float(angle.square().max()), _ZONES).sqrt()
    weight = calibration.angle_weights(nodes)
    response = torch.einsum("za,amk->zkm", weight, calibration.sensitivities)
    place = angle.square() / angle.square().max().clamp_min(1e-12) * (_ZONES - 1)
    height, width, units = y.shape
    expected = np.empty(y.shape, np.float32)
    spectra, zones, places = x.numpy(), response.numpy(), place.numpy()
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            tile = slice(top, top + _TILE), slice(left, left + _TILE)
            zone = zones[round(float(places[tile].mean()))]
            np.matmul(spectra[tile], zone, out=expected[tile])  # row by row: nothing is copied
    found = torch.empty(height * width)
    _mismatch(
        y.reshape(-1, units).numpy(), valid.reshape(-1, units).numpy(),
        expected.reshape(-1, units), np.float32(exposure), np.float32(shot),
        np.float32(fixed), np.float32(_MODEL**2), found.numpy(),
    )  # fmt: skip
    return found.view(height, width)


@numba.njit(parallel=True, cache=True)
def _flag_lacking(y, valid, used, full, flags):
    units, wanted = y.shape[1], max(used.sum(), 1)
    for place in numba.prange(len(y)):
        saturated, lacking = 0, 0
        for unit in range(units):
            if not valid[place, unit]:
                saturated += y[place, unit] > full
                lacking += used[unit]
        if saturated >= _SATURATED * units:
            flags[place] = 1  # Doubt.SATURATED
        elif lacking >= _LACKING * wanted:
            flags[place] = 2  # Doubt.HIDDEN


@numba.njit(parallel=True, cache=True)
def _mismatch(y, valid, expected, exposure, shot, fixed, model, found):
    units = y.shape[1]
    for place in numba.prange(len(y)):
        level, count = np.float32(0), 0
        for unit in range(units):
            if valid[place, unit]:
                level += y[place, unit]
                count += 1
        if count == 0:
            found[place] = np.nan
            continue
        wrong = model * (exposure * level / count) ** 2 + fixed
        total = np.float32(0)
        for unit in range(units):
            if valid[place, unit]:
                seen = y[place, unit]
                off = (seen - expected[place, unit]) * exposure
                total += off * off / (wrong + shot * max(seen, np.float32(0)) * exposure)
        found[place] = total / count
