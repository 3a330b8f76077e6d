"""Motion and sensor models: laws they obey."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.tracks import StateLayout, planar_layout

LAYOUTS = [("x", "vx"), ("x", "y", "vx", "vy"), ("vz", "x", "z", "vx", "y", "vy")]
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
        speed = 0.0 if axis.startswith("v") else state[layout.axes.index("v" + axis)]
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
    draws = len(axes) // 2 if form == "piecewise_constant" else len(axes)
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


@pytest.mark.parametrize("axes", [("x", "y"), ("x", "vx", "yaw"), ("x", "vx", "y"), ("vx", "vy"), ("x", "vy")])
def test_layouts_that_are_not_pairs_are_refused(axes):
    with pytest.raises(ValueError, match="needs axes like x, vx in pairs. Got " + ", ".join(axes)):
        NearlyConstantVelocity(StateLayout(axes), MotionParams())


def test_position_sensor_reads_the_position_axes_wherever_they_stand():
    sensor = LinearSensor.position(StateLayout(("vx", "y", "vy", "x")), 3.0)
    assert sensor.axes == ("x", "y")
    np.testing.assert_array_equal(sensor.matrix @ [1.0, 2.0, 3.0, 4.0], [4.0, 2.0])
    np.testing.assert_array_equal(sensor.noise, [[9.0, 0.0], [0.0, 9.0]])
    assert LinearSensor.position(planar_layout(), 1.0).matrix.shape == (2, 4)
