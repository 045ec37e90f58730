"""Your first cube: one raw frame of the twin, a calibration, a hyperspectral cube."""

import sys
from pathlib import Path

import squilla as sq

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")  # what `make demo` wrote

calibration = sq.load_calibration(folder / "calibration.nc")
measurement = sq.measure(sq.read_raw(folder / "raw.tiff"), calibration)  # aligned, (250, 250, 36)
model = sq.load_model("compound", calibration)
cube = model.reconstruct(measurement)  # DataArray (y, x, wavelength)
sq.save(cube, folder / "first.hdr")  # ENVI; .nc .zarr .tiff by suffix
print(cube.sel(wavelength=600, method="nearest").mean().item())
