"""Inverse covariance intersection: naive fusion less a bound of the information that both tracks share."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array
from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.folding import PairFusion, fold
from track_fusion.rules.shared.weights import GIVEN, TRACE, WeightParams
from track_fusion.solvers.optimise import Derivatives, Solution, minimise_on_interval
from track_fusion.solvers.pair import Pair


@dataclasses.dataclass(frozen=True)
class InverseCovarianceIntersectionParams(WeightParams):
    """How the weights omega are chosen."""

    criterion: str = param(
        "det",
        "what the weights minimise: the fused determinant (does not depend on units), the fused trace "
        "(does), or nothing (given by 'weights')",
        choices=("det", "trace", "given"),
    )
    weights: tuple[float, ...] = param(
        (), "weights of the tracks in the common part, for criterion given, one a source, sum 1",
        low=0.0, high=1.0, kind=float,
    )  # fmt: skip


def fuse(tracks: SourceTracks, params: InverseCovarianceIntersectionParams) -> FusedTracks:
    """Fuse pairs of Gaussian tracks by P^-1 = P1^-1 + P2^-1 - (w P1 + (1 - w) P2)^-1, in the order of the sources.

    Conservative only if the tracks share a part N(c, C), C >= P1, P2, and are independent beyond it: cross-covariance
    P1 C^-1 P2.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : InverseCovarianceIntersectionParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K) in the common part, info converged, iterations

    Raises
    ------
    ValueError     given weights do not fit
    LinAlgError    a covariance is singular

    Notes          P1 = diag(1, 4), P2 = diag(4, 1) and the admissible cross-covariance [[0, 1], [4, 0]] give, along
                   (1, 1), an error variance 1.53 times the claim; half of all admissible
                   cross-covariances break it. Given weights: track k meets the fusion of those
                   before it with its share of their sum. K > 2: the order matters. O(K n^3).
    References     N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking: Performance and
                   Comparison, eq. (47), with the factor of the fused covariance that its mean lacks; B. Noack et
                   al., Decentralized data fusion with inverse covariance intersection, 2017.
    """

    def kernel(x1: Array, p1: Array, x2: Array, p2: Array, share: float | None) -> PairFusion:
        pair = Pair.of(p1, p2)
        if share is None:
            return _fuse_at(pair, x1, x2, minimise_on_interval(_derivatives(pair, params.criterion), len(x1)))
        return _fuse_at(pair, x1, x2, Solution.known(np.full(len(x1), share)))

    return fold(tracks, kernel, params.given(tracks.count))


def _fuse_at(pair: Pair, x1: Array, x2: Array, search: Solution) -> PairFusion:
    """Fuse at weights where both covariances are diagonal and P1 + P2 = 1.

    With M = w P1 + (1 - w) P2 the fused variance is P1 P2 M / (M - P1 P2), and M - P1 P2 is
    w P1^2 + (1 - w) P2^2: nothing is subtracted.
    """
    p, q, w = pair.first, pair.second, search.weights
    near, far = w * p * p, (1.0 - w) * q * q
    gain = far / (near + far)
    mean = x2 + pair.from_coordinates(gain * pair.coordinates(x1 - x2))
    cov = pair.rebuild(p * q * (w * p + (1.0 - w) * q) / (near + far))
    return PairFusion(mean, cov, search)


def _derivatives(pair: Pair, criterion: str) -> Derivatives:
    """Derivatives over the weight of P1 of log det P, or of tr P; every fused variance is convex in it."""
    first, second, change = pair.first, pair.second, -pair.contrast
    length = (pair.basis**2).sum(-2).T if criterion == "trace" else first

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        whole = len(rows) == first.shape[1]
        p, q, c, size = (x if whole else x[:, rows] for x in (first, second, change, length))
        product, common = p * q, q + w * c
        rest = w * p * p + (1.0 - w) * q * q
        if criterion == "det":
            rate = c * product / (common * rest)
            return -rate.sum(0), (rate * c * (common + rest) / (common * rest)).sum(0)
        rate = size * c * (product / rest) ** 2
        return -rate.sum(0), 2.0 * (rate * c / rest).sum(0)

    return derivatives


RULE = Rule(
    key="inverse_covariance_intersection",
    title="Inverse covariance intersection",
    fuse=fuse,
    params=InverseCovarianceIntersectionParams,
    family="gaussian",
    arity="pairwise",
    guarantee="structural",
    caveat="if the tracks share one common part and are independent beyond it; else half of all cross-covariances "
    "break it, by a factor of 1.53 in the example",
    source="Sharma (47)",
    cost="K n^3",
    order_matters=True,
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
    linear=True,
    example=Example(({}, TRACE, GIVEN), not_equivariant=(TRACE,), idempotent=True),
)
