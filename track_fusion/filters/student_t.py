"""The Student-t filter: heavy-tailed state and noises of common degrees of freedom, in closed form.

States are carried by mean, covariance and degrees of freedom (dof > 2; infinite: the Kalman filter). The
scatter of a Student-t density is cov (dof - 2) / dof. In these terms moment matching to another dof keeps mean
and covariance, so that a tracker which resets its dof after each update simply goes on.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import gammaln

from track_fusion.linalg import Array, logdet, mahalanobis_squared, matvec, solve, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition


@dataclasses.dataclass(frozen=True)
class StudentInnovation:
    """What an update learned: residual (..., m), its covariance (..., m, m), dof (...), NIS r' S^-1 r (...)."""

    residual: Array
    cov: Array
    dof: Array
    nis: Array

    @property
    def log_likelihood(self) -> Array:
        """Log-density of the residual: Student-t, or Gaussian where dof is infinite."""
        size, heavy = self.residual.shape[-1], np.isfinite(self.dof)
        dof = np.where(heavy, self.dof, 3.0)
        scale = gammaln(0.5 * (dof + size)) - gammaln(0.5 * dof) - 0.5 * size * np.log(np.pi * (dof - 2.0))
        student = scale - 0.5 * (dof + size) * np.log1p(self.nis / (dof - 2.0))
        gaussian = -0.5 * (self.nis + size * np.log(2.0 * np.pi))
        return np.asarray(np.where(heavy, student, gaussian) - 0.5 * logdet(self.cov))


def scatter_from_cov(cov: Array, dof: Array | float) -> Array:
    """Return cov (dof - 2) / dof, (..., n, n), (...)."""
    return np.asarray(cov * (1.0 - 2.0 / np.asarray(dof))[..., None, None])


def cov_from_scatter(scatter: Array, dof: Array | float) -> Array:
    """Return scatter dof / (dof - 2), (..., n, n), (...)."""
    return np.asarray(scatter / (1.0 - 2.0 / np.asarray(dof))[..., None, None])


def moment_matched_scatter(scatter: Array, dof: Array | float, new_dof: Array | float) -> Array:
    """Scatter of the Student-t density of `new_dof` with the same covariance.

    The factor is (nu - 2) nu' / (nu (nu' - 2)) from nu' = `dof` to nu = `new_dof`.
    """
    return scatter_from_cov(cov_from_scatter(scatter, dof), new_dof)


def predict(mean: Array, cov: Array, transition: Transition) -> tuple[Array, Array]:
    """Predict x' = f(x) + w, f linearised at the mean.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)          covariance, not scatter
    transition : Transition    its noise is the covariance of w, whatever its tails

    Returns
    -------
    mean (..., n), cov (..., n, n)    the dof is kept

    Notes         The sum of independent Student-t variables is none; its moments are matched at the state's dof.
    References    Y. Huang, Y. Zhang, N. Li, J. Chambers, Robust Student's t based nonlinear filter and
                  smoother, 2016; Chen 2022, 5.2.
    """
    slope = transition.jacobian(mean)
    return transition.advance(mean), symmetrise(slope @ cov @ transpose(slope) + transition.noise(mean))


def update(
    mean: Array, cov: Array, dof: Array | float, z: Array, sensor: Sensor
) -> tuple[Array, Array, Array, StudentInnovation]:
    """Condition on z = h(x) + v, where x and v are jointly Student-t and uncorrelated, h linearised at the mean.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)    covariance, not scatter
    dof : (...)          > 2
    z : (..., m)
    sensor : Sensor      its noise is the covariance of v

    Returns
    -------
    mean (..., n), cov (..., n, n), dof + m (...), StudentInnovation

    Raises
    ------
    ValueError    a dof does not exceed 2

    Notes         The mean is Kalman's. The covariance is Kalman's times (dof - 2 + NIS) / (dof - 2 + m): a
                  measurement that surprises makes the state less certain. With dof reset to its old value after
                  each update (Chen 2022) nothing else changes, see the module.
    References    Huang et al. 2016; S. Kotz, S. Nadarajah, Multivariate t distributions, 2004, for the conditional.
    """
    dof = np.asarray(dof, float)
    if not (dof > 2).all():
        raise ValueError(f"The 'dof' of a Student-t state must exceed 2. Got {dof.min():g}.")
    slope, size = sensor.jacobian(mean), z.shape[-1]
    residual = sensor.residual(z, sensor.observe(mean))
    spread = symmetrise(slope @ cov @ transpose(slope) + sensor.noise)
    gain = transpose(solve(spread, slope @ cov))
    keep = np.eye(mean.shape[-1]) - gain @ slope
    nis = mahalanobis_squared(residual, spread)
    finite = np.where(np.isfinite(dof), dof, 3.0)
    growth = np.where(np.isfinite(dof), (finite - 2.0 + nis) / (finite - 2.0 + size), 1.0)
    kalman = keep @ cov @ transpose(keep) + gain @ sensor.noise @ transpose(gain)
    posterior = symmetrise(growth[..., None, None] * kalman)
    return mean + matvec(gain, residual), posterior, dof + size, StudentInnovation(residual, spread, dof, nis)
