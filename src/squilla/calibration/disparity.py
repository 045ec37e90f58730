"""How far sub-images are shifted against each other, whatever their filters do to the contrast.

The array is rigid, so one number, the disparity of the scene's plane, moves all sub-images. Filters
change intensities from one sub-image to the next and may even invert them; the directions of edges
they leave alone. So sub-images are compared by their double-angle gradient, which is the same for a
step up and a step down.
"""

import numba
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

_SMOOTHING = (0.8, 1.6, 3.2, 6.4)
"""Standard deviations of the smoothing before the gradient to choose from, px."""


def edges(
    images: np.ndarray, noise: np.ndarray | None = None, bad: np.ndarray | None = None
) -> Tensor:
    """Return the double-angle gradient of pictures, (gx + i gy)^2 / |g|.

    Parameters
    ----------
    images : array, (M, H, W) float32
    noise : array, (M,), optional
        Variance of each picture's white noise. Pictures are smoothed just enough that in half of
        them the gradients rise above its noise; without it, by 0.8 px.
    bad : array, (M, H, W) bool, optional
        Pixels not to be believed. Single ones are taken as filled; whole areas, such as the dark
        around a sub-image, show no edges.

    Returns
    -------
    Tensor, (M, H, W) complex64
        Tapered to zero at its border, of unit energy for each unit.
    """
    for smooth in _SMOOTHING:
        bell, slope = _derivative(smooth)
        across, down = np.empty_like(images), np.empty_like(images)
        _gradient(images, bell, slope, across, down)
        if noise is None:
            break
        power = (across**2 + down**2).mean((1, 2))
        of_noise = 2 * noise * (bell**2).sum() * (slope**2).sum()
        if np.median(power / of_noise) > 2:
            break
    taper = _taper(images.shape[1])[:, None] * _taper(images.shape[2])[None, :]
    weight = np.broadcast_to(taper, images.shape).copy()
    for unit, wrong in enumerate(() if bad is None else bad):
        area = ndimage.minimum_filter(wrong, 3)  # single pixels are no area
        if area.any():
            weight[unit][ndimage.maximum_filter(area, 3 + len(bell))] = 0
    feature = np.empty(images.shape, np.complex64)
    # The weakest edges are noise: their direction is shrunk to nothing.
    power = across[:, ::4, ::4] ** 2 + down[:, ::4, ::4] ** 2
    floor = np.sqrt(np.median(power, (1, 2)))
    _double_angle(across, down, floor, weight, feature)
    return torch.from_numpy(feature)


def _derivative(smooth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the taps of a Gaussian and of its slope, both of unit response."""
    tap = np.arange(-int(np.ceil(3 * smooth)), int(np.ceil(3 * smooth)) + 1)
    bell = np.exp(-(tap**2) / (2 * smooth**2))
    bell /= bell.sum()
    slope = tap * bell / (tap**2 * bell).sum()
    return bell.astype(np.float32), slope.astype(np.float32)


def _taper(size: int, share: float = 0.1) -> np.ndarray:
    """Return a window that is one inside and falls to zero like a cosine at both ends."""
    edge = max(2, round(share * size))
    ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(edge) + 0.5) / edge)
    return np.concatenate([ramp, np.ones(size - 2 * edge), ramp[::-1]]).astype(np.float32)


@numba.njit(parallel=True, cache=True, fastmath=True)
def _gradient(images, bell, slope, across, down):
    """Fill in the smoothed gradient along columns and rows, (M, H, W) each."""
    units, rows, columns = images.shape
    reach = len(bell) // 2
    for unit in numba.prange(units):
        smooth = np.empty((rows, columns), np.float32)
        steep = np.empty((rows, columns), np.float32)
        for row in range(rows):
            for column in range(columns):
                a, b = np.float32(0), np.float32(0)
                for k in range(-reach, reach + 1):
                    value = images[unit, row, min(max(column + k, 0), columns - 1)]
                    a += bell[k + reach] * value
                    b += slope[k + reach] * value
                smooth[row, column], steep[row, column] = a, b
        for row in range(rows):
            across[unit, row] = 0
            down[unit, row] = 0
            for k in range(-reach, reach + 1):
                near = min(max(row + k, 0), rows - 1)
                for column in range(columns):
                    across[unit, row, column] += bell[k + reach] * steep[near, column]
                    down[unit, row, column] += slope[k + reach] * smooth[near, column]


@numba.njit(parallel=True, cache=True)
def _double_angle(across, down, floor, weight, feature):
    units, rows, columns = across.shape
    for unit in numba.prange(units):
        total, count = 0j, 1e-20
        for row in range(rows):
            for column in range(columns):
                x, y = across[unit, row, column], down[unit, row, column]
                size = np.sqrt(x * x + y * y) + floor[unit] + 1e-20
                value = complex((x * x - y * y) / size, 2 * x * y / size)
                feature[unit, row, column] = value
                total += weight[unit, row, column] * value
                count += weight[unit, row, column]
        mean, energy = total / count, 0.0
        for row in range(rows):
            for column in range(columns):
                value = (feature[unit, row, column] - mean) * weight[unit, row, column]
                feature[unit, row, column] = value
                energy += value.real**2 + value.imag**2
        scale = 1 / np.sqrt(max(energy, 1e-30))
        for row in range(rows):
            for column in range(columns):
                feature[unit, row, column] *= scale


class _Spectra:
    """Fourier transforms of features at the frequencies that matter, and how to shift them back.

    values : (M, h, w) complex64, the frequencies below a quarter of the sampling rate.
    y, x : (h, 1) and (1, w), radians per px.
    """

    def __init__(self, whole: Tensor):
        height, width = whole.shape[-2:]
        rows, columns = _low(height), _low(width)
        self.values = whole[:, rows][:, :, columns].contiguous()
        self.y = 2 * torch.pi * torch.fft.fftfreq(height)[rows][:, None]
        self.x = 2 * torch.pi * torch.fft.fftfreq(width)[columns][None, :]

    def at(self, position: Tensor) -> Tensor:
        """Return the spectra of the features shifted back by `position` (M, 2), px."""
        position = position.float()
        along_y, along_x = position[:, :1, None] * self.y, position[:, 1:, None] * self.x
        return self.values * torch.polar(torch.ones_like(along_y), along_y) * torch.polar(
            torch.ones_like(along_x), along_x
        )  # fmt: skip


def _low(size: int) -> Tensor:
    quarter = size // 4
    return torch.cat([torch.arange(quarter), torch.arange(size - quarter, size)])


def _linearise(spectra: _Spectra, position: Tensor) -> tuple[Tensor, Tensor, Tensor, float]:
    """Compare the aligned features with their mean, the template.

    With the template T a unit that is still shifted by a small d sees a (T - d . grad T).

    Returns
    -------
    scale : Tensor, (M,), a of each unit
    along : Tensor, (M, 2), its residual's component along each slope of the template
    gram : Tensor, (2, 2), of the slopes
    score : float, mean correlation of each unit with the mean of the others
    """
    moved = spectra.at(position)
    template = moved.mean(0)
    power = _dot(template, template)
    shared = torch.einsum("mhw,hw->m", moved, template.conj()).real
    scale = shared / power
    slopes = torch.stack([1j * spectra.y * template, 1j * spectra.x * template])
    gram = torch.einsum("ahw,bhw->ab", slopes, slopes.conj()).real
    own = torch.einsum("hw,ahw->a", template, slopes.conj()).real
    along = torch.einsum("mhw,ahw->ma", moved, slopes.conj()).real - scale[:, None] * own
    energy = torch.view_as_real(moved).square().sum((1, 2, 3))
    # Against the mean of the others: noise then scores zero.
    units = len(moved)
    others = (power - 2 * shared / units + energy / units**2).clamp_min(1e-20)
    score = float(((shared - energy / units) / (others * energy).sqrt().clamp_min(1e-20)).mean())
    return scale, along, gram, score


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return torch.einsum("hw,hw->", a, b.conj()).real


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
        Mean correlation of each unit's features with the mean of the others; 0 for noise.
    """
    whole = torch.fft.fft2(features)
    reference = int(np.abs(baseline).sum(1).argmin())
    surfaces = torch.fft.ifft2(whole * whole[reference].conj()).real
    step = 0.25 / max(float(np.abs(baseline).max()), 1e-9)
    candidates = np.arange(-4 * step, largest + step, step)
    shifts = offset - offset[reference] + candidates[:, None, None] * baseline  # (D, M, 2)
    total = _sample_periodic(surfaces, torch.from_numpy(shifts).float()).sum(1)
    disparity, score = float(candidates[int(total.argmax())]), 0.0
    spectra, direction = _Spectra(whole), torch.from_numpy(baseline).float()
    for _ in range(6):
        position = torch.from_numpy(offset + disparity * baseline)
        scale, along, gram, score = _linearise(spectra, position)
        numerator = (scale[:, None] * along * direction).sum()
        curvature = torch.einsum("m,ma,ab,mb->", scale**2, direction, gram, direction)
        change = -float(numerator / curvature.clamp_min(1e-20))
        disparity += max(-step, min(step, change))
        if abs(change) < 2e-4:
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
        Mean correlation of each unit's features with the mean of the others; 0 for noise.
    """
    whole = torch.fft.fft2(features)
    near = np.rint(start - start[reference])
    position = torch.from_numpy(near) + _peak(whole, near, reference)
    spectra, score = _Spectra(whole), 0.0
    for _ in range(8):
        scale, along, gram, score = _linearise(spectra, position)
        step = -torch.linalg.solve(gram, along.T).T / scale[:, None]
        position = position + step
        position = position - position[reference].clone()
        if float(step.abs().max()) < 1e-3:
            break
    return position.numpy(), score


def _peak(whole: Tensor, position: np.ndarray, reference: int, reach: int = 12) -> Tensor:
    """Return the shift of the highest correlation within `reach` px of whole positions, (M, 2)."""
    surfaces = torch.fft.ifft2(whole * whole[reference].conj()).real
    best = []
    for surface, (y, x) in zip(surfaces, position.astype(int), strict=True):
        near = torch.roll(surface, (reach - int(y), reach - int(x)), (0, 1))
        place = int(near[: 2 * reach + 1, : 2 * reach + 1].argmax())
        best.append((place // (2 * reach + 1) - reach, place % (2 * reach + 1) - reach))
    return torch.tensor(best, dtype=torch.float64)
