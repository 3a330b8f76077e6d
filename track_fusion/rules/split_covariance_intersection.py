"""Split covariance intersection: only the part of the errors that may be correlated is intersected."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, inverse, is_positive_definite, matvec, symmetrise, transpose
from track_fusion.optimise import GradientHessian, Solution, minimise_on_simplex
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, Rule, SourceTracks, check_weights

#: An independent part may exceed the covariance it is a part of by this share of the tracks' sum: rounding.
ROUNDING = 1e-9
#: A weight below this is taken as this: the limit at zero, where a track gives only what is surely independent.
SMALLEST = 1e-14


@dataclasses.dataclass(frozen=True)
class SplitCovarianceIntersectionParams(Params):
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


def fuse(tracks: SourceTracks, params: SplitCovarianceIntersectionParams) -> FusedTracks:
    """Fuse K Gaussian tracks by split covariance intersection: P^-1 = sum of (D_i / w_i + I_i)^-1.

    P_i = D_i + I_i, where the errors of covariance I_i are independent of all others and nothing is known of the
    correlation of those of D_i. Conservative, if each track and its independent part are.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); extras independent_cov (..., K, n, n), I_i, positive
                             semi-definite and not above cov
    params : SplitCovarianceIntersectionParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), info independent_cov (..., n, n), the independent
                   part of the fused covariance, and converged, iterations

    Raises
    ------
    ValueError     given weights do not fit, independent parts have a wrong shape or exceed the covariances
    LinAlgError    a covariance is singular

    Notes          Without independent parts it is covariance intersection, with nothing else naive fusion. The
                   program is convex in the weights. O(K n^3), about ten times that for weights that are sought.
    References     N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking: Performance and
                   Comparison, section 1.1; S. Julier and J. Uhlmann, General decentralized data fusion with
                   covariance intersection, 2001.
    """
    batch, (count, n) = tracks.mean.shape[:-2], tracks.mean.shape[-2:]
    if params.weights and params.criterion != "given":
        raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {params.criterion!r}.")
    mean, cov = tracks.mean.reshape(-1, count, n), tracks.cov.reshape(-1, count, n, n)
    alone = _independent(tracks).reshape(cov.shape)
    parts = _Parts.of(mean, cov, alone)
    info = {}
    if params.criterion == "given":
        weights = np.broadcast_to(check_weights(params.weights, count), mean.shape[:2])
    elif params.criterion == "uniform" or count == 1:
        weights = np.full(mean.shape[:2], 1.0 / count)
    else:
        found = _optimal(parts, params.criterion)
        weights = found.weights
        info = {"converged": found.converged.reshape(batch), "iterations": found.iterations.reshape(batch)}
    if count == 1:
        fused_mean, fused_cov, left = mean[:, 0].copy(), cov[:, 0].copy(), alone[:, 0].copy()
    else:
        fused_mean, fused_cov, left = parts.fused_at(weights, mean[:, 0])
    return FusedTracks(
        fused_mean.reshape(*batch, n), fused_cov.reshape(*batch, n, n), weights.reshape(*batch, count),
        info={**info, "independent_cov": left.reshape(*batch, n, n)},
    )  # fmt: skip


def _independent(tracks: SourceTracks) -> Array:
    alone = np.asarray(tracks.extras["independent_cov"], float)
    if alone.shape != tracks.cov.shape:
        raise ValueError(
            f"The 'independent_cov' of source tracks must have shape {tracks.cov.shape}. Got {alone.shape}."
        )
    return symmetrise(alone)


@dataclasses.dataclass(frozen=True)
class _Parts:
    """Tracks whitened by the sum of their covariances, L L': points (B, K, n), shared and alone (B, K, n, n)."""

    lower: Array
    points: Array
    shared: Array
    alone: Array

    @classmethod
    def of(cls, mean: Array, cov: Array, alone: Array) -> _Parts:
        lower = np.linalg.cholesky(cov.sum(1))
        whiten = np.linalg.inv(lower)[:, None]
        alone = symmetrise(whiten @ alone @ transpose(whiten))
        shared = symmetrise(whiten @ cov @ transpose(whiten)) - alone
        slack = ROUNDING * np.eye(mean.shape[-1])
        for part, text in ((alone, "be positive semi-definite"), (shared, "not exceed 'cov'")):
            if not is_positive_definite(part + slack).all():
                lowest = np.linalg.eigvalsh(part).min()
                raise ValueError(
                    f"The 'independent_cov' of source tracks must {text}. Relative to the tracks' sum, the lowest "
                    f"eigenvalue {'of it' if part is alone else 'of what it leaves'} is {lowest:.3g}."
                )
        return cls(lower, matvec(whiten, mean - mean[:, :1]), shared, alone)

    def info(self, weights: Array, rows: NDArray[np.intp] | slice = slice(None)) -> Array:
        """(D_i / w_i + I_i)^-1, (B, K, n, n)."""
        share = np.maximum(weights, SMALLEST)[..., None, None]
        return inverse(self.shared[rows] / share + self.alone[rows])

    def fused_at(self, weights: Array, origin: Array) -> tuple[Array, Array, Array]:
        """Fused mean (B, n), covariance and its independent part (B, n, n)."""
        info = self.info(weights)
        cov = inverse(info.sum(1))
        gain = cov[:, None] @ info
        mean = origin + matvec(self.lower, matvec(gain, self.points).sum(1))
        alone = (gain @ self.alone @ transpose(gain)).sum(1)
        whole, part = (symmetrise(self.lower @ a @ transpose(self.lower)) for a in (cov, alone))
        return mean, whole, part


def _optimal(parts: _Parts, criterion: str) -> Solution:
    """Weights of least log det P or tr P."""
    batch, count, n = parts.points.shape
    return minimise_on_simplex(_gradient_hessian(parts, criterion), batch, count)


def _gradient_hessian(parts: _Parts, criterion: str) -> GradientHessian:
    """Derivatives over the weights: with A = (D / w + I)^-1, A' = A D A / w^2 and A'' = -2 A I A' / w."""
    n = parts.points.shape[-1]
    units = transpose(parts.lower) @ parts.lower
    start = inverse(parts.info(np.full(parts.points.shape[:2], 1.0 / parts.points.shape[1])).sum(1))
    units = units / (units * start).sum((1, 2))[:, None, None]

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        info, share = parts.info(w, rows), np.maximum(w, SMALLEST)[..., None, None]
        cov = inverse(info.sum(1))
        worth = cov if criterion == "det" else cov @ units[rows] @ cov
        scaled = info / share
        rise = scaled @ parts.shared[rows] @ transpose(scaled)
        bend = symmetrise(scaled @ parts.alone[rows] @ rise)
        flat = rise.reshape(*w.shape, n * n)
        gradient = -(flat @ worth.reshape(len(w), n * n, 1))[..., 0]
        image = (cov[:, None] @ rise @ worth[:, None]).reshape(flat.shape)
        hessian = flat @ transpose(image)
        hessian = hessian if criterion == "det" else hessian + transpose(hessian)
        diagonal = np.arange(w.shape[1])
        hessian[:, diagonal, diagonal] += 2.0 * (bend * worth[:, None]).sum((2, 3))
        return gradient, hessian

    return gradient_hessian


RULE = Rule(
    key="split_covariance_intersection",
    title="Split covariance intersection",
    fuse=fuse,
    params=SplitCovarianceIntersectionParams,
    family="gaussian",
    arity="n_ary",
    guarantee="conservative",
    caveat="if every track is and its independent part is independent of all others",
    source="Sharma 1.1 (Julier and Uhlmann)",
    cost="K n^3, about ten times that for weights that are sought",
    needs=("independent_cov",),
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
)
