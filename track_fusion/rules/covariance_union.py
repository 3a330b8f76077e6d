"""Covariance union: a covariance that covers every track, also those that contradict each other."""

from __future__ import annotations

import dataclasses
from typing import Literal, cast

import numpy as np

from track_fusion.linalg import outer
from track_fusion.params import Params, param
from track_fusion.rules.base import EACH, Example, FusedTracks, Guarantee, Rule, SourceTracks
from track_fusion.rules.shared.weights import TRACE, check_weights, diagnostics
from track_fusion.solvers.upper_bound import bound_about, bound_anywhere
from track_fusion.weights.merging import merging_weights


@dataclasses.dataclass(frozen=True)
class CovarianceUnionParams(Params):
    """Which bound of the tracks is taken, and about which mean."""

    bound: str = param(
        "optimal",
        "optimal: the smallest covariance not below any P_i + (x - x_i)(x - x_i)'; max_trace, min_trace: the one of "
        "them with the largest or smallest trace, eqs. (8) and (9) as printed, which need not bound the others",
        choices=("optimal", "max_trace", "min_trace"),
    )
    criterion: str = param(
        "det",
        "what is smallest of the optimal bound: its determinant (does not depend on units) or its trace (does)",
        choices=("det", "trace"),
    )
    mean: str = param(
        "arithmetic",
        "x: the arithmetic mean of the tracks, at 'weights'; diversity: at the weights of the arithmetic average, "
        "eq. (40); optimal: the one whose optimal bound is smallest",
        choices=("arithmetic", "diversity", "optimal"),
    )
    weights: tuple[float, ...] = param(
        (), "weights for mean arithmetic, one a source, sum 1; none: equal", low=0.0, high=1.0, kind=float
    )


def fuse(tracks: SourceTracks, params: CovarianceUnionParams) -> FusedTracks:
    """Fuse K tracks by covariance union: P >= P_i + (x - x_i)(x - x_i)' for all i.

    Conservative if every track is. If at least one is, whichever it may be, the mean squared error is at most twice
    the claim: fault-tolerant up to that factor.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : CovarianceUnionParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K) of the arithmetic mean, info converged, iterations

    Raises
    ------
    ValueError     weights do not fit or belong to another mean, or the optimal mean is asked for a bound that is not
                   optimal
    LinAlgError    a covariance is singular

    Notes          There is no least upper bound in the Loewner order: the one of least determinant or trace is
                   taken. max_trace breaks the promise: with P1 = diag(1, 4) and P2 = diag(5, 1) at one mean it is
                   P2, and the error variance of a right track 1 is 4 times the claim along the second axis. About a
                   mean by diversity, or the optimal one, the promise holds for each track given the estimates.
                   Two tracks about the arithmetic mean have a closed form, O(n^3); more, or
                   the optimal mean, take some twelve steps of an interior point, O(K n^6) each.
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, eqs. (7)-(9).
    """
    means, covs = tracks.flat
    criterion = cast(Literal["det", "trace"], params.criterion)
    if params.weights and params.mean != "arithmetic":
        raise ValueError(f"The 'weights' parameter needs mean 'arithmetic'. Got mean {params.mean!r}.")
    if params.mean == "optimal":
        if params.bound != "optimal":
            raise ValueError(f"The 'mean' parameter 'optimal' needs bound 'optimal'. Got bound {params.bound!r}.")
        best = bound_anywhere(means, covs, criterion)
        return tracks.fused(best.mean, best.cov, info=diagnostics(best))
    if params.mean == "diversity":
        share = merging_weights(means, covs).weights
    else:
        given = params.weights or (1.0 / tracks.count,) * tracks.count
        share = np.broadcast_to(check_weights(given, tracks.count), means.shape[:2])
    origin = means[:, 0]
    mean = origin + (share[..., None] * (means - origin[:, None])).sum(1)
    if params.bound == "optimal":
        best = bound_about(mean, means, covs, criterion)
        return tracks.fused(best.mean, best.cov, share, info=diagnostics(best))
    sides = covs + outer(mean[:, None] - means)
    traces = np.trace(sides, axis1=-2, axis2=-1)
    chosen = traces.argmax(1) if params.bound == "max_trace" else traces.argmin(1)
    return tracks.fused(mean, sides[np.arange(len(sides)), chosen], share)


def _guarantee(params: CovarianceUnionParams) -> Guarantee:
    return "conservative" if params.bound == "optimal" and params.mean == "arithmetic" else "none"


UNEQUAL = (TRACE, {**TRACE, "mean": "optimal"}, {"bound": "max_trace"}, {"bound": "min_trace"})

RULE = Rule(
    key="covariance_union",
    title="Covariance union",
    fuse=fuse,
    params=CovarianceUnionParams,
    family="gaussian",
    arity="n_ary",
    guarantee=_guarantee,
    caveat="conservative with bound optimal and mean arithmetic, if every track is; if only one is, errors of at most "
    "twice the claim, about any mean; max_trace and min_trace promise nothing",
    source="Li 2022 (7)-(9)",
    cost="n^3 for K = 2, else some twelve times K n^6",
    affine_equivariant="not with a trace, whether as criterion or as bound: it depends on the units of the axes",
    example=Example(
        ({}, {"weights": EACH}, {"mean": "diversity"}, {"mean": "optimal"}, *UNEQUAL),
        UNEQUAL,
        idempotent=True,
    ),
)
