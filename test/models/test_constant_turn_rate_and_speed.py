"""Constant turn rate and speed: against its differential equation, step by step, and against laws of motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp
from scipy.integrate import solve_ivp

from track_fusion.angles import HALF_TURN
from track_fusion.linalg import Array
from track_fusion.models.choices import MOTIONS, make
from track_fusion.models.constant_turn_rate_and_speed import ConstantTurnRateAndSpeed, TurnRateAndSpeedParams
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.tracks import StateLayout

law = settings(deadline=None, derandomize=True)
LAYOUT = StateLayout(("x", "y", "yaw", "speed", "turn_rate"))
SHUFFLED = StateLayout(("turn_rate", "y", "speed", "length", "yaw", "x"))
PARAMS = TurnRateAndSpeedParams(process_noise=0.7, turn_rate_noise=0.02, random_walk_noise=(0.3,))
MOTION = ConstantTurnRateAndSpeed(LAYOUT, PARAMS)
RATES = [0.0, 1e-300, 1e-9, -1e-3, 0.0499, 0.0501, 0.0799, 0.0801, -0.4, 1.5]
DENSITY = np.diag([0.0, 0.0, 0.0, PARAMS.process_noise, PARAMS.turn_rate_noise])

states = st.builds(
    lambda yaw, speed, rate: np.array([3.0, -2.0, yaw, speed, rate]),
    st.floats(-7.0, 7.0), st.floats(-5.0, 30.0), st.floats(-1.0, 1.0),
)  # fmt: skip
durations = st.floats(0.0, 1.5)


def flow(state: Array) -> Array:
    _, _, yaw, speed, rate = state
    return np.array([speed * np.cos(yaw), speed * np.sin(yaw), rate, 0.0, 0.0])


def flow_slope(state: Array) -> Array:
    _, _, yaw, speed, _ = state
    slope = np.zeros((5, 5))
    slope[0, 2:4] = -speed * np.sin(yaw), np.cos(yaw)
    slope[1, 2:4] = speed * np.cos(yaw), np.sin(yaw)
    slope[2, 4] = 1.0
    return slope


def integrated(state: Array, dt: float) -> tuple[Array, Array]:
    """State and covariance after dt of a state known exactly, by small steps of their differential equations."""

    def change(_: float, both: Array) -> Array:
        slope, cov = flow_slope(both[:5]), both[5:].reshape(5, 5)
        return np.concatenate([flow(both[:5]), (slope @ cov + cov @ slope.T + DENSITY).ravel()])

    end = solve_ivp(change, (0.0, dt), [*state, *np.zeros(25)], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return end[:5], end[5:].reshape(5, 5)


@pytest.mark.parametrize("rate", RATES)
def test_motion_and_noise_solve_their_differential_equations(rate: float) -> None:
    state = np.array([3.0, -2.0, 2.5, 12.0, rate])
    for dt in (1e-3, 0.1, 2.0):
        moved, noise = integrated(state, dt)
        transition = MOTION.over(dt)
        np.testing.assert_allclose(transition.advance(state), moved, rtol=1e-11, atol=1e-11)
        scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
        np.testing.assert_allclose(transition.noise(state) / scale, noise / scale, atol=1e-9)


@pytest.mark.parametrize("rate", RATES)
def test_jacobian_by_integrals_of_many_digits(rate: float) -> None:
    yaw, speed, dt = 2.5, 12.0, 1.25

    def integral(of: Callable[[Any], Any]) -> float:
        return float(mp.quad(lambda t: of(t), [0, mp.mpf(dt)]))

    wanted = np.eye(5)
    with mp.workdps(40):
        w, psi = mp.mpf(rate), mp.mpf(yaw)
        wanted[0, 2] = -speed * integral(lambda t: mp.sin(psi + w * t))
        wanted[1, 2] = speed * integral(lambda t: mp.cos(psi + w * t))
        wanted[0, 3], wanted[1, 3] = wanted[1, 2] / speed, -wanted[0, 2] / speed
        wanted[0, 4] = -speed * integral(lambda t: t * mp.sin(psi + w * t))
        wanted[1, 4] = speed * integral(lambda t: t * mp.cos(psi + w * t))
    wanted[2, 4] = dt
    jacobian = MOTION.over(dt).jacobian(np.array([3.0, -2.0, yaw, speed, rate]))
    np.testing.assert_allclose(jacobian, wanted, rtol=1e-12, atol=1e-13)


@law
@given(states, durations, durations)
def test_noise_does_not_depend_on_how_often_one_predicts(state: Array, first: float, second: float) -> None:
    once, start, rest = MOTION.over(first + second), MOTION.over(first), MOTION.over(second)
    between = start.advance(state)
    slope = rest.jacobian(between)
    np.testing.assert_allclose(rest.advance(between), once.advance(state), rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(slope @ start.jacobian(state), once.jacobian(state), atol=1e-10)
    whole = once.noise(state)
    pieces = slope @ start.noise(state) @ slope.T + rest.noise(between)
    np.testing.assert_allclose(pieces, whole, rtol=1e-9, atol=1e-9 * np.abs(whole).max())


@law
@given(states, durations, st.floats(-10.0, 10.0))
def test_a_turned_world_moves_alike(state: Array, dt: float, turn: float) -> None:
    rotation, transition = np.eye(5), MOTION.over(dt)
    rotation[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    turned = rotation @ state + turn * np.eye(5)[2]
    moved = rotation @ transition.advance(state) + turn * np.eye(5)[2]
    np.testing.assert_allclose(transition.advance(turned), moved, atol=1e-12)
    for of in (transition.jacobian, transition.noise):
        wanted = rotation @ of(state) @ rotation.T
        np.testing.assert_allclose(of(turned), wanted, atol=1e-12 * max(1.0, np.abs(wanted).max()))


@law
@given(states, durations)
def test_without_noise_it_is_the_coordinated_turn(state: Array, dt: float) -> None:
    def cartesian(s: Array) -> Array:
        return np.array([s[0], s[1], s[3] * np.cos(s[2]), s[3] * np.sin(s[2]), s[4]])

    turning = CoordinatedTurn(StateLayout(("x", "y", "vx", "vy", "turn_rate")), CoordinatedTurnParams()).over(dt)
    np.testing.assert_allclose(cartesian(MOTION.over(dt).advance(state)), turning.advance(cartesian(state)), atol=1e-12)


@pytest.mark.parametrize(("turn", "share"), [(1.0, 1e-12), (np.pi, 1e-9), (2 * np.pi, 1e-4)])
def test_the_sum_along_the_path_is_as_exact_as_promised(turn: float, share: float) -> None:
    """Against sixty-four times as many places: the same motion in pieces."""
    state, pieces = np.array([0.0, 0.0, 0.3, 12.0, turn / 2.0]), 64
    piece, noise, at = MOTION.over(2.0 / pieces), np.zeros((5, 5)), state
    for _ in range(pieces):
        slope = piece.jacobian(at)
        noise, at = slope @ noise @ slope.T + piece.noise(at), piece.advance(at)
    scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
    np.testing.assert_allclose(MOTION.over(2.0).noise(state) / scale, noise / scale, atol=share)


def test_little_noise_by_sampling_many_small_steps() -> None:
    rng, dt, pieces, runs = np.random.default_rng(0), 2.0, 200, 40_000
    params = dataclasses.replace(PARAMS, process_noise=1e-4, turn_rate_noise=1e-6)
    start = np.array([0.0, 0.0, 0.5, 12.0, 0.6])
    state = np.tile(start, (runs, 1))
    for _ in range(pieces):
        # Half a step of the turn before the way, half after: second order in the step.
        state[:, 2] += 0.5 * dt / pieces * state[:, 4]
        state[:, 0] += dt / pieces * state[:, 3] * np.cos(state[:, 2])
        state[:, 1] += dt / pieces * state[:, 3] * np.sin(state[:, 2])
        state[:, 2] += 0.5 * dt / pieces * state[:, 4]
        state[:, 3:] += rng.normal(size=(runs, 2)) * np.sqrt(dt / pieces * np.array([1e-4, 1e-6]))
    noise = ConstantTurnRateAndSpeed(LAYOUT, params).over(dt).noise(start)
    scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
    np.testing.assert_allclose(np.cov(state.T) / scale, noise / scale, atol=0.03)


def test_axes_in_any_order_and_others_that_walk() -> None:
    motion = ConstantTurnRateAndSpeed(SHUFFLED, PARAMS)
    at, other = list(SHUFFLED.indices(LAYOUT.axes)), SHUFFLED.axes.index("length")
    state = np.array([0.3, -2.0, 12.0, 4.5, 2.5, 3.0])
    whole, alone = motion.over(1.5), MOTION.over(1.5)
    np.testing.assert_array_equal(whole.advance(state)[at], alone.advance(state[at]))
    assert whole.advance(state)[other] == 4.5
    for matrix, part, own in (
        (whole.jacobian(state), alone.jacobian(state[at]), 1.0),
        (whole.noise(state), alone.noise(state[at]), 1.5 * 0.09),
    ):
        np.testing.assert_allclose(matrix[np.ix_(at, at)], part, rtol=1e-12)
        np.testing.assert_allclose(matrix[other], own * np.eye(6)[other], rtol=1e-14)


@pytest.mark.parametrize("axes", [(), (1,), (3, 2), (0,)])
def test_leading_axes_and_a_noise_factor(axes: tuple[int, ...]) -> None:
    state = np.array([0.0, 0.0, 1.0, 10.0, 0.1]) + np.random.default_rng(1).normal(size=(*axes, 5))
    transition, before = MOTION.over(0.8), state.copy()
    moved, slope, noise, factor = (
        of(state) for of in (transition.advance, transition.jacobian, transition.noise, transition.noise_factor)
    )
    assert (moved.shape, slope.shape, noise.shape) == ((*axes, 5), (*axes, 5, 5), (*axes, 5, 5))
    np.testing.assert_allclose(factor @ np.swapaxes(factor, -1, -2), noise, rtol=1e-12)
    draws = np.random.default_rng(2).normal(size=(*axes, factor.shape[-1]))
    disturbed = transition.disturbance(state, draws)
    for i in np.ndindex(axes):
        np.testing.assert_allclose(moved[i], transition.advance(state[i]), rtol=1e-14)
        np.testing.assert_allclose(slope[i], transition.jacobian(state[i]), rtol=1e-14)
        np.testing.assert_allclose(noise[i], transition.noise(state[i]), rtol=1e-13)
        np.testing.assert_allclose(disturbed[i], transition.disturbance(state[i], draws[i]), rtol=1e-12)
    np.testing.assert_array_equal(state, before)


def test_nothing_moves_in_no_time_and_nothing_goes_backward() -> None:
    state, transition = np.array([3.0, -2.0, 2.5, 12.0, 0.3]), MOTION.over(0.0)
    np.testing.assert_array_equal(transition.advance(state), state)
    np.testing.assert_array_equal(transition.jacobian(state), np.eye(5))
    np.testing.assert_array_equal(transition.noise(state), np.zeros((5, 5)))
    with pytest.raises(ValueError, match=r"The 'dt' of a prediction must be >= 0 s. Got -0.1."):
        MOTION.over(-0.1)


@pytest.mark.parametrize("axes", [("x", "y", "yaw", "speed"), (*LAYOUT.axes, "vx"), (*LAYOUT.axes, "z")])
def test_other_axes_are_refused(axes: tuple[str, ...]) -> None:
    with pytest.raises(ValueError) as caught:
        make(MOTIONS, "constant_turn_rate_and_speed", PARAMS, StateLayout(axes))
    wanted = "Constant turn rate and speed needs axes x, y, yaw, speed, turn_rate"
    assert str(caught.value) == f"{wanted}. Got {', '.join(axes)}."


def test_a_yaw_of_unknown_sign_is_refused() -> None:
    layout = StateLayout(LAYOUT.axes, tuple(HALF_TURN if axis == "yaw" else np.inf for axis in LAYOUT.axes))
    with pytest.raises(ValueError, match="needs a yaw that tells front from back. Got one of period pi."):
        make(MOTIONS, "constant_turn_rate_and_speed", PARAMS, layout)
