"""One lens: how it blurs, what it cuts off, and at which angles light goes through its filter."""

import numpy as np

from squilla.camera.design import CameraDesign
from squilla.optics.angle import pupil_cone
from squilla.optics.materials import refractive_index


def defocus(design: CameraDesign, angle: np.ndarray, distance: float) -> tuple[np.ndarray, ...]:
    """Return how far the sensor lies behind the sagittal and the tangential focus.

    A thin lens with its stop at the lens; object at `distance`, sensor at the focus of
    `focus_distance` and `focus_wavelength` on the axis, moved by ``design.lens.defocus``.

    Parameters
    ----------
    design : CameraDesign
    angle : array, (A,)
        Field angle, rad.
    distance : float
        Object distance, mm.

    Returns
    -------
    sagittal, tangential : array, (A, K)
        um; positive where the image forms in front of the sensor. Without the effect of field
        curvature ``design.lens.defocus``, which balances it, is left out too.

    Source: thin-lens equation with the glass' dispersion; Coddington's equations give the image
    surfaces of a thin lens the curvatures (1 + 1/n)/f and (3 + 1/n)/f.
    """
    lens, effects = design.lens, design.effects
    focal = lens.focal_length
    index = np.real(refractive_index(lens.glass, design.wavelength))
    centre = np.real(refractive_index(lens.glass, np.array([lens.focus_wavelength])))[0]
    focal_length = focal * (centre - 1) / (index - 1) if effects.chromatic_focus else focal
    image = focal_length * np.ones(len(index)) + focal**2 / (1000 * distance - focal)
    sensor = focal + focal**2 / (1000 * lens.focus_distance - focal) + lens.defocus
    height = focal * np.tan(angle)[:, None]
    bend = height**2 / (2 * focal) if effects.field_curvature else 0 * height
    sagittal = sensor - image + (1 + 1 / centre) * bend
    tangential = sensor - image + (3 + 1 / centre) * bend
    if not effects.field_curvature:  # then there is nothing for the moved sensor to balance
        return sagittal - lens.defocus, tangential - lens.defocus
    return sagittal, tangential


def transfer_function(
    design: CameraDesign, angle: np.ndarray, distance: float, frequency: np.ndarray
) -> np.ndarray:
    """Return the modulation transfer of the lens, averaged over orientation.

    The autocorrelation of a round pupil with the phase of the defocus. Without diffraction the
    geometric transfer of the blur disc takes its place.

    Parameters
    ----------
    design : CameraDesign
    angle : array, (A,)
        Field angle, rad.
    distance : float
        Object distance, mm.
    frequency : array, (F,)
        Spatial frequency, cycles per px.

    Returns
    -------
    array, (A, K, F), 1 at frequency 0

    Source: Goodman, Introduction to Fourier Optics, chapter 7.
    """
    wavelength = design.wavelength / 1000
    few = np.linspace(wavelength[0], wavelength[-1], min(len(wavelength), 11))
    focal, radius = design.lens.focal_length, design.lens.diameter / 2
    sagittal, tangential = (
        np.stack([np.interp(few, wavelength, row) for row in focus])
        for focus in defocus(design, angle, distance)
    )
    samples = 48  # across the pupil; the phase there turns by at most two waves
    axis = (np.arange(samples) - (samples - 1) / 2) * 2 / samples
    y, x = axis[:, None], axis[None, :]
    pupil = (x**2 + y**2 <= 1).astype(float)
    shift = np.fft.fftfreq(2 * samples, 1 / (2 * samples)) * 2 * radius / samples
    ring = np.rint(np.hypot(shift[:, None], shift[None, :]) / (2 * radius / samples)).astype(int)
    members = np.bincount(ring.ravel())
    distance_of_ring = np.arange(len(members)) * 2 * radius / samples

    transfer = np.empty((len(angle), len(few), len(frequency)))
    for a in range(len(angle)):
        for k, colour in enumerate(few):
            path = radius**2 / (2 * focal**2) * (sagittal[a, k] * x**2 + tangential[a, k] * y**2)
            if design.effects.diffraction:
                field = pupil * np.exp(2j * np.pi * path / colour)
                wide = np.fft.fft2(field, (2 * samples, 2 * samples))
                overlap = np.fft.ifft2(np.abs(wide) ** 2).real
                mean = np.bincount(ring.ravel(), overlap.ravel()) / members
                at = frequency / design.sensor.pixel * colour * focal
                transfer[a, k] = np.interp(at, distance_of_ring, mean / mean[0], right=0.0)
            else:
                transfer[a, k] = _blur_disc(sagittal[a, k], tangential[a, k], design, frequency)
    low = np.clip(np.searchsorted(few, wavelength) - 1, 0, max(len(few) - 2, 0))
    if len(few) > 1:
        weight = ((wavelength - few[low]) / (few[low + 1] - few[low]))[None, :, None]
        transfer = transfer[:, low] * (1 - weight) + transfer[:, low + 1] * weight
    return transfer


def _blur_disc(sagittal: float, tangential: float, design: CameraDesign, frequency: np.ndarray):
    """Return the transfer of the geometric blur disc of mean radius, (F,)."""
    from scipy.special import j1

    per_um = design.lens.diameter / (2 * design.lens.focal_length) / design.sensor.pixel
    radius = np.sqrt((sagittal**2 + tangential**2) / 2) * per_um
    argument = np.maximum(2 * np.pi * frequency * radius, 1e-9)
    return 2 * j1(argument) / argument


def cone(design: CameraDesign, angle: float, rings: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles at which light reaches a pixel through the filter, and their weights.

    Parameters
    ----------
    design : CameraDesign
    angle : float
        Field angle of the pixel (chief ray), rad.
    rings : int
        Rings of points over the pupil, each of six times its number.

    Returns
    -------
    angles, weights : array, (P,)
        rad; weights are cos^4 and sum to 1. Without the cone only the chief ray; without the
        field angle the pixel is taken to be on the axis.
    """
    chief = angle if design.effects.field_angle else 0.0
    lens = design.lens
    f_number = lens.focal_length / lens.diameter if design.effects.cone else np.inf
    return pupil_cone(chief, f_number, rings)


def vignetting(
    design: CameraDesign, unit: int, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return the share of light that reaches the sensor at positions about one lens.

    cos^4 of the field angle, and the share of the pupil that sees the scene through the stop.

    Parameters
    ----------
    design : CameraDesign
    unit : int
    rows, columns : array, (H,) and (W,)
        Position on the sensor against the lens' axis, px.

    Returns
    -------
    array, (H, W), 0..1
    """
    square = (rows[:, None] ** 2 + columns[None, :] ** 2) / design.focal**2
    share = (1 + square) ** -2.0 if design.effects.vignetting else np.ones_like(square)
    if design.stop is None:
        return share
    middle = design.centres.mean(0)
    axes = []
    for position, centre, middle_of_array in zip(
        (rows, columns), design.centres[unit], middle, strict=True
    ):
        # Where the ray from the middle of the pupil crosses the stop, in pupil radii.
        lens = (centre - middle_of_array) * design.sensor.pixel
        crossing = lens - position / design.focal * design.stop.distance * 1000
        edge, radius = design.stop.width * 500, design.lens.diameter / 2
        axes.append(
            _disc_share((edge - crossing) / radius) - _disc_share((-edge - crossing) / radius)
        )
    if not design.effects.vignetting:
        axes = [(axis > 0.5).astype(float) for axis in axes]
    return share * axes[0][:, None] * axes[1][None, :]


def lit(design: CameraDesign, unit: int) -> tuple[slice, slice]:
    """Return the rows and columns of the sensor that one lens can light.

    With a stop its image and penumbra; without one, one and a half pitches to each side: the
    tile of the lens and those of its neighbours.
    """
    slices = []
    middle = design.centres.mean(0)
    for axis, size in enumerate(design.sensor_shape):
        centre = design.centres[unit, axis]
        if design.stop is None:
            low, high = centre - 1.5 * design.pitch, centre + 1.5 * design.pitch
        else:
            far = design.lens.focal_length / (1000 * design.stop.distance)
            image = centre + (centre - middle[axis]) * far
            half = design.stop.width / design.stop.distance * design.focal / 2
            half += design.lens.diameter / 2 * far / design.sensor.pixel + 1
            low, high = image - half, image + half
        slices.append(slice(max(0, int(np.floor(low))), min(size, int(np.ceil(high)) + 1)))
    return slices[0], slices[1]


def _disc_share(edge: np.ndarray) -> np.ndarray:
    """Return the share of a unit disc that lies on the near side of a straight edge."""
    edge = np.clip(edge, -1, 1)
    return 0.5 + (edge * np.sqrt(1 - edge**2) + np.arcsin(edge)) / np.pi
