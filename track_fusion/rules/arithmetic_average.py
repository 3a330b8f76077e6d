"""Arithmetic average: the mixture of the tracks' densities."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from track_fusion.densities.gaussian import merge_near
from track_fusion.densities.mixture.algebra import average
from track_fusion.linalg import Array, merged_moments
from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Mixture, Rule, SourceTracks
from track_fusion.rules.shared.weights import GIVEN, UNIFORM, WeightParams, diagnostics
from track_fusion.solvers.optimise import Solution
from track_fusion.weights.bound import bound_weights
from track_fusion.weights.merging import merging_weights
from track_fusion.weights.target import target_weights


@dataclasses.dataclass(frozen=True)
class ArithmeticAverageParams(WeightParams):
    """How the fusion weights are chosen and what is handed on."""

    criterion: str = param(
        "diversity",
        "fusion weights: by diversity preference, eq. (40), by its bound, eq. (45), by the least divergence from a "
        "target density of the merged Gaussian, eq. (39) (target), or of the mixture itself, eq. (33) "
        "(target_mixture), in proportion to the likelihood of each track's measurements, uniform, or given by "
        "'weights'",
        choices=("diversity", "bound", "target", "target_mixture", "likelihood", "uniform", "given"),
    )
    output: str = param(
        "merged",
        "merged: one Gaussian with the mixture's mean and covariance; mixture: the mixture, its modes preserved",
        choices=("merged", "mixture"),
    )
    merge_threshold: float = param(
        0.0,
        "in output mixture, components nearer to each other (also by way of others) are merged, the rest kept apart: "
        "distance of the means in standard deviations of their difference",
        low=0.0,
    )


def fuse(tracks: SourceTracks, params: ArithmeticAverageParams) -> FusedTracks:
    """Fuse K tracks by the arithmetic average of their densities: f = sum of w_i f_i.

    Conservative at weights that do not depend on the means, if each track is: the merged covariance is the
    weighted mean of the tracks' covariances plus the spread of their means.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); mixtures are averaged as mixtures. Extras: for
                             criterion target or target_mixture `target`, a Mixture of leading shape (...) or
                             none, which the first takes by its moments; for criterion likelihood `likelihood` (..., K),
                             not negative
    params : ArithmeticAverageParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), the mixture for output mixture

    Raises
    ------
    ValueError    given weights or likelihoods do not fit

    Notes          Weights by diversity, its bound, a target or likelihoods depend on the means, and then there is no
                   promise: three scalar tracks of variances 10.4, 10.4 and 6.4, whose errors are 3, 2 and 2 in four
                   cases of five and else 4, 6 and 4, give by diversity a mean squared error of 1.12 times the
                   mean claim. The programs (33), (39) and (40) are convex in the weights; at an interior optimum of
                   (40) all divergences (37) are equal. (33) takes each track by its Gaussian, and expectations by
                   quadrature, of more than four axes by 4000 points. (45) may have several minima; the best found is
                   taken. Where all likelihoods are zero, all tracks weigh the same. O(K n^3).
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, eqs. (6), (10)-(11), (33), (37), (39), (40), (45), section II-E.
    """
    weights, info = _weights(tracks, params)
    mean, cov = merged_moments(tracks.mean, tracks.cov, weights)
    mixture = None
    if params.output == "mixture":
        mixture = _mixture(tracks, weights)
        if params.merge_threshold > 0:
            mixture = Mixture(*merge_near(mixture.weight, mixture.mean, mixture.cov, params.merge_threshold))
    return FusedTracks(mean, cov, weights, mixture=mixture, info=info)


def _weights(tracks: SourceTracks, params: ArithmeticAverageParams) -> tuple[Array, dict[str, Any]]:
    """Weights (..., K) by the criterion, and how their search went."""
    weights = params.fixed(tracks)
    if params.criterion == "likelihood":
        weights = _by_likelihood(tracks)
    elif weights is None and tracks.count == 1:
        weights = np.ones(tracks.mean.shape[:-1])
    if weights is not None:
        return weights, {}
    search = _sought(tracks, params.criterion)
    info = {name: values.reshape(tracks.batch) for name, values in diagnostics(search).items()}
    return search.weights.reshape(tracks.mean.shape[:-1]), info


def _mixture(tracks: SourceTracks, weights: Array) -> Mixture:
    """List the components of all sources, weighted by their source."""
    if tracks.mixture is None:
        return Mixture(weights, tracks.mean, tracks.cov)
    return average(tracks.mixture, weights)


def _sought(tracks: SourceTracks, criterion: str) -> Solution:
    """Find the weights of a program, of a flat batch."""
    mean, cov = tracks.flat
    if criterion == "bound":
        return bound_weights(mean, cov)
    if criterion == "target_mixture":
        target: Mixture = tracks.extras["target"]
        whole = target.normalised.broadcast(tracks.batch)
        return target_weights(mean, cov, Mixture(*(a.reshape(len(mean), *a.shape[len(tracks.batch) :])
                                                   for a in vars(whole).values())))  # fmt: skip
    slopes = None if criterion == "diversity" else _target_slopes(tracks).reshape(mean.shape[:2])
    return merging_weights(mean, cov, slopes)


def _target_slopes(tracks: SourceTracks) -> Array:
    """Linear part of (39), (..., K): tr(P^-1 (P_i + (x_i - x)(x_i - x)')) for a target of moments x, P."""
    target: Mixture = tracks.extras["target"]
    mean, cov = merged_moments(target.mean, target.cov, target.weight / target.weight.sum(-1, keepdims=True))
    offset = tracks.mean - mean[..., None, :]
    second = tracks.cov + offset[..., :, None] * offset[..., None, :]
    slopes = np.trace(np.linalg.solve(cov[..., None, :, :], second), axis1=-2, axis2=-1)
    return np.asarray(slopes, np.float64)


def _by_likelihood(tracks: SourceTracks) -> Array:
    """Weights in proportion to the likelihoods, equal where all are zero, (..., K)."""
    likelihood = np.asarray(tracks.extras["likelihood"], float)
    if likelihood.shape != tracks.mean.shape[:-1]:
        raise ValueError(
            f"The 'likelihood' of source tracks must have shape {tracks.mean.shape[:-1]}. Got {likelihood.shape}."
        )
    if not (np.isfinite(likelihood) & (likelihood >= 0)).all():
        raise ValueError(f"The 'likelihood' of source tracks must be finite and not negative. Got {likelihood.min()}.")
    largest = likelihood.max(-1, keepdims=True)
    share = np.where(largest > 0, likelihood, 1.0) / np.where(largest > 0, largest, 1.0)
    return np.asarray(share / share.sum(-1, keepdims=True))


EXAMPLES = (
    {**UNIFORM, "output": "mixture"}, GIVEN, {"criterion": "bound"}, {"criterion": "target"},
    {"criterion": "target_mixture"}, {"criterion": "likelihood"}, {"output": "mixture", "merge_threshold": 1.5},
)  # fmt: skip

RULE = Rule(
    key="arithmetic_average",
    title="Arithmetic average",
    fuse=fuse,
    params=ArithmeticAverageParams,
    family="gaussian",
    arity="n_ary",
    guarantee=lambda params: "conservative" if params.criterion in ("uniform", "given") else "none",
    caveat="conservative with criterion uniform or given, whose weights do not depend on the means, if every track is; "
    "else errors of 1.12 times the claim in the example",
    source="Li 2022 (6), (10)-(11), (33), (39), (40), (45)",
    cost="K n^3, about ten times that for weights that are sought with K > 2",
    needs_when=(
        ("target", "criterion", "target"),
        ("target", "criterion", "target_mixture"),
        ("likelihood", "criterion", "likelihood"),
    ),
    takes_particles=True,
    takes_phds=True,
    example=Example(({}, *EXAMPLES), idempotent=True),
)
