"""The sensitivity R(wavelength, field angle) from a narrow-band sweep of flat frames."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from squilla.calibration.calibration import Lattice
from squilla.calibration.inference import Inferred, infer_sensitivity
from squilla.calibration.pixels import Darks
from squilla.errors import InputError
from squilla.files.raw import Raw

Window = tuple[slice, slice]

_OUTSIDE = 1e-3
"""Share of its light within the band below which a step lies outside."""


@dataclass(frozen=True)
class SweepStep:
    """One flat frame in narrow-band light.

    raw : the frame.
    wavelength : middle of the band, nm.
    power : photon radiance of the light by the reference detector, summed over the band, in the
        unit that cubes shall have.
    bandwidth : full width at half maximum of the light, nm.
    """

    raw: Raw
    wavelength: float
    power: float
    bandwidth: float


class Zones:
    """Fits the response of every unit as a function of field angle to its pixels.

    The function is linear in the squared angle between a few nodes, as `Calibration.angle_weights`
    interpolates it. The fit is one small matrix for each unit, made once for all frames.

    Parameters
    ----------
    lattice : Lattice
    valid : array, (rows, columns) bool
        Pixels that take part.
    nodes : int
        Number of angles from the axis to the corner of the field.
    """

    def __init__(self, lattice: Lattice, valid: np.ndarray, nodes: int = 5):
        rows, columns = lattice.field
        corner = np.arctan(np.hypot(rows / 2, columns / 2) / lattice.focal)
        self.angle = np.sqrt(np.linspace(0, corner**2, nodes))
        self._windows, self._fits = [], []
        for centre in lattice.centre:
            window = tuple(
                slice(round(middle - size / 2), round(middle - size / 2) + size)
                for middle, size in zip(centre, lattice.field, strict=True)
            )
            at = [
                np.arange(part.start, part.stop) - middle
                for part, middle in zip(window, centre, strict=True)
            ]
            weight = self._weights(np.hypot(at[0][:, None], at[1][None, :]) / lattice.focal)
            weight = weight.reshape(-1, nodes) * valid[window].reshape(-1, 1)
            gram = weight.T @ weight
            if np.linalg.cond(gram) > 1e8:
                raise InputError("A sub-image has too few good pixels to learn its sensitivity.")
            self._windows.append(window)
            self._fits.append(np.linalg.solve(gram, weight.T).astype(np.float32))

    def _weights(self, tangent: np.ndarray) -> np.ndarray:
        nodes, square = self.angle**2, np.arctan(tangent) ** 2
        hats = [np.interp(square, nodes, unit) for unit in np.eye(len(nodes))]
        return np.stack(hats, -1)

    def __call__(self, corrected: Callable[[Window], np.ndarray]) -> np.ndarray:
        """Return the response at the nodes, (A, M).

        Parameters
        ----------
        corrected : function
            Gives the corrected frame within a window, a pair of slices.
        """
        fitted = [
            fit @ corrected(window).ravel()
            for fit, window in zip(self._fits, self._windows, strict=True)
        ]
        return np.stack(fitted, -1)

    def surface(self, lattice: Lattice, response: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Return the frame that responses (A, M) at the nodes stand for.

        Every pixel takes the response of the unit whose centre is nearest.
        """
        image = np.zeros(shape, np.float32)
        reach = lattice.pitch * 0.75
        nearest = np.full(shape, np.inf, np.float32)
        for centre, of_unit in zip(lattice.centre, response.T, strict=True):
            window = tuple(
                slice(max(int(middle - reach), 0), min(int(middle + reach) + 1, length))
                for middle, length in zip(centre, shape, strict=True)
            )
            at = [
                np.arange(part.start, part.stop) - middle
                for part, middle in zip(window, centre, strict=True)
            ]
            square = np.arctan(np.hypot(at[0][:, None], at[1][None, :]) / lattice.focal) ** 2
            own = square < nearest[window]
            image[window] = np.where(own, np.interp(square, self.angle**2, of_unit), image[window])
            nearest[window] = np.minimum(nearest[window], square)
        return image


@dataclass(frozen=True)
class Responses:
    """What the steps of a sweep say, in the order in which they were taken.

    wavelength, bandwidth : (S,) middle and full width at half maximum of the light, nm.
    response : (S, A, M) DN per ms and unit of power.
    saturated : wavelengths of the steps that were left out, nm.
    """

    wavelength: np.ndarray
    bandwidth: np.ndarray
    response: np.ndarray
    saturated: tuple[float, ...] = ()


def sweep_responses(
    steps: Iterable[SweepStep], darks: Darks, flat: np.ndarray, saturation: float, zones: Zones
) -> Responses:
    """Reduce the frames of a sweep, one by one, to responses per unit of light.

    Parameters
    ----------
    steps : iterable of SweepStep
    darks : Darks
    flat : array, (rows, columns)
    saturation : float
        DN; a step with more than 0.1 % saturated pixels is left out.
    zones : Zones

    Returns
    -------
    Responses

    Raises
    ------
    InputError
        If a frame or its figures cannot be used, or more than a tenth of the steps, and more than
        two, are saturated.
    """
    rows, saturated = [], []
    for step in steps:
        figures = (step.wavelength, step.power, step.bandwidth, step.raw.exposure or 0.0)
        if not (np.isfinite(figures).all() and min(figures) > 0):
            raise InputError(
                f"The sweep frame at {step.wavelength:g} nm needs a positive wavelength, power, "
                "bandwidth and exposure."
            )
        if step.raw.frame.shape != flat.shape:
            raise InputError(
                f"The sweep frame at {step.wavelength:g} nm has {step.raw.frame.shape} px, the "
                f"flats {flat.shape}; take all with one camera."
            )
        if np.mean(step.raw.frame >= saturation) > 1e-3:
            saturated.append(float(step.wavelength))
            continue
        frame, exposure = step.raw.frame, np.float32(step.raw.exposure)
        response = zones(
            lambda at, frame=frame, exposure=exposure: (
                (frame[at] - darks.bias[at] - exposure * darks.rate[at]) / flat[at]
            )
        )
        rows.append((step.wavelength, step.bandwidth, response / (step.power * exposure)))
    if len(saturated) > max(2, 0.1 * len(rows)):
        raise InputError(
            f"{len(saturated)} frames of the sweep are saturated, that at {saturated[0]:g} nm for "
            "one; shorten their exposure."
        )
    if len(rows) < 3:
        raise InputError(f"A sweep needs at least three wavelengths; there are {len(rows)}.")
    wavelength, bandwidth, response = map(np.array, zip(*rows, strict=True))
    return Responses(wavelength, bandwidth, response, tuple(saturated))


def sweep_sensitivity(sweep: Responses, grid: np.ndarray) -> tuple[Inferred, dict[str, Any]]:
    """Infer the sensitivity from the responses of a sweep, and say what was wrong with it.

    The finite bandwidth is undone; steps may be missing and unevenly spaced. A wavelength that
    comes back shows how the light drifts beside the reference detector, steps outside the camera's
    band show the stray light of the monochromator; both are then taken out. A step that disagrees
    with its neighbours in all filters at once, by far more than the others do, is left out.

    Parameters
    ----------
    sweep : Responses
    grid : array, (K,)
        Even wavelength grid, nm, which the sweep must cover.

    Returns
    -------
    Inferred
    dict
        saturated_steps, doubted_steps : wavelengths left out, as text.
        power_noise : relative standard deviation of the power from step to step.
        power_drift : relative change over the whole sweep; None where no wavelength comes back.
        stray_light : share of each step's light that is spread over the band; None where no step
            lies outside.

    Raises
    ------
    InputError
        If the sweep does not cover the grid, or the camera sees light outside it.
    """
    light = gaussian_bands(sweep.wavelength, sweep.bandwidth, grid)
    response, drift = _without_drift(sweep)
    outside = light.sum(-1) < _OUTSIDE
    stray = None
    if outside.any() and not outside.all():
        response, stray = _without_stray_light(sweep.wavelength, response, light.sum(-1))
    middle, light, response = sweep.wavelength[~outside], light[~outside], response[~outside]
    _check_cover(middle, grid)
    found = infer_sensitivity(light, response, grid)
    doubted: list[int] = []
    while (worst := _misread(found.power_error)) is not None:
        doubted.append(np.delete(np.arange(len(middle)), doubted)[worst])
        if len(doubted) > max(2, 0.1 * len(middle)):
            raise InputError(
                f"More than {len(doubted) - 1} steps of the sweep contradict the others in all "
                f"filters at once, that at {middle[doubted[0]]:g} nm first; check their powers."
            )
        good = np.delete(np.arange(len(middle)), doubted)
        _check_cover(middle[good], grid)
        found = infer_sensitivity(light[good], response[good], grid)
    if found.power_noise > 0.1:
        raise InputError(
            f"The filters together say that the powers of the sweep are wrong by "
            f"{100 * found.power_noise:.0f} % from step to step; check the table of the sweep."
        )
    return found, {
        "saturated_steps": _listed(sweep.saturated),
        "doubted_steps": _listed(middle[sorted(doubted)]),
        "power_noise": found.power_noise,
        "power_drift": drift,
        "stray_light": stray,
    }


def _misread(power_error: np.ndarray) -> int | None:
    """Return the step whose power was misread most grossly; None where none stands out."""
    size = np.abs(power_error)
    return int(size.argmax()) if size.max() > max(0.05, 10 * float(np.median(size))) else None


def gaussian_bands(wavelength: np.ndarray, bandwidth: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the spectra of narrow-band lights on an even grid, (S, K), each with a sum of 1.

    Of a light that reaches beyond the grid only the part within is there.
    """
    step = grid[1] - grid[0]
    sigma = np.maximum(bandwidth, 0.5 * step)[:, None] / np.sqrt(8 * np.log(2))
    band = np.exp(-((grid - wavelength[:, None]) ** 2) / (2 * sigma**2))
    return band * step / (sigma * np.sqrt(2 * np.pi))


def _without_drift(sweep: Responses) -> tuple[np.ndarray, float | None]:
    """Return responses without the drift that wavelengths measured again show, and its size."""
    near = np.abs(sweep.wavelength[:, None] - sweep.wavelength) < 0.01
    again = near.sum(-1) > 1
    if again.sum() - len(np.unique(near[again], axis=0)) < 2:
        return sweep.response, None
    when = np.arange(len(near)) / (len(near) - 1)
    level = np.log(np.maximum(sweep.response.mean((1, 2)), 1e-300))
    mean = near / near.sum(-1, keepdims=True)
    later, higher = ((each - mean @ each)[again] for each in (when, level))
    rate = float(later @ higher / (later @ later))
    return sweep.response * np.exp(-rate * (when - 0.5))[:, None, None], float(np.expm1(rate))


def _without_stray_light(
    wavelength: np.ndarray, response: np.ndarray, within: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return responses without the part that steps outside the band show, and its share.

    Stray light is taken to be even over the band; `within` is the share, (S,), of each step's light
    that lies in the band.
    """
    outside, inside = within < _OUTSIDE, np.flatnonzero(within > 0.3)
    inside = inside[np.argsort(wavelength[inside], kind="stable")]
    width = np.gradient(wavelength[inside])
    white = np.average(response[inside] / within[inside, None, None], axis=0, weights=width)
    share = float((response[outside] * white).sum() / (outside.sum() * (white**2).sum()))
    if share > 0.05:
        raise InputError(
            f"At {wavelength[outside][0]:g} nm, outside its band, the camera still sees "
            f"{100 * share:.0f} % of the light; widen the design's band to all that it sees."
        )
    share = max(share, 0.0)
    return (response - share * white) / (1 - share), share


def _check_cover(wavelength: np.ndarray, grid: np.ndarray) -> None:
    if not len(wavelength):
        raise InputError(
            f"No step of the sweep lies in the camera's band, {grid[0]:g}-{grid[-1]:g} nm; are its "
            "wavelengths in nm?"
        )
    low, high = wavelength.min(), wavelength.max()
    reach = max(float(np.diff(np.sort(wavelength)).max(initial=0)), grid[1] - grid[0])
    if low > grid[0] + reach or high < grid[-1] - reach:
        raise InputError(
            f"The sweep covers {low:g}-{high:g} nm, the camera's band is "
            f"{grid[0]:g}-{grid[-1]:g} nm; sweep the whole band."
        )


def _listed(wavelengths: Iterable[float]) -> str:
    return ", ".join(f"{each:g} nm" for each in wavelengths) or "none"
