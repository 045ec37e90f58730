"""How well the channels of a camera agree about what they see: each against all the others.

The spectra of the world are alike enough that M channels predict one of them from the rest. Where
S = R P R' + noise is the second moment of measurements, P that of spectra, a channel's difference
to its best linear prediction from all others is, for all channels at once,

    e_m = (S^-1 y)_m / (S^-1)_mm,    with the variance 1 / (S^-1)_mm.
"""

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration, Pixels
from squilla.priors import second_moment

_MODEL = 0.01
"""What the model R may be wrong by in each channel, against the signal, beside its known errors."""

_WORN = 0.03
"""Change of a unit's response from which on it counts as worn; healthy ones stay below 0.015."""

_SURE = 5.0
"""Standard deviations by which a change must be sure."""

_FEWEST = 8
"""Blocks from which on the channels are compared."""


@dataclass(frozen=True)
class Agreement:
    """What each unit passes, compared with what the others and R predict.

    response : (M,) 1 for a sound unit, 0 for one that is covered.
    worn : (M,) bool; units whose channel is not to be used.
    """

    response: np.ndarray
    worn: np.ndarray

    @property
    def told(self) -> str:
        """The worn units and what they pass, in words; "none" without any."""
        units = np.flatnonzero(self.worn)
        return ", ".join(f"{unit} ({self.response[unit]:.0%})" for unit in units) or "none"


def model_error(calibration: Calibration, moment: Tensor) -> Tensor:
    """Return what the uncertainty of the sensitivity adds to measurements, as a second moment.

    Parameters
    ----------
    calibration : Calibration
    moment : Tensor, (K, K), float64
        Second moment of the spectra.

    Returns
    -------
    Tensor, (A + 1, M, M), float64
        The mean of (dR x)(dR x)' over the draws of the error dR, at each field angle and, last, for
        the mean sensitivity; zero where the calibration does not know its errors.
    """
    filters = calibration.filters
    total = torch.zeros(len(calibration.angle) + 1, filters, filters, dtype=torch.float64)
    if calibration.deviations is None:
        return total
    for draw in torch.from_numpy(calibration.deviations).double():
        error = torch.cat([draw, draw.mean(0, keepdim=True)])
        total += error @ moment @ error.mT
    return total / len(calibration.deviations)


def usual_moments(calibration: Calibration) -> Tensor:
    """Return the second moment of measurements of the broad prior at each angle, (A, M, M)."""
    moment = second_moment(calibration.wavelength)
    response = calibration.sensitivities.double()
    return response @ moment @ response.mT + model_error(calibration, moment)[:-1]


def compare(
    y: Tensor,
    valid: Tensor,
    angle: Tensor,
    calibration: Calibration,
    pixels: Pixels,
    *,
    blocks: int = 25,
) -> Agreement:
    """Find the units that measure something else than the others predict.

    Parameters
    ----------
    y : Tensor, (H, W, M)
        DN, aligned at least as well as blocks are large.
    valid : Tensor, (H, W, M) bool
    angle : Tensor, (H, W)
        Field angle, rad.
    calibration : Calibration
    pixels : Pixels
        For the noise.
    blocks : int
        Number of blocks along a side of the field, whose means are compared.

    Notes
    -----
    The unit is left out without which the least stays unexplained, and all is looked at again,
    until no response is off by more than 3 %. Where more than a quarter would have to go the units
    are not to blame, and none is left out.
    """
    side = max(min(y.shape[:2]) // blocks, 4)
    level, wrong, place = _blocks(y, valid, angle, side)
    units = calibration.filters
    response, worn = np.ones(units), np.zeros(units, bool)
    if len(level) < _FEWEST:
        return Agreement(response, worn)
    brightness = np.median(level, 1, keepdims=True)
    noise = brightness / pixels.gain + (pixels.read_noise / pixels.gain) ** 2 + 1 / 12
    relative = float(np.median(noise / brightness**2)) / side**2 + _MODEL**2
    zones = _expected(calibration, place, relative)
    level = np.where(wrong, 0, level) / brightness
    while True:
        change, doubt, unexplained = _changes(level, wrong | worn, zones)
        doubtful = np.abs(change) > np.maximum(_WORN, _SURE * doubt)
        if not doubtful.any():
            break
        worn[np.argmax(np.where(doubtful, unexplained, -1.0))] = True
        if worn.sum() > units // 4:
            return Agreement(response, np.zeros(units, bool))
    for unit in np.flatnonzero(worn):  # each judged once more, by the sound ones alone
        others = worn & (np.arange(units) != unit)
        change, doubt, _ = _changes(level, wrong | others, zones)
        response[unit] = np.clip(1 + change[unit], 0, None)
        worn[unit] = abs(change[unit]) > max(_WORN, _SURE * doubt[unit])
    return Agreement(response, worn)


def _blocks(
    y: Tensor, valid: Tensor, angle: Tensor, side: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the means (N, M) of lit blocks, which of them are not to be used, and their angles."""
    rows, columns = (length // side for length in y.shape[:2])
    shape = (rows, columns, y.shape[2])
    level, count = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
    _sum_blocks(y.numpy(), valid.numpy(), side, level, count)
    wrong = (count < side * side / 2).reshape(-1, shape[2])
    level = (level / np.maximum(count, 1)).astype(float).reshape(-1, shape[2])
    place = angle[side // 2 :: side, side // 2 :: side].numpy()[:rows, :columns].ravel()
    middle = np.median(level, 1)
    usable = (middle > 0.1 * np.median(middle)) & (middle > 0) & (wrong.mean(1) < 0.5)
    return level[usable], wrong[usable], place[usable]


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _sum_blocks(y, valid, side, level, count):
    rows, columns, units = level.shape
    for row in numba.prange(rows):
        for line in range(row * side, (row + 1) * side):
            for place in range(columns * side):
                column = place // side
                for unit in range(units):  # without a branch, one vector loop
                    good = valid[line, place, unit]
                    level[row, column, unit] += np.float32(good) * y[line, place, unit]
                    count[row, column, unit] += good


def _expected(
    calibration: Calibration, place: np.ndarray, relative: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, for four zones of field angle, which blocks lie in them and S, (M, M), of mean 1."""
    weight = calibration.angle_weights(torch.from_numpy(place)).double()
    edges = np.quantile(place, [0.25, 0.5, 0.75])
    zone = np.searchsorted(edges, place)
    found = []
    for number in np.unique(zone):
        some = zone == number
        signal = torch.einsum("a,amn->mn", weight[some].mean(0), calibration.usual_moments)
        signal = signal / signal.diagonal().mean()
        noise = relative * torch.eye(calibration.filters, dtype=torch.float64)
        found.append((some, (signal + noise).numpy()))
    return found


def _changes(
    level: np.ndarray, wrong: np.ndarray, zones: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return by what each response seems changed, how sure that is, and what stays unexplained.

    The doubt is by the scatter from block to block: an edge that hides something is no dust.

    wrong : (N, M) bool; a channel that is wrong in more than half of a zone's blocks is left out.
    """
    units = level.shape[1]
    cross, power, square = np.zeros(units), np.zeros(units), np.zeros(units)
    parts = []
    for some, moment in zones:
        kept = wrong[some].mean(0) < 0.5
        whole = ~wrong[some][:, kept].any(1)
        inverse = np.linalg.inv(moment[np.ix_(kept, kept)])
        y = level[some][whole][:, kept]
        strength = np.diag(inverse)
        error = (y @ inverse) / strength
        cross[kept] += strength * (error * (y - error)).sum(0)
        power[kept] += strength * ((y - error) ** 2).sum(0)
        square[kept] += strength * (error**2).sum(0)
        parts.append((kept, strength, error, y - error))
    power = np.maximum(power, 1e-30)
    change, scatter = cross / power, np.zeros(units)
    for kept, strength, error, expected in parts:
        left = strength * expected * (error - change[kept] * expected)
        scatter[kept] += (left**2).sum(0)
    return change, np.sqrt(scatter) / power, square
