"""A Kalman filter robust to outliers: noises are Gaussian mostly and Student-t sometimes, by variational Bayes.

Assumptions, after Huang et al. 2019, whose parameter values are not in the papers reproduced here:
the predicted state and the measurement noise are each N(0, C) with probability p and Student-t(0, C, dof) else, with
C the nominal covariance (the scatter of the Student-t part); p ~ Beta(a, b) anew at each step. The posterior is
approximated by independent factors for the state (Gaussian), the two scales, indicators and probabilities.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma

from track_fusion.filters import extended
from track_fusion.linalg import Array, mahalanobis_squared, matvec, solve, symmetrise, transpose
from track_fusion.models.base import Sensor
from track_fusion.params import Params, param

#: Predicting is the extended Kalman filter's.
predict = extended.predict


@dataclasses.dataclass(frozen=True)
class MixtureNoiseParams(Params):
    """How heavy the tails are, how likely, and when the iteration ends."""

    dof: float = param(3.0, "degrees of freedom of the Student-t parts", low=0.0, strict=True)
    gaussian_count: float = param(0.85, "a: prior count of Gaussian noises", low=0.0, strict=True)
    student_count: float = param(0.15, "b: prior count of Student-t noises", low=0.0, strict=True)
    max_iterations: int = param(100, "end after so many iterations", low=1)
    tolerance: float = param(1e-10, "end when the shares of Gaussian noise change by less than this", low=0.0)


@dataclasses.dataclass(frozen=True)
class Robustness:
    """What an update learned of the noises.

    Attributes
    ----------
    state_share, noise_share : (...)        probability that the prediction's, the measurement's error is Gaussian
    state_precision, noise_precision : (...)    factor on the nominal information: small for an outlier
    converged : (...) bool
    iterations : int
    """

    state_share: Array
    noise_share: Array
    state_precision: Array
    noise_precision: Array
    converged: NDArray[np.bool_]
    iterations: int


DEFAULTS = MixtureNoiseParams()


def update(
    mean: Array, cov: Array, z: Array, sensor: Sensor, params: MixtureNoiseParams = DEFAULTS
) -> tuple[Array, Array, Robustness]:
    """Condition on z = h(x) + v, h linearised at the mean.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)    nominal covariance of the prediction
    z : (..., m)
    sensor : Sensor      its noise is the nominal covariance
    params : MixtureNoiseParams

    Returns
    -------
    mean (..., n), cov (..., n, n), Robustness

    Notes         Coordinate ascent on the evidence's lower bound, O(iterations n^3); it finds a local optimum,
                  starting from Gaussian noises. Mean-field posteriors tend to be too sure.
    References    Y. Huang, Y. Zhang, Y. Zhao, J. Chambers, A novel robust Gaussian-Student's t mixture
                  distribution based Kalman filter, 2019.
    """
    slope, residual = sensor.jacobian(mean), sensor.residual(z, sensor.observe(mean))
    lead = np.broadcast_shapes(mean.shape[:-1], z.shape[:-1])
    share, weight = np.full((2, *lead), params.gaussian_count / _total(params)), np.ones((2, *lead))
    change, iteration = np.full(lead, np.inf), 0
    while iteration < params.max_iterations and (change > params.tolerance).any():
        offset, posterior = _condition(cov, residual, slope, sensor.noise, share + (1.0 - share) * weight)
        state_square = mahalanobis_squared(offset, cov) + _trace_ratio(cov, posterior)
        left, seen = residual - matvec(slope, offset), slope @ posterior @ transpose(slope)
        noise = np.broadcast_to(sensor.noise, (*lead, *sensor.noise.shape[-2:]))
        square = np.stack([state_square, mahalanobis_squared(left, noise) + _trace_ratio(noise, seen)])
        new_share, weight = _noise_factors(square, share, np.array([mean.shape[-1], z.shape[-1]]), params)
        change, share, iteration = np.abs(new_share - share).max(0), new_share, iteration + 1
    precision = share + (1.0 - share) * weight
    offset, posterior = _condition(cov, residual, slope, sensor.noise, precision)
    converged = np.asarray(change <= params.tolerance)
    return mean + offset, posterior, Robustness(share[0], share[1], precision[0], precision[1], converged, iteration)


def _total(params: MixtureNoiseParams) -> float:
    return params.gaussian_count + params.student_count


def _condition(cov: Array, residual: Array, slope: Array, noise: Array, precision: Array) -> tuple[Array, Array]:
    """Kalman update with both covariances divided by their precisions (2, ...): shift (..., n), cov (..., n, n)."""
    cov, noise = cov / precision[0, ..., None, None], noise / precision[1, ..., None, None]
    spread = symmetrise(slope @ cov @ transpose(slope) + noise)
    gain = transpose(solve(spread, slope @ cov))
    keep = np.eye(cov.shape[-1]) - gain @ slope
    return matvec(gain, residual), symmetrise(keep @ cov @ transpose(keep) + gain @ noise @ transpose(gain))


def _trace_ratio(cov: Array, other: Array) -> Array:
    """Trace of cov^-1 other."""
    return np.asarray(np.trace(solve(cov, other), axis1=-2, axis2=-1))


def _noise_factors(
    square: Array, share: Array, size: NDArray[np.int64], params: MixtureNoiseParams
) -> tuple[Array, Array]:
    """Update scales, probabilities and indicators from expected squares (2, ...).

    Returns the new shares of Gaussian noise and the mean scales of Student-t noise, (2, ...) each. The scales' and
    probabilities' factors use the old shares, so that at a fixed point all belong together.
    """
    size = size.reshape(2, *(1,) * (square.ndim - 1))
    shape, rate = 0.5 * (params.dof + size * (1.0 - share)), 0.5 * (params.dof + (1.0 - share) * square)
    weight, log_weight = shape / rate, digamma(shape) - np.log(rate)
    log_odds = digamma(params.gaussian_count + share) - digamma(params.student_count + 1.0 - share)
    log_odds = log_odds - 0.5 * square - 0.5 * (size * log_weight - weight * square)
    new_share = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -700.0, 700.0)))
    return new_share, np.asarray(weight)
