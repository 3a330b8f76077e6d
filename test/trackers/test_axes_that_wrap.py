"""Directions in trackers: filters hold them unrolled, tracks do not."""

from __future__ import annotations

import numpy as np
import pytest

from track_fusion.angles import TURN, difference
from track_fusion.models.constant_turn_rate_and_speed import ConstantTurnRateAndSpeed, TurnRateAndSpeedParams
from track_fusion.models.measurement import LinearSensor
from track_fusion.trackers.filters import FILTERS
from track_fusion.trackers.one_target import SensorTracker, SensorTrackerParams
from track_fusion.tracks import SECOND_NS, StateLayout


@pytest.mark.parametrize("name", ["extended", "unscented", "cubature", "particle", "student_t"])
def test_a_target_that_turns_is_published_between_minus_pi_and_pi(name: str) -> None:
    """Three rounds, seen by a compass, too."""
    layout = StateLayout(("x", "y", "yaw", "speed", "turn_rate"))
    motion = ConstantTurnRateAndSpeed(layout, TurnRateAndSpeedParams())
    sensor = LinearSensor.reading(layout, ("x", "y", "yaw"), 1e-2 * np.eye(3))
    choice = FILTERS[name]
    params = SensorTrackerParams(initial_mean=(0.0, 0.0, 0.0, 1.0, 0.5), initial_cov=(0.01,) * 5)
    tracker = SensorTracker(motion, sensor, choice.make(motion, sensor, choice.params()), "map", params)
    for k in range(1, 40):
        yaw = 0.5 * k
        place = [2.0 * np.sin(yaw), 2.0 - 2.0 * np.cos(yaw)]
        track = tracker.step(k * SECOND_NS, np.array([[*place, difference(yaw, 0.0, TURN)]]), None)
        assert (np.abs(track.mean[..., 2]) <= np.pi).all()
        assert abs(difference(track.moments[0][0, 2], yaw, TURN)) < 0.2
        assert track.moments[1][0, 2, 2] < 0.05
