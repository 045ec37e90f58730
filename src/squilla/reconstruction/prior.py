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

from squilla.reconstruction.linear import within_tables
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
    return count / len(points), mean, torch.stack(covariance)


# --- posteriors ---------------------------------------------------------------------------------


class Estimators:
    """The posteriors that a prior and one response matrix imply, ready for any noise.

    Noise is white over the channels. In the eigenvectors U of the response's covariance, U' y has
    independent components of variance L + noise; so the estimators of any noise differ by a
    division alone.

    response : (M, K) float64, scaled so that a shape of all ones measures an rms of 1.
    """

    def __init__(self, response: Tensor, prior: Prior):
        seen = response @ prior.basis
        power = (seen @ prior.moment @ seen.T).diagonal().mean()
        zero = torch.zeros_like(prior.mean[:1])
        # Measured shapes have a power of about one by their scale, so the estimator's have, too.
        self.linear = _Gaussians(seen, zero, prior.moment[None] / power)
        # Shapes are known up to a factor: what the amplitude is taken from is noisy itself.
        doubt = 0.1**2 * prior.mean[:, :, None] * prior.mean[:, None, :]
        self.clusters = _Gaussians(seen, prior.mean, prior.covariance + doubt)
        self.log_share = prior.share.log().float()

    def to(self, device: torch.device | str) -> "Estimators":
        """Move all matrices to a device, in place."""
        self.linear.to(device)
        self.clusters.to(device)
        self.log_share = self.log_share.to(device)
        return self

    def mixture(self, shape: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the posterior mean and variance of the coefficients, and the log evidence.

        Parameters
        ----------
        shape : Tensor, (N, M)
            Measured shapes.
        noise : Tensor, (N,)
            Noise variance of each.

        Returns
        -------
        mean (N, C), variance (N, C), log evidence (N,) per channel
        """
        own = self.clusters
        score = (shape - own.seen) @ own.vectors  # (G, N, M)
        precision = 1 / (own.power + noise[:, None])
        logs = self.log_share[:, None] + (precision.log() - score.square() * precision).sum(-1) / 2
        weight = torch.softmax(logs, 0)[..., None]
        estimate = own.mean + (score * precision) @ own.gain
        mean = (weight * estimate).sum(0)
        within = own.variance - precision @ own.gain.square()
        variance = (weight * (within + (estimate - mean).square())).sum(0)
        return mean, variance.clamp_min(1e-10), torch.logsumexp(logs, 0) / shape.shape[-1]

    def wiener(self, shape: Tensor, noise: Tensor) -> Tensor:
        """Return the best linear estimate of the coefficients, (N, M) and (N,) -> (N, C)."""
        own = self.linear
        score = shape @ own.vectors[0]
        return (score / (own.power[0] + noise[:, None])) @ own.gain[0]

    def wiener_variance(self, noise: Tensor) -> Tensor:
        """Return the error variance of `wiener`, (N,) -> (N, C)."""
        own = self.linear
        precision = 1 / (own.power[0] + noise[:, None])
        return (own.variance[0] - precision @ own.gain[0].square()).clamp_min(1e-10)


class _Gaussians:
    """Gaussians of coefficients as a camera sees them, in their eigenvectors; G in front."""

    def __init__(self, seen: Tensor, mean: Tensor, covariance: Tensor):
        power, vectors = torch.linalg.eigh(seen @ covariance @ seen.T)
        self.power = power.flip(-1).clamp_min(0)[:, None].float()  # (G, 1, M), largest first
        self.vectors = vectors.flip(-1).float()  # (G, M, M)
        self.gain = (vectors.flip(-1).mT @ seen @ covariance).float()  # (G, M, C)
        self.mean = mean[:, None].float()  # (G, 1, C)
        self.seen = (mean @ seen.T)[:, None].float()  # (G, 1, M)
        self.variance = covariance.diagonal(dim1=-2, dim2=-1)[:, None].float()  # (G, 1, C)

    def to(self, device: torch.device | str) -> None:
        for name, value in vars(self).items():
            setattr(self, name, value.to(device))


def log_ratio(square: Tensor, power: Tensor, noise: Tensor) -> Tensor:
    """Return how much likelier two measurements are of different spectra than of one, log.

    Parameters
    ----------
    square : Tensor, (..., D)
        Squared differences in the leading eigenvectors of the linear estimator.
    power : Tensor, (D,)
        Variance of one measurement in them, without noise.
    noise : Tensor, (...)
        Noise variance of the difference.

    Returns
    -------
    Tensor, (...)

    Source: Neyman and Pearson; N(0, noise) against N(0, noise + 2 power).
    """
    noise = noise[..., None]
    either = noise + 2 * power
    evidence = square * (1 / noise - 1 / either) - (either / noise).log()
    return evidence.sum(-1) / 2


