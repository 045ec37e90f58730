"""A solid scene to photograph: a doll before a wall, with the depth of every sample."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter
from xarray import DataArray

from squilla.errors import InputError
from squilla.files.cube import labelled
from squilla.spectra import CHART_LIGHT, lights, reflectances

Pattern = Literal["plain", "cloth", "stripes", "dots", "hair", "grain"]


@dataclass(frozen=True)
class Part:
    """A rounded body that stands out of the wall.

    middle, half : (y, x), in sides of the picture.  turn : radians, clockwise.
    height : of its rim and of its top above the wall; 1 is the nearest point of the scene.
    materials : two names in `reflectances`, mixed by the pattern.
    size : of the pattern, in sides of the picture.
    """

    middle: tuple[float, float]
    half: tuple[float, float]
    turn: float
    height: tuple[float, float]
    materials: tuple[str, str]
    pattern: Pattern
    size: float = 0.01


_SKIN = ("HyspexSkinReflectance22", "HyspexSkinReflectance58")
_WALL = ("kaolini8.spc Kaolinite CM7", "goethit1.spc Goethite WS222")
_DOLL = (
    Part((0.28, -0.055), (0.22, 0.038), 0.05, (0.15, 0.35), ("p159", "p67"), "stripes", 0.022),
    Part((0.28, 0.055), (0.22, 0.038), -0.05, (0.15, 0.35), ("p159", "p67"), "stripes", 0.022),
    Part((-0.19, 0.0), (0.18, 0.16), 0.0, (0.25, 0.45), ("p46", "p73"), "hair", 0.01),
    Part((0.09, 0.0), (0.2, 0.135), 0.0, (0.4, 0.75), ("esserChart36", "p73"), "cloth", 0.01),
    Part((0.05, -0.19), (0.045, 0.15), -0.9, (0.3, 0.5), _SKIN, "grain", 0.007),
    Part((0.02, 0.19), (0.045, 0.15), 0.7, (0.55, 0.8), _SKIN, "grain", 0.007),
    Part((-0.2, 0.0), (0.12, 0.1), 0.0, (0.6, 0.95), _SKIN, "plain"),
    Part((-0.22, -0.04), (0.013, 0.018), 0.0, (0.9, 0.95), ("p34", "p34"), "plain"),
    Part((-0.22, 0.04), (0.013, 0.018), 0.0, (0.9, 0.95), ("p34", "p34"), "plain"),
    Part((-0.15, 0.0), (0.01, 0.035), 0.0, (0.9, 0.95), ("esserChart5", "p73"), "plain"),
    Part((-0.07, 0.3), (0.075, 0.075), 0.0, (0.6, 1.0), ("p28", "p14"), "dots", 0.028),
    Part((0.2, -0.33), (0.3, 0.012), 0.12, (0.8, 0.85), ("esserChart24", "p46"), "grain", 0.01),
    Part((0.33, 0.3), (0.09, 0.14), 0.3, (0.2, 0.5), ("p165", "p165"), "plain"),
)


def solid_scene(
    wavelength: np.ndarray,
    size: int = 250,
    *,
    distance: float = 200.0,
    relief: float = 40.0,
    light: str = CHART_LIGHT,
    seed: int = 0,
) -> tuple[DataArray, np.ndarray]:
    """Build a doll with a ball and a stick before a wall, of measured materials under one lamp.

    It holds what makes depth hard: surfaces that hide each other, round and slanted ones, a thin
    stick, skin without texture, a nearly black box.

    Parameters
    ----------
    wavelength : array, (K,)
        nm, within 500-750.
    size : int
        Height and width, px.
    distance : float
        Of the middle of the relief, mm.
    relief : float
        From the wall to the nearest point, mm.
    light : str
        Name of a light in `squilla.spectra.lights`.
    seed : int
        Of the patterns and of small changes of the pose.

    Returns
    -------
    scene : DataArray, (y, x, wavelength), float32
        Photon radiance, relative to a white surface at the peak of the light.
    depth : array, (y, x)
        Distance of every sample, mm.

    Raises
    ------
    InputError
        If the relief is negative or reaches the camera, or the picture is smaller than 40 px.
    """
    if size < 40:
        raise InputError(f"A solid scene needs at least 40 px, not {size}.")
    if not (relief >= 0 and distance - relief / 2 > 0):
        raise InputError(
            f"A relief of {relief:g} mm does not fit before a camera at {distance:g} mm."
        )
    random = np.random.default_rng(seed)
    y, x = (np.mgrid[:size, :size] + 0.5) / size - 0.5
    # A curtain in folds beside a plain wall that leans back; both meet a table below.
    folds = np.clip(1 - (x + 0.5) / 0.55, 0, 1) * (0.25 - 0.25 * np.cos(22 * x + 2 * y))
    height = 0.06 * (y + 0.5) + folds + np.clip(y - 0.4, 0, None) * 2.5
    mix = np.where(x < 0.1 * np.sin(9 * y), _pattern("cloth", 0.01, y, x, random), 0.0)
    surface = _mixed(_WALL, mix, wavelength)
    shade = 0.9 - 0.6 * folds * np.sin(22 * x + 2 * y)
    for part in _DOLL:
        pose = random.normal(0, 0.006, 2)
        v, u = y - part.middle[0] - pose[0], x - part.middle[1] - pose[1]
        lean = (v + u) / max(part.half)
        cosine, sine = np.cos(part.turn), np.sin(part.turn)
        v, u = v * cosine + u * sine, u * cosine - v * sine
        radius = (v / part.half[0]) ** 2 + (u / part.half[1]) ** 2
        rim, top = part.height
        own = rim + (top - rim) * np.sqrt(np.clip(1 - radius, 0, None))
        front = (radius < 1) & (own > height)
        mix = _pattern(part.pattern, part.size, v, u, random)
        height, shade = np.where(front, (own, 0.8 - 0.18 * lean), (height, shade))
        surface[front] = _mixed(part.materials, mix[front], wavelength)
    depth = distance + relief * (0.5 - np.clip(height, 0, 1))
    lamp = lights().one(light, wavelength).astype(np.float32)
    scene = surface * lamp * shade[..., None].astype(np.float32)
    return labelled(scene, wavelength, attributes={"name": "doll", "light": light}), depth


def _mixed(materials: tuple[str, str], mix: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    one, other = (reflectances().one(name, wavelength).astype(np.float32) for name in materials)
    return one + mix[..., None].astype(np.float32) * (other - one)


def _pattern(
    kind: Pattern, size: float, v: np.ndarray, u: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Return how two materials mix, 0..1, at a part's own coordinates."""
    if kind == "plain":
        return np.zeros_like(u)
    if kind == "dots":
        phase = 2 * np.pi / size
        return (np.cos(phase * v) * np.cos(phase * u) > 0.35).astype(float)
    pixels = size * len(u)
    if kind == "hair":
        noise = gaussian_filter(random.standard_normal(u.shape), (3 * pixels, 0.3 * pixels))
    else:
        fine, coarse = (
            gaussian_filter(random.standard_normal(u.shape), scale * pixels) for scale in (0.35, 1)
        )
        noise = 0.35 * fine + coarse
    noise = noise / noise.std()
    if kind == "grain":  # little contrast, as skin and plaster have
        return np.clip(0.3 + 0.25 * noise, 0, 1)
    if kind == "stripes":
        return np.clip(0.5 + np.sin(2 * np.pi * v / size) + 0.2 * noise, 0, 1)
    return np.clip(0.5 + 0.35 * noise, 0, 1)
