"""Depth maps: one distance for each point of a scene."""

from pathlib import Path

import numpy as np

from squilla.errors import InputError
from squilla.files.disk import existing, reading
from squilla.files.tiff import read_pages


def read_depth(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Read a depth map, cut to its middle square and resized to `shape`, as scenes are.

    Parameters
    ----------
    path : Path
        .npy, or a TIFF of one page.
    shape : (int, int)
        Rows and columns wanted.

    Returns
    -------
    array, (y, x) float64, mm

    Raises
    ------
    InputError
        If the file is missing, damaged, or no single picture.
    """
    with reading(existing(path), "depth map"):
        if path.suffix.lower() == ".npy":
            depth = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
        else:
            depth = read_pages(path)
    depth = depth[0] if depth.ndim == 3 and len(depth) == 1 else depth
    if depth.ndim != 2 or depth.size == 0 or depth.dtype.kind not in "uif":
        raise InputError(f"The depth map {path} must be one picture of distances in mm.")
    if depth.shape != tuple(shape):
        from scipy.ndimage import zoom

        side = min(depth.shape)
        top, left = ((length - side) // 2 for length in depth.shape)
        square = depth[top : top + side, left : left + side].astype(float)
        factor = np.divide(shape, side)
        depth = np.asarray(zoom(square, factor, order=1, mode="nearest", grid_mode=True))
    return depth.astype(float)
