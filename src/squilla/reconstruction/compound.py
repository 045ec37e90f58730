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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.reconstruction.prior import Estimators, Prior, broad_prior, log_ratio
from squilla.reconstruction.reconstructor import Reconstructor, Scale, check_scale, picture

if TYPE_CHECKING:
    from xarray import DataArray

LEVELS = 4
"""Halvings from the picture to the coarsest cells."""

SPECTRAL = 2
"""Level at which spectra are inferred; finer ones borrow from it."""

TOLD = 16
"""Leading eigenvectors by which two measurements are told apart."""

FINE = 24
"""Leading coefficients that the network corrects at the finest level."""

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
        self.unit = float(white.square().mean().sqrt())
        """Rms that a flat spectrum of one measures."""
        self.flat = (white / (white @ white)).float()
        """(M,), y @ flat is the amplitude of a measurement."""
        self.zones = [Estimators(one / self.unit, prior) for one in response]
        """The posteriors, zone by zone."""
        own = self.zones[len(self.zones) // 2].linear
        self.told, self.power = own.vectors[0, :, :TOLD], own.power[0, 0, :TOLD]
        """Eigenvectors, (M, TOLD), by which spectra are told apart, and the variance in them."""
        self.quiet = own.vectors[0, :, -(len(white) // 2) :]
        """Eigenvectors, (M, M // 2), that hardly any spectrum reaches: what they see is noise."""

    def to(self, device: torch.device | str) -> "Camera":
        """Move everything to a device, in place."""
        for name in ("flat", "told", "power", "quiet"):
            setattr(self, name, getattr(self, name).to(device))
        for zone in self.zones:
            zone.to(device)
        return self


@dataclass
class View:
    """The measurement at one level: what cells measure, and how sure that is.

    shape : (B, H, W, M) measurements divided by their amplitude and the camera's unit.
    weight : (B, H, W) one over the noise variance of a channel; 0 where nothing was measured.
    amplitude : (B, H, W).
    """

    shape: Tensor
    weight: Tensor
    amplitude: Tensor

    @property
    def noise(self) -> Tensor:
        """Noise variance with what the calibration is wrong by, (B, H, W)."""
        return 1 / self.weight.clamp_min(1e-6) + MODEL_NOISE

    def joined(self) -> Tensor:
        """Return everything that is averaged together, (B, H, W, M + 2)."""
        return torch.cat(
            [self.shape, 1 / self.weight.clamp_min(1e-6)[..., None], self.amplitude[..., None]], -1
        )

    @classmethod
    def parted(cls, joined: Tensor) -> "View":
        """Undo `joined`."""
        return cls(joined[..., :-2], 1 / joined[..., -2], joined[..., -1])


# --- averaging over what looks the same ---------------------------------------------------------


def coarser(view: View) -> View:
    """Average cells two by two, each weighted by its certainty; sides must be even."""
    b, h, w, m = view.shape.shape

    def total(values: Tensor) -> Tensor:
        return values.view(b, h // 2, 2, w // 2, 2, -1).sum((2, 4))

    weight = view.weight[..., None]
    summed = total(weight)
    safe = summed.clamp_min(1e-12)
    amplitude = total(view.amplitude[..., None] * weight) / safe
    return View(total(view.shape * weight) / safe, summed[..., 0], amplitude[..., 0])


def among_neighbours(view: View, camera: Camera) -> View:
    """Average each cell with those of its eight neighbours that show the same spectrum."""
    b, h, w, m = view.shape.shape
    told = view.shape @ camera.told
    features = torch.cat([view.shape, view.amplitude[..., None], told, view.weight[..., None]], -1)
    around = functional.pad(features, (0, 0, 1, 1, 1, 1))
    content = features[..., : m + 1]
    total, weight = content * view.weight[..., None], view.weight.clone()
    for dy, dx in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        other = around[:, dy : dy + h, dx : dx + w]
        noise = view.noise + 1 / other[..., -1].clamp_min(1e-6) + MODEL_NOISE
        differ = log_ratio((other[..., m + 1 : -1] - told).square(), camera.power, noise)
        share = torch.sigmoid(-differ) * other[..., -1]
        total = total + share[..., None] * other[..., : m + 1]
        weight = weight + share
    total = total / weight.clamp_min(1e-12)[..., None]
    return View(total[..., :m], weight, total[..., m])


def kinship(view: View, own: View, coarse: View, camera: Camera) -> Tensor:
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
    Tensor, (B, H, W, 5), non-negative, summing to 1; the order is that of `inherit`
    """
    b, h, w, _ = view.shape.shape
    told, noise = view.shape @ camera.told, view.noise
    around = _edged(
        torch.cat([coarse.shape @ camera.told, coarse.noise[..., None]], -1)
    )
    logs = told.new_empty(b, h, w, 5)
    for phase, cells in _four(h, w):
        for number, cell in enumerate(cells):
            other = around[cell]
            differ = log_ratio(
                (other[..., :-1] - told[phase]).square(), camera.power, noise[phase] + other[..., -1]
            )
            logs[(*phase, number)] = -differ - other[..., -1].log()
    logs[..., 4] = -own.noise.log()
    return torch.softmax(logs, -1)


def inherit(share: Tensor, coarse: Tensor, own: Tensor) -> Tensor:
    """Mix what coarse cells and the cells themselves say, by the shares of `kinship`.

    coarse (B, H/2, W/2, C) and own (B, H, W, C) or (C,) -> (B, H, W, C)
    """
    around = _edged(coarse)
    b, h, w, c = coarse.shape
    own = own.expand(*share.shape[:3], c)
    phases = []
    for phase, cells in _four(2 * h, 2 * w):
        part = share[phase]
        mixed = part[..., 4:] * own[phase]
        for number, cell in enumerate(cells):
            mixed = torch.addcmul(mixed, part[..., number : number + 1], around[cell])
        phases.append(mixed)
    rows = [torch.stack(phases[2 * row : 2 * row + 2], 3) for row in range(2)]
    return torch.stack(rows, 2).view(b, 2 * h, 2 * w, c)


def _edged(picture: Tensor) -> Tensor:
    """Repeat the outermost cells once around a picture."""
    wide = torch.cat([picture[:, :, :1], picture, picture[:, :, -1:]], 2)
    return torch.cat([wide[:, :1], wide, wide[:, -1:]], 1)


def _four(height: int, width: int):
    """Yield the four phases of cells in a coarse one, with their four nearest coarse cells."""
    h, w = height // 2, width // 2
    every = slice(None)
    for y in range(2):
        for x in range(2):
            near = [
                (every, slice(row, row + h), slice(column, column + w))
                for row in (y, y + 1)
                for column in (x, x + 1)
            ]
            yield (every, slice(y, None, 2), slice(x, None, 2)), near


# --- the front end ------------------------------------------------------------------------------


@dataclass
class Evidence:
    """Everything that the front end hands on; a picture's cells at the levels 0, 1, SPECTRAL.

    coefficients, variance : (B, H, W, C) at SPECTRAL, posterior mean and variance.
    features : (B, H, W, 2) at SPECTRAL: log noise and log evidence.
    shares : of `kinship` for the levels below SPECTRAL, finest first.
    own : linear estimates of the levels below SPECTRAL, (B, H, W, C), finest first.
    noise : noise variance of what each cell there knows alone, finest first.
    amplitude : (B, H, W) as measured; smooth : the same averaged over kin.
    """

    coefficients: Tensor
    variance: Tensor
    features: Tensor
    shares: list[Tensor]
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
    amplitude = y @ camera.flat
    floor = 1e-3 * amplitude.abs().mean((1, 2), keepdim=True)
    amplitude = torch.maximum(amplitude, floor).clamp_min(1e-30)
    shape = y / (camera.unit * amplitude[..., None])
    noise = ratio * shape.square().mean(-1).clamp_min(1e-6)
    views = [View(shape, 1 / noise.clamp_min(1e-9), amplitude)]
    for _ in range(levels):
        views.append(coarser(views[-1]))
    known = [views[0], *(among_neighbours(view, camera) for view in views[1:])]
    best, shares = known[-1], []
    lowest = min(SPECTRAL, levels)
    spectral = best
    for level in reversed(range(levels)):
        shares.insert(0, kinship(views[level], known[level], best, camera))
        best = View.parted(inherit(shares[0], best.joined(), known[level].joined()))
        if level == lowest:
            spectral = best
    zone_at = [_coarse_zone(zone, 2**level) for level in range(lowest + 1)]
    mean, variance, evidence = _by_zone(
        lambda one, *given: one.mixture(*given),
        camera.zones, zone_at[lowest], spectral.shape, spectral.noise,
    )  # fmt: skip
    own = [
        _by_zone(
            lambda one, *given: (one.wiener(*given),),
            camera.zones, zone_at[level], known[level].shape, known[level].noise,
        )[0]
        for level in range(lowest)
    ]  # fmt: skip
    return Evidence(
        mean,
        variance,
        torch.stack([spectral.noise.log(), evidence.clamp(-20, 20)], -1),
        shares[:lowest],
        own,
        [known[level].noise for level in range(lowest)],
        amplitude,
        best.amplitude if levels else amplitude,
    )


def _coarse_zone(zone: Tensor | None, step: int) -> Tensor | None:
    return None if zone is None else zone[:, step // 2 :: step, step // 2 :: step].contiguous()


def _by_zone(estimate, zones: Sequence[Estimators], zone: Tensor | None, shape: Tensor, noise: Tensor):
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
    shape = y / (y @ camera.flat).clamp_min(1e-30)[..., None]
    shape = torch.where(shape.abs() < 1e3, shape, torch.nan)
    quiet = shape @ camera.quiet
    power = ratio * shape.square().mean(-1)
    steps = []
    for one, other in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(None), slice(None), slice(1, None)), (slice(None), slice(None), slice(None, -1))),
    ):
        expected = power[one] + power[other]
        steps.append(((quiet[one] - quiet[other]).square().mean(-1) / expected).flatten(1))
    found = torch.cat(steps, 1)
    found = torch.where(found.isfinite(), found, torch.nan)
    count = camera.quiet.shape[1]
    # Wilson and Hilferty: the median of a mean of `count` squares.
    factor = found.nanmedian(1).values / (1 - 2 / (9 * count)) ** 3
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
        widths = (128, 64, 32)
        size = len(prior.moment)
        self.register_buffer("scale", prior.moment.diagonal().sqrt().float(), persistent=False)
        average = hats.double() / hats.double().sum(1, keepdim=True)
        self.register_buffer("knots", (average @ prior.basis).float(), persistent=False)
        self.spectral = Refiner(2 * size + 2, widths[0], 4, size + KNOTS)
        self.middle = Refiner(2 * size + 3, widths[1], 2, size + 1)
        self.fine = Refiner(2 * FINE + 4, widths[2], 1, FINE + 2)
        self.margin = nn.Sequential(nn.Linear(widths[2], 32), nn.ReLU(), nn.Linear(32, KNOTS))

    def forward(self, seen: Evidence, interval: bool = False) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return coefficients (B, H, W, C), amplitude (B, H, W), and the interval at the knots.

        The interval is half the width of the 90 % interval, (B, H, W, KNOTS), for amplitude 1.
        """
        size = len(self.scale)
        deviation = seen.variance.sqrt()
        unit = _rms(seen.coefficients / self.scale)
        relative = (seen.coefficients / self.scale / unit).clamp(-10, 10)
        doubt = (deviation / self.scale / unit).clamp_min(1e-6).log()
        found, _ = self.spectral(torch.cat([relative, doubt, seen.features / 4], -1))
        x = seen.coefficients + deviation * found[..., :size]
        width = None
        if interval:
            # Diagonal in the coefficients, where the posterior is not: the network knows better.
            spread = (seen.variance.detach() @ self.knots.square().T).sqrt()
            width = 1.645 * spread * found[..., size:].clamp(-4, 3).exp()
        for level in reversed(range(len(seen.own))):
            x, width, amplitude = self._finer(seen, level, x, width)
        if not seen.own:
            amplitude = seen.amplitude
        return x, amplitude, width

    def _finer(self, seen: Evidence, level: int, x: Tensor, width: Tensor | None):
        """Go from the cells of one level to those of the next finer."""
        share, own, noise = seen.shares[level], seen.own[level], seen.noise[level]
        x = inherit(share, x, own)
        scale = self.scale if level else self.scale[:FINE]
        used = len(scale)
        unit = _rms(x[..., :used] / scale)
        deviation = noise.sqrt()[..., None]
        apart = own - x
        relative = (x[..., :used] / (scale * unit)).clamp(-10, 10)
        surprise = (apart[..., :used] / (scale * unit * deviation.clamp_min(0.02))).clamp(-10, 10)
        inputs = [relative, surprise, deviation.log() + 3, share[..., 4:], (unit + 1e-6).log()]
        amplitude = seen.amplitude
        if level == 0:
            uneven = (seen.smooth / seen.amplitude.clamp_min(1e-30) - 1)[..., None] / deviation
            uneven = uneven.clamp(-10, 10)
            inputs.append(uneven)
        inputs = torch.cat(inputs, -1)
        found, features = (self.fine if level == 0 else self.middle)(inputs)
        change = deviation * unit * scale * found[..., :used]
        x = x + torch.tanh(found[..., used : used + 1]) * apart
        if level:
            x = x + change
        else:
            x = torch.cat([x[..., :used] + change, x[..., used:]], -1)
            # Kin are of one colour, not of one brightness: only what noise explains is evened out.
            # (An amplitude is about a fifth as noisy as a channel.)
            step = uneven * (-3 * uneven.square()).exp() * deviation
            calm = torch.sigmoid(found[..., -1:])
            amplitude = amplitude * (1 + calm * step)[..., 0]
        if width is not None:
            # What a cell knows alone is as doubtful as its distance from the rest, and its noise.
            alone = (apart.square() @ self.knots.square().T + 0.02 * unit.square()).detach()
            width = inherit(share, width.square(), alone).sqrt()
            if level == 0:
                width = width * self.margin(features.detach()).clamp(-4, 3).exp()
        return x, width, amplitude


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
            cubes = self._spectra(*self._usable(measurement), interval=True)
        both = [self._labelled(cube.cpu().numpy(), measurement, "consistent") for cube in cubes]
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
        *many, height, width, m = (len(y.reshape(-1, y.shape[-1])), 1, 1, y.shape[-1])
        if y.ndim > 2:
            *many, height, width, m = y.shape
        pixels, bands = y.shape[:-1], len(self.wavelength)
        if y.numel() == 0:
            return y.new_zeros(*pixels, bands), y.new_zeros(*pixels, bands) if interval else None
        camera = self._camera(channels, angle is not None)
        y = y.reshape(-1, height, width, m)
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
        x, spread = (
            None if part[0] is None else torch.cat(part).view(*pixels, bands)
            for part in zip(*parts, strict=True)
        )
        return x, spread

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
