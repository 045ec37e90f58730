"""Aligning sub-images that are cut out already: from any array of lenses or of cameras."""

import numpy as np
import torch

from squilla.calibration.alignment import Measurement, align
from squilla.calibration.calibration import Lattice
from squilla.calibration.disparity import find_plane, plane_map
from squilla.calibration.edges import find_edges
from squilla.calibration.quality import colour_error, misalignment
from squilla.calibration.views import SubImages
from squilla.errors import InputError

_ALIKE = 0.4
"""Mean correlation of the views' gradients that noise does not reach when single views are free."""


def align_stack(
    images: np.ndarray,
    shape: tuple[int, int],
    *,
    reference: int | None = None,
    largest: float | None = None,
    loose: float = 3.0,
) -> Measurement:
    """Align the sub-images of an array of which nothing is known but its rows and columns.

    The scene is taken as a plane; its shift from unit to unit, its tilt, and where each unit lies
    beside the regular grid are found from the pictures themselves.

    Parameters
    ----------
    images : array, (N, H, W)
        Row by row; any unit; NaN where a pixel is not to be believed.
    shape : (int, int)
        Rows and columns of the array, such as (3, 3) or (1, 8).
    reference : int, optional
        Unit whose view the others are brought to; by default the one in the middle.
    largest : float, optional
        Largest shift looked for between neighbouring units, px, in either direction; by default
        a third of a view for the outermost.
    loose : float
        How far units may lie beside the grid, px (standard deviation).

    Returns
    -------
    Measurement
        ``y`` (H, W, N) in the unit of `images`, and ``valid``, False where a unit does not see the
        point. Field angles are unknown and zero; ``disparity`` is the shift from unit to unit, px.

    Raises
    ------
    InputError
        If the shape does not fit the number of images, or they agree nowhere.
    """
    images = np.asarray(images)
    rows, columns = shape
    if images.ndim != 3 or len(images) != rows * columns or len(images) < 2:
        raise InputError(
            f"A stack of {rows} x {columns} sub-images has the shape ({rows * columns}, H, W), "
            f"not {images.shape}."
        )
    if min(images.shape[1:]) < 32:
        raise InputError(f"Sub-images of {images.shape[1:]} px are too small; 32 px are needed.")
    middle = (rows // 2) * columns + columns // 2
    reference = middle if reference is None else reference
    if not 0 <= reference < len(images):
        raise InputError(f"The reference must be one of the units 0 to {len(images) - 1}.")
    place = np.stack(np.unravel_index(np.arange(len(images)), shape), -1).astype(float)
    baseline = place - place[reference]
    field = (images.shape[1], images.shape[2])
    lattice = Lattice(
        shape, np.zeros_like(baseline), baseline, reference, field,
        focal=np.inf, pitch=np.inf, pixel=1.0, usual=np.inf,
    )  # fmt: skip
    bad = ~np.isfinite(images)
    values = np.where(bad, 0, images).astype(np.float32)
    widest = min(field) / 3 / float(np.abs(baseline).max()) if largest is None else largest
    edges = find_edges(values, bad)
    found = find_plane(edges, lattice, 0 * baseline, (-widest, widest), free=loose)
    if found.score < _ALIKE:
        raise InputError(
            f"The sub-images agree by {found.score:.2f} only: is the array {rows} x {columns}, row "
            "by row, and does each show the same scene?"
        )
    views = SubImages(torch.from_numpy(values), torch.from_numpy(bad), found.offset, 0, 0.0)
    disparity = plane_map(found.plane, lattice).astype(np.float32)
    y, valid = align(views, lattice, disparity)
    shift = misalignment(found, lattice)
    return Measurement(
        y,
        valid,
        torch.zeros(field),
        torch.from_numpy(disparity),
        None,
        {
            "alignment": "from the scene",
            "alignment_score": found.score,
            "disparity": float(found.plane[0]),
            "misalignment": shift,
            "colour_error": colour_error(y, np.zeros(len(images)), shift),
        },
    )


def agreement(y: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return how well each view is predicted from all others, point by point, where all see.

    Where nobody knows the true alignment this tells a better one from a worse: a filter's view is
    a mixture of the others' at the same point, and no mixture of shifted ones.

    Parameters
    ----------
    y : array, (H, W, N)
    valid : array, (H, W, N) bool

    Returns
    -------
    array, (N,)
        RMS error of the best linear prediction over the standard deviation of the view; fitted on
        every other row and judged on the rows between.
    """
    points = [np.asarray(y)[k::2][np.asarray(valid)[k::2].all(-1)].astype(float) for k in (0, 1)]
    if min(map(len, points)) < 4 * y.shape[-1]:
        raise InputError("The views have too few points in common to predict one from the others.")
    error = []
    for unit in range(y.shape[-1]):
        known = [np.delete(p, unit, 1) for p in points]
        known = [np.column_stack([k, np.ones(len(k))]) for k in known]
        weight, *_ = np.linalg.lstsq(known[0], points[0][:, unit], rcond=None)
        left = points[1][:, unit] - known[1] @ weight
        error.append(np.sqrt(np.mean(left**2)) / (points[1][:, unit].std() + 1e-12))
    return np.array(error)
