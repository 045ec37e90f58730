"""A solid scene from one exposure: how far every point is, and its spectrum without false edges."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import squilla as sq
from squilla.calibration.rehearsal import ideal_calibration
from squilla.camera.solid import solid_scene
from squilla.spectra import CHART_LIGHT, grid, lights

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
wavelength = grid(500, 750, 1)
light = lights().on(wavelength)[lights().name.index(CHART_LIGHT)]

camera = sq.Camera("thesis")
calibration = ideal_calibration(camera)
scene, distance = solid_scene(wavelength)
raw = camera.capture(scene, depth=distance, snr=30)

model = sq.load_model("ridge", calibration)
flat = model.reconstruct(sq.measure(raw, calibration))  # one distance for all, as a plane
relief = sq.measure(raw, calibration, depth=True)  # a distance for every point
cube = model.reconstruct(relief)

figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
axes[0].imshow(flat.squilla.rgb(white=light))
axes[0].set_title("taken for a plane")
axes[1].imshow(cube.squilla.rgb(white=light))
axes[1].set_title("with its depth")
distance = np.where(relief.depth.confident, relief.depth.distance, np.nan)
shown = axes[2].imshow(distance, cmap="viridis_r")
axes[2].set_title("distance, mm; white: no texture to tell")
figure.colorbar(shown, ax=axes[2], shrink=0.8)
for each in axes:
    each.set(xticks=[], yticks=[])
figure.savefig(folder / "relief.webp", dpi=110)
