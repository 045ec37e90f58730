"""Refractive indices of thin-film materials and glasses, from tables that ship or of one's own."""

from collections.abc import Callable
from difflib import get_close_matches
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from squilla.errors import InputError
from squilla.files.tables import read_columns


def refractive_index(material: str | Path, wavelength: np.ndarray | float) -> np.ndarray:
    """Return the complex refractive index n + ik of a material.

    Parameters
    ----------
    material : str or Path
        The name of a table that ships, one of `materials()`, such as "TiO2/Franta"; or the path of
        a file: ``.yml`` as refractiveindex.info hands it out, or ``.csv`` with the columns
        wavelength in nm, n and, optionally, k.
    wavelength : array, (K,)
        nm, within the range of the table.

    Returns
    -------
    array, (K,), complex128
        Tables are interpolated linearly. k is 0 where none is given, and where noise made it
        negative.

    Raises
    ------
    InputError
        If there is no such material, if its file cannot be read, or if a wavelength lies outside
        its range: nothing is extrapolated.

    Example
    -------
    >>> refractive_index("SiO2/Malitson", [589.3]).round(4)
    array([1.4584+0.j])

    Source: the formulas of refractiveindex.info, Polyanskiy, Sci. Data 11, 94 (2024).
    """
    wavelength = np.atleast_1d(np.asarray(wavelength, float))
    dispersion = _dispersion(material)
    start = max(part.start for part in dispersion)
    stop = min(part.stop for part in dispersion)
    slack = 1e-6
    if not np.all((wavelength >= start - slack) & (wavelength <= stop + slack)):
        raise InputError(
            f"The index of {material} is known from {start:g} to {stop:g} nm, but "
            f"{wavelength.min():g}-{wavelength.max():g} nm is needed; choose another table."
        )
    index = np.zeros(wavelength.shape, np.complex128)
    for part in dispersion:
        index += part.at(wavelength) * (1 if part.quantity == "n" else 1j)
    return index


@cache
def materials() -> tuple[str, ...]:
    """Return the names of the materials that ship, such as "TiO2/Franta"."""
    folder = _folder()
    return tuple(
        sorted(
            path.relative_to(folder).with_suffix("").as_posix() for path in folder.glob("*/*.yml")
        )
    )


class _Part(NamedTuple):
    """One quantity of a material, n or k, over a range of wavelengths in nm."""

    quantity: str
    start: float
    stop: float
    at: Callable[[np.ndarray], np.ndarray]


def _folder() -> Path:
    return Path(str(package_files("squilla") / "data" / "materials"))


@cache
def _shipped(name: str) -> list[_Part]:
    return _read_yaml(_folder() / f"{name}.yml")


def _dispersion(material: str | Path) -> list[_Part]:
    if str(material) in materials():
        return _shipped(str(material))
    path = Path(material)
    if path.suffix.lower() not in (".yml", ".yaml", ".csv"):
        close = get_close_matches(str(material), materials(), 3, 0.3)
        meant = (
            f"Did you mean {', '.join(close)}?" if close else f"Known: {', '.join(materials())}."
        )
        raise InputError(
            f"There is no material {str(material)!r}. {meant} A file of your own ends in .yml or "
            ".csv."
        )
    return _read_csv(path) if path.suffix.lower() == ".csv" else _read_yaml(path)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"The table {path} cannot be read: {error}.") from None


def _read_csv(path: Path) -> list[_Part]:
    columns = read_columns(path)[0].T
    if not 2 <= len(columns) <= 3:
        raise InputError(f"{path} has {len(columns)} columns; expected wavelength, n and maybe k.")
    if columns[0].max() < 100:
        raise InputError(
            f"The wavelengths of {path} end at {columns[0].max():g}; they must be in nm, not um."
        )
    return _tables(path, columns[0], dict(zip("nk", columns[1:], strict=False)))


def _read_yaml(path: Path) -> list[_Part]:
    import yaml

    try:
        entries = yaml.safe_load(_text(path))["DATA"]
        parts: list[_Part] = []
        for entry in entries:
            kind, _, quantity = entry["type"].partition(" ")
            if kind == "tabulated":
                columns = np.array([row.split() for row in entry["data"].split("\n") if row], float)
                values = dict(zip(quantity, columns.T[1:], strict=True))
                parts += _tables(path, 1000 * columns[:, 0], values)
            elif entry["type"] in _FORMULAS:
                start, stop = map(float, entry["wavelength_range"].split())
                constants = np.array(entry["coefficients"].split(), float)
                part = _formula(_FORMULAS[entry["type"]], constants, 1000 * start, 1000 * stop)
                with np.errstate(all="ignore"):
                    part.at(np.array([part.start]))  # refuses constants that are too few
                parts.append(part)
            else:
                raise InputError(
                    f"{path} gives its index as {entry['type']!r}; tables of n, k or nk and "
                    f"{', '.join(_FORMULAS)} can be read."
                )
    except InputError:
        raise
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is no refractiveindex.info file: {error!r}.") from None
    if not any(part.quantity == "n" for part in parts):
        raise InputError(f"{path} gives no refractive index n.")
    return parts


def _tables(path: Path, wavelength: np.ndarray, values: dict[str, np.ndarray]) -> list[_Part]:
    order = np.argsort(wavelength)
    wavelength = wavelength[order]
    if not (np.all(np.diff(wavelength) > 0) and all(np.isfinite(v).all() for v in values.values())):
        raise InputError(f"{path} has repeated wavelengths or gaps; repair the table.")

    def interpolation(value: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        value = np.maximum(value[order], 0)
        return lambda at: np.interp(at, wavelength, value)

    return [
        _Part(quantity, wavelength[0], wavelength[-1], interpolation(value))
        for quantity, value in values.items()
    ]


# --- dispersion formulas: constants c1, c2, ... and the wavelength in um ----------------------


def _formula(formula: Callable, constants: np.ndarray, start: float, stop: float) -> _Part:
    return _Part("n", start, stop, lambda at: formula(constants, at[:, None] / 1000))


def _sellmeier(c: np.ndarray, um: np.ndarray) -> np.ndarray:
    return np.sqrt(1 + c[0] + np.sum(c[1::2] * um**2 / (um**2 - c[2::2] ** 2), -1))


def _sellmeier_squared(c: np.ndarray, um: np.ndarray) -> np.ndarray:
    return np.sqrt(1 + c[0] + np.sum(c[1::2] * um**2 / (um**2 - c[2::2]), -1))


def _polynomial(c: np.ndarray, um: np.ndarray) -> np.ndarray:
    return np.sqrt(c[0] + np.sum(c[1::2] * um ** c[2::2], -1))


def _rational(c: np.ndarray, um: np.ndarray) -> np.ndarray:
    poles = np.pad(c[1:9], (0, max(0, 9 - len(c)))).reshape(2, 4)  # two at most, then powers
    scale, power, pole, pole_power = poles[np.any(poles != 0, -1)].T
    resonances = np.sum(scale * um**power / (um**2 - pole**pole_power), -1)
    return np.sqrt(c[0] + resonances + np.sum(c[9::2] * um ** c[10::2], -1))


def _cauchy(c: np.ndarray, um: np.ndarray) -> np.ndarray:
    return c[0] + np.sum(c[1::2] * um ** c[2::2], -1)


_FORMULAS: dict[str, Callable] = {
    "formula 1": _sellmeier,
    "formula 2": _sellmeier_squared,
    "formula 3": _polynomial,
    "formula 4": _rational,
    "formula 5": _cauchy,
}
