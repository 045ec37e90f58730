"""Training samples: random spectra and what a camera measures of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.priors import PRIORS
from squilla.reconstruction.linear import complete
from squilla.training.noise import Noise, add_gain_errors, add_noise, drop_channels


@dataclass(frozen=True)
class Samples:
    """A reproducible stream of training samples for one camera.

    calibration : the camera.
    spectra : name of the prior, a key of spectra.PRIORS; "gaussian" is the thesis' set.
    count : spectra in an epoch; the thesis has 8000.
    noise : none, dB, a range of dB, or a sensor; drawn anew in every epoch.
    gain_error : standard deviation of the factor by which each channel's R is wrong.
    dropped : probability that a channel is lost; lost ones are filled as `reconstruct` does.
    fresh : draw new spectra for every epoch, instead of one set for all.
    seed : every epoch of every seed has random numbers of its own, so that epoch 7 is the same
        whether the six before it were drawn or not.
    """

    calibration: Calibration
    spectra: str = "broad"
    count: int = 8000
    noise: Noise = (15.0, 20.0)
    gain_error: float = 0.0
    dropped: float = 0.0
    fresh: bool = True
    seed: int = 0

    def __post_init__(self):
        if self.spectra not in PRIORS:
            raise InputError(
                f"There is no prior named {self.spectra!r}; there are {', '.join(PRIORS)}."
            )
        if self.count < 1:
            raise InputError(f"{self.count} spectra are not enough; give at least one.")
        if self.seed < 0:
            raise InputError(f"The seed is {self.seed}; give 0 or more.")
        if not (0 <= self.gain_error < 1 and 0 <= self.dropped <= 0.5):
            raise InputError(
                f"Errors of R of {self.gain_error:g} and {self.dropped:g} of the channels dropped "
                "make no sense; give parts from 0 to 1, and to 0.5."
            )

    def draw(self, epoch: int) -> Tensor:
        """Return the spectra of an epoch, (count, K), each with a maximum of 1."""
        return self._drawn(epoch) if self.fresh else self._kept

    @cached_property
    def _kept(self) -> Tensor:
        return self._drawn(0)

    def _drawn(self, epoch: int) -> Tensor:
        generator = self._generator(epoch, 0)
        return PRIORS[self.spectra](self.count, self.calibration.wavelength, generator=generator)

    def batches(
        self, epoch: int, size: int, device: torch.device | str = "cpu"
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield the samples of an epoch in random order, `size` at a time.

        Parameters
        ----------
        epoch, size : int
        device : torch.device
            Where they are made; every kind of device has random numbers of its own.

        Yields
        ------
        y : Tensor, (size, M)
            Noisy measurements, each divided by its maximum.
        angle : Tensor, (size,)
            Field angle of each, rad, spread as evenly over the image area as pixels are.
        x : Tensor, (size, K)
            The spectra, each with a maximum of 1.
        """
        generator = self._generator(epoch, 1, device)
        here = {"device": device, "generator": generator}
        spectra = self.draw(epoch).to(device)
        low, high = (float(end) ** 2 for end in self.calibration.angle[[0, -1]])
        for part in torch.randperm(self.count, **here).split(size):
            x = spectra[part]
            angle = (low + (high - low) * torch.rand(len(x), **here)).sqrt()
            y = self.calibration.project(x, angle)
            if self.gain_error:
                y = add_gain_errors(y, self.gain_error, generator)
            y = add_noise(y, self.noise, generator)
            if self.dropped:
                valid = drop_channels(y, self.dropped, generator)
                y = complete(y, valid, self.calibration, angle)
            yield y / y.amax(-1, keepdim=True).clamp_min(1e-12), angle, x

    def _generator(
        self, epoch: int, stream: int, device: torch.device | str = "cpu"
    ) -> torch.Generator:
        state = np.random.SeedSequence([self.seed, epoch, stream]).generate_state(1, np.uint64)
        return torch.Generator(device).manual_seed(int(state[0] >> np.uint64(1)))
