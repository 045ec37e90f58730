"""Transmittance and reflectance of thin-film stacks by the transfer matrix.

Light of wavelength lambda meets layer 1, layer 2, ..., layer L and then the substrate. In a medium
of index n the wave number across the layers is kz = k0 sqrt(n^2 - (n_ambient sin angle)^2), and the
admittance, the ratio of the tangential magnetic to the tangential electric field of one wave, is
eta_s = kz / k0 or eta_p = n^2 k0 / kz. A layer of thickness d carries the two fields from its far
side to its near side:

    [E]   [cos(delta)               -i sin(delta) / eta] [E']
    [H] = [-i eta sin(delta)         cos(delta)        ] [H'],    delta = kz d.

Multiplied by exp(i delta) this matrix has the entries (1 + q) / 2 and (1 - q) / 2 with
q = exp(2i delta) and |q| <= 1. So it cannot overflow in an absorbing layer, and it is exactly the
identity for a layer of no thickness. It acts on the substrate's fields (1, eta_substrate) layer by
layer; no matrix product is ever formed.

Source: Macleod, Thin-Film Optical Filters, 5th ed., chapter 2; the signs (n + ik, exp(-i omega t))
are those of Byrnes, arXiv:1603.02720.
"""

from typing import Literal

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.errors import InputError

Polarization = Literal["s", "p", "unpolarized"]


def transmittance(
    index: Tensor | ArrayLike,
    thickness: Tensor | ArrayLike,
    wavelength: Tensor | ArrayLike,
    *,
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
        Layer thickness, nm, not negative; 0 leaves the layer out. Any number of stacks at once;
        gradients flow to it. Stacks that share the thickness of a layer share the work for it.
    wavelength : (K,)
        In vacuum, nm.
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

    Source: Macleod, Thin-Film Optical Filters, 5th ed., eq. 2.115 and 2.116.
    """
    return _solve(index, thickness, wavelength, substrate, ambient, angle, polarization)[0]


def reflectance(
    index: Tensor | ArrayLike,
    thickness: Tensor | ArrayLike,
    wavelength: Tensor | ArrayLike,
    *,
    substrate: Tensor | ArrayLike,
    ambient: Tensor | ArrayLike = 1.0,
    angle: Tensor | ArrayLike = 0.0,
    polarization: Polarization = "unpolarized",
) -> Tensor:
    """Return the part of the light's power that a stack of layers throws back.

    Parameters, shapes and errors are those of `transmittance`.

    Source: Macleod, Thin-Film Optical Filters, 5th ed., eq. 2.114.
    """
    return _solve(index, thickness, wavelength, substrate, ambient, angle, polarization)[1]


def _solve(
    index, thickness, wavelength, substrate, ambient, angle, polarization
) -> tuple[Tensor, Tensor]:
    """Return transmittance and reflectance; inside, arrays end in (polarization, angle, K)."""
    thickness = torch.as_tensor(thickness, dtype=torch.float64)
    index, substrate, ambient = (
        torch.as_tensor(given, dtype=torch.complex128, device=thickness.device)
        for given in (index, substrate, ambient)
    )
    wavelength, angle = (
        torch.as_tensor(given, dtype=torch.float64, device=thickness.device)
        for given in (wavelength, angle)
    )
    if index.ndim == 1:
        index = index[:, None]
    _check(index, thickness, wavelength, substrate, ambient, angle, polarization)

    along = (ambient.real * angle.sin().reshape(-1, 1)).square()  # of the wave vector over k0
    if polarization == "unpolarized" and not angle.any():
        polarization = "s"  # which equals p at normal incidence

    def medium(n: Tensor) -> tuple[Tensor, Tensor]:
        """Return kz / k0, (..., 1, A, K), and the admittance, (..., P, A, K), of n (..., K)."""
        n = torch.atleast_1d(n)[..., None, None, :]
        across = (n.square() - along).sqrt()
        s, p = across, n.square() / across
        return across, {"s": s, "p": p}.get(polarization, torch.cat((s, p), -3))

    across, admittance = medium(index)
    _, admittance_in = medium(ambient)
    _, admittance_out = medium(substrate)
    wave_number = 2 * torch.pi / wavelength
    share = index.ndim == 2 and not thickness.requires_grad  # torch.unique has no gradient

    electric, magnetic = torch.ones_like(admittance_out), admittance_out
    for layer in reversed(range(thickness.shape[-1])):
        each = thickness[..., layer]
        distinct, use = torch.unique(each, return_inverse=True) if share else (each, ...)
        phase = wave_number * across[..., layer, :, :, :] * distinct[..., None, None, None]
        round_trip = torch.exp(2j * phase)
        eta = admittance[..., layer, :, :, :]
        cosine, sine = (1 + round_trip) / 2, (1 - round_trip) / 2
        keep, to_electric, to_magnetic = (part[use] for part in (cosine, sine / eta, sine * eta))
        electric, magnetic = (
            torch.addcmul(keep * electric, to_electric, magnetic),
            torch.addcmul(keep * magnetic, to_magnetic, electric),
        )

    decay = torch.einsum("...l,...lpak->...pak", thickness, across.imag) * wave_number
    forward = _power(admittance_in * electric + magnetic)  # the incident wave's
    backward = _power(admittance_in * electric - magnetic)
    through = 4 * admittance_in.real * admittance_out.real * torch.exp(-2 * decay) / forward
    stacks = torch.broadcast_shapes(thickness.shape[:-1], index.shape[:-2])

    def finished(part: Tensor) -> Tensor:
        part = part.mean(-3).expand(*stacks, angle.numel(), len(wavelength))
        return part.reshape(*stacks, *angle.shape, len(wavelength))

    return finished(through), finished(backward / forward)


def _power(amplitude: Tensor) -> Tensor:
    return amplitude.real.square() + amplitude.imag.square()


def _check(index, thickness, wavelength, substrate, ambient, angle, polarization) -> None:
    bands = wavelength.numel()
    if wavelength.ndim != 1:
        raise InputError(f"Wavelengths have the shape (K,), not {tuple(wavelength.shape)}.")
    if thickness.ndim == 0 or index.ndim == 0 or index.shape[-2] != thickness.shape[-1]:
        raise InputError(
            f"Thicknesses of shape {tuple(thickness.shape)} and indices of shape "
            f"{tuple(index.shape)} do not fit; expected (..., L) and (L,), (L, K) or (..., L, K)."
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
