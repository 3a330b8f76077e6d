"""The extended Kalman filter: the Kalman filter on models linearised at the estimate."""

from __future__ import annotations

from track_fusion.filters.base import Gaussian, GaussianFilter, Innovation
from track_fusion.filters.kalman import condition
from track_fusion.linalg import Array, matvec, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition


class Linearising(GaussianFilter):
    """What the filters share that linearise motions at the mean."""

    def predict(self, state: Gaussian, transition: Transition) -> Gaussian:
        """Predict x' = f(x) + w with f linearised at the mean; w has the covariance Q, whatever its tails."""
        slope = transition.jacobian(state.mean) if transition.matrix is None else transition.matrix
        cov = symmetrise(slope @ state.cov @ transpose(slope) + transition.noise(state.mean))
        return Gaussian(transition.advance(state.mean), cov, state.dof)


class Extended(Linearising):
    """The extended Kalman filter.

    Notes    First order: biased where h curves within the spread of the state, and then overconfident.
    """

    def update(self, state: Gaussian, z: Array, sensor: Sensor) -> tuple[Gaussian, Innovation]:
        """Condition on z = h(x) + v, (..., m), with h linearised at the mean; angles in the residual are wrapped."""
        slope = sensor.jacobian(state.mean)
        # The linear filter sees the measurement whose linearised residual is the true, wrapped one.
        equivalent = matvec(slope, state.mean) + sensor.residual(z, sensor.observe(state.mean))
        return condition(state, equivalent, slope, sensor.noise)
