"""Filters called with plain arrays, as their equations are written."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.filters.base import Density, TrackFilter
from track_fusion.filters.kalman import Kalman
from track_fusion.models.base import Sensor, Transition
from track_fusion.models.measurement import LinearSensor

Floats = NDArray[np.float64]


class Plain:
    """A filter whose state begins anew from mean and covariance in each call."""

    def __init__(self, one: TrackFilter[Any, Transition, Floats, Any, Any]) -> None:
        self.one = one

    def predict(self, mean: Floats, cov: Floats, transition: Transition) -> tuple[Floats, Floats]:
        """Return mean and covariance of the prediction."""
        state: Density = self.one.predict(self.one.begin(mean, cov), transition)
        return state.moments

    def update(self, mean: Floats, cov: Floats, z: Any, sensor: Sensor) -> tuple[Floats, Floats, Any]:
        """Return mean and covariance of the posterior, and what was learned."""
        state, learned = self.one.update(self.one.begin(mean, cov), z, sensor)
        return (*state.moments, learned)


def predict(mean: Floats, cov: Floats, f: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Predict by the Kalman filter; F and Q may be one for each state."""
    return Plain(Kalman()).predict(mean, cov, Transition.additive(np.asarray, np.asarray, q, q, f))


def update(mean: Floats, cov: Floats, z: Floats, h: Floats, r: Floats) -> tuple[Floats, Floats, Any]:
    """Update by the Kalman filter; H and R may be one for each state."""
    return Plain(Kalman()).update(mean, cov, z, LinearSensor(tuple("abcdefgh"[: h.shape[-2]]), h, r))
