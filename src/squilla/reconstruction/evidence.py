"""The heart of the compound model: from any camera's measurement to posteriors of spectra.

Nobody trained it. A measurement is divided by its amplitude and projected onto the directions that
spectra reach. Cells of growing size average what, at the known noise, shows the same spectrum; the
prior's posterior gives the spectrum; finer cells borrow it from kin. `docs/compound.md` has the
equations.

Pictures are (B, H, W, channels); level l has cells of 2^l px.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from squilla.reconstruction.estimators import Estimators
from squilla.reconstruction.prior import Prior

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

ALIKE = 1e-6
"""Variance by which shapes may differ and still be of one spectrum."""

SHADED, UNALIKE = 0.1, 1.0
"""Usual difference in brightness of neighbours, relative, if they show one surface, or two."""

TEXTURE = (1.5, 9.0)
"""Squared differences of brightness, over the noise's, that may be chance.

In the mean over 3 x 3 cells, one standard deviation above what noise makes; of one cell, three.
"""

NOTHING = 1e3
"""Noise variance of cells that have measured nothing."""

UNHEARD = 1e-3
"""What a cell says by itself is not heard if it counts for less."""

MISFITS = 10.0 ** np.arange(-6, -1.9, 0.5)
"""What calibrations may be wrong by, as a share of the signal's power: 60 dB to 20."""

FEW = 4
"""Every so many rows tell how noisy a picture is."""

SAMPLE = 8
"""Every so many rows and columns of the spectral cells tell which it is."""


class Camera:
    """What the model must know of a camera.

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
        amplitude = flat @ mean @ prior.basis
        shared = moment @ amplitude
        moment = moment - shared[:, None] * shared / (amplitude @ shared)  # all of one amplitude
        power = (seen @ moment @ seen.T).diagonal().clamp_min(1e-12)
        self.shown = ((prior.knots @ moment @ seen.T) / power).square().T.float()
        """(TOLD, KNOTS), variance of spectra that differ by one in a leading direction."""
        self.power = power.float()
        """(TOLD,), variance of shapes in the leading directions, as if each stood alone."""
        self.power[0], self.shown[0] = 0, 0  # along the amplitude, nearly, all shapes are alike
        self.misfits = torch.from_numpy(MISFITS).float()
        self.quiet = vectors[:, -(len(white) // 2) :].float()
        """(M, M // 2), directions that hardly any spectrum reaches: what they see is noise."""

    def to(self, device: torch.device | str) -> "Camera":
        """Move everything to a device, in place."""
        for name in ("project", "power", "shown", "misfits", "quiet"):
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


def coarser(view: View, camera: Camera) -> View:
    """Join cells two by two into one that shows what most of them show; sides must be even.

    On an edge the mean of all four would be a spectrum that nobody shows. So the cell that most of
    the four agree with is averaged with those that do.
    """
    b, h, w, size = view.shape.shape

    def parts(values: Tensor) -> Tensor:
        values = values.view(b, h // 2, 2, w // 2, 2, -1).transpose(2, 3)
        return values.reshape(b, h // 2, w // 2, 4, -1)

    joined = parts(torch.cat([view.shape, view.amplitude[..., None]], -1))
    noise = parts(view.noise)[..., 0]
    told = joined[..., :TOLD]
    # The quietest count most: of noisy ones among them, it hardly matters what they show.
    scale, against = _telling(8 / (1 / noise).sum(-1) + 2 * ALIKE, camera)
    apart = (told[..., :, None, :] - told[..., None, :, :]).square()
    differ = (apart * scale[..., None, None, :]).sum(-1)
    lit = _alike_in_brightness(joined[..., :, None, -1], joined[..., None, :, -1])
    alike = against[..., None, None] - differ + lit.log()
    itself = torch.eye(4, dtype=torch.bool, device=noise.device)
    share = torch.sigmoid(alike).masked_fill(itself, 1.0) / noise[..., None, :]
    certainty, most = share.sum(-1).max(-1)
    share = share.gather(-2, most[..., None, None].expand(*most.shape, 1, 4))
    mean = (share @ joined)[..., 0, :] / certainty[..., None]
    return View(mean[..., :size], 1 / certainty, mean[..., size])


def among_neighbours(view: View, camera: Camera) -> View:
    """Average each cell with those of its eight neighbours that show the same spectrum."""
    h, w, size = view.shape.shape[1:]
    weight = 1 / view.noise
    told = view.shape[..., :TOLD]
    # Neighbours are about as noisy as the cell itself.
    scale, against = _telling(2 * (view.noise + ALIKE), camera)
    content = torch.cat([view.shape, view.amplitude[..., None]], -1)
    around = functional.pad(torch.cat([content, weight[..., None]], -1), (0, 0, 1, 1, 1, 1))
    total = content * weight[..., None]
    for dy, dx in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        other = around[:, dy : dy + h, dx : dx + w]
        differ = ((other[..., :TOLD] - told).square() * scale).sum(-1)
        lit = _alike_in_brightness(other[..., -2], view.amplitude).log()
        share = torch.sigmoid(against - differ + lit) * other[..., -1]
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
    around = _edged(coarse.joined(TOLD))
    mean = functional.avg_pool2d(around[..., -2], 2, 1)  # of the four around each corner
    phases = []
    for (y, x), phase, cells in _four(*view.noise.shape[1:]):
        h, w = coarse.noise.shape[1:]
        noise = view.noise[phase] + mean[:, y : y + h, x : x + w]
        scale, against = _telling(noise + 2 * ALIKE, camera)
        logs = []
        for cell in cells:
            other = around[cell]
            differ = ((other[..., :TOLD] - told[phase]).square() * scale).sum(-1)
            lit = _alike_in_brightness(other[..., -1], view.amplitude[phase])
            logs.append(against - differ + (lit / (other[..., -2] + ALIKE)).log())
        logs = torch.stack(logs, -1)
        alone = -(own.noise[phase] + ALIKE).log() - torch.logsumexp(logs, -1)
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


def _alike_in_brightness(one: Tensor, other: Tensor) -> Tensor:
    """Return how much likelier two amplitudes are of one surface than of two.

    Shadows and gloss are rare and large, so the differences are taken to have Cauchy densities.
    """
    apart = (2 * (one - other) / (one + other)).square()
    return SHADED / UNALIKE * (UNALIKE**2 + apart) / (SHADED**2 + apart)


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


# --- how bright pixels are ----------------------------------------------------------------------


@dataclass
class Brightness:
    """Amplitudes without the noise that kin do not share.

    amplitude : (B, H, W).
    variance : (B, H, W) of that, relative to its square.
    """

    amplitude: Tensor
    variance: Tensor


def brightened(view: View, kin: Tensor, coarse: Brightness, camera: Camera) -> Brightness:
    """Return the brightness of cells, from that of the coarse ones and what they measured.

    A cell keeps as much of its difference from its kin as is more than chance: by the mean of the
    differences around it, or by its own. Texture weaker than the noise is lost.

    Parameters
    ----------
    view : View
        What the cells measured.
    kin : Tensor, (B, H, W, 4)
        Shares of the coarse cells, of `kinship`.
    coarse : Brightness
        Half the size.
    camera : Camera

    Returns
    -------
    Brightness

    Source: after J.-S. Lee, IEEE Trans. Pattern Anal. Mach. Intell. 2, 165 (1980): a filter by
    local statistics.
    """
    both = inherit(kin, torch.stack([coarse.amplitude, coarse.variance], -1))
    smooth, variance = both.unbind(-1)
    apart = view.amplitude - smooth
    noise = (view.noise / camera.channels).clamp_max(1)
    known = (view.noise < NOTHING).float()
    square = known * (apart / torch.minimum(view.amplitude, smooth)).square() / noise
    sums = functional.avg_pool2d(torch.stack([square, known], 1), 3, 1, 1)
    around = sums[:, 0] / sums[:, 1].clamp_min(0.1)  # at least one of nine
    kept = 1 - 1 / torch.maximum(around / TEXTURE[0], square / TEXTURE[1]).clamp_min(1)
    kept = kept * known
    return Brightness(
        torch.addcmul(smooth, kept, apart), kept * noise + (1 - kept).square() * variance
    )


# --- all of it ----------------------------------------------------------------------------------


@dataclass
class Evidence:
    """Everything that a measurement tells, of the same size for every camera.

    coefficients : (B, H, W, C) at the level SPECTRAL, posterior mean.
    variance : (B, H, W, KNOTS) there, of the spectrum at the knots.
    kin, alone : of `kinship` for the levels below, finest first.
    own : what the cells of these levels say by themselves, (B, H, W, CORRECTED[level]); compiled
        loops leave zeros where nobody hears it.
    own_noise : noise variance of that, (B, H, W).
    pixels, cells : what was measured at level 0 and at the level SPECTRAL.
    spectral : from what the spectra were inferred.
    bright : of the pixels.
    """

    coefficients: Tensor
    variance: Tensor
    kin: list[Tensor]
    alone: list[Tensor]
    own: list[Tensor]
    own_noise: list[Tensor]
    pixels: View
    cells: View
    spectral: View
    bright: Brightness


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
        views.append(coarser(views[-1], camera))
    known = [views[0], *(among_neighbours(view, camera) for view in views[1:])]
    lowest = min(SPECTRAL, levels)
    best = spectral = known[-1]
    bright = Brightness(best.amplitude, (best.noise / camera.channels).clamp_max(1))
    kin, alone = [], []
    for level in reversed(range(levels)):
        shares, odds = kinship(views[level], known[level], best, camera)
        bright = brightened(views[level], shares, bright, camera)
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
    places = [coarse_zone(zone, 2**level) for level in range(lowest + 1)]
    misfit = torch.full_like(spectral.noise[:, :1, :1], float(MISFITS[0]))
    if levels == LEVELS:
        misfit = measured_misfit(spectral, camera, places[lowest])
    mean, variance, _ = by_zone(
        Estimators.mixture, camera.zones, places[lowest], spectral.shape, spectral.noise + misfit
    )
    own, own_noise = [], [view.noise + misfit for view in known[:lowest]]
    for view, noise, place, size in zip(known, own_noise, places, CORRECTED, strict=False):
        one = by_zone(
            lambda zone, shape, noise, size=size: (zone.wiener(shape, noise, size),),
            camera.zones, place, view.shape, noise,
        )  # fmt: skip
        own += one
    return Evidence(
        mean, variance, kin, alone, own, own_noise, views[0], views[lowest], spectral, bright
    )


def measured_misfit(spectral: View, camera: Camera, zone: Tensor | None) -> Tensor:
    """Return by how much the calibration is wrong: what makes some of the cells likely.

    It is one of `MISFITS`, a variance that adds to the noise and that no averaging removes;
    (B, 1, 1).
    """
    some = (slice(None), slice(None, None, SAMPLE), slice(None, None, SAMPLE))
    shape, noise = spectral.shape[some], spectral.noise[some]
    zone = None if zone is None else zone[some]
    likely = [
        by_zone(Estimators.mixture, camera.zones, zone, shape, noise + misfit)[2]
        for misfit in MISFITS.tolist()
    ]
    best = likeliest(torch.stack(likely).clamp(-20, 20).mean((2, 3)))
    return camera.misfits[best][:, None, None]


def likeliest(evidence: Tensor) -> Tensor:
    """Return the largest of `MISFITS` that is likelier than the next smaller, (J, B) -> (B,).

    An unlikely spectrum explains a wrong calibration too, to the last digit if the channels are
    few; but that all of a picture is unlikely is more so.
    """
    number = torch.arange(1, len(evidence), device=evidence.device)
    return torch.where((evidence[1:] > evidence[:-1]).mT, number, 0).amax(-1)


def coarse_zone(zone: Tensor | None, step: int) -> Tensor | None:
    return None if zone is None else zone[:, step // 2 :: step, step // 2 :: step].contiguous()


def by_zone(estimate, zones: list[Estimators], zone: Tensor | None, shape: Tensor, noise: Tensor):
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
    y, ratio = y[:, ::FEW], ratio[:, ::FEW]
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
