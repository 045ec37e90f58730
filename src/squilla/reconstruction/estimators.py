"""The posteriors that a prior and one camera imply, in closed form for any noise."""

import torch
from torch import Tensor

from squilla.reconstruction.prior import Prior

LEADING = 16
"""Coefficients for which the clusters' disagreement counts in the variance."""

_WITHIN, BEYOND = 5.0, 3.0
"""How far from its middle a piece of the sheet reaches, in its own variance, and in the noise's."""

_PIECE = 4096
"""Cells that are inferred at once."""

QUIETEST = 6
"""Tables are interpolated between noise variances of 10^-QUIETEST to 10, two to a decade."""


class Estimators:
    """The posteriors that a prior and one response matrix imply, ready for any noise.

    Noise is white over the channels. In the eigenvectors U of the response's covariance, U' y has
    independent components of variance L + noise; so the estimators of any noise differ by a
    division alone. Variances are those of the spectrum at the knots.

    Parameters
    ----------
    response : Tensor, (D, K), float64
        Of the camera, in D orthogonal directions of its channels.
    flat : Tensor, (K,), float64
        The functional of the spectrum that measured shapes are divided by.
    channels : int
        M; measured shapes have a mean power of about one over the channels.
    prior : Prior
    """

    def __init__(self, response: Tensor, flat: Tensor, channels: int, prior: Prior):
        self.directions = min(channels, len(response))  # others were appended, and see nothing
        seen, amplitude = response @ prior.basis, flat @ prior.basis
        nodes = torch.arange(2 * QUIETEST + 3)
        noise = 10 ** (nodes.double() / 2 - QUIETEST)
        self.nodes = nodes.float()
        moment = prior.moment * (channels / (seen @ prior.moment @ seen.T).trace())
        power, vectors, gain = _eigen(seen, moment)
        whole = torch.einsum("kc,cd,kd->k", prior.knots, moment, prior.knots)
        left = whole - (1 / (power + noise[:, None])) @ (gain @ prior.knots.T).square()
        self.power, self.vectors, self.gain = power.float(), vectors.float(), gain.float()
        self.left = left.clamp_min(1e-10).float()  # (J, KNOTS)
        # A camera may be blind to much of a cluster: its shapes are those of amplitude one.
        unit = 1 / (prior.mean @ amplitude).clamp_min(0.2)
        mean = prior.mean * unit[:, None]
        covariance = prior.covariance * unit.square()[:, None, None]
        # Amplitudes are noisy themselves, so shapes are known up to a factor.
        covariance = covariance + 0.1**2 * mean[:, :, None] * mean[:, None, :]
        power, vectors, gain = _eigen(seen, covariance)  # (G, D), (G, D, D), (G, D, C)
        self.mean = mean.float()
        self.cluster_power = power.float()
        self.cluster_gain = gain.float()
        self.scores = vectors.transpose(0, 1).float()  # (D, G, D)
        self.offset = torch.einsum("gd,gde->ge", mean @ seen.T, vectors).float()  # (G, D)
        total = power + noise[:, None, None]  # (J, G, D)
        seeing = total[..., -self.directions :].log().sum(-1)
        self.log_share = (prior.share.log() - seeing / 2).float()  # (J, G)
        self.learnt = prior.learnt
        piece = slice(prior.learnt, None)
        middle = mean[piece] @ seen.T
        middle = middle / middle.norm(dim=1, keepdim=True)  # (L, D)
        beside = 1 - torch.einsum("gd,gde->ge", middle, vectors[piece]).square()
        self.middle = middle.T.contiguous().float()  # (D, L)
        self.reach = _WITHIN * (power[piece] * beside).sum(-1).float()  # (L,)
        whole = prior.spread * unit.square()[:, None] + 0.1**2 * (mean @ prior.knots.T).square()
        shown = torch.einsum("jgd,gdk->jgk", 1 / total, (gain @ prior.knots.T).square())
        self.within = (whole - shown).clamp_min(1e-10).float()  # (J, G, KNOTS)
        self.knots = prior.knots.T.float()  # (C, KNOTS)

    def to(self, device: torch.device | str) -> "Estimators":
        """Move all matrices to a device, in place."""
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(self, name, value.to(device))
        return self

    def mixture(self, shape: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the posterior mean of the coefficients, its variance, and the log evidence.

        Pieces of the sheet of single lines take part where a shape comes near them.

        Parameters
        ----------
        shape : Tensor, (N, D)
            Measured shapes.
        noise : Tensor, (N,)
            Noise variance of each.

        Returns
        -------
        mean (N, C), variance of the spectrum (N, KNOTS), log evidence (N,) per direction
        """
        if len(shape) > _PIECE:
            pieces = zip(shape.split(_PIECE), noise.split(_PIECE), strict=True)
            parts = [self.mixture(*piece) for piece in pieces]
            mean, variance, evidence = (torch.cat(part) for part in zip(*parts, strict=True))
            return mean, variance, evidence
        near = self.near(shape, noise)
        if shape.device.type != "cpu":  # without asking how many, so that it can be recorded
            return self._posterior(shape, noise, near)
        some = near.any(1)
        if not some.any():
            return self._posterior(shape, noise, None)
        mean, variance, evidence = self._posterior(shape, noise, None)
        mean[some], variance[some], evidence[some] = self._posterior(
            shape[some], noise[some], near[some]
        )
        return mean, variance, evidence

    def near(self, shape: Tensor, noise: Tensor) -> Tensor:
        """Return which pieces of the sheet each shape comes near, (N, L)."""
        beside = shape.square().sum(1, keepdim=True) - (shape @ self.middle).square()
        return beside <= self.reach + BEYOND * self.directions * noise[:, None]

    def _posterior(
        self, shape: Tensor, noise: Tensor, near: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Do what `mixture` says, by what was learnt alone or by the pieces that are near too."""
        count, size = shape.shape
        own = slice(self.learnt if near is None else None)
        scores, offset = self.scores[:, own].flatten(1), self.offset[own].flatten()
        score = (shape @ scores - offset).view(count, -1, size)
        scaled = score / (self.cluster_power[own] + noise[:, None, None])
        node = self._between(noise)
        logs = node @ self.log_share[:, own] - (score * scaled).sum(-1) / 2
        if near is not None:
            logs[:, self.learnt :].masked_fill_(~near, -torch.inf)
        weight = torch.softmax(logs, 1)
        gain, middle, within = self.cluster_gain[own], self.mean[own], self.within[:, own]
        each = torch.bmm(scaled.transpose(0, 1), gain[..., :LEADING])
        each = each.transpose(0, 1) + middle[:, :LEADING]
        scaled = (scaled * weight[..., None]).flatten(1)
        mean = torch.addmm(weight @ middle, scaled, gain.flatten(0, 1))
        variance = (node[:, :, None] * weight[:, None]).flatten(1) @ within.flatten(0, 1)
        apart = each - mean[:, None, :LEADING]
        among = (weight[..., None] * apart).mT @ apart  # (N, LEADING, LEADING)
        knots = self.knots[:LEADING]
        variance = variance + ((among @ knots) * knots).sum(1)
        return mean, variance, torch.logsumexp(logs, 1) / self.directions

    def wiener(self, shape: Tensor, noise: Tensor, size: int) -> Tensor:
        """Return the best linear estimate of the first coefficients, (N, D), (N,) -> (N, size)."""
        return (shape @ self.vectors / (self.power + noise[:, None])) @ self.gain[:, :size]

    def wiener_variance(self, noise: Tensor) -> Tensor:
        """Return how far the spectrum is from the best linear estimate, (N,) -> (N, KNOTS)."""
        return self._between(noise) @ self.left

    def _between(self, noise: Tensor) -> Tensor:
        """Return the weights of the nodes for a noise variance, (N,) -> (N, J)."""
        place = (noise.log10() * 2 + 2 * QUIETEST).clamp(0, len(self.nodes) - 1)
        return torch.relu(1 - (place[:, None] - self.nodes).abs())


def _eigen(seen: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return eigenvalues, eigenvectors and gains of Gaussians as a camera sees them."""
    power, vectors = torch.linalg.eigh(seen @ covariance @ seen.T)
    return power.clamp_min(0), vectors, vectors.mT @ seen @ covariance
