"""Filters known by a table: measured ones, read from files of any common kind, and ideal ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from squilla.errors import InputError
from squilla.files.disk import check_size, reading
from squilla.files.tables import read_columns
from squilla.optics.angle import blue_shift
from squilla.spectra import grid, nanometres


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
        if not np.isfinite(self.values).all():
            raise InputError("The filter table holds NaN or infinite values; repair the table.")
        nanometres(self.wavelength)
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


def band_pass(
    filters: int = 36,
    wavelength: ArrayLike | None = None,
    *,
    fwhm: float = 12.0,
    peak: float = 1.0,
    effective_index: float | None = None,
) -> MeasuredFilters:
    """Return ideal band-pass filters, Gaussian in wavelength and side by side over the band.

    Parameters
    ----------
    filters : int
    wavelength : (K,), optional
        nm; default: `grid`.
    fwhm : float
        nm.
    peak : float
        Transmittance at the peak, 0..1.
    effective_index : float, optional
        For the blue shift at an angle; None: no shift.

    Raises
    ------
    InputError
        If there is no filter, or its width is not positive.
    """
    if filters < 1 or not fwhm > 0:
        raise InputError(
            f"{filters} band-passes {fwhm:g} nm wide are no array; give one or more, of a positive "
            "width."
        )
    wavelength = grid() if wavelength is None else np.asarray(wavelength, float)
    first, last = wavelength[[0, -1]]
    centre = first + (last - first) * (np.arange(filters) + 0.5) / filters
    distance = (wavelength - centre[:, None]) / fwhm
    return MeasuredFilters(wavelength, peak * np.exp(-4 * np.log(2) * distance**2), effective_index)


# --- files --------------------------------------------------------------------------------------


def read_table(
    path: Path, *, wavelength: ArrayLike | None = None, effective_index: float | None = None
) -> MeasuredFilters:
    """Read a table of filters; `squilla.optics.filters.read_filters` says of what kinds."""
    read = _KINDS.get(path.suffix.lower())
    if read is None:
        raise InputError(
            f"Filters cannot be read from {path.name}; expected .toml, {', '.join(_KINDS)}."
        )
    with reading(path, "table of filters"):
        values, own = read(path)
    wavelength = own if wavelength is None else np.asarray(wavelength, float)
    if wavelength is None:
        raise InputError(f"{path} names no wavelengths; give them, one for each band, in nm.")
    if values.ndim == 2 and values.shape[1] != len(wavelength) == values.shape[0]:
        values = values.T
    order = np.argsort(wavelength) if values.shape[-1] == len(wavelength) else slice(None)
    return MeasuredFilters(wavelength[order], values[..., order], effective_index)


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
    from scipy.io import loadmat, whosmat

    try:
        check_size(path, sum(int(np.prod(shape, dtype=float)) for _, shape, _ in whosmat(path)))
        variables = loadmat(path)
    except NotImplementedError:
        raise InputError(f"{path} is of MATLAB's version 7.3; save it with '-v7'.") from None
    return _matrix({k: v for k, v in variables.items() if not k.startswith("__")})


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    with np.load(path, allow_pickle=False) as table:
        check_size(path, sum(entry.file_size for entry in table.zip.infolist()))
        return _matrix(dict(table))


def _read_npy(path: Path) -> tuple[np.ndarray, None]:
    return np.load(path, mmap_mode="r", allow_pickle=False).astype(float), None


def _read_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    columns = read_columns(path)[0].T
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


_KINDS = {
    ".csv": _read_text,
    ".txt": _read_text,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".mat": _read_mat,
    ".nc": _read_netcdf,
}
