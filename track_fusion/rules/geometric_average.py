"""Geometric average: the normalised product of the tracks' densities raised to weights."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.densities.gaussian import weighted_product
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, Rule, SourceTracks, check_weights
from track_fusion.weights.pooling import chernoff_weights, minimax_weights


@dataclasses.dataclass(frozen=True)
class GeometricAverageParams(Params):
    """How the fusion weights omega are chosen."""

    criterion: str = param(
        "uniform",
        "fusion weights: uniform (the average of least mean divergence), chernoff (as far from every track), "
        "minimax_information_loss (nearest to the naive product), or given by 'weights'",
        choices=("uniform", "chernoff", "minimax_information_loss", "given"),
    )
    weights: tuple[float, ...] = param(
        (), "fusion weights for criterion given, one a source, sum 1", low=0.0, high=1.0, kind=float
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
    batch, (count, n) = tracks.mean.shape[:-2], tracks.mean.shape[-2:]
    if params.weights and params.criterion != "given":
        raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {params.criterion!r}.")
    if params.criterion in ("uniform", "given"):
        share = check_weights(params.weights, count) if params.criterion == "given" else np.full(count, 1.0 / count)
        weights = np.broadcast_to(share, (*batch, count))
        return FusedTracks(*weighted_product(tracks.mean, tracks.cov, weights), weights)
    find = chernoff_weights if params.criterion == "chernoff" else minimax_weights
    found = find(tracks.mean.reshape(-1, count, n), tracks.cov.reshape(-1, count, n, n))
    weights = found.weights.reshape(*batch, count)
    info = {"converged": found.converged.reshape(batch), "iterations": found.iterations.reshape(batch)}
    return FusedTracks(*weighted_product(tracks.mean, tracks.cov, weights), weights, info=info)


RULE = Rule(
    key="geometric_average",
    title="Geometric average",
    fuse=fuse,
    params=GeometricAverageParams,
    family="gaussian",
    arity="n_ary",
    guarantee="conservative",
    caveat="at weights that do not depend on the means (uniform, given), if every track is",
    source="Li 2022 (15)-(17); Ahmed (9)-(11)",
    cost="K n^3, about ten times that for weights that are sought",
)
