"""What the compound model learns: a prior, from spectra of measured surfaces under lamps."""

import numpy as np
import torch
from torch import Generator, Tensor

from squilla.errors import InputError
from squilla.priors import gaussian_mixtures, line_spectra, within_tables
from squilla.reconstruction.evidence import CORRECTED
from squilla.reconstruction.prior import Prior, fit_prior
from squilla.spectra import CHART_LIGHT, lights, reflectances

HELD_OUT = 8
"""Of so many reflectances and lamps one is kept for judgement, never learnt from."""

LEARNT = 60_000
"""Spectra from which the model that ships has learnt."""

LEAST = 1000
"""Spectra with which no cluster stays empty."""

FEWEST = CORRECTED[-1]
"""Bands that the model cannot do with fewer of."""


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


def learn_prior(
    wavelength: np.ndarray,
    *,
    count: int = LEARNT,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Prior:
    """Learn the prior of `Compound` on a grid.

    Parameters
    ----------
    wavelength : array, (K,)
        nm; K of `FEWEST` or more.
    count : int
        Spectra to learn from: six in ten natural, a quarter Gaussian mixtures, the others lines.
    seed : int
    device : "cpu", "cuda", ...
        Where the clusters are fitted.

    Raises
    ------
    InputError
        If the bands or the spectra are too few.
    """
    if len(wavelength) < FEWEST:
        raise InputError(
            f"`compound` needs {FEWEST} bands or more, not {len(wavelength)}; train one of the "
            "networks instead."
        )
    if count < LEAST:
        raise InputError(f"{count} spectra are too few to learn from; give {LEAST} or more.")
    palette = Palette(wavelength, seed=seed, count=round(0.25 * count))
    generator = Generator().manual_seed(seed)
    lamp = (torch.rand(round(0.6 * count), generator=generator) * len(palette.lamp)).long()
    natural = palette.natural(lamp, generator)
    families = {
        "natural": (natural / natural.amax(-1, keepdim=True), 28),
        "gaussian": (palette.gaussian, 10),
        "line": (palette.line[: round(0.15 * count)], 10),
    }
    moved = {name: (spectra.to(device), size) for name, (spectra, size) in families.items()}
    return fit_prior(moved, wavelength)
