"""The learnt part of the compound model: three small networks behind the exact front end.

Pictures are (B, H, W, channels); level l has cells of 2^l px.
"""

import numpy as np
import torch
from torch import Tensor, nn

from squilla.reconstruction.evidence import CORRECTED, Evidence, inherit
from squilla.reconstruction.prior import Prior

KNOTS = 51
"""Wavelengths at which the interval is predicted; linear in between."""


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

    def networks(self) -> list[Refiner]:
        """Return those of the coarse cells, of the finest and of those between."""
        networks = [self.spectral, *self.finer]
        return [network for network in networks if isinstance(network, Refiner)]

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


class Told(nn.Module):
    """A `Refiner` without its features."""

    def __init__(self, network: Refiner):
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x)[0]


def hats(bands: int) -> Tensor:
    """Return the matrix of linear interpolation from the knots to the bands, (KNOTS, K)."""
    place = np.linspace(0, KNOTS - 1, bands)
    return torch.from_numpy(
        np.stack([np.interp(place, np.arange(KNOTS), unit) for unit in np.eye(KNOTS)])
    ).float()
