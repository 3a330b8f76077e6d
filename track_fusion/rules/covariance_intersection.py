"""Covariance intersection: the safe product of densities whose cross-correlation is unknown."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.gaussian import weighted_product
from track_fusion.linalg import Array, inverse, keep_sole, matvec, outer, symmetrise, transpose
from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks, Values
from track_fusion.rules.shared.weights import GIVEN, TRACE, UNIFORM, WeightParams, diagnostics, pooled
from track_fusion.solvers.optimise import (
    Derivatives,
    ScalarDerivatives,
    Solution,
    minimise_on_interval,
    minimise_on_simplex,
    minimise_one,
)
from track_fusion.solvers.pair import FEW, SHARP, Pair, SinglePair

#: Large batches are worked on in pieces whose arrays stay in the cache.
PAIR_CHUNK, MANY_CHUNK = 1024, 512


@dataclasses.dataclass(frozen=True)
class CovarianceIntersectionParams(WeightParams):
    """How the fusion weights omega are chosen."""

    criterion: str = param(
        "det",
        "what the weights minimise: the fused determinant (does not depend on units), the fused trace "
        "(does), nothing (uniform), or nothing (given by 'weights')",
        choices=("det", "trace", "uniform", "given"),
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
    weights = params.fixed(tracks)
    if weights is None and tracks.count == 1:
        weights = np.ones(tracks.mean.shape[:-1])
    if weights is not None:
        return pooled(tracks, weights)
    mean, cov, search = _optimal(*tracks.flat, params.criterion)
    return tracks.fused(mean, cov, search.weights, info=diagnostics(search))


Fusion = tuple[Array, Array, Solution]


def _optimal(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse a flat batch, mean (B, K, n), at the weights that minimise the criterion."""
    kernel, size = (_fuse_pairs, PAIR_CHUNK) if mean.shape[1] == 2 else (_fuse_many, MANY_CHUNK)
    if len(mean) <= size:
        return kernel(mean, cov, criterion)
    parts = [kernel(mean[i : i + size], cov[i : i + size], criterion) for i in range(0, len(mean), size)]
    means, covs, search = zip(*parts, strict=True)
    return np.concatenate(means), np.concatenate(covs), Solution.concatenate(search)


def _fuse_pairs(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse pairs where both covariances are diagonal: one weight, Newton over the whole batch."""
    if 0 < len(mean) <= FEW:
        return _fuse_few(mean, cov, criterion)
    first_mean, second_mean, first, second = mean[:, 0], mean[:, 1], cov[:, 0], cov[:, 1]
    pair = Pair.of(first, second)
    search = minimise_on_interval(_pair_derivatives(pair, criterion), len(mean))
    omega = search.weights
    # With P1 + P2 = 1, (w / P1 + (1 - w) / P2)^-1 = P1 P2 / (w P2 + (1 - w) P1).
    share = omega * pair.second
    total = share + (1.0 - omega) * pair.first
    pull = pair.from_coordinates(share / total * pair.coordinates(first_mean - second_mean))
    fused_mean, fused_cov = second_mean + pull, pair.rebuild(pair.first * pair.second / total)
    weights = np.stack([omega, 1.0 - omega], -1)
    keep_sole(fused_mean, fused_cov, mean, cov, weights)
    sharp = np.minimum(pair.first.min(0), pair.second.min(0)) < SHARP
    delicate = sharp | ((omega * (1.0 - omega) < NEAR_END) & (omega > 0.0) & (omega < 1.0))
    if delicate.any():
        rows = np.flatnonzero(delicate)
        fused_mean[rows], fused_cov[rows], exact = _fuse_delicate(mean[rows], cov[rows], criterion)
        weights[rows], search.converged[rows], search.iterations[rows] = (
            exact.weights,
            exact.converged,
            exact.iterations,
        )
    return fused_mean, fused_cov, Solution(weights, search.converged, search.iterations)


def _fuse_few(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse a handful of pairs one by one in plain numbers, which spares the overhead of arrays."""
    parts = [
        _fuse_one(m, c, criterion) or _fuse_delicate(m[None], c[None], criterion)
        for m, c in zip(mean, cov, strict=True)
    ]
    if len(parts) == 1:
        return parts[0]
    means, covs, search = zip(*parts, strict=True)
    return np.concatenate(means), np.concatenate(covs), Solution.concatenate(search)


def _fuse_one(mean: Array, cov: Array, criterion: str) -> Fusion | None:
    """Fuse one pair, mean (2, n), as a batch of one; None where it is delicate. The equations of `_fuse_pairs`."""
    pair = SinglePair.of(cov[0], cov[1])
    if pair is None:
        return None
    omega, converged, iterations = minimise_one(_single_derivatives(pair, criterion))
    search = Solution(np.array([[omega, 1.0 - omega]]), np.array([converged]), np.array([iterations]))
    if omega in (0.0, 1.0):
        source = 0 if omega == 1.0 else 1
        return mean[source][None].copy(), cov[source][None].copy(), search
    if omega * (1.0 - omega) < NEAR_END:
        return None
    totals = [omega * q + (1.0 - omega) * p for p, q in zip(pair.first, pair.second, strict=True)]
    gain = np.array([omega * q / t for q, t in zip(pair.second, totals, strict=True)])
    pull = pair.basis @ (gain * (pair.inverse @ (mean[0] - mean[1])))
    fused = pair.rebuild([p * q / t for p, q, t in zip(pair.first, pair.second, totals, strict=True)])
    return (mean[1] + pull)[None], fused[None], search


#: So close to 0 or 1 the weight's own digits, not the pair's, decide: use the information form.
NEAR_END = 1e-6


def _single_derivatives(pair: SinglePair, criterion: str) -> ScalarDerivatives:
    """`_pair_derivatives` of one pair in plain numbers."""
    slopes = pair.contrast
    if criterion == "det":
        axes = list(zip(pair.first, slopes, strict=True))

        def det(w: float) -> tuple[float, float]:
            slope = curvature = 0.0
            for p, a in axes:
                ratio = a / (p + w * a)
                slope -= ratio
                curvature += ratio * ratio
            return slope, curvature

        return det
    length = (pair.basis * pair.basis).sum(0).tolist()
    terms = [(p, a, s * p * q) for p, q, a, s in zip(pair.first, pair.second, slopes, length, strict=True)]

    def trace(w: float) -> tuple[float, float]:
        slope = curvature = 0.0
        for p, a, s in terms:
            total = p + w * a
            ratio = a / total
            term = s / total * ratio
            slope -= term
            curvature += 2.0 * term * ratio
        return slope, curvature

    return trace


def _pair_derivatives(pair: Pair, criterion: str) -> Derivatives:
    """Derivatives over the weight of P1 of log det P, or of tr P, of diagonal pairs."""
    slope_of = pair.contrast
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

    search = minimise_on_interval(derivatives, len(mean))
    weights = np.stack([search.weights, 1.0 - search.weights], -1)
    return *weighted_product(mean, cov, weights), Solution(weights, search.converged, search.iterations)


def _fuse_many(mean: Array, cov: Array, criterion: str) -> Fusion:
    """Fuse K > 2 tracks, whitened by the sum of their covariances, by an interior point on the simplex."""
    batch, count, n = mean.shape
    lower = np.linalg.cholesky(cov.sum(1))
    whiten = np.linalg.inv(lower)
    info = inverse(whiten[:, None] @ cov @ transpose(whiten)[:, None])
    flat = info.reshape(batch, count, n * n)
    units = None if criterion == "det" else _whitened_units(lower, flat)

    def fused_at(w: Array, flat: Array) -> Array:
        return inverse((w[:, None] @ flat).reshape(-1, n, n))

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        every = len(rows) == batch
        part = info if every else info[rows]
        part_flat = part.reshape(len(w), count, n * n)
        fused = fused_at(w, part_flat)
        # worth is the derivative of the criterion over P; tr(F I_j F I_k) is the product of I_j and F I_k F.
        worth = fused if units is None else fused @ (units if every else units[rows]) @ fused
        image = (fused[:, None] @ part @ worth[:, None]).reshape(part_flat.shape)
        gradient = -(part_flat @ worth.reshape(len(w), n * n, 1))[..., 0]
        hessian = part_flat @ transpose(image)
        return gradient, hessian if units is None else hessian + transpose(hessian)

    search = minimise_on_simplex(gradient_hessian, batch, count)
    fused = fused_at(search.weights, flat)
    origin = mean[:, :1]
    pull = (search.weights[..., None] * matvec(info, matvec(whiten[:, None], mean - origin))).sum(1)
    fused_mean = origin[:, 0] + matvec(lower, matvec(fused, pull))
    fused_cov = symmetrise(lower @ fused @ transpose(lower))
    keep_sole(fused_mean, fused_cov, mean, cov, search.weights)
    return fused_mean, fused_cov, search


def _whitened_units(lower: Array, info: Array) -> Array:
    """Return U, (B, n, n), by which tr(U F) is the trace of the fused covariance over that at uniform weights."""
    units = transpose(lower) @ lower  # the trace of L F L' is that of F L'L
    n = lower.shape[-1]
    start = inverse(info.mean(1).reshape(-1, n, n))
    return np.asarray(units / (start * units).sum((1, 2))[:, None, None])


def _trace(a: Array) -> Array:
    return np.asarray(np.trace(a, axis1=-2, axis2=-1))


EXAMPLES: tuple[Values, ...] = ({}, TRACE, UNIFORM, GIVEN)

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
    linear=True,
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
    example=Example(EXAMPLES, (TRACE,), idempotent=True),
)
