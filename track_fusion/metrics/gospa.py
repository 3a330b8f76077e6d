"""How far a set of tracks is from the set of targets: GOSPA with its parts, and OSPA."""

from __future__ import annotations

import dataclasses

from track_fusion.association.assignment import distances, pairs_within
from track_fusion.association.gate import Indices
from track_fusion.linalg import Array
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class SetDistanceParams(Params):
    """Cut-off c and order p of GOSPA and OSPA."""

    cutoff_m: float = param(
        10.0,
        "GOSPA, OSPA, MOTA, IDF1, HOTA: a target and a track at least so far apart are a missed target and a false "
        "track",
        unit="m",
        low=0.0,
        strict=True,
    )
    order: float = param(2.0, "GOSPA, OSPA: power p of the distances; a large one dwells on the worst", low=1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class SetDistance:
    """The distance between two sets, N targets and M tracks, as powers of order p, in m^p, whose sum is GOSPA^p.

    Attributes
    ----------
    target, track : (P,)     the pairs, none as far apart as the cut-off
    distance : (P,)          of each pair, m
    localisation : float     sum of the distances of the pairs, each to the power p
    missed, false : float    c^p / 2 for each target without a track, and for each track without a target
    ospa_power : float       OSPA^p
    order : float            p
    """

    target: Indices
    track: Indices
    distance: Array
    localisation: float
    missed: float
    false: float
    ospa_power: float
    order: float

    @property
    def gospa(self) -> float:
        """GOSPA (alpha = 2), m."""
        return float((self.localisation + self.missed + self.false) ** (1.0 / self.order))

    @property
    def ospa(self) -> float:
        """OSPA, m, at most the cut-off."""
        return float(self.ospa_power ** (1.0 / self.order))


def set_distance(targets: Array, tracks: Array, params: SetDistanceParams) -> SetDistance:
    """Measure the distance between two sets of points.

    Both metrics take the pairs whose distances, cut off at c and to the power p, have the least sum. GOSPA (alpha = 2)
    counts c^p / 2 for what is left over on either side; OSPA c^p for the surplus of the larger set and for each pair
    that is cut off, and divides by the size of that set, so that two false tracks among many weigh less.

    Parameters
    ----------
    targets, tracks : (N, d), (M, d)    positions, m, without NaN; either may be empty
    params : SetDistanceParams

    References
    ----------
    A. S. Rahmathullah, A. F. Garcia-Fernandez, L. Svensson, Generalized optimal sub-pattern assignment metric, 2017,
    equation 2 and proposition 1; D. Schuhmacher, B.-T. Vo, B.-N. Vo, A consistent metric for performance evaluation of
    multi-object filters, 2008, equation 3
    """
    return set_distance_of(distances(targets, tracks), params)


def set_distance_of(between: Array, params: SetDistanceParams) -> SetDistance:
    """`set_distance` of sets of points between which the distances, (N, M), are known."""
    c, p = params.cutoff_m, params.order
    target, track = pairs_within(between, c, p)
    distance = between[target, track]
    pairs, most = len(target), max(between.shape)
    # Distances are taken in cut-offs: their powers then stay in range however large p is.
    localisation = c**p * float(((distance / c) ** p).sum())
    missed, false = (0.5 * c**p * (count - pairs) for count in between.shape)
    ospa_power = (localisation + c**p * (most - pairs)) / most if most else 0.0
    return SetDistance(target, track, distance, localisation, missed, false, ospa_power, p)
