"""Directions through the whole centre: two sources see targets whose yaw lies about the seam at pi."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from track_fusion.angles import HALF_TURN, TURN, difference
from track_fusion.association.gate import gate
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.centre.publish import StepInfo
from track_fusion.models.base import Motion
from track_fusion.models.constant_turn_rate_and_speed import ConstantTurnRateAndSpeed, TurnRateAndSpeedParams
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.tracks import StateLayout, TrackBatch

SECOND = 10**9
WITH_YAW = StateLayout(("x", "y", "vx", "vy", "yaw"))
TURNING = StateLayout(("x", "y", "yaw", "speed", "turn_rate"))
MOTIONS: dict[str, Motion] = {
    "yaw follows a random walk": NearlyConstantVelocity(WITH_YAW, MotionParams(random_walk_noise=(0.01,))),
    "the target goes where it points": ConstantTurnRateAndSpeed(TURNING, TurnRateAndSpeedParams()),
}
EVERY_MOTION = pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)


def centre_of(motion: Motion, rule: str = "covariance_intersection", **params: Any) -> FusionCentre:
    sources = tuple(SourceConfig(name) for name in ("first", "second"))
    own = RULES[rule]
    manager = TrackManagerParams(confirmation_threshold=(1, 1))
    centre_params = FusionCentreParams(**params)
    identity = IdentityParams("test")
    return FusionCentre(
        CentreConfig(sources, motion, "map", own, own.params(), centre_params, manager, identity=identity)
    )


def scan(layout: StateLayout, yaw: float, time_ns: int, **others: float) -> TrackBatch:
    """One sharp track at this yaw."""
    mean = np.array([[{"yaw": yaw, **others}.get(axis, 0.0) for axis in layout.axes]])
    return TrackBatch.gaussian(layout, "map", mean, np.tile(1e-2 * np.eye(5), (1, 1, 1)), time_ns=time_ns)


def step(centre: FusionCentre, time_ns: int, *yaws: float, **others: float) -> tuple[TrackBatch, StepInfo]:
    layout = centre.config.layout
    return centre.step(time_ns, {k: scan(layout, yaw, time_ns, **others) for k, yaw in enumerate(yaws)})


@EVERY_MOTION
@pytest.mark.parametrize("memory", [False, True])
def test_two_tracks_on_either_side_of_the_seam_are_one_target(motion: Motion, memory: bool) -> None:
    centre, at = centre_of(motion, memory=memory), motion.layout.axes.index("yaw")
    for k in range(1, 6):
        fused, info = step(centre, k * SECOND, np.pi - 0.1, 0.1 - np.pi)
        assert len(fused) == 1
        yaw = fused.mean[0, 0, at]
        assert -np.pi <= yaw < np.pi
        # Of equal covariances covariance intersection weighs one as it likes, beside a third.
        assert abs(difference(yaw, np.pi, TURN)) < (1e-3 if memory else 1e-9)
        assert info.beyond_half_circle == 0


@EVERY_MOTION
@pytest.mark.parametrize("rule", ["covariance_intersection", "naive", "arithmetic_average", "covariance_union"])
def test_turning_every_scan_turns_every_result(motion: Motion, rule: str) -> None:
    """Turned about the vertical, a scene at the seam is a scene at zero: at rest, so that positions stay."""
    at = motion.layout.axes.index("yaw")

    def run(turn: float) -> list[TrackBatch]:
        centre, rng = centre_of(motion, rule), np.random.default_rng(5)
        return [step(centre, k * SECOND, *(turn + 0.1 * rng.normal(size=2)))[0] for k in range(1, 8)]

    for here, there in zip(run(0.0), run(np.pi), strict=True):
        gap = there.mean - here.mean
        np.testing.assert_allclose(difference(gap[..., at], np.pi, TURN), 0.0, atol=1e-9)
        np.testing.assert_allclose(np.delete(gap, at, -1), 0.0, atol=1e-9)
        np.testing.assert_allclose(there.cov, here.cov, rtol=1e-7, atol=1e-9)


def test_a_target_that_turns_is_followed_through_the_seam() -> None:
    """Yaw grows by a quarter radian a second for forty seconds, once and a half round; one track, never lost."""
    centre, at = centre_of(MOTIONS["the target goes where it points"], memory=True), 2
    for k in range(1, 41):
        truth = 0.25 * k
        fused, _ = step(centre, k * SECOND, truth, truth - TURN, turn_rate=0.25)
        assert fused.track_id.tolist() == [1]
        assert abs(difference(fused.mean[0, 0, at], truth, TURN)) < 1e-6
        assert -np.pi <= fused.mean[0, 0, at] < np.pi


@EVERY_MOTION
def test_a_scan_told_beyond_the_seam_is_published_wrapped(motion: Motion) -> None:
    fused, _ = centre_of(motion).step(SECOND, {0: scan(motion.layout, 3.5, SECOND)})
    assert fused.mean[0, 0, motion.layout.axes.index("yaw")] == pytest.approx(3.5 - TURN, abs=1e-12)


def test_opposite_directions_are_counted() -> None:
    centre = centre_of(MOTIONS["yaw follows a random walk"], association="single_target")
    assert step(centre, SECOND, 0.0, np.pi)[1].beyond_half_circle == 1
    assert step(centre, 2 * SECOND, 0.0, 0.1)[1].beyond_half_circle == 0


def test_a_box_whose_front_is_unknown_wraps_at_pi() -> None:
    layout = StateLayout(WITH_YAW.axes, (np.inf,) * 4 + (HALF_TURN,))
    motion = NearlyConstantVelocity(layout, MotionParams(random_walk_noise=(0.01,)))
    fused, _ = step(centre_of(motion), SECOND, 1.0, 1.0 - np.pi)
    assert len(fused) == 1
    assert fused.mean[0, 0, 4] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("count", [30, 90])
def test_the_gate_knows_the_short_way_round(count: int) -> None:
    """Few pairs, all tried, and many, searched: as the gate of tracks that lie a half turn from the seam."""
    rng = np.random.default_rng(2)
    mean, cov = rng.normal(size=(2, count, 3)) * [20.0, 20.0, 0.3], np.tile(np.diag([1.0, 1.0, 0.04]), (count, 1, 1))
    turned = mean + [0.0, 0.0, np.pi]
    turned[..., 2] = difference(turned[..., 2], 0.0, TURN)
    wanted = gate(mean[0], cov, mean[1], cov, 9.0, (0, 1))
    got = gate(turned[0], cov, turned[1], cov, 9.0, (0, 1), (np.inf, np.inf, TURN))
    np.testing.assert_array_equal([got.row, got.col], [wanted.row, wanted.col])
    np.testing.assert_allclose(got.distance, wanted.distance, atol=1e-9)
    assert len(gate(turned[0], cov, turned[1], cov, 9.0, (0, 1)).row) < len(wanted.row)
