"""Scenes to train on: dead leaves of random spectra, textured, lit by one lamp or several.

Leaves of all sizes hide each other, as things in front of a camera do; edges, flat areas and fine
detail come in natural proportions. Everything is drawn on the device that trains.

Source: Lee, Mumford, Huang, International Journal of Computer Vision 41, 35 (2001).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Generator, Tensor
from torch.nn import functional

from squilla.priors import gaussian_mixtures, line_spectra, within_tables
from squilla.spectra import CHART_LIGHT, lights, reflectances

HELD_OUT = 8
"""Of so many reflectances and lamps one is kept for validation, never trained on."""

LEAVES = 48
"""Leaves in a scene, each over those before it."""


class Palette:
    """Spectra to paint with.

    Parameters
    ----------
    wavelength : array, (K,)
        nm.
    held_out : bool
        The reflectances and lamps that training never sees, instead of those that it does.
    count : int
        Number of Gaussian mixtures and of line spectra to choose from.
    """

    def __init__(
        self,
        wavelength: np.ndarray,
        *,
        held_out: bool = False,
        count: int = 20_000,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ):
        generator = Generator().manual_seed(seed + held_out)
        known = within_tables(wavelength)
        lamp = [name != CHART_LIGHT for name in lights().name]
        tables = reflectances().on(known), lights().on(known)[lamp]
        self.surface, self.lamp = (
            torch.from_numpy(table[(np.arange(len(table)) % HELD_OUT == 3) == held_out]).float()
            .to(device)
            for table in tables
        )  # fmt: skip
        self.gaussian, self.line = (
            draw(count, wavelength, generator=generator).to(device)
            for draw in (gaussian_mixtures, line_spectra)
        )

    def natural(self, lamp: Tensor, generator: Generator) -> Tensor:
        """Draw a surface under each of these lamps, (N,) int -> (N, K); some with a white gloss."""
        count, device = len(lamp), lamp.device

        def random(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=device)

        share = random(count, 1) ** 2
        pick = (random(2, count) * len(self.surface)).long()
        surface = (1 - share) * self.surface[pick[0]] + share * self.surface[pick[1]]
        grey = random(count, 1) < 0.05
        surface = torch.where(grey, 0.02 + 0.98 * random(count, 1), surface)
        gloss = 0.3 * (random(count, 1) - 0.5).clamp_min(0)
        return (surface + gloss) * self.lamp[lamp]

    def leaves(self, count: int, generator: Generator) -> Tensor:
        """Draw the spectra of scenes' leaves, (count, 2, LEAVES, K); each leaf fades between two.

        Seven scenes in ten are natural, most under one lamp; the others show Gaussian mixtures,
        lines, or some of each.
        """
        device = self.lamp.device

        def random(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=device)

        shape = (count, 2, LEAVES)
        lamps = (random(count, 3) * len(self.lamp)).long()
        several = (random(count, 1, 1) < 0.25) * (random(*shape) * 3).long()
        lamp = lamps.gather(1, several.flatten(1)).view(-1)
        natural = self.natural(lamp, generator).view(*shape, -1)
        level = 0.1 * 10 ** random(*shape, 1)
        pick = (random(*shape) * len(self.gaussian)).long()
        gaussian, line = level * self.gaussian[pick], level * self.line[pick]
        scene, leaf = random(count, 1, 1), random(*shape)
        kind = torch.where(scene < 0.70, 0, torch.where(scene < 0.82, 1, 2)).expand(shape)
        mixed = torch.where(leaf < 0.5, 0, torch.where(leaf < 0.75, 1, 2))
        kind = torch.where(scene < 0.95, kind, mixed)[..., None]
        return torch.where(kind == 0, natural, torch.where(kind == 1, gaussian, line))


@dataclass
class Scenes:
    """Scenes in parts, so that what a camera measures of them is made without the whole cubes.

    spectra : (B, 2, LEAVES, K).
    label : (B, S, H, W) int; leaf that each of S samples around a pixel shows.
    fade : (B, H, W) 0..1 between the two spectra of a leaf.
    brightness : (B, H, W).
    """

    spectra: Tensor
    label: Tensor
    fade: Tensor
    brightness: Tensor

    def measured(self, response: Tensor) -> Tensor:
        """Return what a response (M, K) measures of each pixel, (B, H, W, M)."""
        return self._painted(self.spectra @ response.T, self.label, self.fade, self.brightness)

    def cubes(self, pixels: Tensor) -> Tensor:
        """Return the spectra at some pixels of each scene, (B, P) flat indices -> (B, P, K)."""
        label = self.label.flatten(2).gather(2, pixels[:, None].expand(-1, self.label.shape[1], -1))
        fade, bright = (each.flatten(1).gather(1, pixels) for each in (self.fade, self.brightness))
        return self._painted(
            self.spectra, label[:, :, None], fade[:, None], bright[:, None]
        ).squeeze(1)

    @staticmethod
    def _painted(colour: Tensor, label: Tensor, fade: Tensor, brightness: Tensor) -> Tensor:
        batch = torch.arange(len(label), device=label.device)[:, None, None]
        total = 0
        for one in label.unbind(1):
            first, second = colour[batch, 0, one], colour[batch, 1, one]
            total = total + torch.lerp(first, second, fade[..., None])
        return total * (brightness / label.shape[1])[..., None]


def draw_scenes(count: int, size: int, palette: Palette, generator: Generator) -> Scenes:
    """Draw square scenes of `size` px."""
    device = palette.lamp.device

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    fine = 2 * size  # leaves are painted at twice the resolution, pixels average four samples
    label = _leaves(count, fine, generator, device)
    blur = (3 * random(count) - 1).clamp_min(0.5)  # half px and more, in fine samples
    samples = []
    for _ in range(4):
        offset = blur[:, None] * torch.randn(count, 2, generator=generator, device=device)
        row, column = offset.round().long().unbind(1)
        place = torch.arange(size, device=device) * 2
        rows = (place + row[:, None]).clamp(0, fine - 1)
        columns = (place + column[:, None]).clamp(0, fine - 1)
        batch = torch.arange(count, device=device)[:, None, None]
        samples.append(label[batch, rows[:, :, None], columns[:, None, :]])
    contrast = 0.4 * (1.4 * random(count, 1, 1) - 0.4).clamp_min(0)
    brightness = (contrast * _texture(count, size, generator, device)).exp()
    slope = 3 * (2 * random(count, 1, 1) - 1).clamp_min(0)
    fade = torch.sigmoid(slope * _texture(count, size, generator, device) - 2)
    fade = torch.where(slope > 0, fade, torch.zeros_like(fade))
    return Scenes(palette.leaves(count, generator), torch.stack(samples, 1), fade, brightness)


def _leaves(count: int, size: int, generator: Generator, device) -> Tensor:
    """Return label maps, (count, size, size); the density of radii falls with their cube."""

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    least = size / 64 * 2 ** (4 * random(count, 1))
    most = size * 0.6
    share = random(count, LEAVES)
    radius = (1 / most**2 + share * (1 / least**2 - 1 / most**2)).rsqrt()
    middle = size * (1.2 * random(2, count, LEAVES) - 0.1)
    stretch = (0.4 * (2 * random(count, LEAVES) - 1)).exp()
    turn = math.pi * random(count, LEAVES) * (random(count, 1) < 0.7)
    square = random(count, LEAVES) < 0.5
    axis = torch.arange(size, device=device, dtype=torch.float32)
    label = torch.zeros(count, size, size, dtype=torch.long, device=device)
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


def _texture(count: int, size: int, generator: Generator, device) -> Tensor:
    """Return random fields with detail at several scales, (count, size, size), deviation 1."""
    total = torch.zeros(count, size, size, device=device)
    for scale in (1, 2, 4, 8, 16, 32):
        side = size // scale + 2
        noise = torch.randn(count, 1, side, side, generator=generator, device=device)
        layer = functional.interpolate(noise, (size, size), mode="bilinear")[:, 0]
        weight = torch.rand(count, 1, 1, generator=generator, device=device) * scale**0.5
        total = total + weight * layer
    return total / total.flatten(1).std(1).clamp_min(1e-6)[:, None, None]
