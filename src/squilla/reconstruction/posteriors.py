"""Posteriors of the compound model on a processor: what `estimators.Estimators` says, cell by cell.

A view is one array, (H, W, 2 + D): noise variance, amplitude, and the shape in D directions.
"""

import math

import numpy as np

from squilla.reconstruction.estimators import BEYOND, LEADING, QUIETEST
from squilla.reconstruction.evidence import CORRECTED, UNHEARD, Camera
from squilla.reconstruction.kernels import ONE, add_product, compiled

_BEYOND = np.float32(BEYOND)

_HEARD = np.float32(math.log(UNHEARD / (1 - UNHEARD)))
"""Log odds from which on a cell is heard by itself."""

_LIKELY = np.float32(1e-6)
"""Clusters less likely than this leave no trace in a posterior."""


class CompiledCamera:
    """The matrices of a `Camera` as the kernels take them; one set for each zone."""

    def __init__(self, camera: Camera):
        zones = camera.zones

        def stacked(name: str) -> np.ndarray:
            return np.ascontiguousarray(np.stack([getattr(zone, name) for zone in zones]))

        self.channels = np.float32(camera.channels)
        self.basis, self.knots = zones[0].knots.shape
        self.project = camera.project.numpy()
        self.flat = np.ascontiguousarray(camera.project[:, -1].numpy())
        self.quiet, self.power = np.ascontiguousarray(camera.quiet.numpy()), camera.power.numpy()
        self.vectors, self.spread, gain = map(stacked, ("vectors", "power", "gain"))
        self.gains = [np.ascontiguousarray(gain[..., :size]) for size in CORRECTED]
        learnt, scores = zones[0].learnt, stacked("scores")  # (Z, D, G, D)
        known = scores[:, :, :learnt].reshape(*scores.shape[:2], -1)
        self.mixture = (
            zones[0].directions,
            np.concatenate([known, stacked("middle")], -1),
            np.ascontiguousarray(scores[:, :, learnt:].swapaxes(1, 2)),
            stacked("reach"),
            stacked("offset"),
            stacked("cluster_power"),
            stacked("cluster_gain"),
            stacked("mean"),
            stacked("log_share"),
            stacked("within"),
            np.ascontiguousarray(zones[0].knots[:LEADING]),
        )


@compiled
def by_zone(first, last, view, zone, matrices, product):
    """Multiply the shape of every cell by the matrix of its zone: a run of one zone at a time."""
    width = view.shape[1]
    shape = np.empty((width, matrices.shape[1]), np.float32)
    for row in range(first, last):
        start = 0
        while start < width:
            where, stop = zone[row, start], start
            while stop < width and zone[row, stop] == where:
                shape[stop] = view[row, stop, 2:]
                stop += 1
            np.dot(shape[start:stop], matrices[where], product[row][start:stop])
            start = stop


@compiled
def wiener(first, last, view, zone, alone, misfit, vectors, power, gain, own):
    """Write the linear estimate of `Estimators.wiener`, as many coefficients as `own` has.

    Of cells that are not heard, by the log odds `alone`, it is left at zero.
    """
    width, size = zone.shape[1], own.shape[2]
    heard = np.empty(width, np.int64)
    shape = np.empty((width, vectors.shape[1]), np.float32)
    score = np.empty((width, vectors.shape[2]), np.float32)
    estimate = np.empty((width, size), np.float32)
    for row in range(first, last):
        own[row] = 0
        column = 0
        while column < width:
            where, count = zone[row, column], 0
            while column < width and zone[row, column] == where:
                if alone[row, column] >= _HEARD:
                    heard[count], shape[count] = column, view[row, column, 2:]
                    count += 1
                column += 1
            if not count:
                continue
            np.dot(shape[:count], vectors[where], score[:count])
            for k in range(count):
                noise = view[row, heard[k], 0] + misfit
                for i in range(score.shape[1]):
                    score[k, i] /= power[where, i] + noise
            np.dot(score[:count], gain[where], estimate[:count])
            for k in range(count):
                own[row, heard[k]] = estimate[k]


@compiled
def mixture(
    first, last, view, zone, misfit, seeing, scores, pieces, reach, offset, power, gain, mean,
    log_share, within, knots, found, variance, evidence,
):  # fmt: skip
    """Write the posterior of `Estimators.mixture`; clusters without a say are left out.

    seeing : directions in which the camera sees anything.
    scores : matrices that tell of each cell how it scores with what was learnt, and how far it goes
        along the middle of each piece.
    variance : left out if it has no knots.
    """
    row_scores = np.empty((1, view.shape[1], scores.shape[2]), np.float32)  # stay in the cache
    for row in range(first, last):
        one = slice(row, row + 1)
        by_zone(0, 1, view[one], zone[one], scores, row_scores)
        _mixed(
            row_scores[0], view[row], zone[row], misfit, seeing, pieces, reach, offset, power, gain,
            mean, log_share, within, knots, found[row], variance[row], evidence[row],
        )  # fmt: skip


@compiled
def _mixed(
    scores, view, zone, misfit, seeing, pieces, reach, offset, power, gain, mean, log_share,
    within, knots, found, variance, evidence,
):  # fmt: skip
    """Do the work of `mixture` for one row."""
    clusters, directions = power.shape[1:]
    size, nodes, learnt = found.shape[1], log_share.shape[1], clusters - reach.shape[1]
    scaled = np.empty(directions, np.float32)
    score = np.empty((clusters, directions), np.float32)
    each = np.empty((clusters, size), np.float32)
    weight = np.empty(clusters, np.float32)
    likely = np.empty(clusters, np.int64)
    for column in range(found.shape[0]):
        seen, where, cell = scores[column], zone[column], view[column, 2:]
        noise = view[column, 0] + misfit
        count = learnt
        for k in range(learnt):
            likely[k] = k
            own, shift = score[k], offset[where, k]
            for i in range(directions):
                own[i] = seen[k * directions + i] - shift[i]
        beside, closest = -_BEYOND * np.float32(seeing) * noise, np.float32(-np.inf)
        for i in range(directions):
            beside += cell[i] * cell[i]
        along, wide = seen[learnt * directions :], reach[where]
        for piece in range(wide.size):
            closest = max(closest, along[piece] * along[piece] + wide[piece])
        if closest >= beside:
            for piece in range(wide.size):
                if along[piece] * along[piece] + wide[piece] >= beside:
                    k = learnt + piece
                    likely[count] = k
                    count += 1
                    score[k] = -offset[where, k]
                    add_product(cell, pieces[where, piece], score[k])
        place = min(max(math.log10(noise) * 2 + 2 * QUIETEST, 0.0), nodes - 1.0)
        low = min(int(place), nodes - 2)
        high = np.float32(place - low)
        tables, most = log_share[where], np.float32(-np.inf)
        for k in likely[:count]:
            unlike, own, known = np.float32(0), score[k], power[where, k]
            for i in range(directions):
                unlike += own[i] * own[i] / (known[i] + noise)
            weight[k] = (ONE - high) * tables[low, k] + high * tables[low + 1, k] - unlike / 2
            most = max(most, weight[k])
        total = np.float32(0)
        for k in likely[:count]:
            weight[k] = math.exp(weight[k] - most)
            total += weight[k]
        each_direction = np.float32((most + math.log(total)) / seeing)
        evidence[column] = min(max(each_direction, np.float32(-20)), np.float32(20))
        mixed = found[column]
        mixed[:] = 0
        for k in likely[:count]:
            weight[k] /= total
            if weight[k] < _LIKELY:
                continue
            own, known = score[k], power[where, k]
            for i in range(directions):
                scaled[i] = own[i] / (known[i] + noise)
            each[k] = mean[where, k]
            add_product(scaled, gain[where, k], each[k])
            for i in range(size):
                mixed[i] += weight[k] * each[k, i]
        if variance.size:
            spread = variance[column]
            spread[:] = 0
            for k in likely[:count]:
                if weight[k] >= _LIKELY:
                    near, far = within[where, low, k], within[where, low + 1, k]
                    _add_spread(weight[k], near, far, high, each[k], mixed, knots, spread)


@compiled
def _add_spread(weight, near, far, high, one, mixed, knots, spread):
    """Add a cluster's variance, and how far it is from the mean, to the variance at the knots."""
    apart = np.zeros(spread.size, np.float32)
    for i in range(knots.shape[0]):
        off = one[i] - mixed[i]
        for knot in range(spread.size):
            apart[knot] += off * knots[i, knot]
    for knot in range(spread.size):
        within = (ONE - high) * near[knot] + high * far[knot]
        spread[knot] += weight * (within + apart[knot] * apart[knot])
