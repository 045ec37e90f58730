"""The blur of the lens, which depends on angle and wavelength, in a form that is quick to apply."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Blur:
    """The blur over angle, wavelength and depth as a sum of terms weight(a, k) frequency(d, f).

    weight : Tensor, (A, r, K).  frequency : (D, r, F) over `cycles` (F,), cycles per px.
    displacement : (r, 2) px, by which each term is displaced besides.
    """

    weight: Tensor
    frequency: np.ndarray
    cycles: np.ndarray
    displacement: np.ndarray

    @classmethod
    def of(cls, transfer: np.ndarray, cycles: np.ndarray, tolerance: float = 6e-4) -> "Blur":
        """Separate a transfer function (A, K, D, F) to a relative tolerance by its SVD.

        Low frequencies weigh more, for pictures are made of them and light must not be lost.
        """
        angles, bands, depths, _ = transfer.shape
        importance = 1 / (cycles + 0.01)
        left, values, right = np.linalg.svd(
            (transfer * importance).reshape(angles * bands, -1), False
        )
        lost = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / np.sum(values**2))
        rank = max(1, int(np.sum(lost > tolerance)))
        weight = (left[:, :rank] * values[:rank]).reshape(angles, bands, rank)
        weight = torch.from_numpy(weight).float().permute(0, 2, 1).contiguous()
        frequency = right[:rank].reshape(rank, depths, -1) / importance
        return cls(weight, frequency.transpose(1, 0, 2), cycles, np.zeros((rank, 2)))

    def displaced(self, displacement: np.ndarray) -> "Blur":
        """Return the blur displaced by px (y, x) that depend on angle and wavelength, (A, K, 2).

        All displacements lie along one line. A picture displaced by any of them is interpolated
        from pictures displaced by a few, at Chebyshev's nodes: exactly enough for what a lens
        resolves.
        """
        flat = displacement.reshape(-1, 2)
        if not flat.any():
            return self
        line = flat[np.abs(flat).sum(1).argmax()]
        line = line / np.linalg.norm(line)
        amount = displacement @ line
        middle, half = (amount.max() + amount.min()) / 2, (amount.max() - amount.min()) / 2
        count = 1 if half < 1e-3 else 3 + int(np.ceil(8 * half))
        nodes = middle + half * np.cos(np.pi * (np.arange(count) + 0.5) / count)
        share = np.ones((count, *amount.shape))
        for i, j in itertools.permutations(range(count), 2):  # Lagrange's polynomials
            share[i] *= (amount - nodes[j]) / (nodes[i] - nodes[j])
        share = torch.from_numpy(share).float().permute(1, 0, 2)[:, :, None, :]  # (A, J, 1, K)
        return Blur(
            (share * self.weight[:, None]).flatten(1, 2),
            np.tile(self.frequency, (1, count, 1)),
            self.cycles,
            np.repeat(nodes, self.frequency.shape[1])[:, None] * line,
        )

    def on_grid(self, size: tuple[int, int]) -> Tensor:
        """Return each term on the grid of a real FFT, times the pixel's aperture, (D, r, ...)."""
        y, x = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None, :]
        radius, pixel = np.hypot(y, x), np.sinc(y) * np.sinc(x)
        terms = [
            [np.interp(radius, self.cycles, term) * pixel for term in layer]
            for layer in self.frequency
        ]
        transfer = torch.from_numpy(np.array(terms)).float()
        if self.displacement.any():
            transfer = transfer * torch.stack([shift(-each, size) for each in self.displacement])
        return transfer


def shift(offset: np.ndarray, size: tuple[int, int]) -> Tensor:
    """Return the phase that moves a picture so that position `offset` becomes its first pixel."""
    y, x = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None, :]
    return torch.from_numpy(np.exp(2j * np.pi * (y * offset[0] + x * offset[1]))).to(
        torch.complex64
    )
