"""The calibration: everything that frames taught us about one camera, in one file."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from squilla.errors import InputError
from squilla.spectra import nanometres

DARK_BLOCK = 8
"""Side of the blocks over which the sensor's dark parts are averaged, px."""


@dataclass(frozen=True)
class Lattice:
    """Where the sub-images lie on the sensor, and how they move with depth.

    A point at inverse depth `disparity` that the reference unit sees at p (px from the centre of
    its field) is seen by unit i at ``centre[i] + p + disparity * baseline[i] + bend[i](p)``.

    shape : (rows, columns) of the array.
    centre : (M, 2) px, (y, x): image of an infinitely distant point on the camera's axis.
    baseline : (M, 2) lens pitches, (y, x), zero for the reference unit.
    reference : index of the unit whose view is reconstructed.
    field : (H, W) px, size of the aligned sub-images.
    focal : focal length, px.
    pitch : nominal distance of neighbouring lenses, px.
    pixel : size of a pixel, um; gives distances their scale.
    usual : distance at which a scene without texture is taken to be, mm.
    bend : (M, 2, 9) px, how each unit's view is bent against the reference's: coefficients of y, x,
        y^2, y x, x^2, y^3, y^2 x, y x^2, x^3 with y, x from -1 to 1 over the field.
    """

    shape: tuple[int, int]
    centre: np.ndarray
    baseline: np.ndarray
    reference: int
    field: tuple[int, int]
    focal: float
    pitch: float
    pixel: float
    usual: float
    bend: np.ndarray | None = None

    def places(self, first: np.ndarray) -> np.ndarray:
        """Return the polynomial of where units see the points of an infinitely distant plane.

        Parameters
        ----------
        first : array, (M, 2)
            Where each unit sees the reference's first pixel, px, were its view not bent.

        Returns
        -------
        array, (M, 2, 10), as `squilla.calibration.resample.resample` wants it
        """
        bend = np.zeros((*first.shape, 9)) if self.bend is None else self.bend
        return np.concatenate([np.asarray(first)[..., None], bend], -1)

    def disparity(self, distance: float) -> float:
        """Return the disparity of a plane at `distance` mm, px per lens pitch."""
        return self.pitch * self.focal * self.pixel / 1000 / distance

    def distance(self, disparity: float) -> float:
        """Return the distance in mm at which a plane has this disparity (px per pitch)."""
        return self.pitch * self.focal * self.pixel / 1000 / max(disparity, 1e-9)

    def field_angle(self) -> np.ndarray:
        """Return the chief-ray angle of every pixel of the reference view, (H, W) rad."""
        rows, columns = (np.arange(size) - (size - 1) / 2 for size in self.field)
        return np.arctan(np.hypot(rows[:, None], columns[None, :]) / self.focal)


@dataclass(frozen=True)
class Pixels:
    """What dark and flat frames say of every pixel of the sensor.

    bias : (rows, columns) DN without light at no exposure, float32; the median where no lens
        lights the sensor.
    dark_rate : (rows, columns) DN per ms that the dark current adds, float32; likewise.
    flat : (rows, columns) relative response, float32; 1 at the response that `sensitivity` states.
    valid : (rows, columns) bool; False for dead, hot and unlit pixels.
    saturation : DN at and above which a pixel is not believed.
    gain : e-/DN.  read_noise : e-.
    """

    bias: np.ndarray
    dark_rate: np.ndarray
    flat: np.ndarray
    valid: np.ndarray
    saturation: float
    gain: float
    read_noise: float

    @cached_property
    def dark_blocks(self) -> np.ndarray:
        """Corners of the blocks of `DARK_BLOCK` px far from every lit pixel, (N, 2) px.

        Three blocks next to a sub-image are left out: its penumbra reaches there.
        """
        from scipy.ndimage import maximum_filter

        rows, columns = (length // DARK_BLOCK for length in self.valid.shape)
        part = self.valid[: rows * DARK_BLOCK, : columns * DARK_BLOCK]
        lit = part.reshape(rows, DARK_BLOCK, columns, DARK_BLOCK).any((1, 3))
        return DARK_BLOCK * np.argwhere(maximum_filter(lit, 7) == 0)

    @cached_property
    def dark_levels(self) -> np.ndarray:
        """The bias and the dark rate of the blocks of `dark_blocks`, (2, N) float32."""
        corners = tuple(self.dark_blocks.T)
        return np.stack([self.bias[corners], self.dark_rate[corners]])

    def dark(self, exposure: float | None) -> np.ndarray:
        """Return what a frame of this exposure (ms) shows without light, (rows, columns) DN."""
        return self.bias + self.dark_rate * np.float32(exposure or 0.0)


@dataclass(frozen=True, repr=False)
class Calibration:
    """Everything that frames taught us about one camera.

    wavelength : (K,) nm, increasing.
    sensitivity : (A, M, K), DN per ms and unit photon radiance for a calibrated camera, any unit
        for a matrix of one's own; one matrix for each field angle in `angle`.
    angle : (A,) rad, increasing.
    lattice, pixels : None when only a response matrix is known.
    deviations : (J, A, M, K) draws of the sensitivity's error, in its unit: sensitivity +
        deviations[j] explains the calibration's frames as well. None where nothing is known of it.
    white : (M,) DN per ms that each unit showed of the lamp of the flats; None where unknown.
    provenance : what it was made from; plain numbers and strings.
    """

    wavelength: np.ndarray
    sensitivity: np.ndarray
    angle: np.ndarray
    lattice: Lattice | None = None
    pixels: Pixels | None = None
    deviations: np.ndarray | None = None
    white: np.ndarray | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        expected = (len(self.angle), self.filters, len(self.wavelength))
        if self.sensitivity.shape != expected:
            raise InputError(
                f"The sensitivity has shape {self.sensitivity.shape}; with {len(self.angle)} "
                f"angles and {len(self.wavelength)} wavelengths {expected} was expected."
            )
        if not np.all(np.isfinite(self.sensitivity)):
            raise InputError("The sensitivity holds NaN or infinite values; repair the table.")
        nanometres(self.wavelength)
        if not (np.all(np.diff(self.wavelength) > 0) and np.all(np.diff(self.angle) > 0)):
            raise InputError("The wavelengths and the angles of a calibration must increase.")
        if self.deviations is not None and (
            self.deviations.shape[1:] != expected or not np.all(np.isfinite(self.deviations))
        ):
            raise InputError(
                f"The deviations have the shape {self.deviations.shape}; finite ones of the shape "
                f"(draws, {', '.join(map(str, expected))}) were expected."
            )
        if self.lattice is not None and len(self.lattice.centre) != self.filters:
            raise InputError(
                f"The lattice has {len(self.lattice.centre)} units, the sensitivity {self.filters}."
            )

    def __repr__(self) -> str:
        band = f"{self.wavelength[0]:g}-{self.wavelength[-1]:g} nm"
        known = [name for name in ("lattice", "pixels") if getattr(self, name) is not None]
        about = "response matrix alone" if not known else f"with {' and '.join(known)}"
        return (
            f"<Calibration: {self.filters} channels, {len(self.wavelength)} bands, {band}, "
            f"{len(self.angle)} field angles, {about}>"
        )

    @classmethod
    def from_sensitivity(
        cls, sensitivity: np.ndarray, wavelength: np.ndarray, angle: np.ndarray | None = None
    ) -> "Calibration":
        """Make a calibration from a response matrix alone.

        Parameters
        ----------
        sensitivity : array, (M, K) or (A, M, K)
        wavelength : array, (K,)
            nm, increasing.
        angle : array, (A,), optional
            Field angles of a (A, M, K) sensitivity, rad.
        """
        sensitivity = np.asarray(sensitivity, np.float64)
        if sensitivity.ndim == 2:
            sensitivity = sensitivity[None]
        if sensitivity.ndim != 3:
            raise InputError(
                f"A response matrix has the shape (filters, wavelengths), not {sensitivity.shape}."
            )
        if sensitivity.mean() < 0:
            raise InputError("The response matrix is negative on the whole; is its sign right?")
        angle = np.zeros(1) if angle is None else np.asarray(angle, float)
        return cls(np.asarray(wavelength, float), sensitivity, angle)

    @property
    def filters(self) -> int:
        """Number of filters, M."""
        return self.sensitivity.shape[-2]

    @property
    def uncertainty(self) -> np.ndarray | None:
        """Standard deviation of the sensitivity's error, (A, M, K), in its unit; None: unknown."""
        if self.deviations is None:
            return None
        return np.sqrt(np.mean(np.square(self.deviations, dtype=float), axis=0))

    @cached_property
    def mean_sensitivity(self) -> Tensor:
        """Sensitivity averaged over the field angles, (M, K), float32."""
        return torch.from_numpy(self.sensitivity.mean(0)).float()

    @cached_property
    def sensitivities(self) -> Tensor:
        """Sensitivity at the angles of `angle`, (A, M, K), float32."""
        return torch.from_numpy(self.sensitivity).float()

    @cached_property
    def usual_moments(self) -> Tensor:
        """Second moments of what is usually measured, (A, M, M), float64; for the broad prior."""
        from squilla.calibration.agreement import usual_moments

        return usual_moments(self)

    def angle_weights(self, angle: Tensor) -> Tensor:
        """Return the weights that interpolate between the angles of the sensitivity.

        Linear in the squared angle, because a thin film's shift is; constant beyond the ends.

        Parameters
        ----------
        angle : Tensor, (...)
            Field angle, rad.

        Returns
        -------
        Tensor, (..., A), float32, non-negative, summing to 1
        """
        node = torch.from_numpy(np.asarray(self.angle) ** 2).float().to(angle.device)
        if len(node) == 1:
            return torch.ones(*angle.shape, 1, device=angle.device)
        square = angle.float().square().clamp(node[0], node[-1])
        right = torch.searchsorted(node, square.contiguous()).clamp(1, len(node) - 1)
        weight = (square - node[right - 1]) / (node[right] - node[right - 1])
        weights = torch.zeros(*angle.shape, len(node), device=angle.device)
        weights.scatter_(-1, (right - 1)[..., None], (1 - weight)[..., None])
        return weights.scatter_(-1, right[..., None], weight[..., None])

    def project(self, cube: Tensor, angle: Tensor | None = None) -> Tensor:
        """Return what the filters measure of spectra, y = R x.

        Parameters
        ----------
        cube : Tensor, (..., K)
        angle : Tensor, (...), optional
            Field angle of each spectrum, rad; without it the mean sensitivity is used.

        Returns
        -------
        Tensor, (..., M)
        """
        if angle is None or len(self.angle) == 1:
            return cube @ self.mean_sensitivity.to(cube.device).T
        weights = self.angle_weights(angle)
        total = torch.zeros(*cube.shape[:-1], self.filters, device=cube.device)
        for node, sensitivity in enumerate(self.sensitivities.to(cube.device)):
            total += weights[..., node, None] * (cube @ sensitivity.T)
        return total

    def tilted(
        self,
        effective_index: float,
        *,
        f_number: float,
        corner: float | None = None,
        measured_in_cone: bool = False,
        vignetting: bool = True,
        nodes: int = 5,
    ) -> "Calibration":
        """Return the calibration with the sensitivity at all field angles, from that on the axis.

        Each pixel sees its filter in the cone of its lens, shifted to the blue; see
        `squilla.optics.angle.blue_shift`.

        Parameters
        ----------
        effective_index : float
            Of the filters' thin films; 1.7 to 1.8 for TiO2 and SiO2.
        f_number : float
            Of each lens.
        corner : float, optional
            Largest field angle, rad; default: that of the lattice.
        measured_in_cone : bool
            Whether the camera itself measured the sensitivity through its lens (True), or a
            spectrophotometer did in a parallel beam (False).
        vignetting : bool
            Whether measurements still have the natural vignetting, cos^4 of the angle.
        nodes : int
            Number of angles from the axis to the corner, even in their square; reconstructors
            interpolate between them.

        Raises
        ------
        InputError
            If the sensitivity is known at several angles already, or a figure is out of range.
        """
        from squilla.optics.angle import COLLIMATED, blue_shift, pupil_cone

        if len(self.angle) > 1:
            raise InputError("The sensitivity is known at several field angles already.")
        if corner is None:
            if self.lattice is None:
                raise InputError("Give the field angle of the corner, rad: no lattice is known.")
            corner = float(self.lattice.field_angle().max())
        if not 0 < corner < np.pi / 2:
            raise InputError(f"The corner's field angle is {corner:g} rad; give one above 0.")
        angle = np.sqrt(np.linspace(0, corner**2, nodes))
        axis = pupil_cone(0.0, f_number) if measured_in_cone else COLLIMATED
        shifts = np.stack(
            [
                (np.cos(one) ** 4 if vignetting else 1.0)
                * blue_shift(
                    self.wavelength, pupil_cone(one, f_number), effective_index, measured_in=axis
                )
                for one in angle
            ]
        )
        return replace(
            self,
            sensitivity=self.sensitivity @ shifts.swapaxes(-1, -2),
            deviations=None
            if self.deviations is None
            else self.deviations @ shifts.swapaxes(-1, -2),
            angle=angle,
            provenance=self.provenance | {"effective_index": effective_index, "f_number": f_number},
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration as one NetCDF file; see `squilla.calibration.store`."""
        from squilla.calibration.store import save_calibration

        save_calibration(self, path)

    def drifted(self, shift: float) -> "Calibration":
        """Return the calibration with all filters `shift` nm to the red of where they were.

        What `squilla.calibration.check` finds is taken into account so. At the ends of the band the
        sensitivity goes on evenly.
        """
        place = np.clip(self.wavelength - shift, self.wavelength[0], self.wavelength[-1])
        right = np.clip(np.searchsorted(self.wavelength, place), 1, len(place) - 1)
        step = self.wavelength[right] - self.wavelength[right - 1]
        share = (place - self.wavelength[right - 1]) / step
        moved = [
            None
            if table is None
            else table[..., right - 1] * (1 - share) + table[..., right] * share
            for table in (self.sensitivity, self.deviations)
        ]
        assert moved[0] is not None
        return replace(self, sensitivity=moved[0], deviations=moved[1])

    def on(self, wavelength: np.ndarray) -> "Calibration":
        """Return the same calibration on another wavelength grid within its own."""
        from squilla.spectra import resample

        values = resample(self.sensitivity, self.wavelength, wavelength)
        errors = self.deviations
        if errors is not None:
            errors = resample(errors, self.wavelength, wavelength)
        wavelength = np.asarray(wavelength, float)
        return replace(self, wavelength=wavelength, sensitivity=values, deviations=errors)
