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


def solve(a: Array, b: Array) -> Array:
    """Return A^-1 B, (..., n, n), (..., n, k) -> (..., n, k).

    Raises
    ------
    LinAlgError    a matrix is singular
    """
    return np.asarray(np.linalg.solve(a, b), np.float64)


def cholesky(cov: Array) -> Array:
    """Lower triangular root of positive definite matrices, (..., n, n).

    Raises
    ------
    LinAlgError    a matrix is not positive definite
    """
    return np.asarray(np.linalg.cholesky(cov), np.float64)


def logdet(cov: Array) -> Array:
    """Log-determinant of positive definite matrices, (..., n, n) -> (...)."""
    diagonal = np.diagonal(np.linalg.cholesky(cov), axis1=-2, axis2=-1)
    return np.asarray(2.0 * np.log(diagonal).sum(-1))


def mahalanobis_squared(residual: Array, cov: Array) -> Array:
    """Squared Mahalanobis length r' P^-1 r, (..., n), (..., n, n) -> (...)."""
    return np.asarray((residual * np.linalg.solve(cov, residual[..., None])[..., 0]).sum(-1))


def is_positive_definite(cov: Array) -> NDArray[np.bool_]:
    """Tell which matrices have a Cholesky factor, (..., n, n) -> (...)."""
    good = np.ones(cov.shape[:-2], bool)
    flat = cov.reshape(-1, *cov.shape[-2:])
    good.reshape(-1)[_without_factor(flat, 0)] = False
    return good


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
