"""Which track is which target: the one home of pairing with the truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    at, turned = list(layout.position), layout.angular
    target, track = nearest_pairs(truth[:, at], mean[:, at], reach_m)
    error = mean[track] - truth[target]
    error[:, turned] = np.remainder(error[:, turned] + np.pi, 2 * np.pi) - np.pi
    return Pairs(target, track, error, nees(error, cov[track]))
