"""The lattice from a few hand-held shots of a textured plane, at distances nobody measured."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from squilla.calibration.calibration import Lattice
from squilla.calibration.disparity import find_plane, plane_map
from squilla.calibration.edges import find_edges
from squilla.calibration.mixture import unmix
from squilla.calibration.views import windows
from squilla.errors import InputError

_LOOSE = 3.0
"""How far lenses may lie beside the places that a flat shows, px (standard deviation)."""

_BENT = 0.3
"""How far views are expected to be bent against the reference's, px (standard deviation)."""


def lattice_from_shots(
    shots: Iterable[np.ndarray],
    lattice: Lattice,
    *,
    distances: Mapping[int, float] | None = None,
    nearest: float = 60.0,
) -> tuple[Lattice, list[np.ndarray]]:
    """Learn centres, baselines and bent views from shots of a plane at unknown distances and tilts.

    A bundle adjustment: every shot's plane (three numbers), every unit's centre and how its view is
    bent (nine numbers along each axis) are moved together until the edges of all units agree best
    in all shots. Baselines follow from the centres, for the lenses of one array look the same way.

    Parameters
    ----------
    shots : iterable of array, (rows, columns)
        Frames corrected for dark and flat; three to ten, of different distances.
    lattice : Lattice
        Right to a few px, as `geometry.lattice_from_flat` makes it.
    distances : mapping of int to float, optional
        Distances of those shots that were measured, mm, by their number.
    nearest : float
        The shortest distance that is looked for, mm.

    Returns
    -------
    lattice : Lattice
    planes : list of array, (3,)
        Of each shot, px per pitch.

    Raises
    ------
    InputError
        If there are fewer than two shots or one has too little texture.

    Notes
    -----
    Alignment sees only shifts between units, and these only as products (1 + f / distance) times
    the distance of lenses. So shots at unknown distances leave one scale free: the lattice keeps
    the mean spacing that it came with, from the design's pitch, unless `distances` tells. A shift
    of all units together and a tilt of all planes together are free too, and are kept small.
    """
    shots = list(shots)
    if len(shots) < 2:
        raise InputError("Give at least two shots of the plane, at different distances.")
    margin = int(np.ceil(lattice.disparity(nearest) * np.abs(lattice.baseline).max())) + 8
    half = (np.array(lattice.field) - 1) / 2
    scenes, planes, offsets = [], [], []
    for number, shot in enumerate(shots):
        origin, images = windows(shot.astype(np.float32), lattice, margin)
        edges = find_edges(images)
        first = lattice.centre - origin - half
        found = find_plane(edges, lattice, first, (0.0, lattice.disparity(nearest)), free=_LOOSE)
        if found.score < 0.3:
            raise InputError(
                f"The sub-images of shot {number} agree by {found.score:.2f} only; use a richly "
                "textured, evenly lit flat thing that fills the view, and hold still."
            )
        scenes.append((edges, origin + half))
        planes.append(found.plane)
        offsets.append(found.offset)
    lattice = _moved(lattice, np.mean(offsets, 0), np.zeros((len(lattice.centre), 2, 9)))
    for _ in range(10):
        lattice, planes, change = _improve(scenes, lattice, planes, distances or {})
        if change < 0.002:
            break
    return lattice, planes


def _improve(scenes, lattice: Lattice, planes, distances):
    """Take one Gauss-Newton step of everything; also return its largest shift of a unit, px."""
    units, count = len(lattice.centre), len(scenes)
    bend = np.zeros((units, 2, 9)) if lattice.bend is None else lattice.bend
    size = units * 20 + 3 * count
    precision, pull = np.zeros((size, size)), np.zeros(size)
    for number, ((edges, corner), plane) in enumerate(zip(scenes, planes, strict=True)):
        disparity = plane_map(plane, lattice, edges.step)
        aligned = unmix(edges, lattice, lattice.centre - corner, disparity, 1)
        own_pull, own_precision = aligned.of_units(10)
        # How a unit's displacement, 10 terms along each axis, answers to every unknown: its own
        # place and bend directly, its baseline as the place over the pitch, and the plane.
        answer = np.eye(units * 20, size).reshape(units, 2, 10, size)
        for axis in (0, 1):
            own = np.arange(units) * 20 + axis * 10
            for term in range(3):
                answer[np.arange(units), axis, term, own] += plane[term] / lattice.pitch
                answer[:, axis, term, own[lattice.reference]] -= plane[term] / lattice.pitch
                at = units * 20 + 3 * number + term
                answer[:, axis, term, at] = lattice.baseline[:, axis]
        answer = answer.reshape(units * 20, size)
        precision += answer.T @ own_precision.reshape(units * 20, -1) @ answer
        pull += answer.T @ own_pull.ravel()
    doubt, known = np.full(size, 1e3), np.zeros(size)
    places = np.arange(units * 20).reshape(units, 2, 10)
    doubt[places[..., 0].ravel()] = _LOOSE
    doubt[places[..., 1:].ravel()] = _BENT
    known[places[..., 1:].ravel()] = bend.ravel()
    slopes = np.arange(units * 20, size).reshape(count, 3)[:, 1:].ravel()
    doubt[slopes], known[slopes] = 0.5, np.ravel([plane[1:] for plane in planes])
    for number, distance in distances.items():
        at = units * 20 + 3 * number
        doubt[at], known[at] = 1e-4, planes[number][0] - lattice.disparity(distance)
    precision += np.diag(doubt**-2.0)
    step = np.linalg.solve(precision, pull - known / doubt**2)
    own = step[: units * 20].reshape(units, 2, 10)
    planes = [p + s for p, s in zip(planes, step[units * 20 :].reshape(count, 3), strict=True)]
    moved = _moved(lattice, own[..., 0], bend + own[..., 1:], spaced=not distances)
    return moved, planes, float(np.abs(own[..., 0]).max())


def _moved(lattice: Lattice, offset: np.ndarray, bend: np.ndarray, spaced: bool = True) -> Lattice:
    """Return a lattice whose units lie elsewhere; where nothing else tells, as wide apart on the
    whole as before."""
    before = lattice.centre - lattice.centre.mean(0)
    after = lattice.centre + offset
    apart = after - after.mean(0)
    if spaced:
        apart = apart * np.sum(before * before) / np.sum(before * apart)
    centre = after.mean(0) - (offset.mean(0)) + apart
    baseline = (centre - centre[lattice.reference]) / lattice.pitch
    return replace(lattice, centre=centre, baseline=baseline, bend=bend)
