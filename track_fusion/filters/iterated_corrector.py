"""The iterated corrector (IC): several sensors' measurements of one time, used one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from track_fusion.filters.kalman import Innovation
from track_fusion.linalg import Array
from track_fusion.models.base import Sensor

#: update of a Gaussian filter: (mean, cov, z, sensor) -> mean, cov, innovation
GaussianUpdate = Callable[[Array, Array, Array, Sensor], tuple[Array, Array, Innovation]]


def update(
    mean: Array, cov: Array, zs: Sequence[Array], sensors: Sequence[Sensor], one: GaussianUpdate
) -> tuple[Array, Array, Array]:
    """Condition on measurements whose errors are independent, by a filter's own update for each in turn.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)           or its root, if that is what the filter carries
    zs : sequence of (..., m_i)
    sensors : sequence of Sensor
    one : callable              update of the extended, unscented, (square-root) cubature filter

    Returns
    -------
    mean (..., n), cov (..., n, n), log-likelihood of all measurements (...)

    Notes         For linear sensors it is the exact posterior, whatever the order; for others the order
                  matters: the sharpest sensor first makes the later linearisations better.
    References    Li 2022 (46).
    """
    total = np.zeros(mean.shape[:-1])
    for z, sensor in zip(zs, sensors, strict=True):
        mean, cov, innovation = one(mean, cov, z, sensor)
        total = total + innovation.log_likelihood
    return mean, cov, total
