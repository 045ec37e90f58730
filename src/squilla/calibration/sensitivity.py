"""The sensitivity R(wavelength, field angle) from a narrow-band sweep of flat frames."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from squilla.calibration.calibration import Lattice
from squilla.calibration.pixels import Darks
from squilla.errors import InputError
from squilla.files.raw import Raw

Window = tuple[slice, slice]


@dataclass(frozen=True)
class SweepStep:
    """One flat frame in narrow-band light.

    raw : the frame.
    wavelength : middle of the band, nm.
    power : photon radiance of the light, summed over the band, in the unit that cubes shall have.
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


def sweep_responses(
    steps: Iterable[SweepStep], darks: Darks, flat: np.ndarray, saturation: float, zones: Zones
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reduce the frames of a sweep, one by one, to responses per unit of light.

    Parameters
    ----------
    steps : iterable of SweepStep
    darks : Darks
    flat : array, (rows, columns)
    saturation : float
        DN; steps with more than 0.1 % saturated pixels in the sub-images are refused.
    zones : Zones

    Returns
    -------
    wavelength, bandwidth : array, (S,)
        nm, sorted.
    response : array, (S, A, M)
        DN per ms and unit of power.
    """
    rows = []
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
            raise InputError(
                f"The sweep frame at {step.wavelength:g} nm is saturated; shorten its exposure."
            )
        frame, exposure = step.raw.frame, np.float32(step.raw.exposure)
        response = zones(
            lambda at, frame=frame, exposure=exposure: (
                (frame[at] - darks.bias[at] - exposure * darks.rate[at]) / flat[at]
            )
        )
        rows.append((step.wavelength, step.bandwidth, response / (step.power * exposure)))
    if len(rows) < 2:
        raise InputError("A sweep needs at least two wavelengths.")
    rows.sort(key=lambda row: row[0])
    wavelength, bandwidth, response = map(np.array, zip(*rows, strict=True))
    if np.any(np.diff(wavelength) <= 0):
        raise InputError("The sweep holds a wavelength twice; average those frames first.")
    return wavelength, bandwidth, response


def unfold(
    wavelength: np.ndarray, bandwidth: np.ndarray, response: np.ndarray, grid: np.ndarray
) -> np.ndarray:
    """Estimate the sensitivity on a fine grid from responses to light of finite bandwidth.

    Minimises ||G R - response||^2 + mu ||R''||^2, where a row of G is the Gaussian band of one step
    and mu is chosen by generalised cross-validation over all filters and angles at once. Light
    outside the grid is taken to be blocked by the camera's band filter.

    Parameters
    ----------
    wavelength, bandwidth : array, (S,)
        Middle and full width at half maximum of each step, nm.
    response : array, (S, ...)
    grid : array, (K,)
        Even wavelength grid within the sweep, nm.

    Returns
    -------
    array, (..., K)

    Source: Golub, Heath, Wahba, Technometrics 21 (1979), for the cross-validation.
    """
    step = grid[1] - grid[0]
    reach = max(np.diff(wavelength).max(), step)
    if wavelength[0] > grid[0] + reach or wavelength[-1] < grid[-1] - reach:
        raise InputError(
            f"The sweep covers {wavelength[0]:g}-{wavelength[-1]:g} nm, the camera's band is "
            f"{grid[0]:g}-{grid[-1]:g} nm; sweep the whole band."
        )
    sigma = np.maximum(bandwidth, 0.5 * step)[:, None] / np.sqrt(8 * np.log(2))
    band = np.exp(-((grid - wavelength[:, None]) ** 2) / (2 * sigma**2))
    band *= step / (sigma * np.sqrt(2 * np.pi))  # each holds all the light of its step
    bend = np.diff(np.eye(len(grid)), 2, axis=0)
    flat = response.reshape(len(wavelength), -1)
    best = None
    normal, rough = band.T @ band, bend.T @ bend
    scale = np.trace(normal) / np.trace(rough)
    for mu in scale * 10.0 ** np.arange(-6, 6.5, 0.5):
        solve = np.linalg.solve(normal + mu * rough + 1e-12 * np.eye(len(grid)), band.T)
        left = flat - band @ (solve @ flat)
        freedom = len(wavelength) - np.trace(band @ solve)
        score = float((left**2).sum()) / max(freedom, 1e-6) ** 2
        if best is None or score < best[0]:
            best = (score, solve @ flat)
    assert best is not None
    return np.moveaxis(best[1].reshape(len(grid), *response.shape[1:]), 0, -1)
