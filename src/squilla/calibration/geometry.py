"""Where the sub-images lie: found in a flat frame, refined with a textured target."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from squilla.calibration.calibration import Lattice
from squilla.calibration.disparity import find_plane
from squilla.calibration.edges import find_edges
from squilla.calibration.views import windows
from squilla.camera.design import CameraDesign
from squilla.errors import InputError

_LOOSE = 3.0
"""How far lenses may lie beside the places that a flat shows, px (standard deviation)."""


def find_windows(flat: np.ndarray, shape: tuple[int, int], pitch: float) -> np.ndarray:
    """Find the middle of every sub-image's lit window in a flat frame.

    Nothing is assumed of position and rotation (within a few degrees); dark filters may be lost
    and are then filled in from the lattice of the others.

    Parameters
    ----------
    flat : array, (rows, columns)
        Mean flat frame without the dark, DN.
    shape : (int, int)
        Rows and columns of the array.
    pitch : float
        Nominal distance of the windows, px.

    Returns
    -------
    array, (M, 2)
        px (y, x), row by row.

    Raises
    ------
    InputError
        If no lattice of this shape is seen.
    """
    middles = _lit_areas(flat, pitch)
    units = shape[0] * shape[1]
    if len(middles) < max(2, units // 2):
        raise InputError(
            f"The flat frame shows {len(middles)} separate sub-images about {pitch:.0f} px apart, "
            f"of {units}: check the flat's exposure, the aperture stop and the camera design."
        )
    position = _index(middles, pitch)
    position -= position.min(0)
    if tuple(position.max(0) + 1) != tuple(shape):
        found = " x ".join(map(str, position.max(0) + 1))
        raise InputError(
            f"The flat frame shows {found} sub-images, the design has {shape[0]} x {shape[1]}."
        )
    rows, columns = np.mgrid[: shape[0], : shape[1]].reshape(2, -1)
    every = np.stack([np.ones(units), rows, columns], -1)
    known = np.column_stack([np.ones(len(position)), position])
    fit, *_ = np.linalg.lstsq(known, middles, rcond=None)
    fine = np.array([_middle_of_window(flat, guess, pitch) for guess in every @ fit])
    seen = np.isfinite(fine).all(1)
    if seen.sum() < max(3, units // 2):
        raise InputError("The edges of the sub-images are not sharp enough in the flat frame.")
    fit, *_ = np.linalg.lstsq(every[seen], fine[seen], rcond=None)
    fine[~seen] = (every @ fit)[~seen]
    return fine


def _lit_areas(flat: np.ndarray, pitch: float) -> np.ndarray:
    """Return the middles of separate bright areas of about the right size, (N, 2) px.

    Filters differ in brightness, so several thresholds are tried and each area is taken from the
    first that separates it.
    """
    block = max(1, round(pitch / 200))
    size = [length - length % block for length in flat.shape]
    coarse = flat[: size[0], : size[1]]
    coarse = coarse.reshape(size[0] // block, block, size[1] // block, block).mean((1, 3))
    middles = []
    for level in (0.03, 0.06, 0.12, 0.25, 0.5):
        label = np.empty(coarse.shape, np.int32)
        ndimage.label(coarse > level * float(np.percentile(coarse, 99)), output=label)
        for box in ndimage.find_objects(label):
            if all(0.7 * pitch < block * (part.stop - part.start) < 1.1 * pitch for part in box):
                middle = [block * (part.start + part.stop) / 2 - 0.5 for part in box]
                if all(np.abs(np.subtract(middle, other)).max() > pitch / 2 for other in middles):
                    middles.append(middle)
    return np.array(middles).reshape(-1, 2)


def _index(middles: np.ndarray, pitch: float) -> np.ndarray:
    """Give each of some lattice points its whole row and column against the first."""
    step = middles[None] - middles[:, None]
    across = step[
        (np.abs(step[..., 1] - pitch) < 0.15 * pitch) & (np.abs(step[..., 0]) < 0.15 * pitch)
    ]
    down = step[
        (np.abs(step[..., 0] - pitch) < 0.15 * pitch) & (np.abs(step[..., 1]) < 0.15 * pitch)
    ]
    if not len(across) and not len(down):
        raise InputError(
            f"The lit areas of the flat frame do not lie {pitch:.0f} px apart, as the design says."
        )
    # In a single row or column the other direction is at right angles to it.
    right = np.median(across, 0) if len(across) else np.median(down, 0)[::-1] * [-1, 1]
    below = np.median(down, 0) if len(down) else right[::-1] * [1, -1]
    basis = np.stack([below, right])
    return np.rint((middles - middles[0]) @ np.linalg.inv(basis)).astype(int)


def _middle_of_window(flat: np.ndarray, guess: np.ndarray, pitch: float) -> np.ndarray:
    """Return the middle between the half-level edges of a lit window, px; NaN if one is missing."""
    middle, half, reach = np.empty(2), 0.47 * pitch, round(0.1 * pitch)
    for axis in (0, 1):
        lines = flat if axis == 0 else flat.T
        y, x = guess[axis], guess[1 - axis]
        span = slice(max(int(x - half / 2), 0), int(x + half / 2))
        ends = []
        for side in (-1, 1):
            # From well inside the expected edge outwards.
            path = np.rint(y + side * (half - reach + np.arange(2 * reach))).astype(int)
            if path.min() < 0 or path.max() >= len(lines):
                return np.full(2, np.nan)
            profile = lines[path, span].mean(1)
            ends.append(path[0] + side * _half_level(profile, pitch))
        middle[axis] = np.mean(ends)
    return middle


def _half_level(profile: np.ndarray, pitch: float) -> float:
    """Return where a profile that leaves a plateau has fallen to half of it, in samples.

    The plateau slopes with the filter's angle; its line is drawn on through the penumbra, which is
    about 0.02 pitches to each side of the edge.
    """
    rough = int(np.argmax(profile < 0.5 * np.median(profile[: len(profile) // 4])))
    inside = np.arange(max(rough - round(0.08 * pitch), 0), rough - round(0.025 * pitch))
    if len(inside) < 3:
        return np.nan
    slope, level = np.polyfit(inside, profile[inside], 1)
    floor = profile[rough:].min()
    share = (profile - floor) / (level + slope * np.arange(len(profile)) - floor)
    at = int(np.argmax(share < 0.5))
    return at - 1 + (share[at - 1] - 0.5) / (share[at - 1] - share[at])


def lattice_from_flat(flat: np.ndarray, design: CameraDesign) -> Lattice:
    """Return the lattice as a flat frame shows it.

    What lights a sub-image is the aperture stop at a finite distance D, so the windows lie wider
    apart than the lenses by 1 + f / D; the design knows both. The middle of the array is taken to
    face the middle of the stop. Walls light it straight through the lens.

    Parameters
    ----------
    flat : array, (rows, columns)
        Mean flat frame without the dark, DN.
    design : CameraDesign
        For the nominal pitch, the stop and the focal length.
    """
    if design.stop is None and design.walls is None:
        raise InputError(
            "Without an aperture stop or walls the sub-images overlap; a flat frame cannot tell "
            "them apart."
        )
    wider = 1.0
    if design.stop is not None:
        wider += design.lens.focal_length / (1000 * design.stop.distance)
    shape = (design.array.rows, design.array.columns)
    found = find_windows(flat, shape, design.pitch * wider)
    middle = found.mean(0)
    centre = middle + (found - middle) / wider
    return lattice_at(design, centre)


def lattice_at(design: CameraDesign, centre: np.ndarray) -> Lattice:
    """Return the lattice of a design with its units at these places, (M, 2) px."""
    reference = design.field.reference
    return Lattice(
        shape=(design.array.rows, design.array.columns),
        centre=centre,
        baseline=(centre - centre[reference]) / design.pitch,
        reference=reference,
        field=(design.field.size, design.field.size),
        focal=design.focal,
        pitch=design.pitch,
        pixel=design.sensor.pixel,
        usual=design.lens.focus_distance,
    )


def refine_with_target(
    corrected: np.ndarray, lattice: Lattice, distance: float
) -> tuple[Lattice, float]:
    """Refine centres and baselines with one frame of a textured plane at a known distance.

    The shifts between the sub-images of the target are (1 + f / distance) times the distances of
    the lenses, lens by lens.

    Parameters
    ----------
    corrected : array, (rows, columns)
        Frame of the target, corrected for dark and flat.
    lattice : Lattice
        Right to a few px, as `lattice_from_flat` makes it.
    distance : float
        mm.

    Returns
    -------
    lattice : Lattice
    score : float
        Mean correlation of the sub-images' edges, 0..1.

    Raises
    ------
    InputError
        If the target has too little texture to see shifts by.
    """
    disparity = lattice.disparity(distance)
    margin = 4
    at_target = replace(lattice, centre=lattice.centre + disparity * lattice.baseline)
    origin, images = windows(corrected, at_target, margin)
    start = at_target.centre - origin - (np.array(lattice.field) - 1) / 2 - margin
    found = find_plane(find_edges(images), at_target, start, (0.0, 0.0), free=_LOOSE)
    if found.score < 0.3:
        raise InputError(
            f"The target's sub-images agree by {found.score:.2f} only; use a richly textured, "
            "evenly lit flat target that faces the camera."
        )
    reference = lattice.reference
    apart = start + found.offset + found.plane[0] * lattice.baseline + origin  # px on the sensor
    apart = apart - apart[reference]
    scale = 1 + disparity / lattice.pitch  # 1 + f / distance
    centre = lattice.centre.mean(0) + (apart - apart.mean(0)) / scale
    baseline = (centre - centre[reference]) / lattice.pitch
    return replace(lattice, centre=centre, baseline=baseline), found.score
