"""Filters at an angle: a blue shift by one effective index, in a cone of light, and its fit.

A thin film tilted by an angle transmits what it transmits on the axis at a longer wavelength,

    T(lambda; angle) = T(lambda / sqrt(1 - (sin(angle) / n)^2); 0),

with one effective index n for all filters of the same two materials. A pixel sees a filter under
all angles of a cone at once, from each point of the lens' pupil one, so it sees a weighted mean of
such shifts: one matrix, the same for every filter.

Source: Macleod, Thin-Film Optical Filters, 5th ed., the effective index of a tilted filter.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from squilla.errors import InputError
from squilla.spectra import resample

Cone = tuple[ArrayLike, ArrayLike]
"""Angles of incidence, (P,) rad, and their weights, (P,), which sum to 1; one for each point of the
pupil, as `pupil_cone` gives them. A collimated beam is ([angle], [1])."""

COLLIMATED: Cone = (np.zeros(1), np.ones(1))


def pupil_cone(angle: float, f_number: float, rings: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return the cone of light in which a pixel behind a round lens sees its filter.

    Parameters
    ----------
    angle : float
        Field angle of the pixel (chief ray), rad.
    f_number : float
        Focal length over diameter of the lens; infinite for a collimated beam.
    rings : int
        Rings of points over the pupil, each of six times its number and all of equal area.

    Returns
    -------
    angles, weights : array, (P,)
        rad; weights are cos^4 and sum to 1.

    Raises
    ------
    InputError
        If the F-number is not above 0.
    """
    if not f_number > 0:
        raise InputError(f"The F-number is {f_number}; it must be above 0, as 4 for an F/4 lens.")
    if np.isinf(f_number):
        return np.array([float(angle)]), np.ones(1)
    x, y = pupil_points(f_number, rings)
    angles = np.arctan(np.hypot(np.tan(angle) - x, y))
    weights = np.cos(angles) ** 4
    return angles, weights / weights.sum()


def pupil_points(f_number: float, rings: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return points of equal area over a round pupil, x and y, (P,) focal lengths.

    The first in the middle, then rings of six times their number.
    """
    x, y = [np.zeros(1)], [np.zeros(1)]
    for ring in range(1, rings + 1):
        turn = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        radius = np.sqrt(3 * ring**2 / (3 * rings * (rings + 1) + 1)) / (2 * f_number)
        x.append(radius * np.cos(turn))
        y.append(radius * np.sin(turn))
    return np.concatenate(x), np.concatenate(y)


def blue_shift(
    wavelength: ArrayLike,
    cone: Cone,
    effective_index: float,
    *,
    onto: ArrayLike | None = None,
    measured_in: Cone = COLLIMATED,
) -> np.ndarray:
    """Return the matrix that turns responses measured on the axis into those seen in a cone.

    Parameters
    ----------
    wavelength : (K,)
        Where the responses are known, nm, increasing.
    cone : angles (P,) and weights (P,)
        In which the filters are seen, rad.
    effective_index : float
        1 or more; 1.7 to 1.8 for TiO2 and SiO2, infinite where nothing shifts.
    onto : (K',), optional
        Wavelengths that are wanted, nm, within the first ones. What a shift would read beyond
        their red end is the last value known.
    measured_in : angles and weights, optional
        The cone in which the responses were measured; default: collimated on the axis. For a
        response that the camera itself measured on the axis of a lens give the cone of the axis,
        with the same points of the pupil in the same order.

    Returns
    -------
    array, (K', K); responses (M, K) become ``responses @ matrix.T``

    Raises
    ------
    InputError
        If the effective index is below 1, `onto` reaches beyond `wavelength`, or the cones have
        other numbers of points.

    Source: the module's. What a cone on the axis has shifted and blurred already is counted once:
    the shifts left, point by point of the pupil, are those between the two cones, whose mean and
    variance are right to the fourth order in the angle.
    """
    wavelength = np.asarray(wavelength, float)
    onto = wavelength if onto is None else np.asarray(onto, float)
    if not effective_index >= 1:
        raise InputError(f"The effective index is {effective_index}; it must be 1 or more.")
    first, last = wavelength[[0, -1]]
    if onto.min() < first - 1e-6 or onto.max() > last + 1e-6:
        raise InputError(
            f"The filter table covers {first:g}-{last:g} nm, but {onto.min():g}-{onto.max():g} nm "
            "is needed; nothing is extrapolated."
        )
    if np.shape(measured_in[0]) not in (np.shape(cone[0]), (1,), ()):
        raise InputError(
            f"The cones have {np.size(measured_in[0])} and {np.size(cone[0])} points of the pupil; "
            "the response must have been measured in as many as it is seen in, or in one."
        )
    here, there = (
        1 - (np.sin(np.asarray(angles, float)) / effective_index) ** 2
        for angles, _ in (measured_in, cone)
    )
    stretch, each = np.unique(np.sqrt(here / there), return_inverse=True)
    weight = np.bincount(each, np.broadcast_to(np.asarray(cone[1], float), each.shape))
    one_each = np.eye(len(wavelength))
    matrix = np.zeros((len(wavelength), len(onto)))
    for stretched, share in zip(stretch[:, None] * onto, weight, strict=True):
        matrix += share * resample(one_each, wavelength, np.clip(stretched, first, last))
    return matrix.T


def fit_effective_index(
    responses: ArrayLike,
    tilted: ArrayLike,
    wavelength: ArrayLike,
    cones: Sequence[Cone],
    *,
    measured_in: Cone = COLLIMATED,
) -> float:
    """Return the effective index that best explains what filters transmit at other angles.

    Parameters
    ----------
    responses : (M, K)
        Measured on the axis, any unit.
    tilted : (A, M, K)
        Measured at A field angles, in the same unit.
    wavelength : (K,)
        nm, increasing.
    cones : A pairs of angles (P,) and weights (P,)
        In which each of `tilted` was seen, rad.
    measured_in : angles and weights, optional
        In which `responses` were; see `blue_shift`.

    Returns
    -------
    float, within 1 to 4; the least squares over filters, angles and wavelengths, without the few
    nm at the red end where a shift would have to read beyond the table

    Raises
    ------
    InputError
        If shapes do not fit, or if no angle differs from that of `responses`.
    """
    from scipy.optimize import minimize_scalar

    responses, tilted = np.asarray(responses, float), np.asarray(tilted, float)
    wavelength = np.asarray(wavelength, float)
    if tilted.shape != (len(cones), *responses.shape) or responses.shape[1:] != wavelength.shape:
        raise InputError(
            f"The responses have the shapes {responses.shape} and {tilted.shape}; with "
            f"{len(cones)} cones and {len(wavelength)} wavelengths (filters, wavelengths) and "
            "(cones, filters, wavelengths) were expected."
        )
    widest = max(float(np.sin(np.asarray(angles)).max()) for angles, _ in cones)
    if widest <= 1e-6:
        raise InputError("The effective index needs responses at an angle; all are on the axis.")
    known = wavelength <= wavelength[-1] * np.sqrt(1 - (widest / 1.5) ** 2)

    def misfit(index: float) -> float:
        return sum(
            float(
                np.square(
                    responses
                    @ blue_shift(
                        wavelength, cone, index, onto=wavelength[known], measured_in=measured_in
                    ).T
                    - seen[:, known]
                ).sum()
            )
            for cone, seen in zip(cones, tilted, strict=True)
        )

    found: Any = minimize_scalar(misfit, bounds=(1, 4), options={"xatol": 1e-4})
    return float(found.x)
