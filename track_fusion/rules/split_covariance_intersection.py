"""Split covariance intersection: only the part of the errors that may be correlated is intersected."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, inverse, matvec, symmetrise, transpose
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.covariance_intersection import EXAMPLES, CovarianceIntersectionParams
from track_fusion.rules.shared.weights import TRACE, diagnostics
from track_fusion.solvers.optimise import GradientHessian, minimise_on_simplex

#: An independent part may leave the range from nothing to the covariance by this share of that: rounding.
ROUNDING = 1e-9
#: A weight below this is taken as this: the limit at zero, where a track gives only what is surely independent.
SMALLEST = 1e-14


def fuse(tracks: SourceTracks, params: CovarianceIntersectionParams) -> FusedTracks:
    """Fuse K Gaussian tracks by split covariance intersection: P^-1 = sum of (D_i / w_i + I_i)^-1.

    P_i = D_i + I_i, where the errors of covariance I_i are independent of all others and nothing is known of the
    correlation of those of D_i. Conservative, if each track and its independent part are.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); extras independent_cov (..., K, n, n), I_i, positive
                             semi-definite and not above cov
    params : CovarianceIntersectionParams

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
    weights, info = params.fixed(tracks), {}
    mean, cov = tracks.flat
    alone = _independent(tracks).reshape(cov.shape)
    parts = _Parts.of(mean, cov, alone)
    if tracks.count == 1:
        ones = np.ones(mean.shape[:2])
        info = {"independent_cov": alone[:, 0].copy()}
        return tracks.fused(mean[:, 0].copy(), cov[:, 0].copy(), ones, info=info)
    if weights is None:
        search = minimise_on_simplex(_gradient_hessian(parts, params.criterion), len(mean), tracks.count)
        weights, info = search.weights, diagnostics(search)
    weights = weights.reshape(mean.shape[:2])
    fused_mean, fused_cov, left = parts.fused_at(weights, mean[:, 0])
    return tracks.fused(fused_mean, fused_cov, weights, info={**info, "independent_cov": left})


def _independent(tracks: SourceTracks) -> Array:
    alone = np.asarray(tracks.extras["independent_cov"], float)
    if alone.shape != tracks.cov.shape:
        raise ValueError(
            f"The 'independent_cov' of source tracks must have shape {tracks.cov.shape}. Got {alone.shape}."
        )
    return symmetrise(alone)


@dataclasses.dataclass(frozen=True)
class _Parts:
    """Tracks whitened by the sum of their covariances, L L', each part diagonal in the frame U of its track.

    P_i = T T', I_i = T diag(alone) T', D_i = T diag(1 - alone) T', T = U^-1; so the information of track i at weight w
    is U' diag(w / (1 - alone + w alone)) U.

    Attributes
    ----------
    lower : (B, n, n)       L
    points : (B, K, n)      the means, from the first
    frame : (B, K, n, n)    U
    alone : (B, K, n)       independent share of each axis, in [0, 1]
    """

    lower: Array
    points: Array
    frame: Array
    alone: Array

    @classmethod
    def of(cls, mean: Array, cov: Array, part: Array) -> _Parts:
        lower = np.linalg.cholesky(cov.sum(1))
        whiten = np.linalg.inv(lower)[:, None]
        own = np.linalg.inv(np.linalg.cholesky(symmetrise(whiten @ cov @ transpose(whiten))))
        rooted = own @ whiten
        share, vectors = np.linalg.eigh(symmetrise(rooted @ part @ transpose(rooted)))
        if share.size and share.min() < -ROUNDING:
            raise ValueError(
                "The 'independent_cov' of source tracks must be positive semi-definite. "
                f"Its lowest eigenvalue relative to 'cov' is {share.min():.3g}."
            )
        if share.size and share.max() > 1.0 + ROUNDING:
            raise ValueError(
                "The 'independent_cov' of source tracks must not exceed 'cov'. "
                f"Its largest eigenvalue relative to 'cov' is {share.max():.3g}."
            )
        return cls(lower, matvec(whiten, mean - mean[:, :1]), transpose(vectors) @ own, np.clip(share, 0.0, 1.0))

    def value(self, weights: Array, rows: NDArray[np.intp] | slice = slice(None)) -> tuple[Array, Array]:
        """Diagonal of each track's information in its frame, and w / diagonal, (B, K, n)."""
        weights = np.maximum(weights, SMALLEST)[..., None]
        alone = self.alone[rows]
        total = (1.0 - alone) + weights * alone
        return weights / total, total

    def fused_at(self, weights: Array, origin: Array) -> tuple[Array, Array, Array]:
        """Fused mean (B, n), covariance and its independent part (B, n, n)."""
        value, _ = self.value(weights)
        info = _rebuilt(self.frame, value)
        cov = inverse(info.sum(1))
        gain = cov[:, None] @ info
        mean = origin + matvec(self.lower, matvec(gain, self.points).sum(1))
        alone = cov @ _rebuilt(self.frame, value * self.alone * value).sum(1) @ cov
        whole, part = (symmetrise(self.lower @ a @ transpose(self.lower)) for a in (cov, alone))
        return mean, whole, part


def _rebuilt(frame: Array, diagonal: Array) -> Array:
    """U' diag(d) U."""
    return symmetrise((transpose(frame) * diagonal[..., None, :]) @ frame)


def _gradient_hessian(parts: _Parts, criterion: str) -> GradientHessian:
    """Derivatives of log det P, or of tr P over that at equal weights, from those of each track's information.

    With a the independent share, w / (1 - a + w a) has the derivatives (1 - a) / (1 - a + w a)^2 and
    -2 a (1 - a) / (1 - a + w a)^3.
    """
    count, n = parts.points.shape[1:]
    equal = _rebuilt(parts.frame, parts.value(np.full(parts.points.shape[:2], 1.0 / count))[0])
    units = transpose(parts.lower) @ parts.lower
    units = units / (units * inverse(equal.sum(1))).sum((1, 2))[:, None, None]

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        frame, alone = parts.frame[rows], parts.alone[rows]
        value, total = parts.value(w, rows)
        cov = inverse(_rebuilt(frame, value).sum(1))
        worth = cov if criterion == "det" else cov @ units[rows] @ cov
        rise = (1.0 - alone) / total**2
        length = (frame @ worth[:, None] * frame).sum(-1)  # diagonal of U worth U'
        gradient = -(rise * length).sum(-1)
        slope = _rebuilt(frame, rise)
        flat, image = slope.reshape(*w.shape, n * n), (cov[:, None] @ slope @ worth[:, None]).reshape(*w.shape, n * n)
        hessian = flat @ transpose(image)
        hessian = hessian if criterion == "det" else hessian + transpose(hessian)
        diagonal = np.arange(count)
        hessian[:, diagonal, diagonal] += 2.0 * (rise * alone / total * length).sum(-1)
        return gradient, hessian

    return gradient_hessian


RULE = Rule(
    key="split_covariance_intersection",
    title="Split covariance intersection",
    fuse=fuse,
    params=CovarianceIntersectionParams,
    family="gaussian",
    arity="n_ary",
    guarantee="conservative",
    caveat="if every track is and its independent part is independent of all others",
    source="Sharma 1.1 (Julier and Uhlmann)",
    cost="K n^3, about ten times that for weights that are sought",
    needs=("independent_cov",),
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
    example=Example(EXAMPLES, (TRACE,), idempotent=False),
)
