"""From evidence to pixels: coefficients, and how far the spectra may be off. Nobody trained it.

A pixel takes the spectrum of its kin, or keeps to itself. The interval adds up the variances of
what the posterior leaves open, of kin that were taken for the same and are not, and of the
brightness; `docs/compound.md` has the equations.

Pictures are (B, H, W, channels); level l has cells of 2^l px.
"""

import torch
from torch import Tensor

from squilla.reconstruction.evidence import (
    LEVELS,
    SPECTRAL,
    TOLD,
    UNHEARD,
    Camera,
    Evidence,
    View,
    by_zone,
    coarse_zone,
    inherit,
)

NINETY = 1.645
"""Half the width of the central 90 % of a normal distribution, in standard deviations."""

SURE = (2.0, 3.0)
"""Standard errors from which differences among kin are believed: all as one, and each."""


def descend(seen: Evidence) -> Tensor:
    """Return the coefficients of every pixel, (B, H, W, C)."""
    x = seen.coefficients
    for level in reversed(range(len(seen.own))):
        x = inherit(seen.kin[level], x)
        own = seen.own[level]
        x[..., : own.shape[-1]].lerp_(own, heard(seen.alone[level]))
    return x


def heard(alone: Tensor) -> Tensor:
    """Return how much cells count by themselves, from log odds, (B, H, W) -> (B, H, W, 1)."""
    itself = torch.sigmoid(alone)[..., None]
    return torch.where(itself < UNHEARD, 0, itself)


def half_width(seen: Evidence, camera: Camera, zone: Tensor | None = None) -> Tensor:
    """Return half the width of the 90 % interval at the knots, for an amplitude of one.

    Parameters
    ----------
    seen : Evidence
    camera : Camera
    zone : Tensor, (B, H, W), int, optional
        As for `gather_evidence`.

    Returns
    -------
    Tensor, (B, H, W, KNOTS)
    """
    knots = camera.zones[0].knots
    x, variance = seen.coefficients, seen.variance
    for level in reversed(range(len(seen.own))):
        own, kin = seen.own[level], seen.kin[level]
        size = own.shape[-1]
        # Of the kin that a spectrum may come from, each has its own, and its own variance.
        second = inherit(kin, variance + (x @ knots).square())
        x = inherit(kin, x)
        variance = second - (x @ knots).square()
        (left,) = by_zone(
            lambda one, _, noise: (one.wiener_variance(noise),),
            camera.zones, coarse_zone(zone, 2**level), own, seen.own_noise[level],
        )  # fmt: skip
        itself = heard(seen.alone[level])
        apart = own - x[..., :size]
        between = itself * (1 - itself) * (apart @ knots[:size]).square()
        variance = torch.lerp(variance, left, itself) + between
        x[..., :size] += itself * apart
    if len(seen.own) == SPECTRAL and min(seen.cells.noise.shape[1:]) >= 2 ** (LEVELS - SPECTRAL):
        variance = variance + (unlikeness(seen, camera) @ camera.shown)[:, None, None]
    bright = seen.bright.variance[..., None] * (x @ knots).square()
    return NINETY * (variance.clamp_min(1e-10) + bright).sqrt()


def unlikeness(seen: Evidence, camera: Camera) -> Tensor:
    """Return by how much kin differ beyond what noise explains, in the leading directions.

    No single pixel shows it, but all together do: what they measured less what they took over has a
    variance greater than the noise. It is searched as the prior would have it, then direction by
    direction in cells, then in pixels; what may be chance is drawn towards zero.

    Returns
    -------
    Tensor, (B, TOLD), variance of shapes

    Source: W. James and C. Stein, Proc. Fourth Berkeley Symposium 1, 361 (1961): shrinkage.
    """
    told = torch.cat([seen.spectral.shape[..., :TOLD], seen.spectral.noise[..., None]], -1)
    excess, error = _excess(seen.cells, told)
    power = camera.power
    total = (excess @ power) / power.square().sum()
    found = _believed(total, error / power.norm(), SURE[0])[:, None] * power
    found = found + _believed(excess - found, error[:, None], SURE[1])
    for kin in reversed(seen.kin):
        told = inherit(kin, told)
    excess, error = _excess(seen.pixels, told)
    return found + _believed(excess - found, error[:, None], SURE[1])


def _excess(measured: View, told: Tensor) -> tuple[Tensor, Tensor]:
    """Return the variance of shapes about their kin beyond the noise, and its error.

    (B, TOLD) and (B,); by the medians of the half of the cells that have most kin.
    """
    apart = (measured.shape[..., :TOLD] - told[..., :-1]).flatten(1, 2)
    noise, taken = measured.noise.flatten(1), told[..., -1].flatten(1)
    lit = noise < 10
    typical = taken.masked_fill(~lit, torch.nan).nanmedian(1, keepdim=True).values
    some = lit & (taken <= 1.001 * typical)  # in flat areas many have the same
    # A cell is one of its own kin, so it is nearer to them by their noise.
    expected = (noise - taken).clamp_min(1e-9)
    off = (apart.square() / expected[..., None]).masked_fill(~some[..., None], torch.nan)
    factor = off.nanmedian(1).values / 0.4549  # the median of a square of a normal deviate
    usual = expected.masked_fill(~some, torch.nan).nanmedian(1).values
    count = some.sum(1).clamp_min(1)
    excess, error = (factor - 1) * usual[:, None], 1.25 * usual * (2 / count).sqrt()
    return excess.nan_to_num(0), error.nan_to_num(0)  # in the dark nothing shows


def _believed(value: Tensor, error: Tensor, sure: float) -> Tensor:
    """Draw what may be chance towards zero; nothing is less than zero."""
    chance = (sure * error / value.clamp_min(1e-30)).square()
    return value.clamp_min(0) * (1 - chance).clamp_min(0)
