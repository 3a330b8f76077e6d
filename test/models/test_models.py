"""Motion and sensor models: laws they obey."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams, KnownTurn, KnownTurnParams
from track_fusion.params import ParameterError
from track_fusion.tracks import StateLayout, planar_layout

BOX = ("yaw", "x", "y", "length", "vx", "vy", "width", "height")
LAYOUTS = [("x", "vx"), ("x", "y", "vx", "vy"), ("vz", "x", "z", "vx", "y", "vy"), BOX]
FORMS = ["continuous", "piecewise_constant"]
durations = st.floats(0.0, 100.0)


def model(axes=LAYOUTS[1], form="continuous", strength=3.0):
    return NearlyConstantVelocity(StateLayout(axes), MotionParams(noise_form=form, process_noise=strength))


@pytest.mark.parametrize("axes", LAYOUTS)
@given(first=durations, second=durations)
def test_continuous_noise_does_not_depend_on_how_often_one_predicts(axes, first, second):
    motion = model(axes)
    f1, q1 = motion.matrices(first)
    f2, q2 = motion.matrices(second)
    f, q = motion.matrices(first + second)
    np.testing.assert_allclose(f2 @ f1, f, rtol=1e-12)
    np.testing.assert_allclose(f2 @ q1 @ f2.T + q2, q, rtol=1e-9, atol=1e-12)


def test_held_acceleration_does_depend_on_how_often_one_predicts():
    motion = model(form="piecewise_constant")
    f, q = motion.matrices(1.0)
    assert np.abs(f @ q @ f.T + q - motion.matrices(2.0)[1]).max() > 1.0


@pytest.mark.parametrize("axes", LAYOUTS)
def test_position_moves_by_velocity_times_time(axes):
    motion, layout = model(axes), StateLayout(axes)
    state = np.arange(1.0, len(axes) + 1)
    moved = motion.matrices(2.5)[0] @ state
    for i, axis in enumerate(axes):
        speed = state[layout.axes.index("v" + axis)] if "v" + axis in axes else 0.0
        assert moved[i] == pytest.approx(state[i] + 2.5 * speed)


def test_held_acceleration_noise_is_that_of_a_random_acceleration():
    """Moments of x = a dt^2 / 2, v = a dt with a of this standard deviation, by sampling."""
    motion, dt, rng = model(("x", "vx"), "piecewise_constant", 5.0), 2.0, np.random.default_rng(0)
    a = 5.0 * rng.normal(size=200_000)
    sampled = np.cov(np.stack([a * dt**2 / 2, a * dt]))
    np.testing.assert_allclose(motion.matrices(dt)[1], sampled, rtol=0.02)


def test_continuous_noise_is_that_of_integrated_white_noise():
    """Moments by Euler steps of a white acceleration of this power spectral density."""
    dt, pieces, rng = 2.0, 200, np.random.default_rng(1)
    x, v = np.zeros((2, 20_000))
    for _ in range(pieces):
        x = x + v * dt / pieces
        v = v + np.sqrt(3.0 * dt / pieces) * rng.normal(size=len(v))
    np.testing.assert_allclose(model(("x", "vx")).matrices(dt)[1], np.cov(np.stack([x, v])), rtol=0.04)


@pytest.mark.parametrize("axes", LAYOUTS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dt", [0.0, 1e-3, 1.0, 50.0])
def test_noise_factor_squares_to_the_noise(axes, form, dt):
    motion = model(axes, form)
    factor = motion.noise_factor(dt)
    np.testing.assert_allclose(factor @ factor.T, motion.matrices(dt)[1], rtol=1e-12, atol=1e-300)
    pairs = sum(axis.startswith("v") for axis in axes)
    draws = len(axes) - pairs if form == "piecewise_constant" else len(axes)
    assert factor.shape == (len(axes), draws)


@pytest.mark.parametrize("form", FORMS)
def test_batch_equals_single_intervals(form):
    motion, dt = model(form=form), np.array([0.0, 0.1, 7.0])
    transition, noise = motion.batch(dt)
    for i, d in enumerate(dt):
        np.testing.assert_array_equal(transition[i], motion.matrices(d)[0])
        np.testing.assert_array_equal(noise[i], motion.matrices(d)[1])


def test_prediction_does_not_go_backward():
    with pytest.raises(ValueError, match=r"The 'dt' of a prediction must be >= 0 s. Got -0.1."):
        model().matrices(-0.1)


@pytest.mark.parametrize("axes", [("x", "y"), ("x", "vx", "ax"), ("x", "vx", "y"), ("vx", "vy"), ("x", "vy")])
def test_layouts_that_are_not_pairs_are_refused(axes):
    with pytest.raises(ValueError, match="needs axes like x, vx in pairs. Got " + ", ".join(axes)):
        NearlyConstantVelocity(StateLayout(axes), MotionParams())


@pytest.mark.parametrize("form", FORMS)
def test_axes_without_a_motion_follow_a_random_walk(form):
    """Each gains its own variance in proportion to time, alone; beside them position and velocity move as ever."""
    noise = dict(zip(("yaw", "length", "width", "height"), (0.3, 0.1, 0.0, 0.2), strict=True))
    params = MotionParams(noise_form=form, process_noise=3.0, random_walk_noise=tuple(noise.values()))
    transition, q = NearlyConstantVelocity(StateLayout(BOX), params).matrices(2.5)
    plane = [BOX.index(axis) for axis in LAYOUTS[1]]
    for whole, alone in zip((transition, q), model(form=form).matrices(2.5), strict=True):
        np.testing.assert_array_equal(whole[np.ix_(plane, plane)], alone)
    for axis, sd in noise.items():
        row = np.zeros(len(BOX))
        row[BOX.index(axis)] = 1.0
        np.testing.assert_array_equal(transition[BOX.index(axis)], row)
        np.testing.assert_allclose(q[BOX.index(axis)], 2.5 * sd**2 * row, rtol=1e-15)
    one = dataclasses.replace(params, random_walk_noise=(0.3,))
    variance = np.diag(NearlyConstantVelocity(StateLayout(BOX), one).matrices(2.5)[1])
    np.testing.assert_allclose([variance[BOX.index(axis)] for axis in noise], 2.5 * 0.09, rtol=1e-15)


TURNING = {
    "coordinated": (CoordinatedTurn, CoordinatedTurnParams, ("vy", "length", "turn_rate", "x", "y", "vx")),
    "known": (KnownTurn, KnownTurnParams, ("vy", "length", "x", "y", "vx")),
}


@pytest.mark.parametrize("name", TURNING)
def test_a_turning_target_carries_axes_without_a_motion(name):
    motion, params, axes = TURNING[name]
    rest = [i for i, axis in enumerate(axes) if axis != "length"]
    whole = motion(StateLayout(axes), params(random_walk_noise=(0.3,))).over(2.0)
    alone = motion(StateLayout(tuple(axes[i] for i in rest)), params()).over(2.0)
    state = np.linspace(1.0, 2.0, len(axes))
    np.testing.assert_allclose(whole.advance(state)[rest], alone.advance(state[rest]), rtol=1e-14)
    assert whole.advance(state)[1] == pytest.approx(state[1], rel=1e-15)
    parts = (whole.jacobian(state), alone.jacobian(state[rest]), 1.0), (whole.noise(state), alone.noise(state), 0.18)
    for matrix, part, own in parts:
        np.testing.assert_allclose(matrix[np.ix_(rest, rest)], part, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(matrix[1], own * np.eye(len(axes))[1], atol=1e-14)
        np.testing.assert_allclose(matrix[:, 1], own * np.eye(len(axes))[1], atol=1e-14)
    factor = whole.noise_factor(state)
    np.testing.assert_allclose(factor @ factor.T, whole.noise(state), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("axes", "count", "text"),
    [
        (("x", "vx", "yaw", "width"), 3, "one number, or one for each of yaw, width. Got 3."),
        (("x", "vx", "yaw"), 0, "one number, or one for each of yaw. Got 0."),
        (("x", "vx"), 2, "one number: every axis has a motion of its own. Got 2."),
    ],
)
def test_another_number_of_random_walks_is_refused(axes, count, text):
    with pytest.raises(ParameterError) as caught:
        NearlyConstantVelocity(StateLayout(axes), MotionParams(random_walk_noise=(0.1,) * count))
    assert str(caught.value) == f"The 'random_walk_noise' parameter must hold {text}"


@pytest.mark.parametrize("name", TURNING)
@pytest.mark.parametrize("extra", ["z", "vz", "ax"])
def test_a_turn_does_not_take_half_a_motion_beside_it(name, extra):
    motion, params, axes = TURNING[name]
    with pytest.raises(ValueError, match=f"needs axes x, y, vx, vy.*Got .*, {extra}"):
        motion(StateLayout((*axes, extra)), params())


def test_position_sensor_reads_the_position_axes_wherever_they_stand():
    sensor = LinearSensor.position(StateLayout(("vx", "y", "vy", "x")), 3.0)
    assert sensor.axes == ("x", "y")
    np.testing.assert_array_equal(sensor.matrix @ [1.0, 2.0, 3.0, 4.0], [4.0, 2.0])
    np.testing.assert_array_equal(sensor.noise, [[9.0, 0.0], [0.0, 9.0]])
    assert LinearSensor.position(planar_layout(), 1.0).matrix.shape == (2, 4)
