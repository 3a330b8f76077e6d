"""The cubature Kalman filter on roots of covariances, for states whose variances span more than 1e8.

A root L, (..., n, n) lower triangular with L L' = P, has half the digits' range of P: where P as a matrix of
doubles is no longer definite, the root still is.
"""

from __future__ import annotations

import numpy as np

from track_fusion.filters.cubature import points
from track_fusion.filters.kalman import Innovation
from track_fusion.filters.sigma_points import expected_measurement
from track_fusion.linalg import Array, cholesky, matvec, solve, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition


def triangular_root(wide: Array) -> Array:
    """Return L lower triangular, diagonal >= 0, with L L' = A A': (..., n, k >= n) -> (..., n, n), by QR."""
    upper = np.asarray(np.linalg.qr(transpose(wide), mode="r"), np.float64)
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0.0, -1.0, 1.0)
    return np.asarray(transpose(upper) * sign[..., None, :])


def _scaled(deviations: Array) -> Array:
    """Columns whose outer products sum to the covariance of equally weighted deviations (..., P, k)."""
    return np.asarray(transpose(deviations) / np.sqrt(deviations.shape[-2]))


def _beside(a: Array, b: Array) -> Array:
    """Put (..., n, k) and (..., n, l) side by side, broadcasting b."""
    return np.concatenate([a, np.broadcast_to(b, (*a.shape[:-2], *b.shape[-2:]))], -1)


def predict(mean: Array, root: Array, transition: Transition) -> tuple[Array, Array]:
    """Predict x' = f(x) + w.

    Parameters
    ----------
    mean : (..., n)
    root : (..., n, n)         lower triangular root of the covariance
    transition : Transition    its noise_factor is used

    Returns
    -------
    mean (..., n), root (..., n, n)

    References     I. Arasaratnam, S. Haykin, Cubature Kalman filters, 2009, appendix B.
    """
    rule = points(mean.shape[-1])
    moved = transition.advance(rule.of(mean, root))
    shift = rule.mean(moved - moved[..., :1, :])
    deviation = moved - moved[..., :1, :] - shift[..., None, :]
    return moved[..., 0, :] + shift, triangular_root(_beside(_scaled(deviation), transition.noise_factor(mean)))


def update(mean: Array, root: Array, z: Array, sensor: Sensor) -> tuple[Array, Array, Innovation]:
    """Condition on z = h(x) + v.

    Parameters
    ----------
    mean : (..., n)
    root : (..., n, n)
    z : (..., m)
    sensor : Sensor    R positive definite

    Returns
    -------
    mean (..., n), root (..., n, n), Innovation

    Notes    One QR of [[Z, R^1/2], [X, 0]], (m + n) x (2 n + m), gives the innovation's root, the gain and the
             posterior's root.
    """
    (*_, n), m = mean.shape, z.shape[-1]
    sigma = points(n).of(mean, root)
    expected, seen = expected_measurement(mean, sigma, sensor, points(n))
    above = _beside(_scaled(seen), cholesky(sensor.noise))
    below = _beside(_scaled(sigma - mean[..., None, :]), np.zeros((n, m)))
    joint = triangular_root(np.concatenate([above, below], -2))
    spread_root, cross, left = joint[..., :m, :m], joint[..., m:, :m], joint[..., m:, m:]
    residual = sensor.residual(z, expected)
    white = solve(spread_root, residual[..., None])[..., 0]
    innovation = Innovation(residual, symmetrise(spread_root @ transpose(spread_root)), (white**2).sum(-1))
    return mean + matvec(cross, white), left, innovation
