"""Time cubes and raw frames to and from the disk beside what NumPy and SPy do with them.

Usage: python benchmarks/files.py [folder]
"""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import spectral
from timing import seconds

from squilla.files.cube import labelled, load_cube, save
from squilla.files.raw import Raw, read_raw, write_raw
from squilla.spectra import grid


def synced(path, write):
    """Write and hand the file through to the disk, as `save` does."""
    write()
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def main(folder: Path) -> None:
    random = np.random.default_rng(0)
    cube = labelled(random.random((250, 250, 251), dtype=np.float32), grid())
    frame = Raw(random.integers(0, 4096, (3000, 4000), dtype=np.uint16), 10.0)
    array, header = folder / "n.npy", folder / "s.hdr"

    def spy_save():
        spectral.envi.save_image(str(header), cube.values, force=True)

    rows = {
        "cube, NumPy .npy": (
            lambda: synced(array, lambda: np.save(array, cube.values)),
            lambda: np.load(array),
        ),
        "cube, SPy .hdr": (
            lambda: synced(header.with_suffix(".img"), spy_save),
            lambda: spectral.open_image(str(header)).load(),
        ),
    }
    for suffix in (".nc", ".hdr", ".tiff", ".zarr"):
        path = folder / f"c{suffix}"
        rows[f"cube, squilla {suffix}"] = (
            lambda path=path: save(cube, path),
            lambda path=path: load_cube(path),
        )
    for suffix in (".npy", ".tiff", ".raw", ".png"):
        path = folder / f"f{suffix}"
        rows[f"frame, squilla {suffix}"] = (
            lambda path=path: write_raw(path, frame),
            lambda path=path: read_raw(path),
        )
    print("cube 250 x 250 x 251 float32 (63 MB), frame 3000 x 4000 uint16 (24 MB), both of noise;")
    print("written through to the disk, read from the system's cache; median of 5, s\n")
    print(f"{'':24}{'write':>8}{'read':>8}")
    for name, (write, read) in rows.items():
        print(f"{name:24}{seconds(write):8.3f}{seconds(read):8.3f}")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as place:
        main(Path(place))
