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
from functools import cache, cached_property
from importlib.resources import files as package_files

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from squilla.priors import within_tables
from squilla.spectra import resample

STORED = "weights.prior_"
"""How the prior's tensors are named in a model file."""

SINGLE_LINES = 0.05
"""Share of spectra that show one line and nothing else."""

CENTRES, WIDTHS, WIDEST = 80, 6, 30.0
"""Pieces of the sheet of lines along centre and width, and the largest FWHM, nm."""

KNOTS = 51
"""Wavelengths at which doubt is worked out; linear in between."""


@dataclass(frozen=True)
class Prior:
    """A mixture of Gaussians over the shapes of spectra.

    wavelength : (K,) nm.
    basis : (K, C) orthonormal on the grid that it was learnt on; a shape is
        ``basis @ coefficients``.
    moment : (C, C) second moment of spectra with a peak of one, scaled to a mean power of one: what
        the best linear estimator needs.
    share : (G,) of each cluster, sums to 1.
    mean : (G, C).
    covariance : (G, C, C).
    learnt : how many clusters, the first, were learnt from examples; the others are pieces of the
        sheet of single lines.
    beyond : (G - learnt, KNOTS) variance of single lines that the basis does not hold.
    All float64.
    """

    wavelength: np.ndarray
    basis: Tensor
    moment: Tensor
    share: Tensor
    mean: Tensor
    covariance: Tensor
    learnt: int
    beyond: Tensor

    @cached_property
    def knots(self) -> Tensor:
        """Means of the basis around the knots, (KNOTS, C)."""
        return around_knots(len(self.wavelength)) @ self.basis

    @cached_property
    def spread(self) -> Tensor:
        """Variance of each cluster at the knots, (G, KNOTS)."""
        held = torch.einsum("kc,gcd,kd->gk", self.knots, self.covariance, self.knots)
        return held + functional.pad(self.beyond, (0, 0, self.learnt, 0))

    def on(self, wavelength: np.ndarray) -> "Prior":
        """Return the prior on another grid.

        A band that lies within the prior's is read there; one that reaches beyond is mapped onto
        the measured tables', see `within_tables`.
        """
        wavelength = np.asarray(wavelength, float)
        least, most = self.wavelength[[0, -1]]
        inside = least - 1e-6 <= wavelength[0] and wavelength[-1] <= most + 1e-6
        at = np.clip(wavelength if inside else within_tables(wavelength), least, most)
        basis = resample(self.basis.numpy().T, self.wavelength, at).T
        here = np.linspace(0, len(at) - 1, KNOTS)
        there = np.linspace(self.wavelength[0], self.wavelength[-1], KNOTS)
        beyond = resample(self.beyond.numpy(), there, np.interp(here, np.arange(len(at)), at))
        return replace(
            self,
            wavelength=wavelength,
            basis=torch.from_numpy(basis),
            beyond=torch.from_numpy(beyond),
        )

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
        middle, spread, beyond = line_sheet(wavelength, basis)
        each = torch.full((len(middle),), SINGLE_LINES / max(len(middle), 1), dtype=share.dtype)
        return cls(
            wavelength,
            basis,
            moment,
            torch.cat([share * (1 - each.sum()), each]),
            torch.cat([mean, middle]),
            torch.cat([covariance, spread]),
            len(share),
            beyond,
        )


@cache
def broad_prior() -> Prior:
    """Return the prior that ships, on 500-750 nm; `experiments/learn_compound.py` makes it."""
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
    moment = peaked.T @ peaked * (len(basis) / peaked.square().sum())
    learnt = basis, moment, torch.cat(share), torch.cat(mean), torch.cat(covariance)
    return Prior.with_lines(wavelength, *(values.cpu() for values in learnt))


def line_sheet(wavelength: np.ndarray, basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return what single lines look like, piece by piece.

    Lines of every centre in the band, and of every width (FWHM) from one band to `WIDEST` nm; none
    where the bands are too far apart to show them.

    Returns
    -------
    mean (G, C), covariance (G, C, C) : of shapes in the basis.
    beyond : (G, KNOTS) mean square of what the basis does not hold.
    """
    finest = float(np.diff(wavelength).max())
    if 2 * finest >= WIDEST:
        empty = basis.new_zeros(0, basis.shape[1])
        return empty, empty[:, :, None] * empty[:, None], basis.new_zeros(0, KNOTS)
    inside = (np.arange(7) + 0.5) / 7
    band = wavelength[-1] - wavelength[0]
    centre = wavelength[0] + band * (np.arange(CENTRES)[:, None] + inside) / CENTRES
    width = finest * (WIDEST / finest) ** ((np.arange(WIDTHS)[:, None] + inside) / WIDTHS)
    away = (wavelength - centre[:, None, :, None, None]) / width[:, None, :, None]
    spectra = torch.from_numpy(np.exp(-4 * np.log(2) * away**2))  # (CENTRES, WIDTHS, 7, 7, K)
    spectra = (spectra / spectra.mean(-1, keepdim=True)).flatten(2, 3).flatten(0, 1)
    shape = spectra @ basis
    beyond = (spectra - shape @ basis.T).square().mean(1) @ around_knots(len(wavelength)).T
    mean = shape.mean(1)
    offset = shape - mean[:, None]
    spread = offset.mT @ offset / offset.shape[1]
    ridge = 1e-6 * mean.square().mean()
    return mean, spread + ridge * torch.eye(basis.shape[1], dtype=basis.dtype), beyond


def hats(bands: int) -> Tensor:
    """Return the matrix of linear interpolation from the knots to the bands, (KNOTS, K)."""
    place = np.linspace(0, KNOTS - 1, bands)
    return torch.from_numpy(
        np.stack([np.interp(place, np.arange(KNOTS), unit) for unit in np.eye(KNOTS)])
    )


def around_knots(bands: int) -> Tensor:
    """Return the matrix of means of the bands around each knot, (KNOTS, K).

    Where bands are fewer than knots, of linear interpolation.
    """
    if bands < KNOTS:
        place = np.linspace(0, bands - 1, KNOTS)
        each = [np.interp(place, np.arange(bands), unit) for unit in np.eye(bands)]
        return torch.from_numpy(np.stack(each, 1))
    weight = hats(bands)
    return weight / weight.sum(1, keepdim=True)


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
        chosen = torch.multinomial(away.cpu(), 1, generator=generator)
        centre = torch.cat([centre, direction[chosen.to(points.device)]])
    belongs = torch.cdist(direction, centre).argmin(1)
    responsible = functional.one_hot(belongs, clusters).double()
    whole = torch.cov(points.T)
    ridge = 1e-6 * whole.diagonal().mean() * torch.eye(len(whole)).to(whole)
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
