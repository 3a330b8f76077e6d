"""Which points of the plane lie in which boxes, found without looking at all pairs."""

from __future__ import annotations

import numpy as np

from track_fusion.association.gate import Indices
from track_fusion.linalg import Array

#: Keys of the search are compared with this much room, relative to the extent of the points, for rounding.
ROOM = 1e-9
#: A strip of points takes up this share of its keys, so that it and the next one stay apart.
FILLED = 1.0 - 4.0 * ROOM


def points_in_boxes(points: Array, low: Array, high: Array, period: float = np.inf) -> tuple[Indices, Indices]:
    """Find all points inside axis-parallel boxes, sides included.

    Parameters
    ----------
    points : (D, 2)
    low, high : (N, 2)    corners of the boxes
    period : float        of the second axis; the points lie within [-period / 2, period / 2], boxes may stand out by
                          less than a period and are at most one wide

    Returns
    -------
    box, point : (P,) each    the pairs, ordered by box, then point

    Notes    The points are cut into strips along the first axis, as wide as the median box, and sorted along the
             second within each: O((D + N) log D + P) for boxes of similar extent.
    """
    if not len(points) or not len(low):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    owner = np.arange(len(low))
    if np.isfinite(period):
        below, above = np.flatnonzero(low[:, 1] < -period / 2), np.flatnonzero(high[:, 1] > period / 2)
        turn = np.array([0.0, period])
        owner = np.concatenate([owner, below, above])
        low, high = (np.concatenate([side, side[below] + turn, side[above] - turn]) for side in (low, high))
    box, point = _pairs(points, low, high)
    box = owner[box]
    order = np.lexsort((point, box))
    return box[order], point[order]


def _pairs(points: Array, low: Array, high: Array) -> tuple[Indices, Indices]:
    (x, y), (left, bottom), (right, top) = (np.ascontiguousarray(a.T) for a in (points, low, high))
    width = max(float(np.median(right - left)), float(np.ptp(x)) / len(x)) or 1.0
    height = float(np.ptp(y)) or 1.0
    strips = int(np.ptp(x) / width)
    strip = ((x - x.min()) / width).astype(np.intp)
    key = strip + (y - y.min()) / height * FILLED
    order = np.argsort(key)
    key = key[order]
    first, last = (np.clip((side - x.min()) / width, -1, strips + 1).astype(np.intp) for side in (left, right))
    first = np.maximum(first, 0)
    box, step = _runs(np.where(top < y.min(), 0, np.maximum(np.minimum(last, strips) - first + 1, 0)))
    at = first[box] + step
    begin, end = (at + (np.clip((side - y.min()) / height, 0.0, 1.0) * FILLED)[box] for side in (bottom, top))
    start = np.searchsorted(key, begin - ROOM)
    row, step = _runs(np.maximum(np.searchsorted(key, end + ROOM, "right") - start, 0))
    box, point = box[row], order[start[row] + step]
    inside = (left[box] <= x[point]) & (x[point] <= right[box]) & (bottom[box] <= y[point]) & (y[point] <= top[box])
    return box[inside], point[inside]


def _runs(count: Indices) -> tuple[Indices, Indices]:
    """Spell out runs of these lengths: the number of the run of each member, and its place in it from 0."""
    run = np.repeat(np.arange(len(count)), count)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(count) - count, count)
