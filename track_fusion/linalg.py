"""Leaves of linear algebra on stacks of small symmetric positive definite matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Relative asymmetry up to which a covariance is taken as symmetric with rounding noise.
ASYMMETRY_TOLERANCE = 1e-6


def transpose(a: Array) -> Array:
    """Swap the last two axes."""
    return np.swapaxes(a, -1, -2)


def symmetrise(a: Array) -> Array:
    """Return (a + a') / 2, shape (..., n, n)."""
    return 0.5 * (a + transpose(a))


def asymmetric(a: Array) -> bool:
    """Tell whether any matrix, (..., n, n), differs from its transpose by more than rounding."""
    return bool((np.abs(a - transpose(a)) > ASYMMETRY_TOLERANCE * np.abs(a).max((-2, -1), keepdims=True)).any())


def outer(a: Array) -> Array:
    """Return a a' of each vector: (..., n) -> (..., n, n)."""
    return a[..., :, None] * a[..., None, :]


def matvec(a: Array, x: Array) -> Array:
    """Return A x: (..., m, n), (..., n) -> (..., m)."""
    return np.asarray(np.matmul(a, x[..., None])[..., 0])


def inverse(cov: Array) -> Array:
    """Invert symmetric positive definite matrices, keeping them symmetric.

    Raises
    ------
    LinAlgError    a matrix is singular
    """
    return symmetrise(np.asarray(np.linalg.inv(cov), np.float64))


def cholesky(cov: Array) -> Array:
    """Lower triangular factors of positive definite matrices, (..., n, n).

    Raises
    ------
    LinAlgError    a matrix is not positive definite
    """
    return np.asarray(np.linalg.cholesky(cov), np.float64)


def whitener(cov: Array) -> Array:
    """W, lower triangular, with W P W' = 1 for positive definite matrices P, (..., n, n)."""
    return np.asarray(np.linalg.inv(cholesky(cov)), np.float64)


def solve(a: Array, b: Array) -> Array:
    """Return A^-1 B, (..., n, n), (..., n, k) -> (..., n, k).

    Raises
    ------
    LinAlgError    a matrix is singular
    """
    return np.asarray(np.linalg.solve(a, b), np.float64)


def logdet(cov: Array) -> Array:
    """Log-determinant of positive definite matrices, (..., n, n) -> (...)."""
    diagonal = np.diagonal(np.linalg.cholesky(cov), axis1=-2, axis2=-1)
    return np.asarray(2.0 * np.log(diagonal).sum(-1))


def keep_sole(fused_mean: Array, fused_cov: Array, mean: Array, cov: Array, weights: Array) -> None:
    """Where one track has weight 1 and all others 0, put that track itself in place of the computed result.

    Shapes (..., n), (..., n, n), (..., K, n), (..., K, n, n), (..., K).
    """
    sole = (weights == 1.0) & (weights.sum(-1, keepdims=True) == 1.0)
    if sole.any():
        *batch, _ = at = np.nonzero(sole)
        fused_mean[tuple(batch)], fused_cov[tuple(batch)] = mean[at], cov[at]


def merged_moments(mean: Array, cov: Array, weights: Array) -> tuple[Array, Array]:
    """Mean and covariance of a Gaussian mixture, Li 2022 (5), (10)-(11).

    Parameters
    ----------
    mean : (..., K, n)
    cov : (..., K, n, n)
    weights : (..., K)    sum to one

    Returns
    -------
    mean (..., n), cov (..., n, n)
    """
    origin = mean[..., 0, :]
    offset = mean - origin[..., None, :]
    shift = (weights[..., None] * offset).sum(-2)
    spread = cov + outer(offset - shift[..., None, :])
    merged_mean, merged_cov = origin + shift, symmetrise((weights[..., None, None] * spread).sum(-3))
    keep_sole(merged_mean, merged_cov, mean, cov, weights)
    return merged_mean, merged_cov


def sample_moments(weight: Array, points: Array) -> tuple[Array, Array]:
    """Mean (..., n) and covariance (..., n, n) of weighted samples: weight (..., N), sum one, points (..., N, n)."""
    origin = points[..., :1, :]
    offset = points - origin
    shift = weight[..., None, :] @ offset
    offset -= shift
    return (origin + shift)[..., 0, :], symmetrise(transpose(weight[..., None] * offset) @ offset)


#: A pivot of a matrix scaled to order one that is smaller counts as zero.
SMALLEST_PIVOT = 1e-9


def eliminate(a: Array, b: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Tell which a (..., n, n) are positive definite; log-determinant and b' a^-1 b of those.

    Gaussian elimination over the whole stack: unlike Cholesky it does not stop at a matrix that is indefinite.
    """
    n = a.shape[-1]
    a, b = np.array(np.moveaxis(a, (-2, -1), (0, 1)), order="C"), np.array(np.moveaxis(b, -1, 0), order="C")
    positive = np.ones(a.shape[2:], bool)
    logdet, square = np.zeros(a.shape[2:]), np.zeros(a.shape[2:])
    for k in range(n):
        good = a[k, k] > SMALLEST_PIVOT
        positive &= good
        pivot = np.where(good, a[k, k], 1.0)
        logdet += np.log(pivot)
        square += b[k] * b[k] / pivot
        for i in range(k + 1, n):
            ratio = a[i, k] / pivot
            a[i, k + 1 :] -= ratio * a[k, k + 1 :]
            b[i] -= ratio * b[k]
    return positive, logdet, square


def mahalanobis_squared(residual: Array, cov: Array) -> Array:
    """Squared Mahalanobis length r' P^-1 r, (..., n), (..., n, n) -> (...)."""
    return np.asarray((residual * np.linalg.solve(cov, residual[..., None])[..., 0]).sum(-1))


def is_positive_definite(cov: Array) -> NDArray[np.bool_]:
    """Tell which matrices have a Cholesky factor, (..., n, n) -> (...)."""
    good = np.ones(cov.shape[:-2], bool)
    flat = cov.reshape(-1, *cov.shape[-2:])
    good.reshape(-1)[_without_factor(flat, 0)] = False
    return good


#: A covariance is well conditioned when it stays definite with this share of its variances taken away: some thousand
#: times the rounding error of inverting it.
RIDGE = 1e-12


def is_well_conditioned(cov: Array) -> NDArray[np.bool_]:
    """Tell which covariances are positive definite by more than rounding, (..., n, n) -> (...)."""
    n, reduced = cov.shape[-1], np.array(cov, order="C")
    reduced.reshape(*cov.shape[:-2], n * n)[..., :: n + 1] *= 1.0 - RIDGE  # the diagonals
    return is_positive_definite(reduced)


def _without_factor(cov: Array, start: int) -> list[int]:
    """List the matrices, counted from `start`, that have no Cholesky factor, by halving: a few bad ones are cheap."""
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        if len(cov) == 1:
            return [start]
        half = len(cov) // 2
        return _without_factor(cov[:half], start) + _without_factor(cov[half:], start + half)
    return []
