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
    label = _labels(fine, generator)
    blur = (3 * torch.rand((), generator=generator) - 1).clamp_min(0.5)  # in fine samples
    place, samples = torch.arange(size) * 2, []
    for _ in range(4):
        row, column = (blur * torch.randn(2, generator=generator)).round().long()
        rows = (place + row).clamp(0, fine - 1)
        samples.append(label[rows[:, None], (place + column).clamp(0, fine - 1)])
    contrast = 0.4 * (1.4 * torch.rand((), generator=generator) - 0.4).clamp_min(0)
    brightness = (contrast * _texture(size, generator)).exp()[..., None]
    slope = 3 * (2 * torch.rand((), generator=generator) - 1).clamp_min(0)
    fade = torch.sigmoid(slope * _texture(size, generator) - 2)
    fade = torch.where(slope > 0, fade, 0)[..., None]
    first, second = _spectra(palette, generator)
    total = torch.zeros(())
    for one in samples:
        total = total + torch.lerp(first[one], second[one], fade)
    return total * brightness / len(samples)


def _spectra(palette: Palette, generator: Generator) -> Tensor:
    """Draw the spectra of the leaves, (2, LEAVES, K); each leaf fades between two.

    Seven scenes in ten are natural, most under one lamp; the others show Gaussian mixtures, lines,
    or some of each.
    """

    def random(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    shape = (2, LEAVES)
    lamps = (random(3) * len(palette.lamp)).long()
    several = (random() < 0.25) * (random(*shape) * 3).long()
    natural = palette.natural(lamps[several].view(-1), generator).view(*shape, -1)
    level = 0.1 * 10 ** random(*shape, 1)
    pick = (random(*shape) * len(palette.gaussian)).long()
    gaussian, line = level * palette.gaussian[pick], level * palette.line[pick]
    scene, leaf = random(), random(*shape)
    kind = torch.where(scene < 0.70, 0, torch.where(scene < 0.82, 1, 2))
    mixed = torch.where(leaf < 0.5, 0, torch.where(leaf < 0.75, 1, 2))
    kind = torch.where(scene < 0.95, kind, mixed)[..., None]
    return torch.where(kind == 0, natural, torch.where(kind == 1, gaussian, line))


def _labels(size: int, generator: Generator) -> Tensor:
    """Return the leaf that each point shows, (size, size); the density of radii falls with r^3."""

    def random(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    least = size / 64 * 2 ** (4 * random())
    most = size * 0.6
    share = random(LEAVES)
    radius = (1 / most**2 + share * (1 / least**2 - 1 / most**2)).rsqrt()
    middle = size * (1.2 * random(2, LEAVES) - 0.1)
    stretch = (0.4 * (2 * random(LEAVES) - 1)).exp()
    turn = math.pi * random(LEAVES) * (random() < 0.7)
    square = random(LEAVES) < 0.5
    axis = torch.arange(size, dtype=torch.float32)
    label = torch.zeros(size, size, dtype=torch.long)
    for leaf in range(1, LEAVES):
        y, x = (axis - middle[0, leaf])[:, None], (axis - middle[1, leaf])[None]
        cosine, sine = turn[leaf].cos(), turn[leaf].sin()
        long, short = radius[leaf] * stretch[leaf], radius[leaf] / stretch[leaf]
        u, v = (cosine * x + sine * y) / long, (cosine * y - sine * x) / short
        inside = torch.maximum(u.abs(), v.abs()) < 0.9 if square[leaf] else u * u + v * v < 1
        label[inside] = leaf
    return label


def _texture(size: int, generator: Generator) -> Tensor:
    """Return a random field with detail at several scales, (size, size), deviation 1."""
    total = torch.zeros(size, size)
    for scale in (1, 2, 4, 8, 16, 32):
        side = size // scale + 2
        noise = torch.randn(1, 1, side, side, generator=generator)
        layer = functional.interpolate(noise, (size, size), mode="bilinear")[0, 0]
        total = total + torch.rand((), generator=generator) * scale**0.5 * layer
    return total / total.std().clamp_min(1e-6)
