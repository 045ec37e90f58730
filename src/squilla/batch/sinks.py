"""Where the cubes of many captures go: a file each, or one store for all."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from squilla.errors import InputError
from squilla.files.disk import flush
from squilla.files.journal import stop_on_disk_error

if TYPE_CHECKING:
    import xarray as xr

Told = dict[str, dict[str, Any]]
"""What the journal says of each capture, by its name."""


class Sink(Protocol):
    """Where cubes go; sent to the workers."""

    @property
    def ready(self) -> bool:
        """Whether cubes can be written."""
        ...

    def lay_out(self, cube: "xr.Dataset") -> None:
        """Make ready for cubes like this one."""

    def write(self, name: str, cube: "xr.Dataset") -> None: ...

    def finish(self, done: Told, failed: dict[str, str]) -> None:
        """Note what is known of each capture, and why others have no cube."""


_SHARED = (
    "long_name", "units", "flag_masks", "flag_meanings",
    "model", "software", "calibration", "weights", "scale",
)  # fmt: skip
"""What is the same for the cubes of all captures."""


@dataclass(frozen=True)
class Folder:
    """One NetCDF file for each capture."""

    path: Path

    ready = True

    def lay_out(self, cube: "xr.Dataset") -> None:
        pass

    def write(self, name: str, cube: "xr.Dataset") -> None:
        from squilla.files.cube import save

        first, *others = cube.data_vars.values()
        extra = {str(array.name): array for array in others}
        save(first, self.path / f"{name}.nc", extra=extra)

    def finish(self, done: Told, failed: dict[str, str]) -> None:
        pass


@dataclass(frozen=True)
class Stack:
    """One Zarr for all captures, along a first dimension; each has chunks of its own."""

    path: Path
    names: list[str]

    def __post_init__(self):
        from squilla.files.cube import need_zarr

        need_zarr(self.path)
        if self.ready and self._opened().capture.values.tolist() != self.names:
            raise InputError(
                f"{self.path} was begun with other captures; give the same, or another output."
            )

    @property
    def ready(self) -> bool:
        """Whether the store was laid out to its end."""
        import zarr

        if not (self.path / "zarr.json").exists():
            return False
        return bool(zarr.open_group(self.path, mode="r").attrs.get("laid_out", False))

    def _opened(self) -> "xr.Dataset":
        import xarray as xr

        return xr.open_zarr(self.path, consolidated=False, chunks=None)

    def lay_out(self, cube: "xr.Dataset") -> None:
        import dask.array
        import numpy as np
        import xarray as xr
        import zarr

        from squilla.files.cube import zarr_encoding

        count = len(self.names)
        empty = {
            name: (
                ("capture", *array.dims),
                dask.array.full(
                    (count, *array.shape),
                    np.nan if array.dtype.kind == "f" else 0,
                    dtype=array.dtype,
                    chunks=-1,
                ),
                {key: array.attrs[key] for key in _SHARED if key in array.attrs},
            )
            for name, array in cube.data_vars.items()
        }
        whole = xr.Dataset(empty, {**cube.coords, "capture": np.array(self.names, object)})
        whole.attrs = {"Conventions": "CF-1.11", "cube": next(iter(empty))}
        encoding = zarr_encoding(whole)
        with stop_on_disk_error(self.path):
            # Over what a run that was killed here has begun.
            whole.to_zarr(
                self.path, mode="w", zarr_format=3, consolidated=False, encoding=encoding,
                compute=False,
            )  # fmt: skip
            zarr.open_group(self.path, mode="r+").attrs["laid_out"] = True

    def write(self, name: str, cube: "xr.Dataset") -> None:
        place = self.names.index(name)
        one = cube.drop_vars(list(cube.coords)).expand_dims("capture")
        for array in one.variables.values():
            array.attrs = {}
        region = {"capture": slice(place, place + 1)}
        with stop_on_disk_error(self.path):
            one.to_zarr(self.path, region=region, zarr_format=3, consolidated=False)
            for variable in one.data_vars:
                flush(self.path / str(variable) / "c" / str(place))

    def finish(self, done: Told, failed: dict[str, str]) -> None:
        """Write what is known of each capture beside its cube."""
        import numpy as np
        import xarray as xr

        if not self.ready:
            return
        known = {key for told in done.values() for key in told}
        columns = {}
        for key in sorted(known - {"source"}):
            values = [done.get(name, {}).get(key) for name in self.names]
            numbers = all(isinstance(value, int | float | None) for value in values)
            empty, kind, dtype = (np.nan, float, float) if numbers else ("", str, object)
            filled = [empty if value is None else kind(value) for value in values]
            columns[key] = ("capture", np.array(filled, dtype))
        reasons = [failed.get(name, "") for name in self.names]
        columns["failed"] = ("capture", np.array(reasons, object))
        told = xr.Dataset(columns, attrs=self._opened().attrs)
        with stop_on_disk_error(self.path):
            told.to_zarr(self.path, mode="a", zarr_format=3, consolidated=False)
