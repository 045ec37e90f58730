"""Two paints that look the same and are not: what the eye cannot tell, a spectral camera can."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import squilla as sq
from squilla.calibration.rehearsal import ideal_calibration
from squilla.colour import tristimulus
from squilla.spectra import CHART_LIGHT, chart_reflectances, grid, lights

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
wavelength = grid(500, 750, 1)
light = lights().on(wavelength)[lights().name.index(CHART_LIGHT)]

# A second paint: the first, and a wave that the observer does not see under this light.
first = chart_reflectances().on(wavelength)[21]
wave = np.cos(2 * np.pi * (wavelength - 500) / 83)
seen = tristimulus(np.eye(len(wavelength)), wavelength) * light[:, None]
hidden = wave - seen @ np.linalg.lstsq(seen, wave, rcond=None)[0]
second = first + 0.9 * first.min() * hidden / np.abs(hidden).max()

# The left half of a checked cloth is of the one, the right half of the other.
rows, columns = np.indices((250, 250))
cloth = 0.7 + 0.3 * ((rows // 16 + columns // 16) % 2)
paint = np.where(columns[..., None] < 125, first, second)
scene = sq.labelled((cloth[..., None] * paint * light).astype(np.float32), wavelength)

camera = sq.Camera("thesis")
calibration = ideal_calibration(camera)
measurement = sq.measure(camera.capture(scene, snr=30), calibration)
cube = sq.load_model("compound", calibration).reconstruct(measurement)

figure, (picture, plot) = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
picture.imshow(cube.squilla.rgb(white=light))
picture.set(title="as the eye sees it", xticks=[], yticks=[])
for name, column, colour in (("left", 60, "#0f8b8d"), ("right", 190, "#d1495b")):
    true = scene.squilla.spectrum(125, column, 20)
    plot.plot(wavelength, true / true.max(), color=colour, alpha=0.4, linewidth=4)
    found = cube.squilla.spectrum(125, column, 20)
    plot.plot(wavelength, found / found.max(), color=colour, label=name)
plot.set(
    title="as the camera sees it; pale: the truth",
    xlabel="wavelength, nm",
    ylabel="relative radiance",
    yticks=[],
)
plot.legend(frameon=False)
figure.savefig(folder / "metamers.webp", dpi=110)
