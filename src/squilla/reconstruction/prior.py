"""What spectra look like before one is measured: a basis, and a mixture of Gaussians in it.

Every spectrum is described by its shape, the spectrum divided by its mean over the bands, in the
leading principal components of the broad prior. Shapes of natural things, of mixtures of Gaussians
and of lines lie in clusters; each cluster is a mean and a covariance. So whatever is linear in the
spectrum, such as the measurement of any camera, has a posterior in closed form.

Single lines lie on a curved sheet, of centre and width, that no few Gaussians follow. It is cut
into pieces so small that each is nearly flat; a piece counts where a measurement comes near it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files as package_files

import numpy as np
import torch
from torch import Tensor

from squilla.priors import within_tables
from squilla.spectra import resample

STORED = "weights.prior_"
"""How the prior's tensors are named in a model file."""

SINGLE_LINES = 0.05
"""Share of spectra that show one line and nothing else."""

CENTRES, WIDTHS, WIDEST = 80, 5, 30.0
"""Pieces of the sheet of lines along centre and width, and the largest FWHM, nm."""


@dataclass(frozen=True)
class Prior:
    """A mixture of Gaussians over the shapes of spectra.

    wavelength : (K,) nm.
    basis : (K, C) orthonormal; a shape is ``basis @ coefficients``.
    moment : (C, C) second moment of spectra with a peak of one, scaled to a mean power of one: what
        the best linear estimator needs.
    share : (G,) of each cluster, sums to 1.
    mean : (G, C).
    covariance : (G, C, C).
    learnt : how many clusters, the first, were learnt from examples; the others are pieces of the
        sheet of single lines.
    All float64.
    """

    wavelength: np.ndarray
    basis: Tensor
    moment: Tensor
    share: Tensor
    mean: Tensor
    covariance: Tensor
    learnt: int

    def on(self, wavelength: np.ndarray) -> "Prior":
        """Return the prior on another grid.

        Within 500-750 nm it is read there; a band that reaches beyond is mapped onto 500-750 nm,
        see `within_tables`.
        """
        at = np.clip(within_tables(wavelength), self.wavelength[0], self.wavelength[-1])
        basis = resample(self.basis.numpy().T, self.wavelength, at).T
        return replace(self, wavelength=wavelength, basis=torch.from_numpy(basis))

    def tensors(self) -> dict[str, Tensor]:
        """Return what was learnt for a file; the covariances as their halves below the diagonal."""
        row, column = torch.tril_indices(*self.moment.shape)
        own = slice(self.learnt)
        return {
            "wavelength": torch.from_numpy(np.asarray(self.wavelength, np.float32)),
            "basis": self.basis.float(),
            "moment": self.moment.float(),
            "share": (self.share[own] / self.share[own].sum()).float(),
            "mean": self.mean[own].float(),
            "covariance": self.covariance[own, row, column].float(),
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "Prior":
        """Undo `tensors`."""
        wavelength = tensors["wavelength"].double().numpy()
        basis, moment, share, mean, half = (
            tensors[name].double() for name in ("basis", "moment", "share", "mean", "covariance")
        )
        row, column = torch.tril_indices(*moment.shape)
        covariance = moment.new_zeros(len(share), *moment.shape)
        covariance[:, row, column] = half
        covariance[:, column, row] = half
        return cls.with_lines(wavelength, basis, moment, share / share.sum(), mean, covariance)

    @classmethod
    def with_lines(
        cls,
        wavelength: np.ndarray,
        basis: Tensor,
        moment: Tensor,
        share: Tensor,
        mean: Tensor,
        covariance: Tensor,
    ) -> "Prior":
        """Add the sheet of single lines to what was learnt."""
        middle, spread = line_sheet(wavelength, basis)
        each = torch.full((len(middle),), SINGLE_LINES / max(len(middle), 1), dtype=share.dtype)
        return cls(
            wavelength,
            basis,
            moment,
            torch.cat([share * (1 - each.sum()), each]),
            torch.cat([mean, middle]),
            torch.cat([covariance, spread]),
            len(share),
        )


@cache
def broad_prior() -> Prior:
    """Return the prior that ships, on 500-750 nm; `experiments/train_compound.py` makes it."""
    from safetensors import safe_open

    path = package_files("squilla") / "data" / "weights" / "compound.safetensors"
    with safe_open(str(path), "pt") as file:
        names = [key for key in file.keys() if key.startswith(STORED)]  # noqa: SIM118
        return Prior.from_tensors({key.removeprefix(STORED): file.get_tensor(key) for key in names})


def fit_prior(
    families: Mapping[str, tuple[Tensor, int]], wavelength: np.ndarray, *, components: int = 64
) -> Prior:
    """Learn a prior from examples of several families of spectra.

    Parameters
    ----------
    families : spectra (N, K) with a peak of 1, and the number of clusters, by name
        A family weighs as much as it has spectra.
    wavelength : array, (K,)
        nm.
    components : int
        Size of the basis, C.
    """
    everything = torch.cat([spectra for spectra, _ in families.values()]).double()
    basis = torch.linalg.eigh(everything.T @ everything)[1].flip(1)[:, :components].contiguous()
    peaked = everything @ basis
    share, mean, covariance = [], [], []
    for spectra, clusters in families.values():
        shape = spectra.double() / spectra.double().mean(-1, keepdim=True)
        parts = fit_mixture(shape @ basis, clusters)
        share.append(parts[0] * len(spectra) / len(everything))
        mean.append(parts[1])
        covariance.append(parts[2])
    return Prior.with_lines(
        wavelength,
        basis,
        peaked.T @ peaked * (len(basis) / peaked.square().sum()),
        torch.cat(share),
        torch.cat(mean),
        torch.cat(covariance),
    )


def line_sheet(wavelength: np.ndarray, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean (G, C) and covariance (G, C, C) of the shapes of single lines, piece by piece.

    Lines of every centre in the band, and of every width (FWHM) from two bands to `WIDEST` nm; none
    where the bands are too far apart to show them.
    """
    finest = 2 * float(np.diff(wavelength).max())
    if finest >= WIDEST:
        empty = basis.new_zeros(0, basis.shape[1])
        return empty, empty[:, :, None] * empty[:, None]
    inside = (np.arange(7) + 0.5) / 7
    band = wavelength[-1] - wavelength[0]
    centre = wavelength[0] + band * (np.arange(CENTRES)[:, None] + inside) / CENTRES
    width = finest * (WIDEST / finest) ** ((np.arange(WIDTHS)[:, None] + inside) / WIDTHS)
    away = (wavelength - centre[:, None, :, None, None]) / width[:, None, :, None]
    spectra = torch.from_numpy(np.exp(-4 * np.log(2) * away**2))  # (CENTRES, WIDTHS, 7, 7, K)
    shape = (spectra / spectra.mean(-1, keepdim=True)) @ basis
    shape = shape.flatten(2, 3).flatten(0, 1)
    mean = shape.mean(1)
    offset = shape - mean[:, None]
    spread = offset.mT @ offset / offset.shape[1]
    ridge = 1e-6 * mean.square().mean()
    return mean, spread + ridge * torch.eye(basis.shape[1], dtype=basis.dtype)


def fit_mixture(points: Tensor, clusters: int, *, rounds: int = 40) -> tuple[Tensor, ...]:
    """Fit a mixture of Gaussians by expectation-maximisation.

    Parameters
    ----------
    points : Tensor, (N, C), float64
    clusters : int
    rounds : int

    Returns
    -------
    share (G,), mean (G, C), covariance (G, C, C)

    Source: Dempster, Laird, Rubin, J. R. Stat. Soc. B 39, 1 (1977); started by k-means++ (Arthur
    and Vassilvitskii, 2007) on directions. Each covariance is drawn to the whole's by half a point.
    """
    generator = torch.Generator().manual_seed(0)
    direction = points / points.norm(dim=1, keepdim=True)
    centre = direction[:1]
    for _ in range(clusters - 1):
        away = torch.cdist(direction, centre).amin(1).square()
        centre = torch.cat([centre, direction[torch.multinomial(away, 1, generator=generator)]])
    belongs = torch.cdist(direction, centre).argmin(1)
    responsible = torch.nn.functional.one_hot(belongs, clusters).double()
    whole = torch.cov(points.T)
    ridge = 1e-6 * whole.diagonal().mean() * torch.eye(points.shape[1], dtype=points.dtype)
    share, mean, covariance = responsible.mean(0), points[:clusters], []
    for _ in range(rounds):
        count = responsible.sum(0) + 1e-9
        mean = responsible.T @ points / count[:, None]
        covariance, logs = [], []
        for one in range(clusters):
            offset = points - mean[one]
            spread = (offset * responsible[:, one, None]).T @ offset
            spread = (spread + 0.5 * whole) / (count[one] + 0.5) + ridge
            factor = torch.linalg.cholesky(spread)
            scaled = torch.linalg.solve_triangular(factor, offset.T, upper=False)
            logs.append(
                (count[one] / len(points)).log()
                - scaled.square().sum(0) / 2
                - factor.diagonal().log().sum()
            )
            covariance.append(spread)
        responsible = torch.softmax(torch.stack(logs, 1), 1)
        share = count / len(points)
    return share, mean, torch.stack(covariance)


# --- posteriors ---------------------------------------------------------------------------------

LEADING = 16
"""Coefficients for which the clusters' disagreement counts in the variance."""

_WITHIN, BEYOND = 5.0, 3.0
"""How far from its middle a piece of the sheet reaches, in its own variance, and in the noise's."""

_NODES = torch.arange(13)
"""Noise variances between which tables are interpolated: 10^-5 to 10, two to a decade."""


class Estimators:
    """The posteriors that a prior and one response matrix imply, ready for any noise.

    Noise is white over the channels. In the eigenvectors U of the response's covariance, U' y has
    independent components of variance L + noise; so the estimators of any noise differ by a
    division alone.

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
        seen, amplitude = response @ prior.basis, flat @ prior.basis
        moment = prior.moment * (channels / (seen @ prior.moment @ seen.T).trace())
        self.power, self.vectors, self.gain = _eigen(seen, moment)
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
        total = power + 10 ** (_NODES.double() / 2 - 5)[:, None, None]  # (J, G, D)
        self.log_share = (prior.share.log() - total.log().sum(-1) / 2).float()  # (J, G)
        self.learnt = prior.learnt
        piece = slice(prior.learnt, None)
        middle = mean[piece] @ seen.T
        middle = middle / middle.norm(dim=1, keepdim=True)  # (L, D)
        beside = 1 - torch.einsum("gd,gde->ge", middle, vectors[piece]).square()
        self.middle = middle.T.contiguous().float()  # (D, L)
        self.reach = _WITHIN * (power[piece] * beside).sum(-1).float()  # (L,)
        prior_variance = covariance.diagonal(dim1=-2, dim2=-1)
        within = prior_variance - torch.einsum("jgd,gdc->jgc", 1 / total, gain.square())
        self.within = within.clamp_min(1e-10).float()  # (J, G, C)
        self.power, self.vectors, self.gain = (
            value.float() for value in (self.power, self.vectors, self.gain)
        )

    def to(self, device: torch.device | str) -> "Estimators":
        """Move all matrices to a device, in place."""
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(self, name, value.to(device))
        return self

    def mixture(self, shape: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the posterior mean and variance of the coefficients, and the log evidence.

        Pieces of the sheet of single lines take part where a shape comes near them.

        Parameters
        ----------
        shape : Tensor, (N, D)
            Measured shapes.
        noise : Tensor, (N,)
            Noise variance of each.

        Returns
        -------
        mean (N, C), variance (N, C), log evidence (N,) per direction
        """
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
        return beside <= self.reach + BEYOND * shape.shape[1] * noise[:, None]

    def _posterior(
        self, shape: Tensor, noise: Tensor, near: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Do what `mixture` says, by what was learnt alone or by the pieces that are near too."""
        count, size = shape.shape
        own = slice(self.learnt if near is None else None)
        scores, offset = self.scores[:, own].flatten(1), self.offset[own].flatten()
        score = (shape @ scores - offset).view(count, -1, size)
        scaled = score / (self.cluster_power[own] + noise[:, None, None])
        place = (noise.log10() * 2 + 10).clamp(0, len(_NODES) - 1)
        node = torch.relu(1 - (place[:, None] - _NODES.to(noise.device)).abs())  # (N, J)
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
        apart = (each - mean[:, None, :LEADING]).square()
        variance[:, :LEADING] += (weight[:, None] @ apart)[:, 0]
        return mean, variance, torch.logsumexp(logs, 1) / size

    def wiener(self, shape: Tensor, noise: Tensor, size: int) -> Tensor:
        """Return the best linear estimate of the first coefficients, (N, D), (N,) -> (N, size)."""
        return (shape @ self.vectors / (self.power + noise[:, None])) @ self.gain[:, :size]


def _eigen(seen: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return eigenvalues, eigenvectors and gains of Gaussians as a camera sees them."""
    power, vectors = torch.linalg.eigh(seen @ covariance @ seen.T)
    return power.clamp_min(0), vectors, vectors.mT @ seen @ covariance
