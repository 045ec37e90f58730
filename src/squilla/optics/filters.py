"""Arrays of thin-film filters, and the recipes that they are drawn from."""

import math
import tomllib
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Generator, Tensor

from squilla.errors import InputError
from squilla.files.disk import replacing
from squilla.optics.materials import refractive_index
from squilla.optics.tables import MeasuredFilters, read_table
from squilla.optics.thinfilm import CACHED, Polarization, transmittance


@dataclass(frozen=True, eq=False)
class FilterArray:
    """Thin-film filters that share their depositions; stencils keep some layers off some filters.

    material : names of the depositions' materials, L, from the glass outwards; see
        `refractive_index`.
    thickness : (L,) of each deposition, nm; or (M, L) where each filter has its own.
    layers : (M, L) bool, which layers each filter has. Further axes in front, here and in
        `thickness`, make many arrays of it; the two are broadcast against each other.
    substrate : material of the glass plate, whose bare back face is counted, incoherently.
    scatter : factor on the transmittance for what roughness takes away, 0..1.
    """

    material: tuple[str, ...]
    thickness: Tensor
    layers: Tensor
    substrate: str = "substrate/D263TECO"
    scatter: float = 1.0

    def __post_init__(self):
        depositions, shape = len(self.material), self.layers.shape
        if (
            len(shape) < 2
            or any(given[-1:] != (depositions,) for given in (shape, self.thickness.shape))
            or not _broadcasts(self.thickness.shape, shape)
        ):
            raise InputError(
                f"{depositions} materials need {depositions} thicknesses and a column of layers "
                f"each; they are {tuple(self.thickness.shape)} and {tuple(self.layers.shape)}."
            )
        if not 0 < self.scatter <= 1:
            raise InputError(f"The scatter factor is {self.scatter}; it must be within 0 to 1.")

    @property
    def stacks(self) -> Tensor:
        """Thickness of every layer of every filter, (M, L) nm, 0 where it is left out."""
        return self.layers * self.thickness

    def transmittance(self, wavelength: ArrayLike, angle: ArrayLike = 0.0) -> Tensor:
        """Return the transmittance of the filters for unpolarized light.

        Parameters
        ----------
        wavelength : (K,)
            nm.
        angle : () or (A,)
            Angle of incidence in air, rad.

        Returns
        -------
        Tensor, (M, K) for one angle, (A, M, K) for A angles, float64, 0..1; many arrays (N, M, K)
        and (N, A, M, K). Gradients flow to the thickness.

        Source: the incoherent back face, Macleod, Thin-Film Optical Filters, 5th ed., section 2.15;
        1/T = 1/T1 + 1/T2 - 1, exact where the film absorbs nothing.
        """
        wavelength, angle = np.asarray(wavelength, float), np.asarray(angle, float)
        table = {name: refractive_index(name, wavelength) for name in set(self.material)}
        index = np.stack([table[name] for name in reversed(self.material)])
        glass = refractive_index(self.substrate, wavelength)
        *many, filters, depositions = self.layers.shape
        thickness = torch.atleast_2d(self.thickness)
        thickness = thickness.expand(*many, *thickness.shape[-2:]).flip(-1)
        few = max(1, CACHED // (filters * len(wavelength)))  # arrays at a time
        parts = zip(
            thickness.reshape(-1, thickness.shape[-2], depositions).split(few),
            self.layers.flip(-1).reshape(-1, filters, depositions).split(few),
            strict=True,
        )
        polarizations: tuple[Polarization, ...] = ("s", "p") if angle.any() else ("s",)
        given: dict[str, Any] = {"substrate": glass, "angle": angle}
        bare = [transmittance([], [], wavelength, polarization=p, **given) for p in polarizations]
        plates = []
        for thicknesses, layers in parts:
            total = torch.zeros(())
            for polarization, back in zip(polarizations, bare, strict=True):
                front = transmittance(
                    index,
                    thicknesses,
                    wavelength,
                    layers=layers,
                    polarization=polarization,
                    **given,
                )
                total = total + front * back / (front + back - front * back)
            plates.append(self.scatter / len(polarizations) * total)
        plate = torch.cat(plates).reshape(*many, filters, *angle.shape, len(wavelength))
        return plate.movedim(len(many), -2)

    def save(self, path: str | Path) -> None:
        """Write the array to a TOML file that `read_filters` reads; InputError if it cannot be."""
        if self.layers.ndim != 2:
            raise InputError(f"There are {len(self.layers)} arrays; save them one by one.")
        rows = ["".join("01"[int(layer)] for layer in row) for row in self.layers]
        lines = [
            "# A filter array. Depositions count from the glass outwards, thickness in nm, a row",
            "# for each filter where they differ; a row of `layers` is a filter: 1 where it has",
            "# the layer, 0 where it was left out.",
            f"substrate = {dumps(self.substrate)}",
            f"scatter = {self.scatter!r}",
            f"material = {dumps(list(self.material))}",
            f"thickness = {dumps(self.thickness.tolist())}",
            "layers = [",
            *(f'    "{row}",' for row in rows),
            "]",
        ]
        with replacing(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _broadcasts(shape: torch.Size, to: torch.Size) -> bool:
    try:
        return torch.broadcast_shapes(shape, to) == to
    except RuntimeError:
        return False


# --- recipes ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StencilRecipe:
    """A random filter array by stencil lithography; the defaults are the thesis' process.

    High and low index alternate, high index first and last. Each deposition has one thickness,
    uniform on its interval and shared by all filters; each filter lacks a random subset of the
    layers, which no other filter lacks too.

    filters : M.  depositions : L.
    high, low, substrate : materials; see `refractive_index`.
    high_thickness, low_thickness : (least, most), nm.
    omitted : (fewest, most) layers that a filter lacks.
    scatter : factor on the transmittance.

    Source: thesis, chapter on the filter array, for the process; the intervals are those with which
    simulated arrays resemble the published ones.
    """

    filters: int = 36
    depositions: int = 19
    high: str = "TiO2/Franta"
    low: str = "SiO2/Rodriguez-de-Marcos"
    substrate: str = "substrate/D263TECO"
    high_thickness: tuple[float, float] = (25.0, 145.0)
    low_thickness: tuple[float, float] = (45.0, 255.0)
    omitted: tuple[int, int] = (2, 5)
    scatter: float = 0.97

    def __post_init__(self):
        fewest, most = self.omitted
        if not 0 <= fewest <= most <= self.depositions:
            raise InputError(
                f"Filters cannot lack {fewest} to {most} of {self.depositions} layers."
            )
        subsets = sum(math.comb(self.depositions, count) for count in range(fewest, most + 1))
        if self.filters > subsets:
            raise InputError(
                f"There are {subsets} ways to leave out {fewest} to {most} of {self.depositions} "
                f"layers, too few for {self.filters} filters."
            )

    @property
    def material(self) -> tuple[str, ...]:
        """Materials of the depositions, L, from the glass outwards."""
        return _alternating(self.high, self.low, self.depositions)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Least and greatest thickness of each deposition, (L,) nm."""
        return _interval(_alternating(self.high_thickness, self.low_thickness, self.depositions))

    def draw(self, seed: int | Generator = 0) -> FilterArray:
        """Draw an array; the same seed gives the same array."""
        generator = _generator(seed)
        least, most = self.limits
        uniform = torch.rand(self.depositions, generator=generator, dtype=torch.float64)
        rows: dict[tuple[bool, ...], None] = {}  # a set that keeps its order
        while len(rows) < self.filters:
            rows[tuple(self.masks(1, generator)[0].tolist())] = None
        return FilterArray(
            self.material,
            least + (most - least) * uniform,
            torch.tensor(list(rows)),
            self.substrate,
            self.scatter,
        )

    def masks(self, count: int, generator: Generator) -> Tensor:
        """Draw ways to leave out layers of one filter, (count, L) bool, True where it has one."""
        layers = torch.ones(count, self.depositions, dtype=torch.bool)
        fewest, most = self.omitted
        for row in layers:
            omitted = int(torch.randint(fewest, most + 1, (), generator=generator))
            row[torch.randperm(self.depositions, generator=generator)[:omitted]] = False
        return layers


@dataclass(frozen=True)
class FreeRecipe:
    """Filters each with a stack of its own, in the materials and limits of the stencil process.

    What an array could be if every filter were coated by itself; no cheap process makes it.

    filters : M.  depositions : layers of each filter, L.
    The other fields are those of `StencilRecipe`.
    """

    filters: int = 36
    depositions: int = 19
    high: str = "TiO2/Franta"
    low: str = "SiO2/Rodriguez-de-Marcos"
    substrate: str = "substrate/D263TECO"
    high_thickness: tuple[float, float] = (25.0, 145.0)
    low_thickness: tuple[float, float] = (45.0, 255.0)
    scatter: float = 0.97

    def __post_init__(self):
        if self.filters < 1 or self.depositions < 1:
            raise InputError("An array has one filter or more, of one layer or more.")

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Least and greatest thickness of each layer, (L,) nm."""
        return _interval(_alternating(self.high_thickness, self.low_thickness, self.depositions))

    def draw(self, seed: int | Generator = 0) -> FilterArray:
        """Draw an array, each thickness uniform on its interval; its thickness is (M, L)."""
        least, most = self.limits
        shape = (self.filters, self.depositions)
        uniform = torch.rand(shape, generator=_generator(seed), dtype=torch.float64)
        return FilterArray(
            _alternating(self.high, self.low, self.depositions),
            least + (most - least) * uniform,
            torch.ones(shape, dtype=torch.bool),
            self.substrate,
            self.scatter,
        )

    def masks(self, count: int, generator: Generator) -> None:
        """There are no masks."""


@dataclass(frozen=True)
class FabryPerotRecipe:
    """Cavities between two mirrors that all filters share, the spacer stepped from one to the next.

    The spacer is one deposition on all filters and a few more of doubling thickness behind masks:
    the binary digits of a filter's number say which of these it has. So the peaks step evenly
    through the band. Drawn at random are the order of the cavity and the centre of the mirrors,
    whose layers are a quarter wave.

    filters : M.
    mirror : layers in each mirror, odd; high index first and last.
    order : (least, most), number of half waves in the spacer.
    centre : (least, most) of the wavelength for which the mirrors are made, nm.
    band : wavelengths of the first and the last filter's peak, nm.
    spacer_thickness : (least, most) of a deposition of the spacer, nm.
    The other fields are those of `StencilRecipe`.

    Source: Macleod, Thin-Film Optical Filters, 5th ed., chapter on band-pass filters.
    """

    filters: int = 36
    mirror: int = 3
    order: tuple[int, int] = (1, 3)
    centre: tuple[float, float] = (560.0, 690.0)
    band: tuple[float, float] = (500.0, 750.0)
    high: str = "TiO2/Franta"
    low: str = "SiO2/Rodriguez-de-Marcos"
    substrate: str = "substrate/D263TECO"
    high_thickness: tuple[float, float] = (25.0, 145.0)
    low_thickness: tuple[float, float] = (45.0, 255.0)
    spacer_thickness: tuple[float, float] = (1.0, 1000.0)
    scatter: float = 0.97

    def __post_init__(self):
        if self.mirror % 2 == 0 or self.filters < 2:
            raise InputError(
                f"A mirror of {self.mirror} layers and {self.filters} filters are no Fabry-Perot "
                "array; give an odd number of layers, and 2 filters or more."
            )

    @property
    def digits(self) -> int:
        """Depositions of the spacer that have masks."""
        return (self.filters - 1).bit_length()

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Least and greatest thickness of each deposition, (L,) nm."""
        mirror = _alternating(self.high_thickness, self.low_thickness, self.mirror)
        return _interval((*mirror, *[self.spacer_thickness] * (1 + self.digits), *mirror))

    def draw(self, seed: int | Generator = 0) -> FilterArray:
        """Draw an array; the same seed gives the same array."""
        generator = _generator(seed)
        order = int(torch.randint(self.order[0], self.order[1] + 1, (), generator=generator))
        least, most = self.centre
        centre = least + (most - least) * float(torch.rand((), generator=generator))
        high, low = (float(refractive_index(m, centre)[0].real) for m in (self.high, self.low))
        quarter = _alternating(centre / 4 / high, centre / 4 / low, self.mirror)
        first, last = (order * peak / 2 / low for peak in self.band)
        step = (last - first) / (self.filters - 1)
        spacer = (first, *(step * 2**digit for digit in range(self.digits)))
        number = torch.arange(self.filters)[:, None]
        layers = torch.ones(self.filters, 2 * self.mirror + len(spacer), dtype=torch.bool)
        chosen = slice(self.mirror + 1, self.mirror + len(spacer))
        layers[:, chosen] = number // 2 ** torch.arange(self.digits) % 2 == 1
        mirror = _alternating(self.high, self.low, self.mirror)
        least, most = self.limits
        thickness = torch.tensor((*quarter, *spacer, *quarter), dtype=torch.float64)
        if step < float(least[self.mirror + 1]):
            raise InputError(
                f"{self.filters} cavities of order {order} from {self.band[0]:g} to "
                f"{self.band[1]:g} nm differ by {step:.2g} nm of spacer, less than can be "
                "deposited; take fewer filters, a wider band or a higher order."
            )
        return FilterArray(
            (*mirror, *[self.low] * len(spacer), *mirror),
            thickness.clamp(least, most),
            layers,
            self.substrate,
            self.scatter,
        )

    def masks(self, count: int, generator: Generator) -> None:
        """The masks count in binary; there is nothing to exchange."""


RECIPES = {"stencil": StencilRecipe, "free": FreeRecipe, "fabry-perot": FabryPerotRecipe}
"""Recipes that a search can improve, by name."""


def linear_variable_filter(
    filters: int = 36,
    band: tuple[float, float] = (500.0, 750.0),
    *,
    mirror: int = 5,
    high: str = "TiO2/Franta",
    low: str = "SiO2/Rodriguez-de-Marcos",
    substrate: str = "substrate/D263TECO",
    scatter: float = 0.97,
) -> FilterArray:
    """Return filters cut out of a wedge: one cavity, all layers of which grow along the band.

    It leaks where its mirrors reflect no more, some 80 nm off each peak: a product would block that
    with further filters.

    Parameters
    ----------
    filters : int
        M, evenly spaced along the wedge; the slope within each is not counted.
    band : (float, float)
        Peak of the first and the last filter, nm.
    mirror : int
        Layers in each of the two mirrors of quarter waves, odd; the spacer is a half wave of low
        index.
    high, low, substrate, scatter
        As in `StencilRecipe`.

    Raises
    ------
    InputError
        If the mirrors have an even number of layers, or there is no filter.
    """
    if mirror % 2 == 0 or filters < 1:
        raise InputError(
            f"A wedge of {filters} filters with mirrors of {mirror} layers cannot be; give an odd "
            "number of layers, and one filter or more."
        )
    peak = torch.linspace(*band, filters, dtype=torch.float64)
    middle = float(peak.mean())
    n = {name: float(refractive_index(name, middle)[0].real) for name in (high, low)}
    half = _alternating(high, low, mirror)
    material = (*half, low, low, *half)  # the spacer as two quarter waves
    quarter = torch.tensor([middle / 4 / n[name] for name in material], dtype=torch.float64)
    layers = torch.ones(filters, len(material), dtype=torch.bool)
    return FilterArray(material, peak[:, None] / middle * quarter, layers, substrate, scatter)


def _alternating(high, low, count: int) -> tuple:
    return tuple(low if i % 2 else high for i in range(count))


def _interval(pairs: tuple[tuple[float, float], ...]) -> tuple[Tensor, Tensor]:
    least, most = torch.tensor(pairs, dtype=torch.float64).T
    return least, most


def _generator(seed: int | Generator) -> Generator:
    return torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed


# --- files ----------------------------------------------------------------------------------


def read_filters(
    path: str | Path, *, wavelength: ArrayLike | None = None, effective_index: float | None = None
) -> FilterArray | MeasuredFilters:
    """Read a filter array: a design in TOML, or a measured table of any common kind.

    Parameters
    ----------
    path : str or Path
        ``.toml``: what `FilterArray.save` wrote. ``.csv`` or ``.txt``: a column of wavelengths,
        then one column for each filter, below any heading. ``.npy``: an array (M, K). ``.npz``
        or ``.mat``: the one matrix among its variables. ``.nc``: the one variable with a
        ``wavelength`` coordinate.
    wavelength : (K,), optional
        nm; needed where the file holds none: for ``.npy`` always, for ``.npz`` and ``.mat`` unless
        a variable is named ``wavelength``, ``wavelengths`` or ``lambda``.
    effective_index : float, optional
        Effective index for the shift of a measured table at an angle; None: no shift.

    Raises
    ------
    InputError
        If the file cannot be read, or if its wavelengths are missing or do not fit.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"There is no file {path}.")
    if path.suffix.lower() == ".toml":
        return _read_design(path)
    return read_table(path, wavelength=wavelength, effective_index=effective_index)


def _read_design(path: Path) -> FilterArray:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        rows = [[{"0": False, "1": True}[layer] for layer in row] for row in table["layers"]]
        return FilterArray(
            tuple(table["material"]),
            torch.tensor(table["thickness"], dtype=torch.float64),
            torch.tensor(rows),
            table["substrate"],
            table["scatter"],
        )
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{path} is no filter array: {error} is missing or misread.") from None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path} is no filter array as `save` writes it: {error}.") from None
