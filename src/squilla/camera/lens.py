"""One lens: how it blurs, what it cuts off, and at which angles light goes through its filter."""

import numpy as np

from squilla.camera.design import CameraDesign
from squilla.optics.angle import pupil_cone, pupil_points
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

    The autocorrelation of a round pupil with the phase of the defocus, cut to the filter where the
    gaps between filters are opaque. Without diffraction the geometric transfer of the whole lens'
    blur disc takes its place.

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
    disc = (x**2 + y**2 <= 1).astype(float)
    shift = np.fft.fftfreq(2 * samples, 1 / (2 * samples)) * 2 * radius / samples
    ring = np.rint(np.hypot(shift[:, None], shift[None, :]) / (2 * radius / samples)).astype(int)
    members = np.bincount(ring.ravel())
    distance_of_ring = np.arange(len(members)) * 2 * radius / samples

    transfer = np.empty((len(angle), len(few), len(frequency)))
    for a in range(len(angle)):
        pupil = disc
        if not design.filters.gap:  # where the gaps are clear, the whole lens makes the picture
            pupil = disc * np.sqrt(_passing(design, float(angle[a]), radius * x, radius * y))
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
        rad; weights are cos^4 and sum to 1, without the light that misses the filter. Without the
        cone only the chief ray; without the field angle the pixel is taken to be on the axis.
    """
    chief = float(angle) if design.effects.field_angle else 0.0
    if not design.effects.cone:
        return pupil_cone(chief, np.inf)
    focal = design.lens.focal_length
    f_number = focal / design.lens.diameter
    angles, weights = pupil_cone(chief, f_number, rings)
    x, y = pupil_points(f_number, rings)
    weights = weights * _passing(design, float(angle), focal * x, focal * y)
    return angles, weights / weights.sum()


def through_filter(design: CameraDesign, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the share of a lens' light that goes through its filter; the rest meets the gap.

    Seen from a pixel the pupil, cast onto the plane of the filters, is a smaller disc, displaced
    towards the pixel.

    Parameters
    ----------
    design : CameraDesign
    y, x : array, (...)
        Position of pixels on the sensor against the lens' axis, px.

    Returns
    -------
    array, (...), 0..1
    """
    if design.filters.size is None or not design.effects.pupil_leak:
        return np.ones(np.broadcast_shapes(np.shape(y), np.shape(x)))
    near = design.filters.distance / design.lens.focal_length
    dy, dx = design.filters.decentre
    pixel = design.sensor.pixel
    radius = design.lens.diameter / 2 * (1 - near)
    return _overlap(pixel * y * near - dy, pixel * x * near - dx, radius, design.filters.size / 2)[
        0
    ]


def lateral_colour(design: CameraDesign, angle: np.ndarray, distance: float) -> np.ndarray:
    """Return how far each wavelength's image is displaced by a pupil beside the lens' axis.

    Filters that are not centred on their lenses leave a pupil that is not, so that light out of
    focus lands beside the axis. The light through clear gaps is taken along.

    Parameters
    ----------
    design : CameraDesign
    angle : array, (A,)
        Field angle, rad.
    distance : float
        Object distance, mm.

    Returns
    -------
    array, (A, K, 2)
        px (y, x).

    Source: similar triangles; the ray through the middle of the pupil.
    """
    sagittal, tangential = defocus(design, angle, distance)
    behind = (sagittal + tangential) / 2 / design.lens.focal_length
    if design.filters.size is None or not design.effects.lateral_colour:
        return np.zeros((*behind.shape, 2))
    offset = np.array(design.filters.decentre)
    near = 1 - design.filters.distance / design.lens.focal_length
    radius, half = design.lens.diameter / 2 * near, design.filters.size / 2
    middle = np.array(_overlap(-offset[0], -offset[1], radius, half)[1:]) + offset
    return -behind[..., None] * middle / near / design.sensor.pixel


def vignetting(
    design: CameraDesign, unit: int, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return the share of light that reaches the sensor at positions about one lens.

    cos^4 of the field angle, and the share of the pupil that sees the scene through the stop and
    is seen between the walls.

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
    radius, (y, x) = design.lens.diameter / 2, (rows[:, None], columns[None, :])
    openings = []
    if design.stop is not None:
        # Where the ray from the middle of the pupil crosses the plane of the stop.
        middle = (design.centres[unit] - design.centres.mean(0)) * design.sensor.pixel
        reach = design.stop.distance * 1000 / design.focal
        crossing, half = (middle[0] - y * reach, middle[1] - x * reach), design.stop.width * 500
        if design.stop.round:
            openings.append(_disc_share((half - np.hypot(*crossing)) / radius))
        else:
            openings += [_between(along, half, radius) for along in crossing]
    if design.walls is not None:
        deep = design.walls.height / design.lens.focal_length
        half = (design.array.pitch - design.walls.thickness) / 2
        cast = max(radius * (1 - deep), 1e-6)  # of the pupil on the plane of the walls' ends
        openings += [_between(along * design.sensor.pixel * deep, half, cast) for along in (y, x)]
    for opening in openings:
        share = share * (opening if design.effects.vignetting else opening > 0.5)
    return share


def lit(design: CameraDesign, unit: int) -> tuple[slice, slice]:
    """Return the rows and columns of the sensor that one lens can light.

    What the stop and the walls let through, penumbra included; without both the whole sensor.
    """
    slices = []
    middle, focal = design.centres.mean(0), design.lens.focal_length
    radius = design.lens.diameter / 2 / design.sensor.pixel
    for axis, size in enumerate(design.sensor_shape):
        centre = design.centres[unit, axis]
        low, high = 0.0, float(size)
        if design.stop is not None:
            far = focal / (1000 * design.stop.distance)
            image = centre + (centre - middle[axis]) * far
            half = design.stop.width / design.stop.distance * design.focal / 2 + radius * far + 1
            low, high = image - half, image + half
        if design.walls is not None:
            deep = design.walls.height / focal
            half = (design.pitch - design.walls.thickness / design.sensor.pixel) / 2
            half = (half + radius * (1 - deep)) / deep + 1
            low, high = max(low, centre - half), min(high, centre + half)
        slices.append(slice(max(0, int(np.floor(low))), min(size, int(np.ceil(high)) + 1)))
    return slices[0], slices[1]


def _passing(design: CameraDesign, angle: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return how often points of the pupil are seen through the filter, (...) 0..1.

    The mean over the directions in which a field of this angle (rad) lies from the axis; x points
    that way, y across, both um in the plane of the lens.
    """
    filters = design.filters
    if filters.size is None or not design.effects.pupil_leak:
        return np.ones(np.broadcast_shapes(np.shape(y), np.shape(x)))
    near = filters.distance / design.lens.focal_length
    along, across = x * (1 - near) + design.lens.focal_length * np.tan(angle) * near, y * (1 - near)
    total = np.zeros(np.broadcast_shapes(np.shape(along), np.shape(across)))
    turns = 2 * np.pi * (np.arange(16) + 0.5) / 16
    for cosine, sine in zip(np.cos(turns), np.sin(turns), strict=True):
        down = along * sine + across * cosine - filters.decentre[0]
        right = along * cosine - across * sine - filters.decentre[1]
        total = total + (np.maximum(np.abs(down), np.abs(right)) < filters.size / 2)
    # Where every point misses the filter nothing is seen, and it does not matter how.
    return total / len(turns) if np.any(total) else np.ones_like(total)


def _overlap(
    y: np.ndarray, x: np.ndarray, radius: float, half: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what of discs about (y, x) lies within the square -half..half: share and middle.

    Chords of the disc, cut to the square, summed along it by Gauss and Legendre's rule.
    """
    y, x = (np.asarray(each, float)[..., None] for each in (y, x))
    node, weight = np.polynomial.legendre.leggauss(48)
    low, high = (np.arcsin(np.clip((edge - y) / radius, -1, 1)) for edge in (-half, half))
    turn = (low + high) / 2 + (high - low) / 2 * node
    chord = radius * np.cos(turn)
    left, right = np.maximum(x - chord, -half), np.minimum(x + chord, half)
    area = (high - low) / 2 * weight * chord * np.maximum(right - left, 0)
    total = np.maximum(area.sum(-1), 1e-9)
    middle = (
        (area * each).sum(-1) / total for each in (y + radius * np.sin(turn), (left + right) / 2)
    )
    return area.sum(-1) / (np.pi * radius**2), *middle


def _between(crossing: np.ndarray, half: float, radius: float) -> np.ndarray:
    """Return the share of discs of this radius about `crossing` that lies within -half..half."""
    return _disc_share((half - crossing) / radius) - _disc_share((-half - crossing) / radius)


def _disc_share(edge: np.ndarray) -> np.ndarray:
    """Return the share of a unit disc that lies on the near side of a straight edge."""
    edge = np.clip(edge, -1, 1)
    return 0.5 + (edge * np.sqrt(1 - edge**2) + np.arcsin(edge)) / np.pi
