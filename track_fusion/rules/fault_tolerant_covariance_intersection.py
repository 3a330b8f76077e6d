"""Fault-tolerant covariance intersection: weights that sum to less than one."""

from __future__ import annotations

import dataclasses

from track_fusion.params import param
from track_fusion.rules import covariance_intersection
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.weights import GIVEN, TRACE


@dataclasses.dataclass(frozen=True)
class FaultTolerantCovarianceIntersectionParams(covariance_intersection.CovarianceIntersectionParams):
    """How the weights are chosen, as for covariance intersection, and what they sum to."""

    delta: float = param(
        0.9, "what the weights sum to: the covariance is that of covariance intersection over delta",
        low=0.0, high=1.0, strict=True,
    )  # fmt: skip


def fuse(tracks: SourceTracks, params: FaultTolerantCovarianceIntersectionParams) -> FusedTracks:
    """Fuse K Gaussian tracks by fault-tolerant convex combination (FFCC): weights that sum to delta <= 1.

    Conservative for every cross-correlation, also when the covariances of the tracks are too small by a factor of up
    to delta; so one track alone is inflated, too.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : FaultTolerantCovarianceIntersectionParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K) of sum delta, info converged, iterations

    Raises
    ------
    ValueError     given weights do not fit (they sum to 1 before they are multiplied by delta)
    LinAlgError    a covariance is singular

    Notes          The mean is that of covariance intersection, the covariance P_CI / delta, of one track P / delta.
                   O(K n^3).
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, section II-C, (19).
    """
    fused = covariance_intersection.fuse(tracks, params)
    assert fused.weights is not None
    return dataclasses.replace(fused, cov=fused.cov / params.delta, weights=fused.weights * params.delta)


BY_TRACE = {**TRACE, "delta": 0.75}

RULE = Rule(
    key="fault_tolerant_covariance_intersection",
    title="Fault-tolerant covariance intersection",
    fuse=fuse,
    params=FaultTolerantCovarianceIntersectionParams,
    family="gaussian",
    arity="n_ary",
    guarantee="conservative",
    caveat="if every track is, or is too small by a factor of at most delta; for every cross-correlation, and for one "
    "track, too",
    source="Li 2022 II-C",
    cost="as covariance intersection",
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
    example=Example(({}, BY_TRACE, GIVEN), (BY_TRACE,), idempotent=False, keeps_one=False),
)
