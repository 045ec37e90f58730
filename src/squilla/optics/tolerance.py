"""What the faults of a coating process do to a filter array, and to the spectra made with it.

Arrays are coated many times over with random faults. For each the response is known in closed form,
and so is the error of two reconstructions: the one made for the array as designed, and the one made
for the array as it is, which only a calibration can know.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from numpy.typing import ArrayLike
from torch import Generator, Tensor

from squilla.errors import InputError
from squilla.optics.filters import FilterArray
from squilla.optics.merit import Noise, Prior, estimator_error, expected_error, wiener


@dataclass(frozen=True)
class ProcessErrors:
    """The faults of a process; each is a standard deviation, relative to a thickness or an area.

    scale : of all thicknesses of an array together, as of a wrong tooling factor.
    deposition : of each deposition, alike on all filters that have it.
    layer : of each layer of each filter by itself, as of roughness and gradients over the plate.
    misalignment : of each mask, as the share of a filter's area that it leaves bare: there the
        filter has the layer that it should lack. Its sign does not matter.
    index : materials that turned out to be others, such as {"TiO2/Franta": "TiO2/Siefke"}; see
        `squilla.optics.materials.materials`.
    """

    scale: float = 0.0
    deposition: float = 0.0
    layer: float = 0.0
    misalignment: float = 0.0
    index: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        for name in ("scale", "deposition", "layer", "misalignment"):
            if not 0 <= getattr(self, name) < 0.3:
                raise InputError(
                    f"The {name} error is {getattr(self, name)}; expected a share from 0 to below "
                    "0.3, such as 0.01 for one percent."
                )


def coated(
    array: FilterArray,
    errors: ProcessErrors,
    wavelength: ArrayLike,
    *,
    count: int,
    generator: Generator | None = None,
) -> Tensor:
    """Return the transmittances of an array coated many times with random faults.

    Parameters
    ----------
    array : FilterArray
        As designed.
    errors : ProcessErrors
    wavelength : (K,)
        nm.
    count : int
        N.
    generator : torch.Generator, optional

    Returns
    -------
    Tensor, (N, M, K), at normal incidence. A misaligned filter transmits the mean of its parts,
    by area, where no two masks leave the same spot bare.
    """
    strangers = set(errors.index) - set(array.material)
    if strangers:
        raise InputError(
            f"The array has no layer of {', '.join(sorted(strangers))}; its materials are "
            f"{', '.join(sorted(set(array.material)))}."
        )
    filters, depositions = array.layers.shape

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    factor = 1 + errors.scale * normal(1, 1) + errors.deposition * normal(1, depositions)
    if errors.layer:
        factor = factor + errors.layer * normal(filters, depositions)
    material = tuple(errors.index.get(name, name) for name in array.material)
    layers = array.layers.expand(count, filters, depositions)
    thickness = (array.thickness * factor).clamp_min(0)
    made = replace(array, material=material, thickness=thickness, layers=layers)
    response = made.transmittance(wavelength)
    if not errors.misalignment or array.layers.all():
        return response
    which, layer = (~array.layers).nonzero(as_tuple=True)
    bare = array.layers[which]
    bare[torch.arange(len(layer)), layer] = True
    own = thickness if thickness.shape[1] == 1 else thickness[:, which]
    part = replace(made, thickness=own, layers=bare.expand(count, *bare.shape))
    share = (errors.misalignment * normal(depositions)).abs()[:, layer, None]
    change = share * (part.transmittance(wavelength) - response[:, which])
    return response.index_add(1, which, change)


@dataclass(frozen=True, eq=False)
class Tolerance:
    """How an array takes the faults of its process.

    nominal : mean squared error of the best linear estimate with the array as designed.
    change : (N,) root mean square change of the response, relative to that of the response.
    fixed : (N,) error of the estimator that was made for the array as designed.
    recalibrated : (N,) error of the estimator made for the array as it is.
    """

    nominal: float
    change: Tensor
    fixed: Tensor
    recalibrated: Tensor


def tolerance(
    array: FilterArray,
    errors: ProcessErrors,
    prior: Prior,
    *,
    noise: Noise,
    efficiency: Tensor | float = 1.0,
    count: int = 1000,
    generator: Generator | None = None,
) -> Tolerance:
    """Coat an array many times and return what that does to reconstructed spectra.

    Parameters
    ----------
    array : FilterArray
        As designed.
    errors : ProcessErrors
    prior, noise
        As in `squilla.optics.merit.expected_error`.
    efficiency : (K,)
        Quantum efficiency of the sensor behind the filters; default 1.
    count : int
        How often, N.
    generator : torch.Generator, optional

    Raises
    ------
    InputError
        If the array has no layer of a material that is to be replaced.
    """
    wavelength = prior.wavelength
    design = array.transmittance(wavelength) * efficiency
    true = efficiency * coated(array, errors, wavelength, count=count, generator=generator)
    estimator = wiener(design, prior, noise=noise)
    return Tolerance(
        float(expected_error(design, prior, noise=noise)),
        (true - design).square().sum((-2, -1)).sqrt() / design.norm(),
        estimator_error(estimator, true, prior, noise=noise),
        expected_error(true, prior, noise=noise),
    )
