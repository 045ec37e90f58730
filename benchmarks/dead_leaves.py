"""Scenes to judge by: dead leaves of random spectra, textured, lit by one lamp or several.

Leaves of all sizes hide each other, as things in front of a camera do; edges, flat areas and fine
detail come in natural proportions.

Source: Lee, Mumford, Huang, International Journal of Computer Vision 41, 35 (2001).
"""

import math

import torch
from torch import Generator, Tensor
from torch.nn import functional

from squilla.training.prior import Palette

LEAVES = 48
"""Leaves in a scene, each over those before it."""


def dead_leaves(palette: Palette, size: int, generator: Generator) -> Tensor:
    """Draw a square scene, (size, size, K)."""
    fine = 2 * size  # leaves are painted at twice the resolution, pixels average four samples
    label = _labels(1, fine, generator)
    blur = (3 * torch.rand(1, generator=generator) - 1).clamp_min(0.5)  # in fine samples
    place, samples = torch.arange(size) * 2, []
    for _ in range(4):
        row, column = (blur * torch.randn(1, 2, generator=generator)).round().long()[0]
        rows = (place + row).clamp(0, fine - 1)
        samples.append(label[0, rows[:, None], (place + column).clamp(0, fine - 1)])
    contrast = 0.4 * (1.4 * torch.rand(1, 1, 1, generator=generator) - 0.4).clamp_min(0)
    brightness = (contrast * _texture(1, size, generator)).exp()[0, ..., None]
    slope = 3 * (2 * torch.rand(1, 1, 1, generator=generator) - 1).clamp_min(0)
    fade = torch.sigmoid(slope * _texture(1, size, generator) - 2)
    fade = torch.where(slope > 0, fade, torch.zeros_like(fade))[0, ..., None]
    spectra = _spectra(palette, 1, generator)[0]
    total = sum(torch.lerp(spectra[0, one], spectra[1, one], fade) for one in samples)
    assert isinstance(total, Tensor)
    return total * brightness / len(samples)


def _spectra(palette: Palette, count: int, generator: Generator) -> Tensor:
    """Draw the spectra of scenes' leaves, (count, 2, LEAVES, K); each leaf fades between two.

    Seven scenes in ten are natural, most under one lamp; the others show Gaussian mixtures,
    lines, or some of each.
    """

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    shape = (count, 2, LEAVES)
    lamps = (random(count, 3) * len(palette.lamp)).long()
    several = (random(count, 1, 1) < 0.25) * (random(*shape) * 3).long()
    lamp = lamps.gather(1, several.flatten(1)).view(-1)
    natural = palette.natural(lamp, generator).view(*shape, -1)
    level = 0.1 * 10 ** random(*shape, 1)
    pick = (random(*shape) * len(palette.gaussian)).long()
    gaussian, line = level * palette.gaussian[pick], level * palette.line[pick]
    scene, leaf = random(count, 1, 1), random(*shape)
    kind = torch.where(scene < 0.70, 0, torch.where(scene < 0.82, 1, 2)).expand(shape)
    mixed = torch.where(leaf < 0.5, 0, torch.where(leaf < 0.75, 1, 2))
    kind = torch.where(scene < 0.95, kind, mixed)[..., None]
    return torch.where(kind == 0, natural, torch.where(kind == 1, gaussian, line))


def _labels(count: int, size: int, generator: Generator) -> Tensor:
    """Return label maps, (count, size, size); the density of radii falls with their cube."""

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    least = size / 64 * 2 ** (4 * random(count, 1))
    most = size * 0.6
    share = random(count, LEAVES)
    radius = (1 / most**2 + share * (1 / least**2 - 1 / most**2)).rsqrt()
    middle = size * (1.2 * random(2, count, LEAVES) - 0.1)
    stretch = (0.4 * (2 * random(count, LEAVES) - 1)).exp()
    turn = math.pi * random(count, LEAVES) * (random(count, 1) < 0.7)
    square = random(count, LEAVES) < 0.5
    axis = torch.arange(size, dtype=torch.float32)
    label = torch.zeros(count, size, size, dtype=torch.long)
    for leaf in range(1, LEAVES):
        y, x = (axis - middle[dimension, :, leaf, None] for dimension in range(2))
        y, x = y[:, :, None], x[:, None, :]
        cosine, sine = turn[:, leaf].cos()[:, None, None], turn[:, leaf].sin()[:, None, None]
        long = (radius[:, leaf] * stretch[:, leaf])[:, None, None]
        short = (radius[:, leaf] / stretch[:, leaf])[:, None, None]
        u, v = (cosine * x + sine * y) / long, (cosine * y - sine * x) / short
        inside = torch.where(
            square[:, leaf, None, None], torch.maximum(u.abs(), v.abs()) < 0.9, u * u + v * v < 1
        )
        label.masked_fill_(inside, leaf)
    return label


def _texture(count: int, size: int, generator: Generator) -> Tensor:
    """Return random fields with detail at several scales, (count, size, size), deviation 1."""
    total = torch.zeros(count, size, size)
    for scale in (1, 2, 4, 8, 16, 32):
        side = size // scale + 2
        noise = torch.randn(count, 1, side, side, generator=generator)
        layer = functional.interpolate(noise, (size, size), mode="bilinear")[:, 0]
        weight = torch.rand(count, 1, 1, generator=generator) * scale**0.5
        total = total + weight * layer
    return total / total.flatten(1).std(1).clamp_min(1e-6)[:, None, None]
