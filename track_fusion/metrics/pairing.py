"""Which track is which target: the one home of pairing with the truth."""

from __future__ import annotations

from typing import NamedTuple

from track_fusion.angles import difference
from track_fusion.association.assignment import nearest_pairs
from track_fusion.association.gate import Indices
from track_fusion.linalg import Array
from track_fusion.metrics.consistency import nees
from track_fusion.tracks import StateLayout


class Pairs(NamedTuple):
    """P targets with their tracks: indices (P,) of both, error (P, n), angles wrapped, and its NEES (P,)."""

    target: Indices
    track: Indices
    error: Array
    nees: Array


def paired(layout: StateLayout, truth: Array, mean: Array, cov: Array, reach_m: float) -> Pairs:
    """Pair targets and tracks one to one by least total distance between positions, none farther than `reach_m`.

    Parameters
    ----------
    truth : (N, n)                     states of the targets
    mean, cov : (M, n), (M, n, n)      of the tracks
    """
    at = list(layout.position)
    target, track = nearest_pairs(truth[:, at], mean[:, at], reach_m)
    error = difference(mean[track], truth[target], layout.periods)
    return Pairs(target, track, error, nees(error, cov[track]))
