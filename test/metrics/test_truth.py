"""The truth between its stamps: polynomials are met exactly, angles go the short way, nothing is extrapolated."""

from __future__ import annotations

import numpy as np
import pytest

from track_fusion.angles import HALF_TURN, difference
from track_fusion.metrics.truth import Truth, interpolated
from track_fusion.tracks import SECOND_NS, StateLayout, planar_layout

LAYOUT = planar_layout()
SHARES = (0.0, 0.2, 0.5, 0.9, 1.0)


def cubic(t: float) -> np.ndarray:
    """State on a path that is a cubic polynomial of time."""
    x, y = np.polynomial.Polynomial([1.0, -20.0, 3.0, 0.5]), np.polynomial.Polynomial([1e6, 4.0, -1.0, 0.2])
    return np.array([x(t), y(t), x.deriv()(t), y.deriv()(t)])


@pytest.mark.parametrize("share", SHARES)
def test_a_cubic_path_is_met_exactly(share: float) -> None:
    start, gap = 2.0, 0.5
    got = interpolated(LAYOUT, cubic(start), cubic(start + gap), gap, share)
    np.testing.assert_allclose(got, cubic(start + share * gap), rtol=1e-12, atol=1e-9)


def test_braking_at_2_hz_costs_nothing() -> None:
    """On a straight line between the positions the error is a T^2 / 8, .19 m at 6 m/s^2."""
    start, end = np.array([0.0, 0.0, 20.0, 0.0]), np.array([20 * 0.5 - 3 * 0.25, 0.0, 17.0, 0.0])
    middle = interpolated(LAYOUT, start, end, 0.5, 0.5)
    np.testing.assert_allclose(middle, [20 * 0.25 - 3 * 0.0625, 0.0, 18.5, 0.0], atol=1e-12)
    assert abs(middle[0] - 0.5 * (start[0] + end[0])) == pytest.approx(6.0 * 0.25 / 8)


def test_without_velocities_it_is_a_straight_line() -> None:
    got = interpolated(StateLayout(("x", "size")), np.array([0.0, 4.0]), np.array([2.0, 5.0]), 3.0, 0.25)
    np.testing.assert_allclose(got, [0.5, 4.25])


def test_a_velocity_with_an_acceleration_is_a_polynomial_of_its_own() -> None:
    layout = StateLayout(("x", "vx", "ax"))
    start, end = np.array([0.0, 1.0, 2.0]), np.array([5.0, -1.0, 0.5])
    got = interpolated(layout, start, end, 2.0, 0.3)
    velocity = interpolated(StateLayout(("x", "vx")), start[1:], end[1:], 2.0, 0.3)
    assert got[1] == pytest.approx(velocity[0])


@pytest.mark.parametrize("shift", [-3.0, 0.0, 2.0, 7.0])
@pytest.mark.parametrize("share", SHARES)
def test_angles_go_the_short_way_and_turn_with_the_circle(shift: float, share: float) -> None:
    layout = StateLayout(("yaw",))
    start, end = np.array([3.1 + shift]), np.array([-3.1 + shift])
    got = interpolated(layout, start, end, 1.0, share)
    want = 3.1 + shift + share * (2 * np.pi - 6.2)
    assert np.exp(1j * got) == pytest.approx(np.exp(1j * np.array([want])))
    assert -np.pi <= got[0] < np.pi


@pytest.mark.parametrize("share", SHARES)
def test_a_direction_whose_sign_is_unknown_goes_the_short_way_of_its_own_period(share: float) -> None:
    layout = StateLayout(("yaw",), (HALF_TURN,))
    got = interpolated(layout, np.array([1.5]), np.array([-1.5]), 1.0, share)
    assert -0.5 * HALF_TURN <= got[0] < 0.5 * HALF_TURN
    assert difference(got, 1.5 + share * (HALF_TURN - 3.0), HALF_TURN) == pytest.approx(0.0, abs=1e-12)


def test_a_known_turn_rate_tells_which_way_round() -> None:
    layout = StateLayout(("yaw", "turn_rate"))
    rate = 4.0  # more than half a turn in a second
    got = interpolated(layout, np.array([0.0, rate]), np.array([4.0 - 2 * np.pi, rate]), 1.0, 0.5)
    np.testing.assert_allclose(got, [2.0, rate])


def truth(whole: bool, steps: dict[float, list[int]], max_gap_s: float = 1.0) -> Truth:
    """Targets with x = 10 id + 2 t, at rest otherwise told by vx = 2."""
    held = Truth(LAYOUT, round(max_gap_s * SECOND_NS), whole)
    for at_s, ids in steps.items():
        held.add(round(at_s * SECOND_NS), ids, np.array([[10.0 * i + 2 * at_s, 0, 2, 0] for i in ids]).reshape(-1, 4))
    return held


def known(held: Truth, at_s: float) -> tuple[dict[int, float], int] | None:
    got = held.at(round(at_s * SECOND_NS))
    return got and (dict(zip(got.targets.tolist(), got.states[:, 0].round(9).tolist(), strict=True)), got.unknown)


def test_nothing_is_extrapolated_and_no_large_gap_crossed() -> None:
    held = truth(True, {1.0: [1], 2.0: [1], 3.5: [1]})
    assert [known(held, t) for t in (0.9, 2.5, 3.6)] == [None] * 3
    assert known(held, 1.5) == ({1: 13.0}, 0)
    assert known(held, 3.5) == ({1: 17.0}, 0)
    assert known(Truth(LAYOUT, 1, True), 0.0) is None


def test_who_is_not_in_a_whole_step_is_not_there() -> None:
    held = truth(True, {1.0: [1, 2], 1.5: [1], 2.0: [1, 2], 2.5: []})
    assert known(held, 1.5) == ({1: 13.0}, 0)
    assert known(held, 1.2) == ({1: 12.4}, 1)  # 2 ended somewhere between
    assert known(held, 1.7) == ({1: 13.4}, 0)  # or began
    assert known(held, 2.5) == ({}, 0)


def test_a_piece_that_was_lost_is_interpolated_or_unknown() -> None:
    held = truth(False, {1.0: [1, 2], 1.5: [1], 2.0: [1, 2], 2.5: [1], 3.5: [1, 2]})
    assert known(held, 1.5) == ({1: 13.0, 2: 23.0}, 0)
    assert known(held, 2.5) == ({1: 15.0}, 1)
    assert known(held, 4.0) is None
    assert not held.at(round(1.5 * SECOND_NS)).exact  # type: ignore[union-attr]
    assert held.at(SECOND_NS).exact  # type: ignore[union-attr]


@pytest.mark.parametrize("whole", [True, False])
def test_old_steps_are_dropped_by_time_and_by_number(whole: bool) -> None:
    held = truth(whole, {float(t): [1] for t in range(1, 11)})
    assert held.forget(3 * SECOND_NS, 100) == [SECOND_NS, 2 * SECOND_NS]
    assert held.forget(0, 5) == [t * SECOND_NS for t in range(3, 6)]
    assert held.stamps == tuple(t * SECOND_NS for t in range(6, 11))
