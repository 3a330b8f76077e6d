"""What the unscented and the cubature filter share: Gaussians pushed through functions by a few points."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.filters.kalman import Innovation
from track_fusion.linalg import Array, cholesky, mahalanobis_squared, matvec, solve, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition


@dataclasses.dataclass(frozen=True)
class SigmaPoints:
    """Points that stand for N(0, 1) in n axes.

    Attributes
    ----------
    offsets : (P, n)
    mean_weight, cov_weight : (P,)    weights in means and in covariances
    """

    offsets: Array
    mean_weight: Array
    cov_weight: Array

    def of(self, mean: Array, root: Array) -> Array:
        """Points (..., P, n) of a Gaussian with this mean and root of its covariance, (..., n, n)."""
        return np.asarray(mean[..., None, :] + self.offsets @ transpose(root))

    def mean(self, deviations: Array) -> Array:
        """Mean of values at the points, (..., P, k) -> (..., k)."""
        return np.asarray((self.mean_weight[:, None] * deviations).sum(-2))

    def cross(self, a: Array, b: Array) -> Array:
        """Weighted sum of a b' over the points, (..., P, k), (..., P, l) -> (..., k, l)."""
        return np.asarray(transpose(self.cov_weight[:, None] * a) @ b)


def predict(mean: Array, cov: Array, transition: Transition, points: SigmaPoints) -> tuple[Array, Array]:
    """Predict x' = f(x) + w: moments of f at the points, plus Q; shapes (..., n), (..., n, n)."""
    moved = transition.advance(points.of(mean, cholesky(cov)))
    origin = moved[..., :1, :]
    shift = points.mean(moved - origin)
    deviation = moved - origin - shift[..., None, :]
    return origin[..., 0, :] + shift, symmetrise(points.cross(deviation, deviation) + transition.noise(mean))


def expected_measurement(mean: Array, sigma: Array, sensor: Sensor, points: SigmaPoints) -> tuple[Array, Array]:
    """Return the expected measurement (..., m) and its deviations at the points (..., P, m), angles wrapped."""
    reference = sensor.observe(mean)
    turned = sensor.residual(sensor.observe(sigma), reference[..., None, :])
    shift = points.mean(turned)
    return reference + shift, turned - shift[..., None, :]


def update(mean: Array, cov: Array, z: Array, sensor: Sensor, points: SigmaPoints) -> tuple[Array, Array, Innovation]:
    """Condition on z = h(x) + v by the joint Gaussian that the points give.

    The posterior covariance is summed from the points' remaining deviations, so that it stays definite when
    all weights are positive.
    """
    sigma = points.of(mean, cholesky(cov))
    expected, seen = expected_measurement(mean, sigma, sensor, points)
    offset = sigma - mean[..., None, :]
    spread = symmetrise(points.cross(seen, seen) + sensor.noise)
    gain = transpose(solve(spread, points.cross(seen, offset)))
    left = offset - seen @ transpose(gain)
    posterior = symmetrise(points.cross(left, left) + gain @ sensor.noise @ transpose(gain))
    residual = sensor.residual(z, expected)
    innovation = Innovation(residual, spread, mahalanobis_squared(residual, spread))
    return mean + matvec(gain, residual), posterior, innovation
