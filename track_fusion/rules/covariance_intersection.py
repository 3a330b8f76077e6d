"""Covariance intersection: the safe product of densities whose cross-correlation is unknown."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.gaussian import weighted_product
from track_fusion.densities.pair import SHARP, Pair
from track_fusion.linalg import Array, inverse, outer, symmetrise, transpose
from track_fusion.optimise import Derivatives, Solution, minimise_on_interval, minimise_on_simplex
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, Rule, SourceTracks, check_weights

#: Pairs are worked on in pieces whose arrays stay in the cache.
CHUNK = 1024


@dataclasses.dataclass(frozen=True)
class CovarianceIntersectionParams(Params):
    """How the fusion weights omega are chosen."""

    criterion: str = param(
        "det",
        "what the weights minimise: the fused determinant (does not depend on units), the fused trace "
        "(does), nothing (uniform), or nothing (given by 'weights')",
        choices=("det", "trace", "uniform", "given"),
    )
    weights: tuple[float, ...] = param(
        (), "fusion weights for criterion given, one a source, sum 1", low=0.0, high=1.0, kind=float
    )


def fuse(tracks: SourceTracks, params: CovarianceIntersectionParams) -> FusedTracks:
    """Fuse K Gaussian tracks by covariance intersection: P^-1 = sum of w_i P_i^-1.

    Conservative for every cross-correlation of the tracks, if each track is.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : CovarianceIntersectionParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), info converged, iterations

    Raises
    ------
    ValueError     given weights do not fit
    LinAlgError    a covariance is singular

    Notes          The weights depend on the covariances alone, so the promise holds at every one of them.
                   Trace-optimal weights change with the units of the axes. O(K n^3), some ten
                   iterations of that for more than two sources.
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, eqs. (16)-(18).
    """
    batch, (count, n) = tracks.mean.shape[:-2], tracks.mean.shape[-2:]
    if params.criterion == "given" or params.weights:
        if params.criterion != "given":
            raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {params.criterion!r}.")
        weights = np.broadcast_to(check_weights(params.weights, count), (*batch, count))
        return FusedTracks(*weighted_product(tracks.mean, tracks.cov, weights), weights)
    if params.criterion == "uniform" or count == 1:
        weights = np.full((*batch, count), 1.0 / count)
        return FusedTracks(*weighted_product(tracks.mean, tracks.cov, weights), weights)
    mean, cov, found = _optimal(
        tracks.mean.reshape(-1, count, n), tracks.cov.reshape(-1, count, n, n), params.criterion
    )
    info = {"converged": found.converged.reshape(batch), "iterations": found.iterations.reshape(batch)}
    weights = found.weights.reshape(*batch, count)
    return FusedTracks(mean.reshape(*batch, n), cov.reshape(*batch, n, n), weights, info=info)


Fusion = tuple[Array, Array, Solution]


def _optimal(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse a flat batch, mean (B, K, n), at the weights that minimise the criterion."""
    kernel = _fuse_pairs if mean.shape[1] == 2 else _fuse_many
    if len(mean) <= CHUNK:
        return kernel(mean, cov, criterion)
    parts = [kernel(mean[i : i + CHUNK], cov[i : i + CHUNK], criterion) for i in range(0, len(mean), CHUNK)]
    means, covs, found = zip(*parts, strict=True)
    return np.concatenate(means), np.concatenate(covs), Solution.concatenate(found)


def _fuse_pairs(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse pairs where both covariances are diagonal: one weight, Newton over the whole batch."""
    first_mean, second_mean, first, second = mean[:, 0], mean[:, 1], cov[:, 0], cov[:, 1]
    pair = Pair.of(first, second)
    found = minimise_on_interval(_pair_derivatives(pair, criterion), len(mean))
    omega = found.weights
    # With P1 + P2 = 1, (w / P1 + (1 - w) / P2)^-1 = P1 P2 / (w P2 + (1 - w) P1).
    share = omega * pair.second
    total = share + (1.0 - omega) * pair.first
    pull = pair.from_coordinates(share / total * pair.coordinates(first_mean - second_mean))
    fused_mean, fused_cov = second_mean + pull, pair.rebuild(pair.first * pair.second / total)
    weights = np.stack([omega, 1.0 - omega], -1)
    near_end = np.minimum(omega, 1.0 - omega) < NEAR_END
    sharp = np.minimum(pair.first.min(0), pair.second.min(0)) < SHARP
    delicate = near_end | sharp
    if delicate.any():
        rows = np.flatnonzero(delicate)
        fused_mean[rows], fused_cov[rows], exact = _fuse_delicate(mean[rows], cov[rows], criterion)
        weights[rows], found.converged[rows], found.iterations[rows] = exact.weights, exact.converged, exact.iterations
    return fused_mean, fused_cov, Solution(weights, found.converged, found.iterations)


#: So close to 0 or 1 the weight's own digits, not the pair's, decide: use the information form.
NEAR_END = 1e-6


def _pair_derivatives(pair: Pair, criterion: str) -> Derivatives:
    """Derivatives over the weight of P1 of log det P, or of tr P, of diagonal pairs."""
    slope_of = pair.second - pair.first
    if criterion == "trace":
        length = np.ascontiguousarray((pair.basis**2).sum(-2).T) * pair.first * pair.second

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        every = len(rows) == len(w) == slope_of.shape[1]
        a, p = (slope_of, pair.first) if every else (slope_of[:, rows], pair.first[:, rows])
        total = p + w * a
        ratio = a / total
        if criterion == "det":
            return -ratio.sum(0), (ratio * ratio).sum(0)
        term = (length if every else length[:, rows]) / total * ratio
        return -term.sum(0), 2.0 * (term * ratio).sum(0)

    return derivatives


def _fuse_delicate(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse pairs of extreme spread in information form, returning an input itself at weight 0 or 1."""
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1).sum(1))
    info = inverse(cov / outer(scale)[:, None])
    change = info[:, 0] - info[:, 1]

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        w = w[:, None, None]
        fused = inverse(w * info[rows, 0] + (1.0 - w) * info[rows, 1])
        step = fused @ change[rows]
        if criterion == "det":
            return -_trace(step), _trace(step @ step)
        loss = (step @ fused) * outer(scale[rows])
        return -_trace(loss), 2.0 * _trace((step @ step @ fused) * outer(scale[rows]))

    found = minimise_on_interval(derivatives, len(mean))
    weights = np.stack([found.weights, 1.0 - found.weights], -1)
    fused_mean, fused_cov = weighted_product(mean, cov, weights)
    for source in (0, 1):
        alone = weights[:, source] == 1.0
        fused_mean[alone], fused_cov[alone] = mean[alone, source], cov[alone, source]
    return fused_mean, fused_cov, Solution(weights, found.converged, found.iterations)


def _fuse_many(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse K > 2 tracks, whitened by the sum of their covariances, by an interior point on the simplex."""
    lower = np.linalg.cholesky(cov.sum(1))
    whiten = np.linalg.inv(lower)[:, None]
    info = inverse(symmetrise(whiten @ cov @ transpose(whiten)))
    units = transpose(lower) @ lower  # the trace of L P L' is that of P L'L
    batch, count, n = mean.shape

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        part = info[rows]
        fused = inverse(np.einsum("bk,bkij->bij", w, part))
        if criterion == "det":
            left = right = fused[:, None] @ part
        else:
            worth = symmetrise(fused @ units[rows] @ fused)
            left, right = worth[:, None] @ part, 2.0 * (fused[:, None] @ part)
        gradient = -np.trace(left, axis1=-2, axis2=-1)
        flat = left.reshape(len(w), count, n * n), transpose(right).reshape(len(w), count, n * n)
        return gradient, symmetrise(flat[0] @ transpose(flat[1]))

    found = minimise_on_simplex(gradient_hessian, batch, count)
    fused_mean, fused_cov = weighted_product(mean, cov, found.weights)
    alone = found.weights == 1.0
    rows, source = np.nonzero(alone)
    fused_mean[rows], fused_cov[rows] = mean[rows, source], cov[rows, source]
    return fused_mean, fused_cov, found


def _trace(a: Array) -> Array:
    return np.asarray(np.trace(a, axis1=-2, axis2=-1))


RULE = Rule(
    key="covariance_intersection",
    title="Covariance intersection",
    fuse=fuse,
    params=CovarianceIntersectionParams,
    family="gaussian",
    arity="n_ary",
    guarantee="conservative",
    caveat="if every track is; for every cross-correlation",
    source="Li 2022 (16)-(18)",
    cost="K n^3, about ten times that for K > 2",
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
)
