"""One model for every camera: a mosaic sensor of sixteen filters, and no training for it."""

import sys
from importlib.resources import files
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.io import loadmat

import squilla as sq
from squilla.spectra import grid

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
wavelength = grid(500, 750, 1)

# The measured responses of a mosaic sensor; any (M, K) matrix will do.
measured = files("squilla") / "data" / "responses" / "spectral_responses_4x4.mat"
response = loadmat(str(measured))["SpectralProfiles"][:, 100:351]
calibration = sq.Calibration.from_sensitivity(response, wavelength)

# What that camera would see of a real scene at 25 dB, its channels laid upon each other.
scene = sq.load_scene("indian-pines", wavelength, 200)
y = scene.values @ response.T
random = np.random.default_rng(0)
y += np.sqrt(np.mean(y**2)) * 10 ** (-25 / 20) * random.standard_normal(y.shape)
measurement = sq.Measurement.of(y, snr=25)

figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
axes[0].imshow(scene.squilla.rgb())
axes[0].set_title("truth")
places = {"#0f8b8d": (60, 40), "#d1495b": (150, 120), "#30638e": (100, 170)}
for axis, name in zip(axes[1:3], ("ridge", "compound"), strict=True):
    cube = sq.load_model(name, calibration).reconstruct(measurement)
    error = sq.evaluate(cube, scene)["mse"]
    axis.imshow(cube.squilla.rgb())
    axis.set_title(f"{name}: MSE {error:.5f}")
    for colour, (row, column) in places.items():
        style = {"ridge": ":", "compound": "-"}[name]
        axes[3].plot(wavelength, cube.squilla.spectrum(row, column), style, color=colour)
for colour, (row, column) in places.items():
    axes[3].plot(wavelength, scene.squilla.spectrum(row, column), color=colour, alpha=0.3, lw=4)
    axes[0].plot(column, row, "o", color=colour, markeredgecolor="white")
axes[3].set(
    title="pale: truth; dotted: ridge", xlabel="wavelength, nm", ylabel="photon radiance", yticks=[]
)
for each in axes[:3]:
    each.set(xticks=[], yticks=[])
figure.savefig(folder / "any_camera.webp", dpi=110)
