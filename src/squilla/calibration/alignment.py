"""From a raw frame to the measurement: correct it, find the disparity, align the sub-images.

The array is rigid, so one number, the disparity of the scene's plane, moves all sub-images. Filters
change intensities from one sub-image to the next and may even invert them; the directions of edges
they leave alone. So sub-images are compared by their double-angle gradient, which is the same for a
step up and a step down.
"""

from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.errors import InputError
from squilla.files.raw import Raw

_TAPS = 8
"""Length of the resampling filter, px."""

_TEXTURED = 0.1
"""Mean correlation of the sub-images' edges below which they show the same thing by chance."""


@dataclass(frozen=True)
class Measurement:
    """The aligned measurement: what the filters saw of each point of the reference view.

    y : (H, W, M) float32, DN per ms, corrected for dark and flat.
    valid : (H, W, M) bool; False where saturated, defective or outside the sensor.
    angle : (H, W) field angle, rad.
    disparity : (H, W) px per lens pitch.
    snr : signal-to-noise ratio of `y`, dB, by the sensor's calibrated noise; None if unknown.
    provenance : how it was made; plain numbers and strings.
    """

    y: Tensor
    valid: Tensor
    angle: Tensor
    disparity: Tensor
    snr: float | None = None
    provenance: dict[str, Any] = field(default_factory=dict)


def measure(
    raw: Raw, calibration: Calibration, *, distance: float | None = None, nearest: float = 60.0
) -> Measurement:
    """Turn a raw frame into the aligned measurement.

    Parameters
    ----------
    raw : Raw
    calibration : Calibration
        Made from frames of the same camera.
    distance : float, optional
        Distance of the scene's plane, mm; by default it is found from the scene itself.
    nearest : float
        The shortest distance that is looked for, mm.

    Returns
    -------
    Measurement

    Raises
    ------
    InputError
        If the calibration is of another camera or knows no geometry, or if the frame is dark or
        saturated.
    """
    lattice, pixels = _fitting(raw, calibration)
    farthest = float(np.abs(lattice.baseline).max())
    margin = int(np.ceil(lattice.disparity(min(nearest, distance or nearest)) * farthest)) + _TAPS
    views = sub_images(raw, lattice, pixels, margin)
    snr = _judge(views, raw, pixels)
    score = 1.0
    if distance is not None:
        disparity, how = lattice.disparity(distance), "from the given distance"
    else:
        disparity, score = find_disparity(
            edges(views.image), views.offset, lattice.baseline, lattice.disparity(nearest)
        )
        how = "from the scene"
        if score < _TEXTURED:
            disparity, how = lattice.disparity(lattice.usual), "no texture: at the usual distance"
    y, valid = align(views, lattice, disparity)
    y = y / (raw.exposure or 1.0)
    shape = lattice.field
    return Measurement(
        y,
        valid,
        torch.from_numpy(lattice.field_angle()).float(),
        torch.full(shape, float(disparity)),
        snr,
        {
            "camera": raw.metadata.get("camera", "unknown"),
            "exposure": raw.exposure or 0.0,
            "disparity": disparity,
            "distance": lattice.distance(disparity),
            "alignment": how,
            "alignment_score": score,
        },
    )


# --- correction -------------------------------------------------------------------------------


@dataclass(frozen=True)
class SubImages:
    """Every unit's field with a margin around, corrected, not yet aligned.

    image : Tensor, (M, H + 2 margin, W + 2 margin) float32, DN.
    bad : Tensor of the same shape, bool; saturated, defective or outside the sensor.
    offset : (M, 2) px; where in its image each unit sees an infinitely distant point on the axis,
        against the middle.
    margin : px.
    saturated : share of saturated pixels.
    """

    image: Tensor
    bad: Tensor
    offset: np.ndarray
    margin: int
    saturated: float


def sub_images(raw: Raw, lattice: Lattice, pixels: Pixels, margin: int) -> SubImages:
    """Cut the sub-images out of a frame, subtract the dark, divide by the flat.

    Bad pixels are filled with the mean of their good neighbours.
    """
    origin, frame = windows(raw.frame, lattice, margin)
    flat, valid = (
        windows(pixels.flat, lattice, margin)[1],
        windows(pixels.valid, lattice, margin)[1],
    )
    bias = windows(pixels.bias, lattice, margin)[1]
    rate = windows(pixels.dark_rate, lattice, margin)[1]
    image = np.empty(frame.shape, np.float32)
    bad = np.empty(frame.shape, bool)
    exposure = np.float32(raw.exposure or 0.0)
    _correct(frame, bias, rate, exposure, flat, valid, np.float32(pixels.saturation), image, bad)
    unit, row, column = np.nonzero(bad)
    if len(unit) < bad.size // 100:  # single pixels; whole areas have no neighbours to take
        near = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
        y = np.clip(row[:, None] + near[:, 0], 0, bad.shape[1] - 1)
        x = np.clip(column[:, None] + near[:, 1], 0, bad.shape[2] - 1)
        good = ~bad[unit[:, None], y, x]
        total = np.where(good, image[unit[:, None], y, x], 0).sum(1)
        image[unit, row, column] = total / np.maximum(good.sum(1), 1)
    offset = lattice.centre - origin - (np.array(lattice.field) - 1) / 2 - margin
    saturated = float(np.mean(_inner(frame, margin) >= pixels.saturation))
    return SubImages(torch.from_numpy(image), torch.from_numpy(bad), offset, margin, saturated)


@numba.njit(parallel=True, cache=True)
def _correct(frame, bias, rate, exposure, flat, valid, saturation, image, bad):
    units, rows, columns = frame.shape
    for line in numba.prange(units * rows):
        unit, row = line // rows, line % rows
        for column in range(columns):
            level = np.float32(frame[unit, row, column])
            dark = bias[unit, row, column] + exposure * rate[unit, row, column]
            wrong = not valid[unit, row, column] or level >= saturation
            bad[unit, row, column] = wrong
            image[unit, row, column] = (level - dark) / flat[unit, row, column] if not wrong else 0


def windows(image: np.ndarray, lattice: Lattice, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut every unit's field out of a frame, at whole pixels.

    Returns
    -------
    origin : array, (M, 2) int
        Frame position of each window's first pixel.
    images : array, (M, H + 2 margin, W + 2 margin); zero outside the sensor.
    """
    half = (np.array(lattice.field) - 1) / 2
    origin = np.floor(lattice.centre - half).astype(int) - margin
    height, width = (size + 2 * margin for size in lattice.field)
    images = np.zeros((len(origin), height, width), image.dtype)
    for window, (y, x) in zip(images, origin, strict=True):
        top, left = max(y, 0), max(x, 0)
        part = image[top : max(y + height, 0), left : max(x + width, 0)]
        window[top - y : top - y + part.shape[0], left - x : left - x + part.shape[1]] = part
    return origin, images


def _inner(images, margin: int):
    """Return pictures without their margin."""
    return images[:, margin : images.shape[1] - margin, margin : images.shape[2] - margin]


def _judge(views: SubImages, raw: Raw, pixels: Pixels) -> float:
    """Return the signal-to-noise ratio of sub-images, dB; InputError if it is no picture."""
    if views.saturated > 0.5:
        raise InputError(
            f"{100 * views.saturated:.0f} % of the frame is saturated; expose shorter or dim the "
            "light."
        )
    good = _inner(views.image, views.margin)[~_inner(views.bad, views.margin)]
    shot = float(good.mean().clamp_min(0)) / pixels.gain if len(good) else 0.0
    noise = shot + (pixels.read_noise / pixels.gain) ** 2 + 1 / 12
    power = float(good.square().mean()) - noise if len(good) else 0.0
    if power <= noise:
        raise InputError(
            "The frame is dark: its signal does not rise above the noise; expose longer, open the "
            "stop or check the lens cover."
        )
    return float(10 * np.log10(power / noise))


def _fitting(raw: Raw, calibration: Calibration) -> tuple[Lattice, Pixels]:
    lattice, pixels = calibration.lattice, calibration.pixels
    if lattice is None or pixels is None:
        raise InputError(
            "This calibration knows a response matrix but no camera geometry; raw frames need one "
            "made by `squilla calibrate`."
        )
    if raw.frame.shape != pixels.bias.shape:
        raise InputError(
            f"The raw frame has {raw.frame.shape[0]} x {raw.frame.shape[1]} px, the calibration "
            f"was made for {pixels.bias.shape[0]} x {pixels.bias.shape[1]}: they are of different "
            "cameras or regions."
        )
    taken, made = raw.metadata.get("camera"), calibration.provenance.get("camera")
    if taken and made and taken != made:
        raise InputError(
            f"The raw frame is of camera {taken!r}, the calibration of {made!r}; use its own."
        )
    return lattice, pixels


# --- disparity --------------------------------------------------------------------------------


def edges(images: Tensor, smooth: float = 0.8) -> Tensor:
    """Return the double-angle gradient of pictures, (gx + i gy)^2 / |g|, blind to contrast.

    Parameters
    ----------
    images : Tensor, (M, H, W)
    smooth : float
        Standard deviation of the Gaussian smoothing before, px.

    Returns
    -------
    Tensor, (M, H, W) complex64, tapered to zero at its border, of unit energy for each unit
    """
    reach = 3
    tap = torch.arange(-reach, reach + 1, dtype=torch.float32)
    bell = torch.exp(-(tap**2) / (2 * smooth**2))
    bell = bell / bell.sum()
    slope = tap * bell / (tap**2 * bell).sum()
    padded = functional.pad(images[:, None], [reach] * 4, mode="replicate")
    along_x = functional.conv2d(
        functional.conv2d(padded, slope[None, None, None]), bell[None, None, :, None]
    )
    along_y = functional.conv2d(
        functional.conv2d(padded, bell[None, None, None]), slope[None, None, :, None]
    )
    gradient = torch.complex(along_x[:, 0], along_y[:, 0])
    strength = gradient.abs()
    # The weakest edges are noise: their direction is shrunk to nothing.
    floor = strength.flatten(1).median(1).values[:, None, None]
    feature = gradient.square() / (strength + floor).clamp_min(1e-20)
    taper = _taper(images.shape[-2])[:, None] * _taper(images.shape[-1])[None, :]
    feature = (feature - feature.mean((-2, -1), keepdim=True)) * taper
    energy = feature.abs().square().sum((-2, -1), keepdim=True).sqrt()
    return feature / energy.clamp_min(1e-20)


def _taper(size: int, share: float = 0.1) -> Tensor:
    """Return a window that is one inside and falls to zero like a cosine at both ends."""
    edge = max(2, round(share * size))
    ramp = 0.5 - 0.5 * torch.cos(torch.pi * (torch.arange(edge) + 0.5) / edge)
    return torch.cat([ramp, torch.ones(size - 2 * edge), ramp.flip(0)])


def find_disparity(
    features: Tensor, offset: np.ndarray, baseline: np.ndarray, largest: float
) -> tuple[float, float]:
    """Find the disparity of a plane from all sub-images at once.

    Every unit's correlation with the reference is a surface over shifts; one disparity is a point
    on each of them. The sum over the units has its highest peak at the truth, which a few joint
    Gauss-Newton steps against the mean of the aligned features then place to a few hundredths of
    a pixel.

    Parameters
    ----------
    features : Tensor, (M, H, W) complex
        Of `edges`.
    offset : array, (M, 2)
        Where each unit sees an infinitely distant point, against the reference pixel grid, px.
    baseline : array, (M, 2)
        Lens pitches.
    largest : float
        Largest disparity looked for, px per pitch.

    Returns
    -------
    disparity : float
        px per lens pitch.
    score : float
        Mean correlation of the units' features with their mean, 0..1.
    """
    spectra = torch.fft.fft2(features)
    reference = int(np.abs(baseline).sum(1).argmin())
    surfaces = torch.fft.ifft2(spectra * spectra[reference].conj()).real
    step = 0.25 / max(float(np.abs(baseline).max()), 1e-9)
    candidates = np.arange(-4 * step, largest + step, step)
    shifts = offset - offset[reference] + candidates[:, None, None] * baseline  # (D, M, 2)
    total = _sample_periodic(surfaces, torch.from_numpy(shifts).float()).sum(1)
    disparity = float(candidates[int(total.argmax())])
    direction = torch.from_numpy(baseline).float()
    for _ in range(6):
        step, score = _joint_step(
            spectra, torch.from_numpy(offset + disparity * baseline), direction
        )
        disparity += step
        if abs(step) < 1e-4:
            break
    return disparity, score


def _sample_periodic(surfaces: Tensor, shifts: Tensor) -> Tensor:
    """Read surfaces (M, H, W) bilinearly at shifts (D, M, 2) px, both periodic; (D, M)."""
    _, height, width = surfaces.shape
    unit = torch.arange(len(surfaces))
    low = shifts.floor().long()
    part = shifts - low
    total = torch.zeros(shifts.shape[:-1])
    for i in (0, 1):
        for j in (0, 1):
            weight = (part[..., 0] if i else 1 - part[..., 0]) * (
                part[..., 1] if j else 1 - part[..., 1]
            )
            total += weight * surfaces[unit, (low[..., 0] + i) % height, (low[..., 1] + j) % width]
    return total


def _aligned(spectra: Tensor, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shift features back by `position` (M, 2); return their spectra and the two frequencies."""
    y = torch.fft.fftfreq(spectra.shape[-2])[:, None]
    x = torch.fft.fftfreq(spectra.shape[-1])[None, :]
    position = position.float()
    phase = 2 * torch.pi * (position[:, 0, None, None] * y + position[:, 1, None, None] * x)
    return spectra * torch.polar(torch.ones_like(phase), phase), y, x


def _joint_step(spectra: Tensor, position: Tensor, direction: Tensor) -> tuple[float, float]:
    """Return the Gauss-Newton step along one shared direction (M, 2), and the mean correlation.

    With the template T, the mean of the aligned features, unit i sees a_i (T - step d_i . grad T).
    """
    moved, y, x = _aligned(spectra, position)
    template = moved.mean(0)
    power = template.abs().square().sum()
    scale = (moved * template.conj()).real.sum((-2, -1)) / power
    slopes = torch.stack([2j * torch.pi * frequency * template for frequency in (y, x)])
    residual = moved - scale[:, None, None] * template
    along = torch.einsum("mhw,ahw->ma", residual, slopes.conj()).real
    gram = torch.einsum("ahw,bhw->ab", slopes, slopes.conj()).real
    numerator = (scale[:, None] * along * direction).sum()
    denominator = (
        scale[:, None, None] ** 2 * gram * direction[:, :, None] * direction[:, None]
    ).sum()
    each = (moved * template.conj()).real.sum((-2, -1)) / (
        power.sqrt() * moved.abs().square().sum((-2, -1)).sqrt()
    ).clamp_min(1e-20)
    return float(-numerator / denominator.clamp_min(1e-20)), float(each.mean())


def find_offsets(features: Tensor, start: np.ndarray, reference: int) -> tuple[np.ndarray, float]:
    """Find every unit's own shift against the reference, jointly; for calibration targets.

    Parameters
    ----------
    features : Tensor, (M, H, W) complex
        Of `edges`.
    start : array, (M, 2)
        Shifts to start from, px, within a few px.
    reference : int

    Returns
    -------
    offset : array, (M, 2)
        px; zero for the reference.
    score : float
        Mean correlation of the units' features with their mean, 0..1.
    """
    spectra = torch.fft.fft2(features)
    position = torch.from_numpy(start - start[reference]).double()
    position += _peak(spectra, position, reference)
    score = 0.0
    for _ in range(8):
        moved, y, x = _aligned(spectra, position)
        template = moved.mean(0)
        slopes = torch.stack([2j * torch.pi * frequency * template for frequency in (y, x)])
        gram = torch.einsum("ahw,bhw->ab", slopes, slopes.conj()).real
        scale = (moved * template.conj()).real.sum((-2, -1)) / template.abs().square().sum()
        residual = moved - scale[:, None, None] * template
        along = torch.einsum("mhw,ahw->ma", residual, slopes.conj()).real
        step = -torch.linalg.solve(gram, along.T).T / scale[:, None]
        position = position + step
        position = position - position[reference].clone()
        norm = moved.abs().square().sum((-2, -1)).sqrt() * template.abs().square().sum().sqrt()
        score = float(((moved * template.conj()).real.sum((-2, -1)) / norm).mean())
        if float(step.abs().max()) < 1e-3:
            break
    return position.numpy(), score


def _peak(spectra: Tensor, position: Tensor, reference: int, reach: int = 12) -> Tensor:
    """Return the shift of the highest correlation within `reach` px of each position, (M, 2)."""
    moved, _, _ = _aligned(spectra, position)
    surface = torch.fft.ifft2(moved * moved[reference].conj()).real
    surface = torch.roll(surface, (reach, reach), (-2, -1))[:, : 2 * reach + 1, : 2 * reach + 1]
    best = surface.flatten(1).argmax(1)
    return torch.stack([best // (2 * reach + 1), best % (2 * reach + 1)], -1).double() - reach


# --- resampling -------------------------------------------------------------------------------


def align(views: SubImages, lattice: Lattice, disparity: float) -> tuple[Tensor, Tensor]:
    """Resample every sub-image onto the reference view, once.

    Parameters
    ----------
    views : SubImages
    lattice : Lattice
    disparity : float
        px per lens pitch; no more than the margin of `views` allows.

    Returns
    -------
    y : Tensor, (H, W, M) float32
    valid : Tensor, (H, W, M) bool

    Notes
    -----
    A separable windowed sinc of 8 taps (Kaiser, beta 5): its response at half a pixel's shift is
    within 1 % of one up to 0.35 cycles per px.
    """
    start = views.margin + views.offset + disparity * lattice.baseline
    first = np.floor(start).astype(int)
    kernel = sinc_kernel(torch.from_numpy(start - first).float())
    before = _TAPS // 2 - 1
    height, width = lattice.field
    cut, valid = [], []
    for unit, (row, column) in enumerate(first):
        rows = slice(row - before, row - before + height + _TAPS - 1)
        columns = slice(column - before, column - before + width + _TAPS - 1)
        cut.append(views.image[unit, rows, columns])
        # A pixel is believed if the four around its position are.
        near = ~views.bad[unit, row : row + height + 1, column : column + width + 1]
        valid.append(near[:-1, :-1] & near[1:, :-1] & near[:-1, 1:] & near[1:, 1:])
    image = torch.stack(cut)[None]
    units = len(start)
    image = functional.conv2d(image, kernel[:, 0, None, :, None], groups=units)
    image = functional.conv2d(image, kernel[:, 1, None, None, :], groups=units)
    return image[0].permute(1, 2, 0).contiguous(), torch.stack(valid, -1)


def sinc_kernel(fraction: Tensor) -> Tensor:
    """Return the resampling filter for shifts of a fraction of a pixel, (...) -> (..., 8)."""
    tap = torch.arange(_TAPS) - (_TAPS // 2 - 1)
    position = tap - fraction[..., None]
    window = torch.special.i0(5 * (1 - (2 * position / _TAPS) ** 2).clamp_min(0).sqrt())
    kernel = torch.sinc(position) * window
    return kernel / kernel.sum(-1, keepdim=True)
