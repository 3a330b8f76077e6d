"""The cubature Kalman filter: moments by the third-degree spherical-radial rule of 2 n equal points."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from track_fusion.filters import sigma_points
from track_fusion.filters.kalman import Innovation
from track_fusion.filters.sigma_points import SigmaPoints
from track_fusion.linalg import Array
from track_fusion.models.base import Sensor, Transition


@lru_cache(maxsize=64)
def points(size: int) -> SigmaPoints:
    """Return the 2 n points at distance sqrt(n) along the axes, of equal weight: exact to the third degree."""
    offsets = np.sqrt(size) * np.concatenate([np.eye(size), -np.eye(size)])
    weight = np.full(2 * size, 0.5 / size)
    return SigmaPoints(offsets, weight, weight)


def predict(mean: Array, cov: Array, transition: Transition) -> tuple[Array, Array]:
    """Predict x' = f(x) + w.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    transition : Transition

    Returns
    -------
    mean (..., n), cov (..., n, n)

    Raises
    ------
    LinAlgError    a covariance is not positive definite

    References     I. Arasaratnam, S. Haykin, Cubature Kalman filters, 2009.
    """
    return sigma_points.predict(mean, cov, transition, points(mean.shape[-1]))


def update(mean: Array, cov: Array, z: Array, sensor: Sensor) -> tuple[Array, Array, Innovation]:
    """Condition on z = h(x) + v; angles are averaged about the measurement of the mean and wrapped.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    z : (..., m)
    sensor : Sensor

    Returns
    -------
    mean (..., n), cov (..., n, n), Innovation

    Raises
    ------
    LinAlgError    a covariance is not positive definite
    """
    return sigma_points.update(mean, cov, z, sensor, points(mean.shape[-1]))
