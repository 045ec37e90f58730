"""What every reconstructor is: a torch module from measurements to spectra."""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from squilla import __version__
from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.errors import InputError
from squilla.priors import broad_spectra
from squilla.reconstruction.engine import (
    Network,
    check_engine,
    compile_network,
    error,
    write_onnx,
)
from squilla.reconstruction.partial import PointwiseReconstruction, Reconstruction
from squilla.reconstruction.weights import digest, fingerprint, write_weights

if TYPE_CHECKING:
    from xarray import DataArray

Scale = Literal["consistent", "maximum"]


class Reconstructor(nn.Module):
    """A map from the measurement of a pixel to its spectrum.

    A subclass writes `estimate` for a batch of normalised pixels; this class checks the input,
    works through it in pieces that fit in the cache, and restores the scale.

    name : how `load_model` calls it.
    wavelength : (K,) nm.
    calibration : the camera it reconstructs for.
    provenance : how its weights came about; plain numbers and strings.
    """

    name: ClassVar[str]
    trained: ClassVar[bool] = False
    """Whether its weights come from training; then its output has a shape but no scale yet."""
    universal: ClassVar[bool] = False
    """Whether its weights serve every camera, not only the one that they were trained for."""
    piece: ClassVar[int] = 2048
    """Pixels worked on at once by a processor, to stay in its cache."""

    def __init__(self, calibration: Calibration):
        super().__init__()
        self.calibration = calibration
        self.wavelength = calibration.wavelength
        self.provenance: dict[str, Any] = {}
        self._network: Network | None = None

    @classmethod
    def for_weights(
        cls, calibration: Calibration, weights: Mapping[str, Tensor]
    ) -> "Reconstructor":
        """Return a model that these weights fit."""
        return cls(calibration)

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None) -> Tensor:
        """Map finite measurements with a maximum of 1, (N, M), to spectra, (N, K).

        Networks get them `levelled`.

        angle : (N,) rad, or None for the mean sensitivity.
        snr : (N,) dB, or None where it is unknown; networks do without.
        """
        raise NotImplementedError

    def forward(
        self,
        y: Tensor,
        angle: Tensor | None = None,
        snr: Tensor | float | None = None,
        scale: Scale = "consistent",
    ) -> Tensor:
        """Reconstruct the spectrum of every pixel.

        Parameters
        ----------
        y : Tensor, (..., M)
            Measurements in the unit of the sensitivity. A pixel with a NaN or infinite channel
            gives a spectrum of NaN; a pixel without any positive channel gives zero.
        angle : Tensor, (...), optional
            Field angle, rad; without it the mean sensitivity is used.
        snr : Tensor, (...), or float, optional
            Signal-to-noise ratio of each pixel, dB; without it 20 is assumed where it matters.
        scale : "consistent" or "maximum"
            What restores the scale of a network's output: "consistent" multiplies by
            <y, R x> / <R x, R x>, so that the spectrum explains the measurement; "maximum" by the
            maximum of y (the thesis' rule). Estimators that solve y = R x have a scale already,
            and both rules leave it.

        Returns
        -------
        Tensor, (..., K), float32, non-negative

        Raises
        ------
        InputError
            If `y` has another number of channels, `angle` or `snr` another shape than the pixels,
            or `scale` another name.
        """
        check_scale(scale)
        y, angle, snr = self._accepted(y, angle, snr)
        pixels = y.shape[:-1]
        if y.numel() == 0:
            return y.new_zeros(*pixels, len(self.wavelength))
        y = y.reshape(-1, y.shape[-1])
        angle, snr = (None if each is None else each.reshape(-1) for each in (angle, snr))
        return self._whole(y, angle, snr, scale).reshape(*pixels, len(self.wavelength))

    def _whole(self, y: Tensor, angle: Tensor | None, snr: Tensor | None, scale: Scale) -> Tensor:
        """Work through pixels, (N, M), in pieces."""
        # A GPU has to be filled; threads of an engine and of PyTorch should not take short turns.
        alone = y.device.type == "cpu" and self._network is None
        piece = self.piece * (1 if alone else 32)
        told = [repeat(None) if each is None else each.split(piece) for each in (angle, snr)]
        each = zip(y.split(piece), *told, strict=False)
        parts = [self._piece(some, place, ratio, scale) for some, place, ratio in each]
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    def _piece(self, y: Tensor, angle: Tensor | None, snr: Tensor | None, scale: Scale) -> Tensor:
        finite = y.sum(-1, keepdim=True).isfinite()
        y = torch.where(finite, y, 0)
        peak = y.amax(-1, keepdim=True)
        lit = peak > 0
        y = y / torch.where(lit, peak, 1)
        seen = self.levelled(y, angle)
        if self._network is None:
            x = self.estimate(seen, angle, snr).clamp_min(0)
        else:  # a network; compiled for pieces of one size
            filled = nn.functional.pad(seen, (0, 0, 0, -len(seen) % self.piece)).cpu().numpy()
            found = [self._network(part) for part in np.split(filled, len(filled) // self.piece)]
            x = torch.from_numpy(np.concatenate(found))[: len(seen)].to(y).clamp_min(0)
        factor = torch.where(finite, torch.where(lit, peak, 0), torch.nan)
        if self.trained and scale == "consistent":
            factor = factor * consistent_scale(y, x, self.calibration, angle)
        return x * factor

    def only(self, bands: Sequence[int]) -> "Reconstructor | None":
        """Return what estimates these bands alone, for less; None where all cost the same."""
        return None

    def with_engine(self, engine: str) -> "Reconstructor":
        """Let an engine run the networks from now on, and return the model.

        Parameters
        ----------
        engine : str
            One of `engine.ENGINES`. How far its results are from those of PyTorch in float32, rms
            relative to rms on a picture of 256 pixels, is measured and noted in `provenance` as
            ``engine_error``.

        Raises
        ------
        InputError
            If there is no such engine, its packages are missing, or this is no network.
        """
        check_engine(engine)
        if not self.trained:
            raise InputError(
                f"`{self.name}` is no network; engines are for networks. Leave the engine out."
            )
        with torch.inference_mode():
            y = _probe(self.calibration)
            self._take("torch")
            reference = self(y, snr=30.0)
            self._take(engine)
            found = reference if engine == "torch" else self(y, snr=30.0)
        away = error(found.numpy(), reference.numpy())
        self.provenance |= {"engine": engine, "engine_error": float(f"{away:.2g}")}
        return self

    def _take(self, engine: str) -> None:
        """Compile the networks for an engine."""
        self._network = None if engine == "torch" else compile_network(self.for_engines(), engine)

    def for_engines(self) -> nn.Module:
        """Return what `estimate` does of measurements alone, in the form that engines like best."""
        return Estimate(self)

    def export(self, path: str | Path) -> None:
        """Write the network as an ONNX file, for any number of pixels at once.

        Its input is what `estimate` takes: measurements with a maximum of 1, (N, M); its output
        are spectra before their scale is restored, (N, K).

        Raises
        ------
        InputError
            If this is no network, or the packages for it are missing.
        """
        if not self.trained:
            raise InputError(f"`{self.name}` is no network; there is nothing to export.")
        write_onnx(Estimate(self), (2, self.calibration.filters), path)

    def levelled(self, y: Tensor, angle: Tensor | None) -> Tensor:
        """Return measurements as `estimate` wants them, (N, M).

        What a network sees is brought to the mean sensitivity, the one that it learns; see
        `linear.levelling`. Estimators that know the sensitivity at every angle take y as it is.
        """
        if not self.trained or angle is None or len(self.calibration.angle) == 1:
            return y
        weights = self.calibration.angle_weights(angle.cpu()).to(y)
        seen = torch.einsum("nm,akm->ank", y, self._levelling.to(y))
        return torch.einsum("na,ank->nk", weights, seen)

    @cached_property
    def _levelling(self) -> Tensor:
        from squilla.reconstruction.linear import levelling

        return levelling(self.calibration)

    def _accepted(
        self, y: Tensor, angle: Tensor | None, snr: Tensor | float | None
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        y = torch.as_tensor(y, dtype=torch.float32)
        if y.ndim == 0 or y.shape[-1] != self.calibration.filters:
            raise InputError(
                f"The measurement has the shape {tuple(y.shape)}; its last axis must hold the "
                f"{self.calibration.filters} channels of the calibration."
            )
        if len(self.calibration.angle) == 1:
            angle = None
        return y, _per_pixel(angle, y, "field angles"), _per_pixel(snr, y, "SNRs")

    def reconstruct(self, measurement: Measurement, scale: Scale = "consistent") -> "DataArray":
        """Reconstruct a whole measurement.

        Channels marked invalid are first filled with the linear estimate from the valid channels
        of the same pixel (`linear.complete`; for "ridge" this is the same as leaving them out). A
        pixel with fewer than half of its channels valid becomes NaN.

        Parameters
        ----------
        measurement : Measurement
        scale : "consistent" or "maximum"
            See `forward`.

        Returns
        -------
        DataArray, (y, x, wavelength), float32
            Photon radiance in the unit that the sensitivity implies, with the wavelengths (nm) as
            coordinate and the origin of the result in `attrs`.
        """
        return self.labelled(self.spectra_of(measurement, scale), measurement, scale)

    def spectra_of(self, measurement: Measurement, scale: Scale = "consistent") -> np.ndarray:
        """Return the numbers of `reconstruct` alone, (y, x, K)."""
        from squilla.reconstruction.linear import complete

        check_measurement(measurement)
        y = picture(torch.as_tensor(measurement.y, dtype=torch.float32))
        y, angle, snr = self._accepted(y, measurement.angle, measurement.snr)
        y = complete(y, measurement.valid, self.calibration, angle, snr)
        device = next(iter([*self.parameters(), *self.buffers()]), y).device
        with torch.inference_mode():
            return self(y.to(device), angle, snr, scale).cpu().numpy()

    def reconstruct_interval(self, measurement: Measurement) -> "tuple[DataArray, DataArray]":
        """Return the cube, and half the width of the interval that holds nine in ten of its values.

        Raises
        ------
        InputError
            If this model does not know how far it is off.
        """
        raise InputError(f"`{self.name}` does not tell how far it may be off; `compound` does.")

    def look(self, measurement: Measurement) -> Reconstruction:
        """Return a reconstruction that works out only what is asked: bands, spectra, colours."""
        return PointwiseReconstruction(self, measurement)

    def labelled(
        self, cube: np.ndarray, measurement: Measurement, scale: Scale = "consistent"
    ) -> "DataArray":
        """Return spectra with their wavelengths, unit and origin."""
        from squilla.files.cube import labelled

        origin = {
            "long_name": "photon radiance",
            "model": self.name,
            "software": f"squilla {__version__}",
            "calibration": fingerprint(self.calibration),
            "weights": digest(self.state_dict(), {})[:12] if self.trained else None,
            "scale": scale if self.trained else "solved",
        }
        origin |= {f"model_{key}": value for key, value in self.provenance.items()}
        origin |= {f"measurement_{key}": value for key, value in measurement.provenance.items()}
        known = {key: value for key, value in origin.items() if value is not None}
        return labelled(cube, self.wavelength, attributes=known)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the weights to a safetensors file that `load_model` reads.

        The file holds the sensitivity that the weights were trained for, so that they are not used
        with another camera by mistake.

        Parameters
        ----------
        path : path
            Replaced only when the new file is whole.
        half : bool
            Store 16-bit weights: half the size, 0.1 % rounding.
        """
        if not self.trained:
            raise InputError(
                f"`{self.name}` is computed from the calibration; it has no weights to save."
            )
        tensors = {f"weights.{key}": value.cpu() for key, value in self.state_dict().items()}
        if half:
            tensors = {
                key: value.half() if value.is_floating_point() else value
                for key, value in tensors.items()
            }
        tensors["sensitivity"] = self.calibration.mean_sensitivity
        tensors["wavelength"] = torch.from_numpy(np.asarray(self.wavelength, np.float64))
        metadata = {
            "name": self.name,
            "calibration": fingerprint(self.calibration),
            "provenance": json.dumps(self.provenance),
        }
        write_weights(path, tensors, metadata)


class Estimate(nn.Module):
    """The network of a reconstructor alone: normalised pixels in, spectra out."""

    def __init__(self, model: Reconstructor):
        super().__init__()
        self.model = model

    def forward(self, y: Tensor) -> Tensor:
        return self.model.estimate(y)


def _probe(calibration: Calibration) -> Tensor:
    """Return a picture of 16 x 16 pixels, four spectra and noise, to compare engines on."""
    generator = torch.Generator().manual_seed(0)
    spectra = broad_spectra(4, calibration.wavelength, generator=generator)
    half = (torch.arange(16) >= 8).long()
    y = calibration.project(spectra[2 * half[:, None] + half])
    noise = torch.randn(y.shape, generator=generator)
    return y + 10**-1.5 * y.square().mean(-1, keepdim=True).sqrt() * noise


def check_measurement(measurement: Measurement) -> None:
    """Raise InputError unless it is a measurement."""
    if not isinstance(measurement, Measurement):
        raise InputError(
            "Only a measurement is reconstructed: make one with measure, or of aligned channels "
            "with Measurement.of."
        )


def check_scale(scale: str) -> None:
    """Raise InputError unless there is such a rule of scale."""
    if scale not in ("consistent", "maximum"):
        raise InputError(f"There is no scale {scale!r}; there are 'consistent' and 'maximum'.")


def picture(y: Tensor) -> Tensor:
    """Return y if it has rows, columns and channels."""
    if y.ndim != 3:
        raise InputError(
            f"A measurement has the shape (rows, columns, channels), not {tuple(y.shape)}."
        )
    return y


def _per_pixel(value: Tensor | float | None, y: Tensor, what: str) -> Tensor | None:
    """Return one finite number for each pixel of y, (...), or None."""
    if value is None:
        return None
    value = torch.as_tensor(value, dtype=torch.float32, device=y.device)
    if value.ndim == 0:
        value = value.expand(y.shape[:-1])
    if value.shape != y.shape[:-1]:
        raise InputError(
            f"The {what} have the shape {tuple(value.shape)}, but the measurement has the pixels "
            f"{tuple(y.shape[:-1])}; give one per pixel, or one for all."
        )
    if not np.isfinite(value.detach().cpu().numpy()).all():
        raise InputError(f"The {what} hold NaN or infinite values; give finite numbers.")
    return value


def consistent_scale(
    y: Tensor, x: Tensor, calibration: Calibration, angle: Tensor | None = None
) -> Tensor:
    """Return the factor by which spectra explain their measurements best, <y, Rx> / <Rx, Rx>.

    Parameters
    ----------
    y : Tensor, (..., M)
    x : Tensor, (..., K)
        Spectra whose shape is known and whose scale is not.
    calibration : Calibration
    angle : Tensor, (...), optional
        Field angle, rad.

    Returns
    -------
    Tensor, (..., 1), non-negative; 0 where `x` is zero
    """
    expected = calibration.project(x, angle)
    power = expected.square().sum(-1, keepdim=True)
    overlap = (y * expected).sum(-1, keepdim=True).clamp_min(0)
    return overlap / torch.where(power > 0, power, 1)
