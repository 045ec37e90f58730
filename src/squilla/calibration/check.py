"""The morning check: a few dark frames and flats tell what has changed since the calibration.

Within one frame of an unknown scene nothing tells filters that moved by a nanometre from a world
that moved the other way. A lamp that is known tells: each filter's level of its light changes by
the slope of that filter, a pattern that no change of the lamp's own brightness or colour makes.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.calibration.pixels import Darks, Stack
from squilla.calibration.views import windows
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.priors import second_moment

_DRIFT = 0.3
"""Drift of the filters that is told, nm."""

_DUST = 0.03
"""Change of a pixel's response that is told as dust, over 5 x 5 px."""

_COLOURS = 2
"""Degree of the polynomial in wavelength by which the lamp may have changed its colour."""


@dataclass(frozen=True, eq=False)
class Check:
    """What has changed.

    drift : nm to the red by which the filters have moved.
    drift_error : its standard deviation, nm.
    lamp : brightness of the lamp of the flats against that of the calibration.
    response : (M,) of each unit against the calibration, by dust; 1 for a clean one.
    dusty : share of the lit pixels that lie under dust.
    hot : number of lit pixels that have gone hot.
    dark_risen : DN by which the dark frames lie above the calibrated ones.
    pixels : as they are now.
    """

    drift: float
    drift_error: float
    lamp: float
    response: np.ndarray
    dusty: float
    hot: int
    dark_risen: float
    pixels: Pixels

    @property
    def says(self) -> list[str]:
        """What a person should know, a sentence each; empty if all is well."""
        told = []
        if self.moved:
            told.append(
                f"The filters have moved by {self.drift:+.2f} nm (+- {self.drift_error:.2f})."
            )
        if self.dusty > 1e-3:
            worst = int(np.argmin(self.response))
            told.append(
                f"Dust lies before {self.dusty:.1%} of the pixels; unit {worst} has lost most, "
                f"{1 - self.response[worst]:.0%}."
            )
        if self.hot > 30:
            told.append(f"{self.hot} pixels have gone hot.")
        if self.dark_risen > 1:
            told.append(f"The dark level has risen by {self.dark_risen:.1f} DN.")
        if abs(self.lamp - 1) > 0.05:
            told.append(f"The lamp of the flats gives {self.lamp:.0%} of its light.")
        return told

    @property
    def moved(self) -> bool:
        """Whether the filters have moved beyond doubt."""
        return abs(self.drift) > max(_DRIFT, 3 * self.drift_error)

    def mended(self, calibration: Calibration) -> Calibration:
        """Return the calibration with what the check found taken into account."""
        found = calibration.drifted(self.drift) if self.moved else calibration
        told = {"checked": " ".join(self.says) or "nothing has changed", "drift": self.drift}
        return replace(found, pixels=self.pixels, provenance=calibration.provenance | told)


def white_levels(light: np.ndarray, lattice: Lattice, pixels: Pixels) -> np.ndarray:
    """Return what each unit shows of an even light, (M,) DN, without its broken pixels.

    light : (rows, columns) DN above the dark.
    """
    even = np.where(pixels.valid, light / np.maximum(pixels.flat, 0.1), np.nan)
    return np.nanmedian(windows(even, lattice, 0)[1], (1, 2))


def check(calibration: Calibration, *, dark: Iterable[Raw], flat: Iterable[Raw]) -> Check:
    """Compare today's dark frames and flats with a calibration.

    Parameters
    ----------
    calibration : Calibration
        Made by `squilla.calibration.calibrate` from flats of the same lamp.
    dark, flat : iterable of Raw
        Some frames each, four or more.

    Returns
    -------
    Check

    Raises
    ------
    InputError
        If the calibration holds no level of its flats, or frames do not fit it.
    """
    lattice, pixels, white = calibration.lattice, calibration.pixels, calibration.white
    if lattice is None or pixels is None or white is None:
        raise InputError(
            "This calibration keeps no flats to compare with; make it anew with `squilla "
            "calibrate`."
        )
    darks = Darks.of(dark)
    flats = Stack.of(flat, "flat", darks)
    if not darks.bias.shape == flats.mean.shape == pixels.bias.shape:
        raise InputError("The frames are of another size than those of the calibration.")
    lit = pixels.valid
    level = darks.at(flats.exposure)
    usual = pixels.dark(flats.exposure)
    risen = float(np.median((level - usual)[lit]))
    spread = 1.4826 * float(np.median(np.abs(level - usual - risen)[lit]))
    hot = lit & (level - usual - risen > max(12 * spread, 4.0))
    light = flats.mean - level
    relative = np.where(lit, light / np.maximum(pixels.flat, 0.1), 0)
    now = white_levels(light, lattice, pixels) / (flats.exposure or 1.0)
    drift, error, lamp, response = _drift(calibration, now / white)
    change = _local(relative, lit & ~hot, calibration)
    shade = _whole(change, response, lattice)
    dusty = lit & ~hot & (np.abs(shade - 1) > _DUST)
    factor = np.where(dusty, shade, 1.0).astype(np.float32)
    rate = darks.rate if darks.rate.any() else pixels.dark_rate
    new = replace(
        pixels,
        bias=np.where(lit, darks.bias, np.median(darks.bias)).astype(np.float32),
        dark_rate=np.where(lit, rate, np.median(rate)).astype(np.float32),
        flat=pixels.flat * factor,
        valid=lit & ~hot & (pixels.flat * factor > 0.2),
    )
    share = float(dusty.sum() / max(lit.sum(), 1))
    return Check(drift, error, lamp, response, share, int(hot.sum()), risen, new)


def _drift(calibration: Calibration, ratio: np.ndarray) -> tuple[float, float, float, np.ndarray]:
    """Return drift, its error, the lamp's brightness and each unit's own response.

    ratio : (M,) level of each unit now against that of the calibration.

    Notes
    -----
    ratio = lamp (1 + colour) (1 + drift slope) response, solved for few units that do not follow.
    """
    response = calibration.mean_sensitivity.double().numpy()
    lamp = _lamp(calibration)
    level = response @ lamp
    wavelength = calibration.wavelength
    place = 2 * (wavelength - wavelength[0]) / np.ptp(wavelength) - 1
    columns = [(response * place**n) @ lamp / level for n in range(_COLOURS + 1)]
    columns.append(
        (calibration.drifted(0.5).mean_sensitivity.double().numpy() @ lamp / level - 1) * 2
    )
    model = np.stack(columns, -1)
    weight = np.ones(len(ratio))
    fit = np.zeros(model.shape[1])
    for _ in range(30):  # units under dust do not follow, and count less and less
        fit = np.linalg.lstsq(weight[:, None] * model, weight * ratio, rcond=None)[0]
        left = ratio - model @ fit
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-5)
        weight = 1 / (1 + (left / (2 * scale)) ** 2)
    error = scale * np.sqrt(np.linalg.pinv((weight[:, None] ** 2 * model).T @ model)[-1, -1])
    brightness = float((model[:, :-1] @ fit[:-1]).mean())
    own = ratio / (model @ fit)
    own[np.abs(own - 1) < max(4 * scale, 0.01)] = 1.0
    return float(fit[-1] / brightness), float(error / brightness), brightness, own


def _lamp(calibration: Calibration) -> np.ndarray:
    """Return the spectrum of the flats' lamp as their levels and the prior tell it, (K,)."""
    white = calibration.white
    assert white is not None
    response = calibration.mean_sensitivity.double().numpy()
    moment = second_moment(calibration.wavelength).numpy()
    seen = response @ moment @ response.T
    seen += 1e-4 * np.trace(seen) / len(seen) * np.eye(len(seen))
    return moment @ response.T @ np.linalg.solve(seen, white)


def _local(relative: np.ndarray, good: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return the change of each pixel against the median of its sub-image, (rows, columns).

    relative : (rows, columns) light over the calibrated flat.
    """
    lattice = calibration.lattice
    assert lattice is not None
    fall = calibration.sensitivity @ _lamp(calibration)  # (A, M)
    change = np.ones(relative.shape, np.float32)
    weight = uniform_filter(good.astype(np.float32), 5)
    smooth = uniform_filter(np.where(good, relative, 0).astype(np.float32), 5)
    smooth = np.where(weight > 0.2, smooth / np.maximum(weight, 0.2), relative)
    square, nodes = np.tan(calibration.angle) ** 2, len(calibration.angle)
    for unit, centre in enumerate(lattice.centre):
        rows, columns = (  # the field and a little more; beyond it the stop's penumbra begins
            slice(max(int(c - side / 2) - 4, 0), min(int(c + side / 2) + 5, size))
            for c, side, size in zip(centre, lattice.field, relative.shape, strict=True)
        )
        y, x = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
        angle = np.hypot((y - centre[0])[:, None], x - centre[1]) / lattice.focal
        expected = np.interp(angle**2, square, fall[:, unit]) if nodes > 1 else fall[0, unit]
        part = smooth[rows, columns] / expected
        inside = good[rows, columns]
        if inside.any():
            change[rows, columns] = part / max(float(np.median(part[inside])), 1e-9)
    return change


def _whole(change: np.ndarray, response: np.ndarray, lattice: Lattice) -> np.ndarray:
    """Return the change of each pixel with that of its whole unit."""
    whole = change.copy()
    for unit, centre in enumerate(lattice.centre):
        reach = 0.5 * lattice.pitch
        part = tuple(slice(max(int(c - reach), 0), int(c + reach) + 1) for c in centre)
        whole[part] *= response[unit]
    return whole
