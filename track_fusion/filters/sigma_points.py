"""What the unscented and the cubature filter share: Gaussians pushed through functions by a few points."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod

import numpy as np

from track_fusion.angles import OPPOSITE, within_half_circle
from track_fusion.filters.base import Gaussian, GaussianFilter, Innovation
from track_fusion.linalg import Array, cholesky, matvec, solve, symmetrise, transpose
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


def expected_measurement(mean: Array, sigma: Array, sensor: Sensor, points: SigmaPoints) -> tuple[Array, Array]:
    """Return the expected measurement (..., m) and its deviations at the points (..., P, m), angles unrolled."""
    reference = sensor.observe(mean)
    turned = unrolled(mean, sigma, reference, sensor)
    shift = points.mean(turned)
    return reference + shift, turned - shift[..., None, :]


def unrolled(mean: Array, sigma: Array, reference: Array, sensor: Sensor) -> Array:
    """Return by how much the points' measurements differ from that of the mean, (..., P, m).

    The short way round may be the wrong one for an axis of the state itself: where a difference was wrapped, it is
    summed over two steps, to the point halfway and from there. So a direction whose standard deviation is 90 degrees
    is measured as if it did not wrap, up to points a whole turn away.

    Raises
    ------
    LinAlgError    measured directions, other than axes of the state, lie beyond a half circle: the points surround
                   the sensor
    """
    seen = sensor.observe(sigma)
    turned = sensor.residual(seen, reference[..., None, :])
    if np.array_equal(turned, seen - reference[..., None, :]):
        unwrapped = turned
    else:
        halfway = sensor.observe(0.5 * (sigma + mean[..., None, :]))
        unwrapped = sensor.residual(halfway, reference[..., None, :]) + sensor.residual(seen, halfway)
    beyond = ~within_half_circle(unwrapped, sensor.periods)
    if beyond.any():
        straight = (sigma - mean[..., None, :]) @ transpose(sensor.jacobian(mean))
        bent = np.isfinite(sensor.periods) & (np.abs(unwrapped - straight) > OPPOSITE)
        if (beyond & bent.any((-2, -1))).any():
            raise np.linalg.LinAlgError(
                "The sigma points surround the sensor: what they measure has no mean direction."
            )
    return unwrapped


class SigmaPointFilter(GaussianFilter, ABC):
    """A filter that a choice of points makes; it raises a LinAlgError where a covariance is not positive definite."""

    @abstractmethod
    def points(self, size: int) -> SigmaPoints:
        """Return the points for n axes."""

    def predict(self, state: Gaussian, transition: Transition) -> Gaussian:
        """Predict x' = f(x) + w: moments of f at the points, plus Q."""
        points = self.points(state.mean.shape[-1])
        moved = transition.advance(points.of(state.mean, cholesky(state.cov)))
        origin = moved[..., :1, :]
        shift = points.mean(moved - origin)
        deviation = moved - origin - shift[..., None, :]
        cov = symmetrise(points.cross(deviation, deviation) + transition.noise(state.mean))
        return Gaussian(origin[..., 0, :] + shift, cov, state.dof)

    def update(self, state: Gaussian, z: Array, sensor: Sensor) -> tuple[Gaussian, Innovation]:
        """Condition on z = h(x) + v, (..., m), by the joint Gaussian that the points give.

        Angles are averaged about the measurement of the mean. The posterior covariance is summed from the
        points' remaining deviations, so that it stays definite when all weights are positive.
        """
        points, mean = self.points(state.mean.shape[-1]), state.mean
        sigma = points.of(mean, cholesky(state.cov))
        expected, seen = expected_measurement(mean, sigma, sensor, points)
        offset = sigma - mean[..., None, :]
        spread = symmetrise(points.cross(seen, seen) + sensor.noise)
        gain = transpose(solve(spread, points.cross(seen, offset)))
        left = offset - seen @ transpose(gain)
        posterior = symmetrise(points.cross(left, left) + gain @ sensor.noise @ transpose(gain))
        residual = sensor.residual(z, expected)
        return Gaussian(mean + matvec(gain, residual), posterior, state.dof), Innovation(residual, spread)
