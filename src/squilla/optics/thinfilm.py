"""Transmittance and reflectance of thin-film stacks by the transfer matrix.

Light of wavelength lambda meets layer 1, layer 2, ..., layer L and then the substrate. In a medium
of index n the wave number across the layers is kz = k0 sqrt(n^2 - (n_ambient sin angle)^2), and the
admittance, the ratio of the tangential magnetic to the tangential electric field of one wave, is
eta_s = kz / k0 or eta_p = n^2 k0 / kz. In each medium one wave runs forward and one backward, with
the tangential electric fields f and b. A boundary between the media i and j, and a layer of
thickness d behind it, make of them

    [f_i]   1 [1 r] [1 0] [f_j]
    [b_i] = - [r 1] [0 q] [b_j],    r = (eta_i - eta_j) / (eta_i + eta_j),  t = 1 + r,
            t                       q = exp(2i kz d),

but for a factor exp(-i kz d) common to both. Since |q| <= 1, nothing overflows in an absorbing
layer; and the 1/t, the same for all stacks of the same materials, are multiplied once and for all.
A layer that a stack lacks is one with q = 1: the boundaries before and behind it together are then
the one boundary that is left. No matrix product is ever formed.

Source: Yeh, Optical Waves in Layered Media, chapter 5, and Macleod, Thin-Film Optical Filters,
chapter 2; the signs (n + ik, exp(-i omega t)) are those of Byrnes, arXiv:1603.02720.
"""

import math
from typing import Literal

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.errors import InputError

Polarization = Literal["s", "p", "unpolarized"]

CACHED = 100_000
"""Complex numbers of one wave that are worked on at a time: what stays in a processor's cache."""


def transmittance(
    index: Tensor | ArrayLike,
    thickness: Tensor | ArrayLike,
    wavelength: Tensor | ArrayLike,
    *,
    layers: Tensor | ArrayLike = True,
    substrate: Tensor | ArrayLike,
    ambient: Tensor | ArrayLike = 1.0,
    angle: Tensor | ArrayLike = 0.0,
    polarization: Polarization = "unpolarized",
) -> Tensor:
    """Return the part of the light's power that a stack of layers hands on to its substrate.

    Parameters
    ----------
    index : complex, (L,), (L, K) or (..., L, K)
        Refractive index n + ik of each layer, k >= 0, the layer that the light meets first in
        front.
    thickness : (..., L)
        Layer thickness, nm, not negative. Any number of stacks at once; gradients flow to it.
    wavelength : (K,)
        In vacuum, nm.
    layers : bool, (..., L)
        Which layers a stack has; broadcasts against `thickness`, so that stacks that share the
        thickness of a layer, and most of the work for it, may yet lack it one by one.
    substrate : complex, () or (K,)
        Index of the half space behind the stack.
    ambient : real, () or (K,)
        Index of the half space that the light comes from.
    angle : () or (A,)
        Angle of incidence in the ambient, rad, 0 <= angle < pi/2.
    polarization : "s", "p" or "unpolarized"
        Unpolarized is the mean of s and p.

    Returns
    -------
    Tensor, (..., K) for one angle, (..., A, K) for A angles, float64, on the device of `thickness`

    Raises
    ------
    InputError
        If shapes do not fit together, or a value lies outside of its range.

    Example
    -------
    A quarter-wave layer of index sqrt(1.52) takes all reflection from glass:

    >>> transmittance([1.52**0.5], [550 / 4 / 1.52**0.5], [550.0], substrate=1.52)
    tensor([1.0000], dtype=torch.float64)

    """
    return _solve(index, thickness, wavelength, layers, substrate, ambient, angle, polarization)[0]


def reflectance(
    index: Tensor | ArrayLike,
    thickness: Tensor | ArrayLike,
    wavelength: Tensor | ArrayLike,
    *,
    layers: Tensor | ArrayLike = True,
    substrate: Tensor | ArrayLike,
    ambient: Tensor | ArrayLike = 1.0,
    angle: Tensor | ArrayLike = 0.0,
    polarization: Polarization = "unpolarized",
) -> Tensor:
    """Return the part of the light's power that a stack of layers throws back.

    Parameters, shapes and errors are those of `transmittance`.
    """
    return _solve(index, thickness, wavelength, layers, substrate, ambient, angle, polarization)[1]


def _solve(
    index, thickness, wavelength, layers, substrate, ambient, angle, polarization
) -> tuple[Tensor, Tensor]:
    """Return transmittance and reflectance, a few angles at a time."""
    thickness = torch.as_tensor(thickness, dtype=torch.float64)
    device = thickness.device
    index, substrate, ambient = (
        torch.as_tensor(given, dtype=torch.complex128, device=device)
        for given in (index, substrate, ambient)
    )
    wavelength, angle = (
        torch.as_tensor(given, dtype=torch.float64, device=device) for given in (wavelength, angle)
    )
    layers = torch.atleast_1d(torch.as_tensor(layers, dtype=torch.bool, device=device))
    if index.ndim == 1:
        index = index[:, None]
    _check(index, thickness, wavelength, layers, substrate, ambient, angle, polarization)
    if polarization == "unpolarized" and not angle.any():
        polarization = "s"  # which equals p at normal incidence
    layers = layers.expand(*layers.shape[:-1], thickness.shape[-1])
    stacks = torch.broadcast_shapes(thickness.shape[:-1], layers.shape[:-1], index.shape[:-2])
    work = math.prod(stacks) * len(wavelength) * (2 if polarization == "unpolarized" else 1)
    few = angle.reshape(-1).split(max(1, CACHED // max(work, 1)))
    parts = [
        _waves(index, thickness, wavelength, layers, substrate, ambient, angles, polarization)
        for angles in few
    ]
    shape = (*stacks, *angle.shape, len(wavelength))
    through, back = (torch.cat(part, -2).reshape(shape) for part in zip(*parts, strict=True))
    return through, back


def _waves(
    index, thickness, wavelength, layers, substrate, ambient, angle, polarization
) -> tuple[Tensor, Tensor]:
    """Return transmittance and reflectance, (..., A, K), for the angles (A,).

    Inside, arrays end in (polarization, angle, K).
    """
    wave_number = 2 * torch.pi / wavelength
    along = (ambient.real * angle.sin()[:, None]).square()  # of the wave vector over k0, squared

    def medium(n: Tensor) -> tuple[Tensor, Tensor]:
        """Return kz / k0, (..., 1, A, K), and the admittance, (..., P, A, K), of n (..., K)."""
        n = torch.atleast_1d(n).expand(*n.shape[:-1], len(wavelength))[..., None, None, :]
        across = (n.square() - along).sqrt()
        s, p = across, n.square() / across
        return across, {"s": s, "p": p}.get(polarization, torch.cat((s, p), -3))

    across, admittance = medium(index)
    (_, first), (_, last) = medium(ambient), medium(substrate)
    ends = (*index.shape[:-2], 1, *first.shape)
    media = torch.cat((first.expand(ends), admittance, last.expand(ends)), -4)
    before, behind = media[..., :-1, :, :, :], media[..., 1:, :, :, :]
    reflection = (before - behind) / (before + behind)
    passed = _power(1 + reflection).prod(-4)

    forward, backward = torch.ones_like(last), reflection[..., -1, :, :, :]
    there, nothing = layers[..., None, None, None], torch.ones_like(last[:1, :1, :1])
    for layer in reversed(range(thickness.shape[-1])):
        phase = wave_number * across[..., layer, :, :, :] * thickness[..., layer, None, None, None]
        backward = backward * torch.where(there[..., layer, :, :, :], _exp2i(phase), nothing)
        r = reflection[..., layer, :, :, :]
        forward, backward = (
            torch.addcmul(forward, r, backward),
            torch.addcmul(backward, r, forward),
        )

    decay = torch.einsum("...l,...lpak->...pak", thickness * layers, across.imag) * wave_number
    incident = _power(forward)
    through = last.real / first.real * passed * torch.exp(-2 * decay) / incident
    return through.mean(-3), (_power(backward) / incident).mean(-3)


def _exp2i(phase: Tensor) -> Tensor:
    """Return exp(2i phase), which of real functions takes torch a quarter of the time."""
    size, turn = torch.exp(-2 * phase.imag), 2 * phase.real
    return torch.complex(size * turn.cos(), size * turn.sin())


def _power(amplitude: Tensor) -> Tensor:
    return amplitude.real.square() + amplitude.imag.square()


def _check(index, thickness, wavelength, layers, substrate, ambient, angle, polarization) -> None:
    bands = wavelength.numel()
    if wavelength.ndim != 1:
        raise InputError(f"Wavelengths have the shape (K,), not {tuple(wavelength.shape)}.")
    if thickness.ndim == 0 or index.ndim == 0 or index.shape[-2] != thickness.shape[-1]:
        raise InputError(
            f"Thicknesses of shape {tuple(thickness.shape)} and indices of shape "
            f"{tuple(index.shape)} do not fit; expected (..., L) and (L,), (L, K) or (..., L, K)."
        )
    if layers.shape[-1] not in (1, thickness.shape[-1]):
        raise InputError(
            f"Which of {thickness.shape[-1]} layers a stack has is said for {layers.shape[-1]}."
        )
    for name, value in {"layers": index, "substrate": substrate, "ambient": ambient}.items():
        if value.ndim and value.shape[-1] not in (1, bands):
            raise InputError(
                f"The index of the {name} is given at {value.shape[-1]} wavelengths, not {bands}."
            )
        if (value.imag < 0).any():
            raise InputError(
                f"The index of the {name} has a negative imaginary part, which would amplify "
                "light; write absorption as n + ik with k >= 0."
            )
    if ambient.imag.any() or not (ambient.real > 0).all():
        raise InputError("The index of the ambient must be real and positive.")
    if not (thickness >= 0).all():
        raise InputError("A layer has a negative or undefined thickness; thicknesses are nm >= 0.")
    if not (wavelength > 0).all():
        raise InputError("Wavelengths must be positive, in nm.")
    if angle.ndim > 1 or not ((angle >= 0) & (angle < torch.pi / 2)).all():
        raise InputError("Angles are () or (A,) in rad, from 0 to below pi/2; convert degrees.")
    if polarization not in ("s", "p", "unpolarized"):
        raise InputError(f'The polarization is "s", "p" or "unpolarized", not {polarization!r}.')
