"""Filter arrays: the thesis' stencil process, and tables that were measured."""

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
from squilla.optics.angle import blue_shift
from squilla.optics.materials import read_columns, refractive_index
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
        depositions, given = len(self.material), (self.thickness.shape, self.layers.shape)
        if (
            self.layers.ndim < 2
            or any(shape[-1:] != (depositions,) for shape in given)
            or not _fit(self.thickness.shape, self.layers.shape)
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
        """Write the array to a TOML file that `read_filters` reads."""
        if self.layers.ndim != 2:
            raise InputError(f"There are {len(self.layers)} arrays; save them one by one.")
        rows = ["".join("01"[int(layer)] for layer in row) for row in self.layers]
        lines = [
            "# A filter array. Depositions count from the glass outwards, thickness in nm, a row for",
            "# each filter where they differ; a row of `layers` is a filter: 1 where it has the",
            "# layer, 0 where it was left out.",
            f"substrate = {dumps(self.substrate)}",
            f"scatter = {self.scatter!r}",
            f"material = {dumps(list(self.material))}",
            f"thickness = {dumps(self.thickness.tolist())}",
            "layers = [",
            *(f'    "{row}",' for row in rows),
            "]",
        ]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


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

    def draw(self, seed: int | Generator = 0) -> FilterArray:
        """Draw an array; the same seed gives the same array."""
        generator = torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed
        high = torch.arange(self.depositions) % 2 == 0
        uniform = torch.rand(self.depositions, generator=generator, dtype=torch.float64)
        least, most = (
            torch.where(high, h, low)
            for h, low in zip(self.high_thickness, self.low_thickness, strict=True)
        )
        absent: dict[frozenset[int], None] = {}  # a set that keeps its order
        while len(absent) < self.filters:
            count = int(
                torch.randint(self.omitted[0], self.omitted[1] + 1, (), generator=generator)
            )
            order = torch.randperm(self.depositions, generator=generator)
            absent[frozenset(order[:count].tolist())] = None
        layers = torch.ones(self.filters, self.depositions, dtype=torch.bool)
        for row, left_out in zip(layers, absent, strict=True):
            row[list(left_out)] = False
        material = tuple(self.high if h else self.low for h in high)
        return FilterArray(
            material, least + (most - least) * uniform, layers, self.substrate, self.scatter
        )


@dataclass(frozen=True, eq=False)
class MeasuredFilters:
    """Filters known by a measured table of their transmittance, or response, at normal incidence.

    wavelength : (K,) nm, increasing.
    values : (M, K) transmittance, 0..1, or a response in any unit.
    effective_index : effective index of the stack, for its blue shift at an angle; None: no shift.
    """

    wavelength: np.ndarray
    values: np.ndarray
    effective_index: float | None = None

    def __post_init__(self):
        if self.values.ndim != 2 or self.values.shape[1] != len(self.wavelength):
            raise InputError(
                f"The filter table has the shape {self.values.shape}; with {len(self.wavelength)} "
                f"wavelengths (filters, {len(self.wavelength)}) was expected."
            )
        if not (np.isfinite(self.values).all() and np.isfinite(self.wavelength).all()):
            raise InputError("The filter table holds NaN or infinite values; repair the table.")
        if not np.all(np.diff(self.wavelength) > 0):
            raise InputError("The wavelengths of a filter table must increase.")
        if self.effective_index is not None and not self.effective_index >= 1:
            raise InputError(
                f"The effective index is {self.effective_index}; it must be 1 or more."
            )

    def transmittance(self, wavelength: ArrayLike, angle: ArrayLike = 0.0) -> Tensor:
        """Return the table on another grid, shifted to the blue at an angle.

        Parameters
        ----------
        wavelength : (K,)
            nm, within the table. What the shift would read beyond the table's red end is the
            table's last value.
        angle : () or (A,)
            Angle of incidence in air, rad.

        Returns
        -------
        Tensor, (M, K) for one angle, (A, M, K) for A angles, float64

        Source: `blue_shift`.
        """
        shifts = np.stack(
            [
                blue_shift(
                    self.wavelength,
                    ([one], [1.0]),
                    self.effective_index or np.inf,
                    onto=np.asarray(wavelength, float),
                )
                for one in np.atleast_1d(np.asarray(angle, float))
            ]
        )
        seen = self.values @ shifts.swapaxes(-1, -2)
        return torch.from_numpy(seen if np.ndim(angle) else seen[0])


def _fit(shape: tuple[int, ...], layers: tuple[int, ...]) -> bool:
    """Whether thicknesses of a shape broadcast to the layers'."""
    padded = (1,) * (len(layers) - len(shape)) + tuple(shape)
    return len(padded) == len(layers) and all(
        a in (1, b) for a, b in zip(padded, layers, strict=True)
    )


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
    suffix = path.suffix.lower()
    if suffix == ".toml":
        return _read_design(path)
    if suffix not in _TABLES:
        raise InputError(
            f"Filters cannot be read from {path.name}; expected .toml, {', '.join(_TABLES)}."
        )
    try:
        values, own = _TABLES[suffix](path)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"The filter table {path} cannot be read: {error}") from None
    wavelength = own if wavelength is None else np.asarray(wavelength, float)
    if wavelength is None:
        raise InputError(
            f"{path} names no wavelengths; pass wavelength=, one for each band, in nm."
        )
    if values.ndim == 2 and values.shape[1] != len(wavelength) == values.shape[0]:
        values = values.T
    order = np.argsort(wavelength) if values.shape[-1] == len(wavelength) else slice(None)
    return MeasuredFilters(wavelength[order], values[..., order], effective_index)


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
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is no filter array as `save` writes it: {error!r}.") from None


def _matrix(variables: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the one matrix among named arrays and the wavelengths, if one is named so."""
    arrays = {name: np.asarray(value) for name, value in variables.items()}
    matrices = [
        array
        for array in arrays.values()
        if array.ndim == 2 and min(array.shape) > 1 and np.issubdtype(array.dtype, np.number)
    ]
    if len(matrices) != 1:
        raise InputError(
            f"One matrix of filters was expected among {sorted(arrays)}, not {len(matrices)}; "
            "save it alone."
        )
    named = [
        array
        for name, array in arrays.items()
        if name.lower() in ("wavelength", "wavelengths", "lambda")
    ]
    return matrices[0].astype(float), named[0].astype(float).ravel() if named else None


def _read_mat(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(path)
    except NotImplementedError:
        raise InputError(f"{path} is of MATLAB's version 7.3; save it with '-v7'.") from None
    except MatReadError as error:
        raise InputError(f"The filter table {path} cannot be read: {error}.") from None
    return _matrix({k: v for k, v in variables.items() if not k.startswith("__")})


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    with np.load(path) as table:
        return _matrix(dict(table))


def _read_npy(path: Path) -> tuple[np.ndarray, None]:
    return np.load(path).astype(float), None


def _read_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    columns = read_columns(path).T
    return columns[1:], columns[0]


def _read_netcdf(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import xarray

    with xarray.open_dataset(path, engine="h5netcdf") as dataset:
        tables = [v for v in dataset.data_vars.values() if "wavelength" in v.coords and v.ndim == 2]
        if len(tables) != 1:
            raise InputError(
                f"{path} holds {len(tables)} tables (filter, wavelength); expected one."
            )
        table = tables[0].transpose(..., "wavelength")
        return table.to_numpy().astype(float), table["wavelength"].to_numpy().astype(float)


_TABLES = {
    ".csv": _read_text,
    ".txt": _read_text,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".mat": _read_mat,
    ".nc": _read_netcdf,
}
