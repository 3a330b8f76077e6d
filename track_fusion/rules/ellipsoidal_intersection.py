"""Ellipsoidal intersection: naive fusion less the largest information that both tracks can share."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array
from track_fusion.params import Params
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.folding import PairFusion, fold
from track_fusion.solvers.pair import Pair


def fuse(tracks: SourceTracks, params: Params) -> FusedTracks:
    """Fuse pairs of Gaussian tracks by ellipsoidal intersection, in the order of the sources.

    P^-1 = P1^-1 + P2^-1 - C^-1, C the common part: along the axes of both covariances at once, the vaguer of the two.
    So the fusion takes along each of these axes the sharper track. Not guaranteed conservative.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : Params          none

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n)

    Raises
    ------
    LinAlgError    a covariance is singular

    Notes          P1 = diag(1, 4), P2 = diag(4, 1), the errors of whose sharp axes are equal, give along (1, 1) an
                   error variance 2 times the claim. Along axes of equal variance the mean is halved between the
                   tracks, the limit of the regularisation of Sijs and Lazar, taken in the joint axes so that units do
                   not matter; the mean jumps there. K > 2: the order matters. O(K n^3).
    References     J. Sijs and M. Lazar, State fusion with unknown correlation: Ellipsoidal intersection, 2012;
                   N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking: Performance and
                   Comparison, section 1.1.
    """
    return fold(tracks, _fuse_pairs)


def _fuse_pairs(x1: Array, p1: Array, x2: Array, p2: Array, given: float | None) -> PairFusion:
    pair = Pair.of(p1, p2)
    # In the joint axes C = max(P1, P2), hence 1/P1 + 1/P2 - 1/C = 1/min(P1, P2); the same for the mean.
    gain = 0.5 * (1.0 + np.sign(pair.contrast))
    mean = x2 + pair.from_coordinates(gain * pair.coordinates(x1 - x2))
    return PairFusion(mean, pair.rebuild(np.minimum(pair.first, pair.second)))


RULE = Rule(
    key="ellipsoidal_intersection",
    title="Ellipsoidal intersection",
    fuse=fuse,
    params=Params,
    family="gaussian",
    arity="pairwise",
    guarantee="none",
    caveat="not guaranteed conservative: errors of twice the claimed variance in the example",
    source="Sharma 1.1 (Sijs and Lazar)",
    cost="K n^3",
    order_matters=True,
    linear=True,
    example=Example(idempotent=True),
)
