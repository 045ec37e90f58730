"""The image sensor: from light to digital numbers, with the noise of every step."""

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numba
import numpy as np
from torch import Generator

from squilla.camera.design import CameraDesign
from squilla.errors import InputError

_MANY, _FEW = 10.0, 0.05
"""Shot noise follows Poisson's law, drawn exactly up to so many electrons. Above, a normal number z
gives mean + sqrt(mean) z + (z^2 - 1) / 6, which has its skewness too (Cornish and Fisher). Below so
small a share of the read noise's variance it is added to that, which drowns its shape."""

_BANDS = 16
"""Bands of rows with a random generator each, so that noise does not depend on the threads."""


class ImageSensor:
    """A sensor with its own fixed pattern, drawn once from the design's seed.

    Parameters
    ----------
    design : CameraDesign
    """

    def __init__(self, design: CameraDesign):
        self.design = design
        self.sensor = design.sensor
        self.effects = design.effects

    @cached_property
    def response(self) -> np.ndarray:
        """Relative response of every pixel (PRNU), (rows, columns) float32."""
        shape = self.design.sensor_shape
        if not self.effects.fixed_pattern:
            return np.ones(shape, np.float32)
        random = np.random.default_rng([self.sensor.seed, 1])
        return 1 + np.float32(self.sensor.prnu) * random.standard_normal(shape, np.float32)

    @cached_property
    def dark_rate(self) -> np.ndarray:
        """Dark current of every pixel, (rows, columns) float32, e-/ms."""
        shape = self.design.sensor_shape
        rate = np.full(shape, self.sensor.dark_current / 1000, np.float32)
        if self.effects.fixed_pattern:
            random = np.random.default_rng([self.sensor.seed, 2])
            hot = random.integers(rate.size, size=round(self.sensor.hot_pixels * rate.size))
            rate.ravel()[hot] *= 2000
        return rate

    def expose(
        self, rate: np.ndarray, exposure: float, *, generator: Generator | None = None
    ) -> np.ndarray:
        """Take one frame.

        Parameters
        ----------
        rate : array, (rows, columns)
            Photoelectrons per ms.
        exposure : float
            ms.
        generator : torch.Generator, optional
            Seeds the noise; the same generator state gives the same frame on any number of threads.

        Returns
        -------
        array, (rows, columns), uint16, DN
        """
        import torch

        seed = int(torch.randint(2**31, (1,), generator=generator))
        sensor, effects = self.sensor, self.effects
        frame = np.empty(rate.shape, np.uint16)
        read_noise = sensor.read_noise if effects.read_noise else 0.0
        scale = (sensor.gain, sensor.black_level, 2**sensor.bits - 1)
        rate = np.ascontiguousarray(rate, np.float32)

        def take(band: int) -> None:
            rows = slice(band * len(rate) // _BANDS, (band + 1) * len(rate) // _BANDS)
            random = np.random.Generator(np.random.SFC64([seed, band]))
            mean = (rate[rows], self.response[rows], self.dark_rate[rows], exposure)
            _expose(*mean, effects.shot_noise, read_noise, *scale, random, frame[rows])

        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            list(pool.map(take, range(_BANDS)))
        return frame

    def exposure_for(self, rate: np.ndarray, snr: float) -> float:
        """Return the exposure at which the pixels given have a wanted signal-to-noise ratio.

        The signal is the root mean square of the photoelectrons; the noise that of shot, dark,
        read and quantisation noise together.

        Parameters
        ----------
        rate : array
            Photoelectrons per ms of the pixels that count.
        snr : float
            dB, 20 log10 of the ratio of amplitudes.

        Returns
        -------
        float, ms

        Raises
        ------
        InputError
            If the pixels are dark, or would saturate before they reach this ratio.
        """
        if not np.isfinite(snr):
            raise InputError(f"The SNR must be a number of dB, not {snr:g}.")
        signal = float(np.mean(np.square(rate, dtype=np.float64)))
        if signal <= 0:
            raise InputError("The scene sends no light to the sensor; no exposure reaches an SNR.")
        ratio = 10 ** (snr / 10)
        growing = self._growing_noise(rate)
        fixed = self._fixed_noise()
        exposure = ratio * growing + np.sqrt((ratio * growing) ** 2 + 4 * signal * ratio * fixed)
        exposure = float(exposure / (2 * signal))
        longest = self.sensor.full_well / float(rate.max())
        if exposure > longest:
            reached = signal * longest**2 / (growing * longest + fixed)
            raise InputError(
                f"An SNR of {snr:g} dB saturates the sensor; one exposure of this scene reaches "
                f"{10 * np.log10(reached):.1f} dB."
            )
        return exposure

    def _growing_noise(self, rate: np.ndarray) -> float:
        """Return the noise variance that grows with exposure, e-^2 per ms."""
        if not self.effects.shot_noise:
            return 0.0
        return float(rate.mean(dtype=np.float64)) + self.sensor.dark_current / 1000

    def _fixed_noise(self) -> float:
        """Return the noise variance that every frame has, e-^2."""
        read = self.sensor.read_noise**2 if self.effects.read_noise else 0.0
        return read + self.sensor.gain**2 / 12


@numba.njit(nogil=True, cache=True)
def _expose(
    rate, response, dark, exposure, shot_noise, read_noise, gain, black, top, random, frame
):
    rows, columns = rate.shape
    for row in range(rows):
        for column in range(columns):
            mean = (rate[row, column] * response[row, column] + dark[row, column]) * exposure
            electrons, variance = mean, read_noise**2
            if shot_noise:
                if mean > _MANY:
                    normal = random.standard_normal()
                    electrons = np.rint(mean + np.sqrt(mean) * normal + (normal**2 - 1) / 6)
                elif mean > _FEW * variance:
                    electrons = float(random.poisson(mean))
                else:
                    variance += mean
            if variance > 0:
                electrons += np.sqrt(variance) * random.standard_normal()
            # The top of the scale is the full well: clipping the number clips the electrons.
            level = np.rint(electrons / gain + black)
            frame[row, column] = np.uint16(min(max(level, 0.0), top))
