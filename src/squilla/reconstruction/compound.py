"""One model for every camera: exact estimates at several scales, trained by nobody.

The measurement of any calibrated camera becomes posteriors of the coefficients of a fixed basis of
spectra, at several scales (`evidence`); each pixel then takes the spectrum of its kin, or keeps to
itself (`interval`). What was learnt is the prior: what spectra look like.
`docs/compound.md` tells the whole story.

Pictures are (B, H, W, channels); level l has cells of 2^l px.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.reconstruction import compiled
from squilla.reconstruction.coded import blended
from squilla.reconstruction.engine import check_engine
from squilla.reconstruction.evidence import (
    LEVELS,
    Camera,
    Evidence,
    gather_evidence,
    noise_factor,
)
from squilla.reconstruction.interval import descend, half_width
from squilla.reconstruction.partial import CodedReconstruction, Reconstruction
from squilla.reconstruction.posteriors import CompiledCamera
from squilla.reconstruction.prior import Prior, broad_prior, hats
from squilla.reconstruction.reconstructor import (
    Reconstructor,
    Scale,
    check_measurement,
    check_scale,
    picture,
)

if TYPE_CHECKING:
    from xarray import DataArray

ZONES = 8
"""Zones of field angle, equal in area, each of which has estimators of its own."""

UNKNOWN = 20.0
"""Signal-to-noise ratio where none is given, dB."""

SMALLEST = 16
"""Side of a picture, px, from which on its own noise is measured in it."""


class Compound(Reconstructor):
    """The one model for every camera; see the module.

    Pictures, (..., H, W, M), are reconstructed with their neighbourhoods; a list of measurements,
    (N, M) or (M,), one by one.

    Parameters
    ----------
    calibration : Calibration
        With several field angles, pixels are treated in zones of nearly one angle each.
    prior : Prior, optional
        Default: the one that ships; a band beyond 500-750 nm takes it stretched.
    """

    name = "compound"
    trained = True
    universal = True
    piece = 4096
    basis: Tensor
    hats: Tensor

    def __init__(self, calibration: Calibration, prior: Prior | None = None):
        super().__init__(calibration)
        prior = broad_prior() if prior is None else prior
        for key, value in prior.tensors().items():  # the file of the weights holds the prior too
            self.register_buffer(f"prior_{key}", value)
        self.prior = prior.on(calibration.wavelength)
        self.register_buffer("basis", self.prior.basis.T.float(), persistent=False)
        self.register_buffer("hats", hats(len(self.wavelength)).float(), persistent=False)
        self._cameras: dict[tuple[bool, ...], tuple[Camera, Camera]] = {}
        self._compiled: dict[Camera, CompiledCamera] = {}

    def with_engine(self, engine: str) -> "Compound":
        check_engine(engine)
        raise InputError(
            "`compound` is no network: compiled loops compute it on a processor, and tensors on a "
            "GPU after model.to('cuda'). Leave the engine out."
        )

    @classmethod
    def for_weights(cls, calibration: Calibration, weights: Mapping[str, Tensor]) -> "Compound":
        stored = {
            key.removeprefix("prior_"): value
            for key, value in weights.items()
            if key.startswith("prior_")
        }
        return cls(calibration, Prior.from_tensors(stored) if "covariance" in stored else None)

    def forward(
        self,
        y: Tensor,
        angle: Tensor | None = None,
        snr: Tensor | float | None = None,
        scale: Scale = "consistent",
    ) -> Tensor:
        """Reconstruct spectra; see `Reconstructor.forward`.

        y : (..., H, W, M) for pictures, (N, M) or (M,) for measurements without neighbours. Both
        rules of `scale` leave the result, which has its own.
        """
        check_scale(scale)
        return self._spectra(*self._accepted(y, angle, snr))[0]

    def with_interval(
        self, y: Tensor, angle: Tensor | None = None, snr: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor]:
        """Reconstruct spectra, and say how far they may be off.

        Arguments are those of `forward`.

        Returns
        -------
        x : Tensor, (..., K)
        width : Tensor, (..., K)
            Half the width of the 90 % interval: the truth of a band lies within x +- width for nine
            in ten.
        """
        x, width = self._spectra(*self._accepted(y, angle, snr), interval=True)
        assert width is not None
        return x, width

    def reconstruct(self, measurement: Measurement, scale: Scale = "consistent") -> "DataArray":
        check_scale(scale)
        with torch.inference_mode():
            cube, _ = self._spectra(*self._usable(measurement))
        return self.labelled(cube.cpu().numpy(), measurement, scale)

    def reconstruct_interval(self, measurement: Measurement) -> "tuple[DataArray, DataArray]":
        """Return the cube of `reconstruct` and half the width of its 90 % interval."""
        with torch.inference_mode():
            cube, width = self._spectra(*self._usable(measurement), interval=True)
        assert width is not None
        both = [
            self.labelled(values.cpu().numpy(), measurement, "consistent")
            for values in (cube, width)
        ]
        both[1].attrs["long_name"] = "half width of the 90 % interval of the photon radiance"
        return both[0], both[1].rename("interval")

    def look(self, measurement: Measurement) -> Reconstruction:
        y, angle, snr, channels = self._usable(measurement)
        if y.device.type != "cpu" or max(y.shape[:2]) <= 2 ** (LEVELS - 1):
            return Reconstruction(self, measurement)
        camera, ratio, zone = self._told(y, angle, snr, channels)
        with torch.inference_mode():
            coded = blended(*self._evidence(y, ratio, camera, zone), torch.get_num_threads())
        return CodedReconstruction(self, measurement, coded, self.basis.numpy())

    def export(self, path: str | Path) -> None:
        raise InputError("`compound` is no network; there is nothing to export.")

    def _usable(self, measurement: Measurement):
        """Return y, angle, snr and channels of a measurement.

        A channel that most pixels lack is left out of the camera; what single pixels lack is
        filled by the linear estimate from their other channels.
        """
        from squilla.reconstruction.linear import complete, counted

        check_measurement(measurement)
        y = torch.as_tensor(measurement.y, dtype=torch.float32)
        y, angle, snr = self._accepted(picture(y), measurement.angle, measurement.snr)
        valid = torch.as_tensor(measurement.valid, dtype=torch.bool)
        count = counted(y, valid).numpy()
        enough = count >= (y.shape[-1] + 1) // 2
        if 2 * np.sum(count == y.shape[-1]) >= np.sum(enough):  # no channel lacks most pixels
            y = complete(y, valid, self.calibration, angle, snr)
            return y.to(self.basis.device), angle, snr, (True,) * y.shape[-1]
        valid, enough = valid & y.isfinite(), torch.from_numpy(enough)
        kept = valid[enough].float().mean(0) >= 0.5
        known = self.calibration
        part = Calibration(known.wavelength, known.sensitivity[:, kept], known.angle)
        y = complete(y[..., kept], valid[..., kept], part, angle, snr)
        y = torch.where(enough[..., None], y, torch.nan).to(self.basis.device)
        return y, angle, snr, tuple(kept.tolist())

    def _camera(self, channels: tuple[bool, ...] | None, zoned: bool) -> Camera:
        """Return the camera of some of the channels, (M,), with the mean angle or in zones."""
        key = channels or (True,) * self.calibration.filters
        if key not in self._cameras:
            response = self.calibration.mean_sensitivity[list(key)]
            one = Camera(response[None], self.prior)
            every = one
            if len(self.calibration.angle) > 1:
                weight = self.calibration.angle_weights(self._middles().sqrt())
                zones = torch.einsum("za,amk->zmk", weight, self.calibration.sensitivities)
                every = Camera(zones[:, list(key)], self.prior)
            self._cameras[key] = one.to(self.basis.device), every.to(self.basis.device)
        return self._cameras[key][zoned]

    def _middles(self) -> Tensor:
        """Return the squared angle in the middle of each zone, (ZONES,)."""
        least, most = (float(end) ** 2 for end in self.calibration.angle[[0, -1]])
        return least + (most - least) * (torch.arange(ZONES) + 0.5) / ZONES

    def _apply(self, fn, recurse=True):
        self._cameras, self._compiled = {}, {}  # made anew on the device to which the module moves
        return super()._apply(fn, recurse)

    def _spectra(
        self,
        y: Tensor,
        angle: Tensor | None,
        snr: Tensor | None,
        channels: tuple[bool, ...] | None = None,
        interval: bool = False,
    ) -> tuple[Tensor, Tensor | None]:
        """Reconstruct accepted measurements, and the interval if wanted."""
        height, width = y.shape[-3:-1] if y.ndim > 2 else (1, 1)
        pixels, bands = y.shape[:-1], len(self.wavelength)
        if y.numel() == 0:
            return y.new_zeros(*pixels, bands), y.new_zeros(*pixels, bands) if interval else None
        camera, ratio, zone = self._told(y, angle, snr, channels)
        y = y.reshape(-1, height, width, y.shape[-1])
        ratio = ratio.reshape(y.shape[:-1])
        zone = None if zone is None else zone.reshape(y.shape[:-1])
        size = self.piece if height * width == 1 else 1
        parts = [
            self._pictures(
                y[some], ratio[some], camera, None if zone is None else zone[some], interval
            )
            for some in torch.arange(len(y), device=y.device).split(size)
        ]
        x = _joined([part[0] for part in parts]).view(*pixels, bands)
        spreads = [part[1] for part in parts if part[1] is not None]
        return x, _joined(spreads).view(*pixels, bands) if interval else None

    def _told(
        self,
        y: Tensor,
        angle: Tensor | None,
        snr: Tensor | None,
        channels: tuple[bool, ...] | None,
    ) -> tuple[Camera, Tensor, Tensor | None]:
        """Return the camera, and of each pixel the noise over the signal and its zone."""
        stated = UNKNOWN if snr is None else snr.cpu().numpy()
        ratio = np.float32(10) ** (np.minimum(stated, np.float32(60)) / np.float32(-10))
        ratio = torch.as_tensor(ratio, dtype=torch.float32).to(y.device)
        zone = None
        if angle is not None:
            middles = self._middles().numpy()
            place = np.searchsorted((middles[1:] + middles[:-1]) / 2, angle.cpu().numpy() ** 2)
            zone = torch.as_tensor(place).to(y.device)
        return self._camera(channels, angle is not None), ratio.expand(y.shape[:-1]), zone

    def _pictures(
        self, y: Tensor, ratio: Tensor, camera: Camera, zone: Tensor | None, interval: bool
    ) -> tuple[Tensor, Tensor | None]:
        height, width = y.shape[1:3]
        levels = min(LEVELS, math.ceil(math.log2(max(height, width))))
        if levels == LEVELS and y.device.type == "cpu" and not y.requires_grad:
            here = None if zone is None else zone[0]
            seen, known = self._evidence(y[0], ratio[0], camera, here, interval)
            if not interval:
                coded = blended(seen, known, torch.get_num_threads())
                cube = coded.spell_out(self.basis.numpy(), torch.get_num_threads())
                return torch.from_numpy(cube)[None], None
            known = torch.from_numpy(known)
        else:
            finite = y.isfinite().all(-1)
            lit = (y > 0).any(-1) & finite
            known = torch.where(finite, lit.float(), torch.nan)
            y, ratio = torch.where(finite[..., None], y, 0), torch.where(lit, ratio, torch.inf)
            seen = self._torch_evidence(y, ratio, camera, zone, levels)
        amplitude = (seen.bright.amplitude[:, :height, :width] * known)[..., None]
        x = (descend(seen)[:, :height, :width] * amplitude) @ self.basis
        if not interval:
            return x.relu_(), None
        zone = None if zone is None else _filled_up(zone, 2**levels)
        spread = half_width(seen, camera, zone)[:, :height, :width]
        return x.relu_(), (spread * amplitude) @ self.hats

    def _torch_evidence(
        self, y: Tensor, ratio: Tensor, camera: Camera, zone: Tensor | None, levels: int
    ) -> Evidence:
        """Gather the evidence of pictures, on any device."""
        height, width = y.shape[1:3]
        if min(height, width) >= SMALLEST:
            ratio = ratio * noise_factor(y, ratio, camera)
        step = 2**levels
        y = _filled_up(y.permute(0, 3, 1, 2), step).permute(0, 2, 3, 1)
        ratio = _filled_up(ratio, step, torch.inf)
        zone = None if zone is None else _filled_up(zone, step)
        return gather_evidence(y, ratio, camera, levels, zone)

    def _evidence(
        self,
        y: Tensor,
        ratio: Tensor,
        camera: Camera,
        zone: Tensor | None,
        interval: bool = False,
    ) -> tuple[Evidence, np.ndarray]:
        """Gather the evidence of one picture, by loops compiled for a processor.

        And what brightness is multiplied by: 1 where there was light, 0 where there was none, NaN
        where y is not finite.
        """
        if camera not in self._compiled:
            self._compiled[camera] = CompiledCamera(camera)
        matrices, threads = self._compiled[camera], torch.get_num_threads()
        values, stated = (each.detach().contiguous().numpy() for each in (y, ratio))
        known = compiled.light(values, threads)
        if not known.min() > 0:
            values = np.where(np.isnan(known)[..., None], np.float32(0), values)
            stated = np.where(known > 0, stated, np.float32(np.inf))
        factor = 1.0
        if min(stated.shape) >= SMALLEST:
            factor = compiled.noise_factor(values, stated, matrices, threads)
        places = None if zone is None else zone.numpy()
        seen = compiled.gather_evidence(values, stated, factor, matrices, places, threads, interval)
        return seen, known


def _joined(parts: list[Tensor]) -> Tensor:
    """Put parts one after another; one alone is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _filled_up(pictures: Tensor, step: int, value: float = 0) -> Tensor:
    """Append rows and columns, the last two axes, until there are multiples of `step`."""
    height, width = pictures.shape[-2:]
    return functional.pad(pictures, (0, -width % step, 0, -height % step), value=value)
