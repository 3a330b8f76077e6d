"""The Kalman filter, batched over leading axes."""

from __future__ import annotations

import numpy as np

from track_fusion.angles import wrap
from track_fusion.filters.base import Gaussian, GaussianFilter, Innovation
from track_fusion.linalg import Array, matvec, solve, symmetrise, transpose
from track_fusion.models.base import Transition
from track_fusion.models.measurement import LinearSensor


def linear_gain(cov: Array, slope: Array, noise: Array) -> tuple[Array, Array]:
    """Gain (..., n, m) of an update by a sensor of slope H (..., m, n) and noise R, and the residual's covariance."""
    cross = slope @ cov
    spread = symmetrise(cross @ transpose(slope) + noise)
    return transpose(solve(spread, cross)), spread


def joseph(cov: Array, gain: Array, slope: Array, noise: Array) -> Array:
    """Covariance (..., n, n) after an update, (1 - K H) P (1 - K H)' + K R K': it stays definite."""
    keep = np.eye(cov.shape[-1]) - gain @ slope
    return np.asarray(keep @ cov @ transpose(keep) + gain @ noise @ transpose(gain))


def condition(state: Gaussian, z: Array, slope: Array, noise: Array) -> tuple[Gaussian, Innovation]:
    """Condition on z = H x + v (..., m) of a sensor of slope H (..., m, n) and noise R (..., m, m)."""
    residual = z - matvec(slope, state.mean)
    gain, spread = linear_gain(state.cov, slope, noise)
    posterior = symmetrise(joseph(state.cov, gain, slope, noise))
    return Gaussian(state.mean + matvec(gain, residual), posterior, state.dof), Innovation(residual, spread)


class Kalman(GaussianFilter):
    """The Kalman filter, of linear motions and sensors.

    A covariance that a batch shares stays shared: it depends on no measurement.
    """

    def predict(self, state: Gaussian, transition: Transition) -> Gaussian:
        """Predict x' = F x + w, w ~ N(0, Q).

        Parameters
        ----------
        state : Gaussian           (..., n)
        transition : Transition    linear: it has a matrix F

        Raises
        ------
        ValueError    the motion is not linear
        """
        if (matrix := transition.matrix) is None:
            raise ValueError("The 'transition' of a Kalman filter must be linear. Got one without a matrix.")
        cov = symmetrise(matrix @ state.cov @ transpose(matrix) + transition.noise(state.mean))
        return Gaussian(matvec(matrix, state.mean), cov, state.dof)

    def update(self, state: Gaussian, z: Array, sensor: LinearSensor) -> tuple[Gaussian, Innovation]:
        """Condition on z = H x + v, v ~ N(0, R), in Joseph's form, which keeps the covariance definite.

        Parameters
        ----------
        state : Gaussian         (..., n)
        z : (..., m)
        sensor : LinearSensor    H (m, n), or one for each state (..., m, n), and R
        """
        gap = z - matvec(sensor.matrix, state.mean)
        # So many whole turns more or less bring an angle next to what is expected; elsewhere it is nothing at all.
        turns = wrap(gap, sensor.periods) - gap
        return condition(state, z + turns, sensor.matrix, sensor.noise)
