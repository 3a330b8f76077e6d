"""The Student-t filter: heavy-tailed state and noises of common degrees of freedom, in closed form.

States are carried by mean, covariance and degrees of freedom (dof > 2; infinite: the Kalman filter). The
scatter of a Student-t density is cov (dof - 2) / dof. In these terms moment matching to another dof keeps mean
and covariance, so that a filter which resets its dof after each update simply goes on.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import gammaln

from track_fusion.filters.base import Gaussian
from track_fusion.filters.extended import Linearising
from track_fusion.filters.kalman import joseph, linear_gain
from track_fusion.linalg import Array, logdet, mahalanobis_squared, matvec, symmetrise
from track_fusion.models.base import Sensor
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class StudentTParams(Params):
    """The Student-t filter: tails of state and noises; initial, process and sensor covariances stay covariances."""

    dof: float = param(
        3.0, "degrees of freedom, the same after each update and after feedback (moments matched)", low=2.0, strict=True
    )


@dataclasses.dataclass(frozen=True)
class StudentInnovation:
    """What an update learned: residual (..., m), its covariance (..., m, m) and dof (...), NIS r' S^-1 r (...)."""

    residual: Array
    cov: Array
    dof: Array
    nis: Array

    @property
    def posterior_dof(self) -> Array:
        """Degrees of freedom (...) of the exact posterior, whose moments the filter matches at its own dof."""
        return np.asarray(self.dof + self.residual.shape[-1])

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


@dataclasses.dataclass(frozen=True)
class StudentT(Linearising):
    """The Student-t filter: state and noises are jointly Student-t and uncorrelated.

    Notes         The sum of independent Student-t variables is none: its moments are matched at the state's dof, as
                  are those of a posterior, whose dof would be greater by the number of measured axes.
    References    Y. Huang, Y. Zhang, N. Li, J. Chambers, Robust Student's t based nonlinear filter and smoother,
                  2016; S. Kotz, S. Nadarajah, Multivariate t distributions, 2004, for the conditional; Chen 2022, 5.2.
    """

    params: StudentTParams = StudentTParams()

    def begin(self, mean: Array, cov: Array) -> Gaussian:
        """Return the Student-t density of these moments and the filter's dof."""
        return Gaussian(mean, cov, self.params.dof)

    def update(self, state: Gaussian, z: Array, sensor: Sensor) -> tuple[Gaussian, StudentInnovation]:
        """Condition on z = h(x) + v, h linearised at the mean.

        Parameters
        ----------
        state : Gaussian    (..., n), dof > 2
        z : (..., m)
        sensor : Sensor     its noise is the covariance of v

        Raises
        ------
        ValueError    a dof does not exceed 2

        Notes         The mean is Kalman's. The covariance is Kalman's times (dof - 2 + NIS) / (dof - 2 + m): a
                      measurement that surprises makes the state less certain.
        """
        mean, cov, dof = state.mean, state.cov, np.asarray(state.dof, float)
        if not (dof > 2).all():
            raise ValueError(f"The 'dof' of a Student-t state must exceed 2. Got {dof.min():g}.")
        slope, size = sensor.jacobian(mean), z.shape[-1]
        residual = sensor.residual(z, sensor.observe(mean))
        gain, spread = linear_gain(cov, slope, sensor.noise)
        nis = mahalanobis_squared(residual, spread)
        finite = np.where(np.isfinite(dof), dof, 3.0)
        growth = np.where(np.isfinite(dof), (finite - 2.0 + nis) / (finite - 2.0 + size), 1.0)
        posterior = symmetrise(growth[..., None, None] * joseph(cov, gain, slope, sensor.noise))
        learned = StudentInnovation(residual, spread, dof, nis)
        return Gaussian(mean + matvec(gain, residual), posterior, state.dof), learned
