"""The extended Kalman filter: the Kalman filter on models linearised at the estimate."""

from __future__ import annotations

from track_fusion.filters import kalman
from track_fusion.filters.kalman import Innovation
from track_fusion.linalg import Array, matvec, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition


def predict(mean: Array, cov: Array, transition: Transition) -> tuple[Array, Array]:
    """Predict x' = f(x) + w with f linearised at the mean.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    transition : Transition

    Returns
    -------
    mean (..., n), cov (..., n, n)
    """
    slope = transition.jacobian(mean) if transition.matrix is None else transition.matrix
    return transition.advance(mean), symmetrise(slope @ cov @ transpose(slope) + transition.noise(mean))


def update(mean: Array, cov: Array, z: Array, sensor: Sensor) -> tuple[Array, Array, Innovation]:
    """Condition on z = h(x) + v with h linearised at the mean; angles in the residual are wrapped.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    z : (..., m)
    sensor : Sensor

    Returns
    -------
    mean (..., n), cov (..., n, n), Innovation

    Notes    First order: biased where h curves within the spread of the state, and then overconfident.
    """
    slope = sensor.jacobian(mean)
    # The linear filter sees the measurement whose linearised residual is the true, wrapped one.
    equivalent = matvec(slope, mean) + sensor.residual(z, sensor.observe(mean))
    return kalman.update(mean, cov, equivalent, slope, sensor.noise)
