"""The design of a camera: one TOML file, validated, from which the twin is built."""

import tomllib
from collections.abc import Mapping
from functools import cached_property
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from squilla.errors import InputError
from squilla.spectra import grid

_BUILT_IN = Path(str(package_files("squilla"))) / "data" / "cameras"


class _Section(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, ignored_types=(cached_property,)
    )


class Array(_Section):
    """The lens array. pitch, position_error um; rotation degrees, clockwise; offset px (y, x)."""

    rows: int = Field(gt=0, le=64)
    columns: int = Field(gt=0, le=64)
    pitch: float = Field(gt=0)
    rotation: float = Field(0.0, ge=-5, le=5)
    offset: tuple[float, float] = (0.0, 0.0)
    position_error: float = Field(0.0, ge=0)
    seed: int = Field(0, ge=0)


class Lens(_Section):
    """One lens. focal_length, diameter, defocus um; focus_distance mm; focus_wavelength nm."""

    focal_length: float = Field(gt=0)
    diameter: float = Field(gt=0)
    glass: str
    focus_distance: float = Field(gt=0)
    focus_wavelength: float = Field(600.0, gt=0)
    defocus: float = 0.0


class Filters(_Section):
    """The filters: where they sit, and what they are: a recipe drawn with a seed, or a file.

    layout : "array", one under each lens; "mosaic", on the pixels behind a single lens; or
        "sequential", one after another before a single lens, an exposure for each.
    shape : rows and columns of a mosaic's tile, or of the plate that a sequence goes through.
    fwhm : width of the bands of the recipe "band-pass", nm.
    table : stacks or measured responses; see `squilla.optics.filters.read_filters`.
    effective_index : of the films, for the blue shift of tabulated filters at an angle.
    size : side of each square filter of an array, um; without it a filter covers its lens.
    distance : from the lenses to the filters behind them, um.
    gap : transmittance of the gaps between the filters, 0 for opaque ones, 0.92 for bare glass.
    decentre : of the filter plate against the lenses, um (y, x).
    """

    layout: Literal["array", "mosaic", "sequential"] = "array"
    shape: tuple[int, int] | None = None
    recipe: Literal["stencil", "fabry-perot", "band-pass", "linear-variable"] | None = None
    seed: int = Field(0, ge=0)
    fwhm: float = Field(12.0, gt=0)
    table: Path | None = None
    effective_index: float | None = Field(None, gt=1)
    size: float | None = Field(None, gt=0)
    distance: float = Field(0.0, ge=0)
    gap: float = Field(0.0, ge=0, le=1)
    decentre: tuple[float, float] = (0.0, 0.0)

    @model_validator(mode="after")
    def _well_formed(self):
        if (self.recipe is None) == (self.table is None):
            raise ValueError("give either a recipe or a table")
        if (self.layout == "array") != (self.shape is None):
            raise ValueError("a shape belongs to the layouts mosaic and sequential, and only there")
        if self.shape is not None and not all(1 <= side <= 16 for side in self.shape):
            raise ValueError("the shape must be within 1 to 16 rows and columns")
        if self.size is None and (self.distance, self.gap, *self.decentre) != (0, 0, 0, 0):
            raise ValueError("distance, gap and decentre need the size of the filters")
        return self


class Stop(_Section):
    """The aperture stop in front of the array, square or round. width, distance mm."""

    width: float = Field(gt=0)
    distance: float = Field(gt=0)
    round: bool = False


class Walls(_Section):
    """Walls between the tiles of the lenses, hanging from the lens plane. height, thickness um."""

    height: float = Field(gt=0)
    thickness: float = Field(0.0, ge=0)


class Spectrum(_Section):
    """A tabulated quantity. wavelength nm, increasing; value of the same length."""

    wavelength: tuple[float, ...]
    value: tuple[float, ...]

    @model_validator(mode="after")
    def _well_formed(self):
        if len(self.wavelength) != len(self.value) or len(self.value) < 2:
            raise ValueError("wavelength and value must have the same length, at least 2")
        if np.any(np.diff(self.wavelength) <= 0):
            raise ValueError("wavelength must increase")
        return self


class Sensor(_Section):
    """The sensor. pixel um; full_well, read_noise e-; dark_current e-/s; black_level DN."""

    rows: int = Field(gt=0, le=20000)
    columns: int = Field(gt=0, le=20000)
    pixel: float = Field(gt=0)
    bits: int = Field(ge=8, le=16)
    full_well: float = Field(gt=0)
    read_noise: float = Field(ge=0)
    dark_current: float = Field(0.0, ge=0)
    black_level: float = Field(0.0, ge=0)
    prnu: float = Field(0.0, ge=0, lt=0.5)
    hot_pixels: float = Field(0.0, ge=0, lt=0.1)
    seed: int = Field(0, ge=0)
    quantum_efficiency: Spectrum

    @model_validator(mode="after")
    def _possible(self):
        if self.black_level >= 2**self.bits - 1:
            raise ValueError("black_level must lie below the top of the scale, 2^bits - 1")
        efficiency = self.quantum_efficiency.value
        if min(efficiency) < 0 or max(efficiency) > 1:
            raise ValueError("the quantum efficiency must lie within 0..1")
        return self

    @property
    def gain(self) -> float:
        """Electrons per digital number, e-/DN: the full well fills the range above black."""
        return self.full_well / (2**self.bits - 1 - self.black_level)


class FieldOfView(_Section):
    """The aligned sub-images. size px; reference is the unit whose view is reconstructed."""

    size: int = Field(gt=8)
    reference: int = Field(ge=0)


class Band(_Section):
    """The wavelengths, nm; step must divide the band, for each band holds `step` of the light."""

    start: float = Field(gt=0)
    stop: float = Field(gt=0)
    step: float = Field(ge=0.01)

    @model_validator(mode="after")
    def _even(self):
        if self.stop <= self.start:
            raise ValueError("stop must lie above start")
        steps = (self.stop - self.start) / self.step
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"a step of {self.step:g} nm does not divide the band from {self.start:g} to "
                f"{self.stop:g} nm"
            )
        return self


class Light(_Section):
    """radiance of a scene value of 1, photons / (s m2 sr nm)."""

    radiance: float = Field(gt=0)


class Effects(_Section):
    """Which effects the twin simulates."""

    diffraction: bool = True
    chromatic_focus: bool = True
    field_curvature: bool = True
    field_angle: bool = True
    cone: bool = True
    pupil_leak: bool = True
    lateral_colour: bool = True
    vignetting: bool = True
    shot_noise: bool = True
    read_noise: bool = True
    fixed_pattern: bool = True

    @classmethod
    def none(cls) -> "Effects":
        """Return all of them switched off."""
        return cls(**dict.fromkeys(cls.model_fields, False))


class CameraDesign(_Section):
    """A camera on paper: every figure that the twin needs, checked.

    Read with `CameraDesign.load`; change with ``design.model_copy(update={"stop": None})``.
    Without a stop or walls neighbouring sub-images leak into each other.
    """

    name: str
    array: Array
    lens: Lens
    filters: Filters
    sensor: Sensor
    field: FieldOfView
    band: Band
    light: Light
    stop: Stop | None = None
    walls: Walls | None = None
    effects: Effects = Effects()

    def model_copy(
        self, *, update: Mapping[str, Any] | None = None, deep: bool = False
    ) -> "CameraDesign":
        """Return a design with some sections changed, checked like one that was read."""
        sections = {name: getattr(self, name) for name in type(self).model_fields}
        try:
            return type(self)(**sections | dict(update or {}))
        except ValidationError as error:
            raise _refused("The changed design", error) from error

    @classmethod
    def load(cls, source: str | Path = "thesis") -> "CameraDesign":
        """Read a design.

        Parameters
        ----------
        source : str or Path
            The name of a built-in design (`designs`), or the path of a TOML file of the same form
            (``squilla camera --toml`` prints one to start from). A filter table in it is looked for
            beside the file.

        Raises
        ------
        InputError
            If the file cannot be read, or a value is missing, unknown or out of its range.
        """
        path = design_path(source)
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise InputError(f"The camera design {path} cannot be read: {error}.") from error
        table = tree.get("filters", {}) if isinstance(tree.get("filters", {}), dict) else {}
        if isinstance(table.get("table"), str):
            table["table"] = path.parent / table["table"]
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            raise _refused(f"The camera design {path}", error) from error

    @model_validator(mode="after")
    def _fits(self):
        units = self.array.rows * self.array.columns
        if self.field.reference >= units:
            raise ValueError(f"field.reference must be one of the units 0 to {units - 1}")
        if self.filters.layout != "array" and units > 1:
            raise ValueError(f"filters in a {self.filters.layout} layout have a single lens")
        if self.filters.distance >= self.lens.focal_length:
            raise ValueError("filters.distance must be less than the focal length")
        if self.walls is not None:
            if self.walls.height > self.lens.focal_length:
                raise ValueError("walls.height must not exceed the focal length")
            if self.walls.thickness > self.array.pitch - self.lens.diameter:
                raise ValueError("walls.thickness must leave the lenses free")
        if self.field.size > self.pitch:
            raise ValueError(
                f"the sub-images overlap: a field of {self.field.size} px does not fit between "
                f"lenses {self.pitch:.1f} px apart; lower field.size or raise array.pitch"
            )
        reach = np.abs(self.centres - (np.array(self.sensor_shape) - 1) / 2).max(0)
        needed = reach + self.field.size / 2
        if np.any(needed > np.array(self.sensor_shape) / 2):
            rows, columns = np.ceil(2 * needed).astype(int)
            raise ValueError(
                f"the sub-images leave the sensor: they need {rows} x {columns} px, it has "
                f"{self.sensor.rows} x {self.sensor.columns}"
            )
        known = self.sensor.quantum_efficiency.wavelength
        if self.band.start < known[0] or self.band.stop > known[-1]:
            raise ValueError("the quantum efficiency must cover the band")
        return self

    @property
    def units(self) -> int:
        """Number of lenses."""
        return self.array.rows * self.array.columns

    @property
    def channels(self) -> int:
        """Number of filters, M; as many as lenses in an array."""
        rows, columns = self.filters.shape or (self.array.rows, self.array.columns)
        return rows * columns

    @cached_property
    def mosaic(self) -> np.ndarray:
        """Which filter lies on each pixel of a mosaic's tile, drawn by the filters' seed.

        Pixel (0, 0) of the sensor has the tile's first.
        """
        order = np.random.default_rng(self.filters.seed).permutation(self.channels)
        return order.reshape(self.filters.shape or (1, -1))

    @property
    def pitch(self) -> float:
        """Distance of neighbouring lenses, px."""
        return self.array.pitch / self.sensor.pixel

    @property
    def focal(self) -> float:
        """Focal length, px."""
        return self.lens.focal_length / self.sensor.pixel

    @property
    def sensor_shape(self) -> tuple[int, int]:
        return self.sensor.rows, self.sensor.columns

    @cached_property
    def wavelength(self) -> np.ndarray:
        """Wavelength grid of the band, (K,) nm."""
        return grid(self.band.start, self.band.stop, self.band.step)

    @cached_property
    def centres(self) -> np.ndarray:
        """Where each lens' axis meets the sensor, (M, 2) px (y, x), position errors included."""
        rows, columns = np.mgrid[: self.array.rows, : self.array.columns].reshape(2, -1)
        steps = np.stack(
            [rows - (self.array.rows - 1) / 2, columns - (self.array.columns - 1) / 2], axis=-1
        )
        turn = np.deg2rad(self.array.rotation)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        error = np.random.default_rng(self.array.seed).normal(size=steps.shape)
        middle = (np.array(self.sensor_shape) - 1) / 2 + self.array.offset
        return (
            middle
            + self.pitch * steps @ rotation.T
            + (self.array.position_error / self.sensor.pixel * error)
        )

    @property
    def quantum_efficiency(self) -> np.ndarray:
        """Quantum efficiency on the band's grid, (K,), 0..1."""
        table = self.sensor.quantum_efficiency
        return np.interp(self.wavelength, table.wavelength, table.value)


def _refused(what: str, error: ValidationError) -> InputError:
    """Return in one sentence what is wrong with a design."""
    first = error.errors()[0]
    place = ".".join(map(str, first["loc"]))
    said = first["msg"].removeprefix("Value error, ")
    return InputError(f"{what}: {f'{place}: {said}' if place else said}.")


def designs() -> list[str]:
    """Return the names of the camera designs that are built in."""
    return sorted(path.stem for path in _BUILT_IN.glob("*.toml"))


def design_path(source: str | Path) -> Path:
    """Return the file of a built-in or own camera design; InputError where there is none."""
    for path in (_BUILT_IN / f"{source}.toml", Path(source)):
        if path.is_file():
            return path
    raise InputError(
        f"There is no camera design {str(source)!r}; there are {', '.join(designs())}, or give a "
        "TOML file of your own."
    )
