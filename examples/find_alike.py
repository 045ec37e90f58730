"""Where else is this? A click on one point of a cube, and all that has its spectrum."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import squilla as sq
from squilla.calibration.rehearsal import ideal_calibration
from squilla.spectra import grid

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
camera = sq.Camera("thesis")
calibration = ideal_calibration(camera)
scene = sq.load_scene("indian-pines", grid(500, 750, 1), 250)
measurement = sq.measure(camera.capture(scene, snr=30), calibration)
cube = sq.load_model("compound", calibration).reconstruct(measurement)

row, column = 55, 95
wanted = cube.squilla.spectrum(row, column, 2).values
norms = np.linalg.norm(cube.values, axis=-1) * np.linalg.norm(wanted)
angle = np.degrees(np.arccos(np.clip(cube.values @ wanted / norms, -1, 1)))

figure, (picture, alike, plot) = plt.subplots(1, 3, figsize=(9.5, 3), layout="constrained")
picture.imshow(cube.squilla.rgb())
picture.plot(column, row, "o", color="#d1495b", markeredgecolor="white")
picture.set_title("one point")
shown = alike.imshow(angle, cmap="magma_r", vmax=np.percentile(angle, 98))
alike.set_title("spectral angle to it, degrees")
figure.colorbar(shown, ax=alike, shrink=0.8)
near, far = np.percentile(angle, (10, 90))
for name, chosen in (("the tenth most alike", angle < near), ("most unlike", angle > far)):
    some = cube.values[chosen]
    some = some / some.max(-1, keepdims=True)
    low, middle, high = np.percentile(some, (10, 50, 90), axis=0)
    plot.fill_between(cube.wavelength, low, high, alpha=0.3)
    plot.plot(cube.wavelength, middle, label=name)
plot.set(xlabel="wavelength, nm", ylabel="relative radiance", yticks=[])
plot.legend(frameon=False, fontsize="small")
for each in (picture, alike):
    each.set(xticks=[], yticks=[])
figure.savefig(folder / "find_alike.webp", dpi=110)
