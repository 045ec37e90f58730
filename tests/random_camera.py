"""Cameras for tests: random smooth broadband sensitivities, as thin-film stacks have them."""

import numpy as np

from squilla.calibration.calibration import Calibration


def smooth_camera(seed=0, filters=36, bands=251, angles=1) -> Calibration:
    """Return a camera whose filters are sums of sinusoids in 1/wavelength, shifted by angle."""
    random = np.random.default_rng(seed)
    wavelength = np.linspace(500.0, 750.0, bands)
    angle = np.radians(np.linspace(0, 9, angles)) if angles > 1 else np.zeros(1)
    order = random.uniform(0.3, 10, (filters, 6))
    phase = random.uniform(0, 2 * np.pi, (filters, 6))
    depth = random.uniform(0.2, 1, (filters, 6)) / order**0.3
    matrices = []
    for field in angle:
        shifted = wavelength / np.sqrt(1 - (np.sin(field) / 1.75) ** 2)
        position = (1 / shifted - 1 / 750) / (1 / 500 - 1 / 750)
        wave = depth[..., None] * np.cos(2 * np.pi * order[..., None] * position + phase[..., None])
        total = wave.sum(1) / depth.sum(1)[:, None]
        matrices.append((0.5 + 0.48 * total) * (0.9 - 0.4 * (wavelength - 500) / 250))
    return Calibration.from_sensitivity(np.stack(matrices), wavelength, angle)
