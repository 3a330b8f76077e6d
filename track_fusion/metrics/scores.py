"""Scores of whole pictures, targets and tracks of a time together: GOSPA with its parts, OSPA, identities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.assignment import distances
from track_fusion.linalg import Array
from track_fusion.metrics.gospa import SetDistanceParams, set_distance_of
from track_fusion.metrics.identities import Identities, Scene

#: What is averaged over the times, each to the power p, so that the parts to that power sum to GOSPA to that power.
_POWERS = ("gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m", "ospa_m")


class Scores:
    """Sums over times, in their order."""

    def __init__(self, params: SetDistanceParams) -> None:
        self._params, self._identities = params, Identities(params.cutoff_m)
        self._sums, self._times = np.zeros(len(_POWERS)), 0

    def add(
        self, targets: NDArray[np.int64], target_positions: Array, tracks: NDArray[np.int64], track_positions: Array
    ) -> None:
        """Take a time: identifiers (N,) and positions (N, d) of the targets, (M,) and (M, d) of the tracks."""
        between = distances(target_positions, track_positions)
        result = set_distance_of(between, self._params)
        parts = np.array([result.localisation, result.missed, result.false])
        self._sums += [parts.sum(), *parts, result.ospa_power]
        self._times += 1
        self._identities.add(Scene(targets, tracks, between))

    def figures(self) -> Mapping[str, Any]:
        """The scores, ready for JSON; None where there is no time."""
        means = (self._sums / max(self._times, 1)) ** (1.0 / self._params.order)
        told = dict(zip(_POWERS, means.tolist() if self._times else [None] * len(_POWERS), strict=True))
        return {"times": self._times, **vars(self._params), **told, **self._identities.figures()}
