"""Frames of the twin at the pace of a camera: noise fast enough for twelve megapixels live."""

from collections.abc import Iterable, Iterator

import numba
import numpy as np
from xarray import DataArray

from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.live.connection import Region

_QUANTILES = 1 << 16

POSES = 8
"""Steps of half a swing of a moving scene."""


class TwinFrames:
    """What the twin's sensor shows of a few unchanging views, frame after frame.

    Parameters
    ----------
    camera : Camera
    rates : iterable of array, (rows, columns)
        Photoelectrons per ms, as `Camera.rate` returns them; frames go through them there and back.
        More may be added with `add`.
    seed : int
        Of the noise.

    Notes
    -----
    `ImageSensor.expose` draws every electron by its law and takes some tenths of a second. Here
    light, dark current and read noise together are one number for each pixel,

        e = m + sqrt(v) z + m / v (z^2 - 1) / 6,    v = m + read noise^2,

    which has the mean, the variance and the skewness of Poisson's m electrons with read noise on
    top (Cornish and Fisher). The normal number z is looked up among 65 536 quantiles by a hash of
    frame number, row and column, so it is independent in space and time, reaches 4.3 standard
    deviations and is the same each time the same frame is asked for.
    """

    def __init__(self, camera: Camera, rates: Iterable[np.ndarray], seed: int = 0):
        self.design, self.serial, self.seed = camera.design, camera.serial, seed
        self._sensor, self._normal = camera.sensor, _normal_quantiles()
        self.means: list[np.ndarray] = []
        for rate in rates:
            self.add(rate)

    def add(self, rate: np.ndarray) -> None:
        """Add a view at the end of the movement."""
        if rate.shape != self.design.sensor_shape:
            raise InputError(
                f"Frames need pictures of {self.design.sensor_shape} px of electrons per ms, not "
                f"of {rate.shape}."
            )
        mean = rate * self._sensor.response + self._sensor.dark_rate
        self.means.append(mean.astype(np.float32, copy=False))

    @property
    def bright_exposure(self) -> float:
        """Exposure at which the brighter pixels fill seven tenths of the scale, ms."""
        light = max(float(np.percentile(mean[::8, ::8], 99.5)) for mean in self.means)
        return float(np.clip(0.7 * self.design.sensor.full_well / max(light, 1e-9), 0.01, 1e4))

    def draw(
        self, number: int, exposure: float, gain: float = 0.0, region: Region | None = None
    ) -> np.ndarray:
        """Return a frame.

        Parameters
        ----------
        number : int
            Which frame: the same number gives the same frame.
        exposure : float
            ms.
        gain : float
            dB above the gain at which the full well fills the scale.
        region : Region, optional
            Part of the sensor that is read; all of it if not given.

        Returns
        -------
        array, (rows, columns) uint16, DN
        """
        effects, sensor = self.design.effects, self.design.sensor
        part = region or Region(*self.design.sensor_shape)
        last = len(self.means) - 1
        step = number % max(2 * last, 1)
        mean = self.means[min(step, 2 * last - step)]
        mean = mean[part.row : part.row + part.rows, part.column : part.column + part.columns]
        frame = np.empty(mean.shape, np.uint16)
        read_noise = sensor.read_noise if effects.read_noise else 0.0
        _expose(
            mean,
            np.float32(exposure),
            np.float32(effects.shot_noise),
            np.float32(read_noise**2),
            np.float32(10 ** (gain / 20) / sensor.gain),
            np.float32(sensor.black_level + 0.5),
            np.float32(2**sensor.bits - 1),
            np.random.default_rng([self.seed, number]).integers(2**32, dtype=np.uint32),
            self._normal,
            frame,
        )
        return frame


def views(
    camera: Camera,
    scene: str | DataArray,
    distance: float = 300.0,
    *,
    moving: bool = False,
) -> Iterator[np.ndarray]:
    """Go through what falls on the sensor, photoelectrons per ms: one view, or half a swing.

    Parameters
    ----------
    camera : Camera
    scene : str or DataArray
        "dark" for a covered lens, "white" for an even white that fills every view, what
        `load_scene` takes, or a scene.
    distance : float
        mm; of the middle, where the scene moves.
    moving : bool
        Let the scene drift, turn and come nearer, from one end of a swing to the other.
    """
    if isinstance(scene, str):
        if scene == "dark":
            yield np.zeros(camera.design.sensor_shape, np.float32)
            return
        if scene == "white":
            yield camera.flat_rate(np.ones(len(camera.design.wavelength)))
            return
        scene = load_scene(scene, camera.design.wavelength, camera.design.field.size)
    if not moving:
        yield camera.rate(scene, distance=distance)
        return
    for swing in np.sin(np.linspace(-np.pi / 2, np.pi / 2, POSES)):
        yield camera.rate(moved(scene, float(swing)), distance=distance * (1 - 0.15 * swing))


def moved(scene: DataArray, swing: float) -> DataArray:
    """Return a scene turned and shifted by its place in the swing, -1..1; its edges reflect it."""
    import torch
    from torch.nn.functional import affine_grid, grid_sample

    picture = torch.from_numpy(np.ascontiguousarray(scene.values)).permute(2, 0, 1)[None].float()
    angle, shift = np.radians(5 * swing), 0.12 * swing
    turn = [[np.cos(angle), -np.sin(angle), shift], [np.sin(angle), np.cos(angle), shift / 2]]
    where = affine_grid(torch.tensor([turn]).float(), list(picture.shape), align_corners=False)
    moved = grid_sample(picture, where, padding_mode="reflection", align_corners=False)
    return scene.copy(data=moved[0].permute(1, 2, 0).clamp_min(0).numpy())


def _normal_quantiles() -> np.ndarray:
    """Return the middles of equally likely steps of a normal number, of variance one."""
    from scipy.special import ndtri

    values = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    return (values / values.std()).astype(np.float32)


@numba.njit(inline="always")
def _hash(value):
    """Mix the bits of a 32-bit number. Source: C. Wellons, hash-prospector, "lowbias32"."""
    value = np.uint32((value ^ (value >> np.uint32(16))) * np.uint32(0x7FEB352D))
    value = np.uint32((value ^ (value >> np.uint32(15))) * np.uint32(0x846CA68B))
    return value ^ (value >> np.uint32(16))


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _expose(mean, exposure, shot, read, scale, black, top, seed, normal, frame):
    rows, columns = mean.shape
    number = np.empty(columns, np.float32)
    for row in range(rows):
        start = _hash(np.uint32(seed + np.uint32(row) * np.uint32(0x9E3779B9)))
        for column in range(columns):  # apart from the rest, which the compiler then vectorises
            number[column] = normal[_hash(np.uint32(start + np.uint32(column))) >> np.uint32(16)]
        line, pixels = mean[row], frame[row]
        for column in range(columns):
            light, z = line[column] * exposure, number[column]
            spread = shot * light + read
            skewed = shot * light / (spread + np.float32(1e-9)) * (z * z - 1) / 6
            electrons = light + np.sqrt(spread) * z + skewed
            level = electrons * scale + black
            pixels[column] = np.uint16(min(max(level, np.float32(0)), top))
