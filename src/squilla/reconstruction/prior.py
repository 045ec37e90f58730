"""What spectra look like before one is measured: a basis, and a mixture of Gaussians in it.

Every spectrum is described by its shape, the spectrum divided by its mean over the bands, in the
leading principal components of the broad prior. Shapes of natural things, of mixtures of Gaussian
lines and of single lines lie in clusters; each cluster is a mean and a covariance. So whatever is
linear in the spectrum, such as the measurement of any camera, has a posterior in closed form.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files as package_files

import numpy as np
import torch
from torch import Tensor

from squilla.priors import within_tables
from squilla.spectra import resample

STORED = "weights.prior_"
"""How the prior's tensors are named in a model file."""


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
    All float64.
    """

    wavelength: np.ndarray
    basis: Tensor
    moment: Tensor
    share: Tensor
    mean: Tensor
    covariance: Tensor

    def on(self, wavelength: np.ndarray) -> "Prior":
        """Return the prior on another grid.

        Within 500-750 nm it is read there; a band that reaches beyond is mapped onto 500-750 nm,
        see `within_tables`.
        """
        at = np.clip(within_tables(wavelength), self.wavelength[0], self.wavelength[-1])
        basis = resample(self.basis.numpy().T, self.wavelength, at).T
        return Prior(
            wavelength, torch.from_numpy(basis), self.moment, self.share, self.mean, self.covariance
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return the numbers for a file; the covariances as their halves below the diagonal."""
        row, column = torch.tril_indices(*self.moment.shape)
        return {
            "wavelength": torch.from_numpy(np.asarray(self.wavelength, np.float32)),
            "basis": self.basis.float(),
            "moment": self.moment.float(),
            "share": self.share.float(),
            "mean": self.mean.float(),
            "covariance": self.covariance[:, row, column].float(),
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
        return cls(wavelength, basis, moment, share / share.sum(), mean, covariance)


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
    basis = torch.linalg.eigh(everything.T @ everything)[1].flip(1)[:, :components]
    peaked = everything @ basis
    share, mean, covariance = [], [], []
    for spectra, clusters in families.values():
        shape = spectra.double() / spectra.double().mean(-1, keepdim=True)
        parts = fit_mixture(shape @ basis, clusters)
        share.append(parts[0] * len(spectra) / len(everything))
        mean.append(parts[1])
        covariance.append(parts[2])
    return Prior(
        wavelength,
        basis,
        peaked.T @ peaked * (len(basis) / peaked.square().sum()),
        torch.cat(share),
        torch.cat(mean),
        torch.cat(covariance),
    )


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
        self.scores = vectors.permute(1, 0, 2).flatten(1).float()  # (D, G D)
        self.offset = torch.einsum("gd,gde->ge", mean @ seen.T, vectors).flatten().float()
        total = power + 10 ** (_NODES.double() / 2 - 5)[:, None, None]  # (J, G, D)
        self.log_share = (prior.share.log() - total.log().sum(-1) / 2).float()  # (J, G)
        prior_variance = covariance.diagonal(dim1=-2, dim2=-1)
        within = prior_variance - torch.einsum("jgd,gdc->jgc", 1 / total, gain.square())
        self.within = within.clamp_min(1e-10).flatten(0, 1).float()  # (J G, C)
        self.power, self.vectors, self.gain = (
            value.float() for value in (self.power, self.vectors, self.gain)
        )

    def to(self, device: torch.device | str) -> "Estimators":
        """Move all matrices to a device, in place."""
        for name, value in vars(self).items():
            setattr(self, name, value.to(device))
        return self

    def mixture(self, shape: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the posterior mean and variance of the coefficients, and the log evidence.

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
        count, (clusters, size) = len(shape), self.cluster_power.shape
        score = (shape @ self.scores - self.offset).view(count, clusters, size)
        scaled = score / (self.cluster_power + noise[:, None, None])
        place = (noise.log10() * 2 + 10).clamp(0, len(_NODES) - 1)
        node = torch.relu(1 - (place[:, None] - _NODES.to(noise.device)).abs())  # (N, J)
        logs = node @ self.log_share - (score * scaled).sum(-1) / 2
        weight = torch.softmax(logs, 1)
        each = torch.bmm(scaled.transpose(0, 1), self.cluster_gain[..., :LEADING])
        each = each.transpose(0, 1) + self.mean[:, :LEADING]
        scaled = (scaled * weight[..., None]).flatten(1)
        mean = torch.addmm(weight @ self.mean, scaled, self.cluster_gain.flatten(0, 1))
        variance = (node[:, :, None] * weight[:, None]).flatten(1) @ self.within
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
