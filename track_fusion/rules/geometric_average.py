"""Geometric average: the normalised product of the tracks' densities raised to weights."""

from __future__ import annotations

import dataclasses

from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.weights import GIVEN, WeightParams, pooled, pooled_by
from track_fusion.weights.pooling import chernoff_weights, minimax_weights


@dataclasses.dataclass(frozen=True)
class GeometricAverageParams(WeightParams):
    """How the fusion weights omega are chosen."""

    criterion: str = param(
        "uniform",
        "fusion weights: uniform (the average of least mean divergence), chernoff (as far from every track), "
        "minimax_information_loss (nearest to the naive product), or given by 'weights'",
        choices=("uniform", "chernoff", "minimax_information_loss", "given"),
    )


def fuse(tracks: SourceTracks, params: GeometricAverageParams) -> FusedTracks:
    """Fuse K Gaussian tracks by the geometric average of their densities: f proportional to the product of f_i^w_i.

    Conservative for every cross-correlation of the tracks at uniform or given weights, if each track is: at given
    weights it is covariance intersection.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : GeometricAverageParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), info converged, iterations

    Raises
    ------
    ValueError     given weights do not fit
    LinAlgError    a covariance is singular

    Notes          chernoff and minimax_information_loss weights depend on the means; for them the promise does not
                   hold (see fast_covariance_intersection, which is criterion chernoff). O(K n^3), a
                   few iterations where weights are sought.
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, eqs. (15)-(17); N. R. Ahmed, Decentralized Gaussian Mixture Fusion through
                   Unified Quotient Approximations, eqs. (9)-(11).
    """
    weights = params.fixed(tracks)
    if weights is not None:
        return pooled(tracks, weights)
    return pooled_by(chernoff_weights if params.criterion == "chernoff" else minimax_weights, tracks)


SOUGHT = ({"criterion": "chernoff"}, {"criterion": "minimax_information_loss"})

RULE = Rule(
    key="geometric_average",
    title="Geometric average",
    fuse=fuse,
    params=GeometricAverageParams,
    family="gaussian",
    arity="n_ary",
    guarantee=lambda params: "conservative" if params.criterion in ("uniform", "given") else "none",
    caveat="at weights that do not depend on the means (uniform, given), if every track is",
    source="Li 2022 (15)-(17); Ahmed (9)-(11)",
    cost="K n^3, about ten times that for weights that are sought",
    example=Example(({}, *SOUGHT, GIVEN), idempotent=True),
)
