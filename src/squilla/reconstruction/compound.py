"""One model for every camera: exact estimates at several scales, then a small network.

A front end that nobody trained turns the measurement of any calibrated camera into coefficients of
a fixed basis of spectra. It averages each pixel with the neighbours that, at the known noise, show
the same spectrum; so most pixels are far less noisy than they were measured. The posterior of a
mixture of Gaussians then gives the spectrum and its variance. A small convolutional network behind
it has learnt, over many random cameras, scenes and noises, what is left to be mended, and how far
the result may be off. `docs/compound.md` tells the whole story.

Pictures are (B, H, W, channels); level l has cells of 2^l px.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.reconstruction.prior import Estimators, Prior, broad_prior
from squilla.reconstruction.reconstructor import Reconstructor, Scale, check_scale, picture

if TYPE_CHECKING:
    from xarray import DataArray

LEVELS = 4
"""Halvings from the picture to the coarsest cells."""

SPECTRAL = 2
"""Level at which spectra are inferred; finer ones borrow from it."""

DIRECTIONS = 32
"""Directions of the channels that are kept: what others see of spectra is below 60 dB."""

TOLD = 12
"""Leading directions by which two measurements are told apart."""

CORRECTED = (16, 32)
"""Leading coefficients that cells of levels 0 and 1 know something of by themselves."""

KNOTS = 51
"""Wavelengths at which the interval is predicted; linear in between."""

ZONES = 8
"""Zones of field angle, equal in area, each of which has estimators of its own."""

MODEL_NOISE = 1e-5
"""What calibrations are wrong by, as a share of the signal's power: 50 dB."""

UNKNOWN = 20.0
"""Signal-to-noise ratio where none is given, dB."""

SMALLEST = 16
"""Side of a picture, px, from which on its own noise is measured in it."""


class Camera:
    """What the front end must know of a camera.

    Parameters
    ----------
    response : Tensor, (A, M, K)
        One matrix for each zone of field angles.
    prior : Prior
        On the same wavelengths.
    """

    def __init__(self, response: Tensor, prior: Prior):
        response = response.double()
        mean = response.mean(0)
        white = mean.sum(-1)
        flat = white / (white @ white)
        seen = mean @ prior.basis
        unit = white.square().mean().sqrt()
        vectors = torch.linalg.eigh(seen @ prior.moment @ seen.T)[1].flip(1)
        kept = torch.zeros(len(white), DIRECTIONS, dtype=torch.float64)
        kept[:, : len(white)] = vectors[:, :DIRECTIONS]
        self.project = torch.cat([kept / unit, flat[:, None]], 1).float()
        """(M, DIRECTIONS + 1), y @ project is amplitude times shape in the directions kept, and
        the amplitude. A flat spectrum of one has an amplitude of one and a shape of rms one."""
        self.channels = len(white)
        self.zones = [
            Estimators(kept.T @ one / unit, flat @ one, len(white), prior) for one in response
        ]
        """The posteriors, zone by zone."""
        seen = kept[:, :TOLD].T @ seen / unit
        moment = prior.moment * (len(white) / (seen @ prior.moment @ seen.T).trace())
        self.power = (seen @ moment @ seen.T).diagonal().clamp_min(1e-12).float()
        """(TOLD,), variance of shapes in the leading directions."""
        self.quiet = vectors[:, -(len(white) // 2) :].float()
        """(M, M // 2), directions that hardly any spectrum reaches: what they see is noise."""

    def to(self, device: torch.device | str) -> "Camera":
        """Move everything to a device, in place."""
        for name in ("project", "power", "quiet"):
            setattr(self, name, getattr(self, name).to(device))
        for zone in self.zones:
            zone.to(device)
        return self


@dataclass
class View:
    """The measurement at one level: what cells measure, and how sure that is.

    shape : (B, H, W, D) measurements divided by their amplitude, in the camera's directions.
    noise : (B, H, W) noise variance of each direction.
    amplitude : (B, H, W).
    """

    shape: Tensor
    noise: Tensor
    amplitude: Tensor

    def joined(self, size: int) -> Tensor:
        """Return what is averaged together, (B, H, W, size + 2), of `size` directions."""
        return torch.cat(
            [self.shape[..., :size], self.noise[..., None], self.amplitude[..., None]], -1
        )

    @classmethod
    def parted(cls, joined: Tensor) -> "View":
        """Undo `joined`."""
        return cls(joined[..., :-2], joined[..., -2], joined[..., -1])


# --- averaging over what looks the same ---------------------------------------------------------


def coarser(view: View) -> View:
    """Average cells two by two, each weighted by its certainty; sides must be even."""
    b, h, w, _ = view.shape.shape

    def total(values: Tensor) -> Tensor:
        return values.view(b, h // 2, 2, w // 2, 2, -1).sum((2, 4))

    weight = 1 / view.noise[..., None]
    summed = total(weight)
    amplitude = total(view.amplitude[..., None] * weight) / summed
    return View(total(view.shape * weight) / summed, 1 / summed[..., 0], amplitude[..., 0])


def among_neighbours(view: View, camera: Camera) -> View:
    """Average each cell with those of its eight neighbours that show the same spectrum."""
    h, w, size = view.shape.shape[1:]
    weight = 1 / view.noise
    told = view.shape[..., :TOLD]
    # Neighbours are about as noisy as the cell itself.
    scale, against = _telling(2 * (view.noise + MODEL_NOISE), camera)
    content = torch.cat([view.shape, view.amplitude[..., None]], -1)
    around = functional.pad(torch.cat([content, weight[..., None]], -1), (0, 0, 1, 1, 1, 1))
    total = content * weight[..., None]
    for dy, dx in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        other = around[:, dy : dy + h, dx : dx + w]
        differ = ((other[..., :TOLD] - told).square() * scale).sum(-1) - against
        share = torch.sigmoid(-differ) * other[..., -1]
        total = torch.addcmul(total, share[..., None], other[..., : size + 1])
        weight = weight + share
    total = total / weight[..., None]
    return View(total[..., :size], 1 / weight, total[..., size])


def kinship(view: View, own: View, coarse: View, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return how much each cell takes from the four coarse cells around it, and from itself.

    The likelihoods that a cell shows the spectrum of a coarse one, times how certain that is.

    Parameters
    ----------
    view : View
        What the cells measured.
    own : View
        What they know without the coarse level; its certainty counts for "itself".
    coarse : View
        Half the size.

    Returns
    -------
    kin : Tensor, (B, H, W, 4)
        Shares of the coarse cells, summing to 1, in the order of `inherit`.
    alone : Tensor, (B, H, W)
        Log odds of the cell itself against all of them.
    """
    told = view.shape[..., :TOLD]
    around = _edged(torch.cat([coarse.shape[..., :TOLD], coarse.noise[..., None]], -1))
    mean = functional.avg_pool2d(around[..., -1], 2, 1)  # of the four around each corner
    phases = []
    for (y, x), phase, cells in _four(*view.noise.shape[1:]):
        h, w = coarse.noise.shape[1:]
        noise = view.noise[phase] + mean[:, y : y + h, x : x + w]
        scale, against = _telling(noise + 2 * MODEL_NOISE, camera)
        logs = []
        for cell in cells:
            other = around[cell]
            differ = ((other[..., :-1] - told[phase]).square() * scale).sum(-1) - against
            logs.append(-differ - (other[..., -1] + MODEL_NOISE).log())
        logs = torch.stack(logs, -1)
        alone = -(own.noise[phase] + MODEL_NOISE).log() - torch.logsumexp(logs, -1)
        phases.append(torch.cat([torch.softmax(logs, -1), alone[..., None]], -1))
    both = _interleaved(phases)
    return both[..., :4], both[..., 4]


def _telling(noise: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return scale (..., TOLD) and constant (...): how to tell two spectra apart.

    The sum of squared differences times scale, less the constant, is how much likelier two
    measurements are of different spectra than of one, as a logarithm. `noise` is the variance of
    their difference.

    Source: Neyman and Pearson; N(0, noise) against N(0, noise + 2 power).
    """
    share = 2 * camera.power / noise[..., None]
    return share / (1 + share) / (2 * noise[..., None]), torch.log1p(share).sum(-1) / 2


def inherit(kin: Tensor, coarse: Tensor) -> Tensor:
    """Mix the four coarse cells, (B, H/2, W/2, C), around each cell, (B, H, W, 4)."""
    around = _edged(coarse)
    phases = []
    for _, phase, cells in _four(*kin.shape[1:3]):
        part = kin[phase]
        mixed = part[..., :1] * around[cells[0]]
        for number in range(1, 4):
            mixed = torch.addcmul(mixed, part[..., number : number + 1], around[cells[number]])
        phases.append(mixed)
    return _interleaved(phases)


def _edged(picture: Tensor) -> Tensor:
    """Repeat the outermost cells once around a picture."""
    wide = torch.cat([picture[:, :, :1], picture, picture[:, :, -1:]], 2)
    return torch.cat([wide[:, :1], wide, wide[:, -1:]], 1)


def _four(height: int, width: int):
    """Yield the four phases of cells in a coarse one: number, place, its nearest coarse cells."""
    h, w = height // 2, width // 2
    every = slice(None)
    for y in range(2):
        for x in range(2):
            near = [
                (every, slice(row, row + h), slice(column, column + w))
                for row in (y, y + 1)
                for column in (x, x + 1)
            ]
            yield (y, x), (every, slice(y, None, 2), slice(x, None, 2)), near


def _interleaved(phases: list[Tensor]) -> Tensor:
    """Undo the parting of a picture into four phases."""
    b, h, w, c = phases[0].shape
    rows = [torch.stack(phases[2 * row : 2 * row + 2], 3) for row in range(2)]
    return torch.stack(rows, 2).view(b, 2 * h, 2 * w, c)


# --- the front end ------------------------------------------------------------------------------


@dataclass
class Evidence:
    """Everything that the front end hands on, of the same size for every camera.

    coefficients, variance : (B, H, W, C) at the level SPECTRAL, posterior mean and variance.
    features : (B, H, W, 2) there: log noise and log evidence.
    kin, alone : of `kinship` for the levels below, finest first.
    own : what the cells of these levels say by themselves, (B, H, W, CORRECTED[level]).
    noise : noise variance of that, (B, H, W).
    amplitude : (B, H, W) as measured; smooth : the same averaged over kin.
    """

    coefficients: Tensor
    variance: Tensor
    features: Tensor
    kin: list[Tensor]
    alone: list[Tensor]
    own: list[Tensor]
    noise: list[Tensor]
    amplitude: Tensor
    smooth: Tensor


def gather_evidence(
    y: Tensor, ratio: Tensor, camera: Camera, levels: int, zone: Tensor | None = None
) -> Evidence:
    """Turn measurements into posteriors.

    Parameters
    ----------
    y : Tensor, (B, H, W, M)
        Sides must be multiples of 2^levels.
    ratio : Tensor, (B, H, W)
        Noise power over signal power; infinite where nothing was measured.
    camera : Camera
    levels : int
        0 for pixels without neighbours.
    zone : Tensor, (B, H, W), int, optional
        Number of each pixel's zone; a camera of one zone needs none.
    """
    projected = y @ camera.project
    amplitude = projected[..., -1]
    floor = 1e-3 * amplitude.abs().mean((1, 2), keepdim=True)
    amplitude = torch.maximum(amplitude, floor).clamp_min(1e-30)
    shape = projected[..., :-1] / amplitude[..., None]
    power = shape.square().sum(-1) / camera.channels
    views = [View(shape, (ratio * power.clamp_min(1e-6)).clamp(1e-9, 1e6), amplitude)]
    for _ in range(levels):
        views.append(coarser(views[-1]))
    known = [views[0], *(among_neighbours(view, camera) for view in views[1:])]
    lowest = min(SPECTRAL, levels)
    best = spectral = known[-1]
    kin, alone = [], []
    for level in reversed(range(levels)):
        shares, odds = kinship(views[level], known[level], best, camera)
        if level < lowest:
            kin.insert(0, shares)
            alone.insert(0, odds)
        if level == 0:
            break
        size = DIRECTIONS if level >= lowest else TOLD
        inherited = inherit(shares, best.joined(size))
        itself = torch.sigmoid(odds)[..., None]
        best = View.parted(torch.lerp(inherited, known[level].joined(size), itself))
        if level == lowest:
            spectral = best
    smooth = inherit(kin[0], best.amplitude[..., None])[..., 0] if levels else amplitude

    def estimated(level: int, view: View, estimate):
        return _by_zone(
            estimate, camera.zones, _coarse_zone(zone, 2**level), view.shape,
            view.noise + MODEL_NOISE,
        )  # fmt: skip

    mean, variance, evidence = estimated(lowest, spectral, Estimators.mixture)
    own = [
        estimated(
            level, known[level],
            lambda one, shape, noise, size=CORRECTED[level]: (one.wiener(shape, noise, size),),
        )[0]
        for level in range(lowest)
    ]  # fmt: skip
    noise = (spectral.noise + MODEL_NOISE).log()
    return Evidence(
        mean,
        variance,
        torch.stack([noise, evidence.clamp(-20, 20)], -1),
        kin,
        alone,
        own,
        [known[level].noise + MODEL_NOISE for level in range(lowest)],
        amplitude,
        smooth,
    )


def _coarse_zone(zone: Tensor | None, step: int) -> Tensor | None:
    return None if zone is None else zone[:, step // 2 :: step, step // 2 :: step].contiguous()


def _by_zone(estimate, zones: list[Estimators], zone: Tensor | None, shape: Tensor, noise: Tensor):
    """Apply each zone's estimator to its own cells; returns pictures."""
    grid = noise.shape
    shape, noise = shape.reshape(-1, shape.shape[-1]), noise.reshape(-1)
    if zone is None or len(zones) == 1:
        found = estimate(zones[0], shape, noise)
    else:
        places = [torch.nonzero(zone.reshape(-1) == number)[:, 0] for number in range(len(zones))]
        parts = [
            estimate(one, shape[place], noise[place])
            for one, place in zip(zones, places, strict=True)
            if len(place)
        ]
        order = torch.argsort(torch.cat(places))
        found = [torch.cat(part)[order] for part in zip(*parts, strict=True)]
    return [part.view(*grid, *part.shape[1:]) for part in found]


def noise_factor(y: Tensor, ratio: Tensor, camera: Camera) -> Tensor:
    """Return by how much a picture is noisier than its stated ratio says, in power, (B, 1, 1).

    Neighbouring pixels, each divided by its amplitude, differ by noise alone nearly everywhere, all
    the more in directions of the measurement that spectra hardly reach. The median of these
    differences over the picture is not moved by the edges in it.
    """
    y, ratio = y[:, ::2], ratio[:, ::2]  # every other row is plenty
    amplitude = (y @ camera.project[:, -1:]).clamp_min(1e-30)
    quiet = (y @ camera.quiet) / amplitude
    power = ratio * (y / amplitude).square().mean(-1)
    expected = power[:, :, 1:] + power[:, :, :-1]
    steps = (quiet[:, :, 1:] - quiet[:, :, :-1]).square().mean(-1) / expected
    steps = torch.where(expected < 1e6, steps, torch.nan).flatten(1)
    count = camera.quiet.shape[1]
    # Wilson and Hilferty: the median of a mean of `count` squares.
    factor = steps.nanmedian(1).values / (1 - 2 / (9 * count)) ** 3
    return factor.nan_to_num(1.0).clamp(0.05, 20.0)[:, None, None]


# --- the back end -------------------------------------------------------------------------------


class Block(nn.Module):
    """A depthwise convolution and two dense layers over the channels, added to the input."""

    def __init__(self, width: int, kernel: int = 5):
        super().__init__()
        self.around = nn.Conv2d(width, width, kernel, padding=kernel // 2, groups=width)
        self.widen = nn.Linear(width, 2 * width)
        self.narrow = nn.Linear(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        seen = self.around(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        return x + self.narrow(torch.relu(self.widen(seen)))


class Refiner(nn.Module):
    """Dense in, blocks, dense out; starts as zero, so that training starts at the front end."""

    def __init__(self, inputs: int, width: int, blocks: int, outputs: int, kernel: int = 5):
        super().__init__()
        self.enter = nn.Linear(inputs, width)
        self.blocks = nn.Sequential(*(Block(width, kernel) for _ in range(blocks)))
        self.leave = nn.Linear(width, outputs)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return what leaves, and the features before."""
        x = self.blocks(self.enter(x))
        return self.leave(x), x


class BackEnd(nn.Module):
    """What is learnt: corrections at three levels, and the interval.

    Parameters
    ----------
    prior : Prior
    hats : Tensor, (KNOTS, K)
        Linear interpolation from the knots of the interval to the bands.
    """

    scale: Tensor
    knots: Tensor

    def __init__(self, prior: Prior, hats: Tensor):
        super().__init__()
        size = len(prior.moment)
        self.register_buffer("scale", prior.moment.diagonal().sqrt().float(), persistent=False)
        average = hats.double() / hats.double().sum(1, keepdim=True)
        self.register_buffer("knots", (average @ prior.basis).float(), persistent=False)
        fine, middle = CORRECTED
        self.spectral = Refiner(2 * size + 2, 96, 3, size + KNOTS)
        self.finer = nn.ModuleList(
            [Refiner(2 * fine + 4, 24, 1, fine + 2), Refiner(2 * middle + 4, 48, 1, middle + 2)]
        )
        self.margin = nn.Sequential(nn.Linear(24, 32), nn.ReLU(), nn.Linear(32, KNOTS))

    def forward(
        self, seen: Evidence, interval: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return coefficients (B, H, W, C), amplitude (B, H, W), and the interval at the knots.

        The interval is half the width of the 90 % interval, (B, H, W, KNOTS), for amplitude 1.
        """
        size = len(self.scale)
        deviation = seen.variance.sqrt()
        unit = _rms(seen.coefficients / self.scale)
        relative = (seen.coefficients / (self.scale * unit)).clamp(-10, 10)
        doubt = (deviation / (self.scale * unit)).clamp_min(1e-6).log()
        found, _ = self.spectral(torch.cat([relative, doubt, seen.features / 4], -1))
        x = seen.coefficients + deviation * found[..., :size]
        width = None
        if interval:
            # Diagonal in the coefficients, where the posterior is not: the network knows better.
            spread = (seen.variance @ self.knots.square().T).sqrt()
            width = 1.645 * spread * found[..., size:].clamp(-4, 3).exp()
        amplitude = seen.amplitude
        for level in reversed(range(len(seen.own))):
            x, width, calm = self._finer(seen, level, x, width)
            if level == 0:
                amplitude = amplitude * (1 + calm)
        return x, amplitude, width

    def _finer(self, seen: Evidence, level: int, x: Tensor, width: Tensor | None):
        """Go from the cells of one level to those of the next finer."""
        own, noise = seen.own[level], seen.noise[level]
        used = own.shape[-1]
        x = inherit(seen.kin[level], x)
        low, scale = x[..., :used].clone(), self.scale[:used]
        unit = _rms(low / scale)
        scale = scale * unit
        deviation = noise.sqrt()[..., None]
        odds = seen.alone[level][..., None]
        apart = own - low
        uneven = torch.zeros_like(odds)
        if level == 0:
            uneven = (seen.smooth / seen.amplitude - 1)[..., None] / deviation
            uneven = uneven.clamp(-10, 10)
        inputs = [
            (low / scale).clamp(-10, 10),
            (apart / (scale * deviation.clamp_min(0.02))).clamp(-10, 10),
            deviation.log() + 3,
            odds.clamp(-10, 10) / 4,
            unit.log(),
            uneven,
        ]
        found, features = self.finer[level](torch.cat(inputs, -1))
        itself = torch.sigmoid(odds + found[..., used : used + 1])
        x[..., :used] = low + itself * apart + deviation * scale * found[..., :used]
        if width is not None:
            # What a cell says by itself is as doubtful as its distance from the rest, and noise.
            knots = self.knots[:, :used].square().T
            surprise = apart.square() @ knots + 0.02 * unit.square()
            kin = inherit(seen.kin[level], width.square())
            width = torch.lerp(kin, surprise.detach(), itself.detach()).sqrt()
            if level == 0:
                width = width * self.margin(features.detach()).clamp(-4, 3).exp()
        # Kin are of one colour, not of one brightness: only what noise explains is evened out. (An
        # amplitude is about a fifth as noisy as a channel.)
        step = uneven * (-3 * uneven.square()).exp() * deviation
        return x, width, (torch.sigmoid(found[..., -1:]) * step)[..., 0]


def _rms(x: Tensor) -> Tensor:
    return x.square().mean(-1, keepdim=True).sqrt().clamp_min(1e-6)


# --- the model ----------------------------------------------------------------------------------


class Compound(Reconstructor):
    """The one model for every camera; see the module.

    Pictures, (..., H, W, M), are reconstructed with their neighbourhoods; a list of measurements,
    (N, M) or (M,), one by one.

    Parameters
    ----------
    calibration : Calibration
        With several field angles, pixels are treated in zones of nearly one angle each.
    prior : Prior, optional
        Default: the one that ships; a band beyond 500-750 nm takes it stretched.
    """

    name = "compound"
    trained = True
    universal = True
    piece = 4096
    basis: Tensor
    hats: Tensor

    def __init__(self, calibration: Calibration, prior: Prior | None = None):
        super().__init__(calibration)
        prior = broad_prior() if prior is None else prior
        for key, value in prior.tensors().items():  # the file of the weights holds the prior too
            self.register_buffer(f"prior_{key}", value)
        self.prior = prior.on(calibration.wavelength)
        hats = _hats(len(self.wavelength))
        self.back = BackEnd(self.prior, hats)
        self.register_buffer("basis", self.prior.basis.T.float(), persistent=False)
        self.register_buffer("hats", hats, persistent=False)
        self._cameras: dict[tuple[bool, ...], tuple[Camera, Camera]] = {}

    @classmethod
    def for_weights(cls, calibration: Calibration, weights: Mapping[str, Tensor]) -> "Compound":
        stored = {
            key.removeprefix("prior_"): value
            for key, value in weights.items()
            if key.startswith("prior_")
        }
        return cls(calibration, Prior.from_tensors(stored) if "covariance" in stored else None)

    def forward(
        self,
        y: Tensor,
        angle: Tensor | None = None,
        snr: Tensor | float | None = None,
        scale: Scale = "consistent",
    ) -> Tensor:
        """Reconstruct spectra; see `Reconstructor.forward`.

        y : (..., H, W, M) for pictures, (N, M) or (M,) for measurements without neighbours. Both
        rules of `scale` leave the result, which has its own.
        """
        check_scale(scale)
        return self._spectra(*self._accepted(y, angle, snr))[0]

    def with_interval(
        self, y: Tensor, angle: Tensor | None = None, snr: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor]:
        """Reconstruct spectra, and say how far they may be off.

        Arguments are those of `forward`.

        Returns
        -------
        x : Tensor, (..., K)
        width : Tensor, (..., K)
            Half the width of the 90 % interval: the truth of a band lies within x +- width for nine
            in ten.
        """
        x, width = self._spectra(*self._accepted(y, angle, snr), interval=True)
        assert width is not None
        return x, width

    def reconstruct(self, measurement: Measurement, scale: Scale = "consistent") -> "DataArray":
        check_scale(scale)
        with torch.inference_mode():
            cube, _ = self._spectra(*self._usable(measurement))
        return self._labelled(cube.cpu().numpy(), measurement, scale)

    def reconstruct_interval(self, measurement: Measurement) -> "tuple[DataArray, DataArray]":
        """Return the cube of `reconstruct` and half the width of its 90 % interval."""
        with torch.inference_mode():
            cube, width = self._spectra(*self._usable(measurement), interval=True)
        assert width is not None
        both = [
            self._labelled(values.cpu().numpy(), measurement, "consistent")
            for values in (cube, width)
        ]
        both[1].attrs["long_name"] = "half width of the 90 % interval of the photon radiance"
        return both[0], both[1].rename("interval")

    def _usable(self, measurement: Measurement):
        """Return y, angle, snr and channels of a measurement.

        A channel that most pixels lack is left out of the camera; what single pixels lack is
        filled by the linear estimate from their other channels.
        """
        from squilla.reconstruction.linear import complete

        y = torch.as_tensor(measurement.y, dtype=torch.float32)
        y, angle, snr = self._accepted(picture(y), measurement.angle, measurement.snr)
        valid = torch.as_tensor(measurement.valid, dtype=torch.bool) & y.isfinite()
        enough = valid.sum(-1) >= (y.shape[-1] + 1) // 2
        channels = valid[enough].float().mean(0) >= 0.5
        part = replace(self.calibration, sensitivity=self.calibration.sensitivity[:, channels])
        y = complete(y[..., channels], valid[..., channels], part, angle, snr)
        y = torch.where(enough[..., None], y, torch.nan).to(self.basis.device)
        return y, angle, snr, tuple(channels.tolist())

    def _camera(self, channels: tuple[bool, ...] | None, zoned: bool) -> Camera:
        """Return the front end for some of the channels, (M,), with the mean angle or in zones."""
        key = channels or (True,) * self.calibration.filters
        if key not in self._cameras:
            response = self.calibration.mean_sensitivity[list(key)]
            one = Camera(response[None], self.prior)
            every = one
            if len(self.calibration.angle) > 1:
                weight = self.calibration.angle_weights(self._middles().sqrt())
                zones = torch.einsum("za,amk->zmk", weight, self.calibration.sensitivities)
                every = Camera(zones[:, list(key)], self.prior)
            self._cameras[key] = one.to(self.basis.device), every.to(self.basis.device)
        return self._cameras[key][zoned]

    def _middles(self) -> Tensor:
        """Return the squared angle in the middle of each zone, (ZONES,)."""
        least, most = (float(end) ** 2 for end in self.calibration.angle[[0, -1]])
        return least + (most - least) * (torch.arange(ZONES) + 0.5) / ZONES

    def _apply(self, fn, recurse=True):
        self._cameras = {}  # made anew on the device to which the module moves
        return super()._apply(fn, recurse)

    def _spectra(
        self,
        y: Tensor,
        angle: Tensor | None,
        snr: Tensor | None,
        channels: tuple[bool, ...] | None = None,
        interval: bool = False,
    ) -> tuple[Tensor, Tensor | None]:
        """Reconstruct accepted measurements, and the interval if wanted."""
        height, width = y.shape[-3:-1] if y.ndim > 2 else (1, 1)
        pixels, bands = y.shape[:-1], len(self.wavelength)
        if y.numel() == 0:
            return y.new_zeros(*pixels, bands), y.new_zeros(*pixels, bands) if interval else None
        camera = self._camera(channels, angle is not None)
        y = y.reshape(-1, height, width, y.shape[-1])
        ratio = 10 ** (-(y.new_tensor(UNKNOWN) if snr is None else snr).clamp_max(60) / 10)
        ratio = ratio.expand(pixels).reshape(y.shape[:-1])
        zone = None
        if angle is not None:
            middles = self._middles().to(y.device)
            edges = (middles[1:] + middles[:-1]) / 2
            zone = torch.bucketize(angle.reshape(y.shape[:-1]).square(), edges)
        size = self.piece if height * width == 1 else 1
        parts = [
            self._pictures(
                y[some], ratio[some], camera, None if zone is None else zone[some], interval
            )
            for some in torch.arange(len(y), device=y.device).split(size)
        ]
        x = torch.cat([part[0] for part in parts]).view(*pixels, bands)
        spreads = [part[1] for part in parts if part[1] is not None]
        return x, torch.cat(spreads).view(*pixels, bands) if interval else None

    def _pictures(
        self, y: Tensor, ratio: Tensor, camera: Camera, zone: Tensor | None, interval: bool
    ) -> tuple[Tensor, Tensor | None]:
        height, width = y.shape[1:3]
        finite = y.isfinite().all(-1)
        lit = (y > 0).any(-1) & finite
        y = torch.where(finite[..., None], y, 0)
        ratio = torch.where(lit, ratio, torch.inf)
        if min(height, width) >= SMALLEST:
            ratio = ratio * noise_factor(y, ratio, camera)
        levels = min(LEVELS, math.ceil(math.log2(max(height, width))))
        step = 2**levels
        below, right = -height % step, -width % step
        if below or right:
            y = functional.pad(y, (0, 0, 0, right, 0, below))
            ratio = functional.pad(ratio, (0, right, 0, below), value=torch.inf)
            if zone is not None:
                zone = functional.pad(zone, (0, right, 0, below))
        seen = gather_evidence(y, ratio, camera, levels, zone)
        coefficients, amplitude, spread = self.back(seen, interval)
        amplitude = torch.where(finite, amplitude[:, :height, :width] * lit, torch.nan)[..., None]
        x = ((coefficients[:, :height, :width] * amplitude) @ self.basis).relu_()
        if spread is not None:
            spread = (spread[:, :height, :width] * amplitude) @ self.hats
        return x, spread


def _hats(bands: int) -> Tensor:
    """Return the matrix of linear interpolation from the knots to the bands, (KNOTS, K)."""
    place = np.linspace(0, KNOTS - 1, bands)
    return torch.from_numpy(
        np.stack([np.interp(place, np.arange(KNOTS), unit) for unit in np.eye(KNOTS)])
    ).float()
