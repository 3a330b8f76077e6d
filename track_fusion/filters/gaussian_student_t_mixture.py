"""A Kalman filter robust to outliers: noises are Gaussian mostly and Student-t sometimes, by variational Bayes.

Assumptions, after Huang et al. 2019, whose parameter values are not in the papers reproduced here:
the predicted state and the measurement noise are each N(0, C) with probability p and Student-t(0, C, dof) else, with
C the nominal matrix (covariance of the Gaussian part, scatter of the Student-t part); p ~ Beta(a, b) anew at each
step. The posterior is approximated by independent factors for the state (Gaussian), the two scales, indicators and
probabilities.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma

from track_fusion.filters.base import Gaussian
from track_fusion.filters.extended import Linearising
from track_fusion.filters.kalman import joseph, linear_gain
from track_fusion.filters.student_t import cov_from_scatter, scatter_from_cov
from track_fusion.linalg import Array, matvec, outer, solve, symmetrise, transpose
from track_fusion.models.base import Sensor
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class MixtureNoiseParams(Params):
    """How heavy the tails are, how likely, and when the iteration ends."""

    dof: float = param(3.0, "degrees of freedom of the Student-t parts", low=0.0, strict=True)
    gaussian_count: float = param(0.85, "a: prior count of Gaussian noises", low=0.0, strict=True)
    student_count: float = param(0.15, "b: prior count of Student-t noises", low=0.0, strict=True)
    max_iterations: int = param(100, "end after so many iterations", low=1)
    tolerance: float = param(
        1e-10, "end when shares of Gaussian noise and, relatively, precisions change by less", low=0.0
    )


@dataclasses.dataclass(frozen=True)
class Robustness:
    """What an update learned of the noises.

    Attributes
    ----------
    state_share, noise_share : (...)        probability that the prediction's, the measurement's error is Gaussian
    state_precision, noise_precision : (...)    factor on the nominal information: small for an outlier
    converged : (...) bool
    iterations : int                            of the slowest
    """

    state_share: Array
    noise_share: Array
    state_precision: Array
    noise_precision: Array
    converged: NDArray[np.bool_]
    iterations: int


@dataclasses.dataclass(frozen=True)
class GaussianStudentTMixture(Linearising):
    """The filter: Kalman's prediction, and an update that weighs prediction and measurement by how they agree.

    Attributes
    ----------
    params : MixtureNoiseParams
    dof : float    of the densities whose covariances state and sensor give: their scatters are the nominal matrices;
                   infinite: the covariances themselves are

    Notes         Coordinate ascent on the evidence's lower bound, O(iterations n^3); it finds a local optimum,
                  starting from Gaussian noises. Mean-field posteriors tend to be too sure.
    References    Y. Huang, Y. Zhang, Y. Zhao, J. Chambers, A novel robust Gaussian-Student's t mixture
                  distribution based Kalman filter, 2019.
    """

    params: MixtureNoiseParams = MixtureNoiseParams()
    dof: float = np.inf

    def begin(self, mean: Array, cov: Array) -> Gaussian:
        """Return the density of these moments and the filter's dof."""
        return Gaussian(mean, cov, self.dof)

    def update(self, state: Gaussian, z: Array, sensor: Sensor) -> tuple[Gaussian, Robustness]:
        """Condition on z = h(x) + v, h linearised at the mean."""
        mean = state.mean
        residual = sensor.residual(z, sensor.observe(mean))
        lead, (n, m) = np.broadcast_shapes(mean.shape[:-1], z.shape[:-1]), (mean.shape[-1], z.shape[-1])
        shapes = (n, n), (m,), (m, n), (m, m)
        # As scatter_from_cov, but in an order that gives whole numbers back: nominal noises of t(3) are such.
        noise = sensor.noise - sensor.noise * (2.0 / np.asarray(state.dof))[..., None, None]
        parts = (scatter_from_cov(state.cov, state.dof), residual, sensor.jacobian(mean), noise)
        whole = _Update(*(np.broadcast_to(a, (*lead, *s)).reshape(-1, *s) for a, s in zip(parts, shapes, strict=True)))
        share, weight, converged, iterations = _ascend(whole, self.params)
        precision = share + (1.0 - share) * weight
        offset, scatter = whole.condition(precision)
        share, precision = share.reshape(2, *lead), precision.reshape(2, *lead)
        learned = Robustness(share[0], share[1], precision[0], precision[1], converged.reshape(lead), iterations)
        cov = cov_from_scatter(scatter.reshape(*lead, n, n), state.dof)
        return Gaussian(mean + offset.reshape(*lead, n), cov, state.dof), learned


class _Update(NamedTuple):
    """B linearised updates: covariance (B, n, n), residual (B, m), slope (B, m, n), noise (B, m, m)."""

    cov: Array
    residual: Array
    slope: Array
    noise: Array

    def rows(self, rows: NDArray[np.bool_]) -> _Update:
        """Return some of them."""
        return _Update(*(values[rows] for values in self))

    def condition(self, precision: Array) -> tuple[Array, Array]:
        """Kalman update with covariances divided by their precisions (2, B): shift (B, n), covariance (B, n, n)."""
        cov, noise = self.cov / precision[0, :, None, None], self.noise / precision[1, :, None, None]
        gain, _ = linear_gain(cov, self.slope, noise)
        return matvec(gain, self.residual), symmetrise(joseph(cov, gain, self.slope, noise))

    def expected_squares(self, precision: Array) -> Array:
        """Expected squares of the prediction's and the measurement's error by their nominal matrices, (2, B)."""
        offset, posterior = self.condition(precision)
        left, seen = self.residual - matvec(self.slope, offset), self.slope @ posterior @ transpose(self.slope)
        pairs = (self.cov, outer(offset) + posterior), (self.noise, outer(left) + seen)
        return np.stack([np.trace(solve(nominal, square), axis1=-2, axis2=-1) for nominal, square in pairs])


def _ascend(whole: _Update, params: MixtureNoiseParams) -> tuple[Array, Array, NDArray[np.bool_], int]:
    """Iterate each update by itself to its fixed point.

    Returns
    -------
    shares of Gaussian noise (2, B), mean scales of Student-t noise (2, B), converged (B,), most iterations
    """
    batch = len(whole.cov)
    size = np.array([[whole.cov.shape[-1]], [whole.noise.shape[-1]]])
    shares, weights = np.full((2, batch), params.gaussian_count / _total(params)), np.ones((2, batch))
    converged, rows = np.zeros(batch, bool), np.arange(batch)
    part, share, precision, iteration = whole, shares, np.ones((2, batch)), 0
    while iteration < params.max_iterations and len(rows):
        new_share, weight = _noise_factors(part.expected_squares(precision), share, size, params)
        new_precision = new_share + (1.0 - new_share) * weight
        # The share of an outlier is zero at once, long before its scale has settled.
        change = np.maximum(np.abs(new_share - share), np.abs(new_precision / precision - 1.0)).max(0)
        done, share, precision, iteration = change <= params.tolerance, new_share, new_precision, iteration + 1
        shares[:, rows], weights[:, rows], converged[rows] = share, weight, done
        if done.any():
            rows, part, share, precision = rows[~done], part.rows(~done), share[:, ~done], precision[:, ~done]
    return shares, weights, converged, iteration


def _total(params: MixtureNoiseParams) -> float:
    return params.gaussian_count + params.student_count


def _noise_factors(
    square: Array, share: Array, size: NDArray[np.int64], params: MixtureNoiseParams
) -> tuple[Array, Array]:
    """Update scales, probabilities and indicators from expected squares (2, B) of vectors of `size` (2, 1) axes.

    Returns the new shares of Gaussian noise and the mean scales of Student-t noise, (2, B) each. The scales' and
    probabilities' factors use the old shares, so that at a fixed point all belong together.
    """
    shape, rate = 0.5 * (params.dof + size * (1.0 - share)), 0.5 * (params.dof + (1.0 - share) * square)
    weight, log_weight = shape / rate, digamma(shape) - np.log(rate)
    log_odds = digamma(params.gaussian_count + share) - digamma(params.student_count + 1.0 - share)
    log_odds = log_odds - 0.5 * square - 0.5 * (size * log_weight - weight * square)
    new_share = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -700.0, 700.0)))
    return new_share, np.asarray(weight)
