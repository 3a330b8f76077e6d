"""Turning motions, van Loan's discretisation, nonlinear sensors and the local frame: laws and independent oracles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpmath import mp
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from track_fusion.models.base import Transition
from track_fusion.models.geodetic import LocalFrame
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor, RangeRangeRateSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import (
    CoordinatedTurn,
    CoordinatedTurnParams,
    KnownTurn,
    KnownTurnParams,
    turn_coefficient_slopes,
    turn_coefficients,
)
from track_fusion.models.van_loan import van_loan
from track_fusion.tracks import StateLayout, planar_layout

TURN = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
SHUFFLED = StateLayout(("vy", "turn_rate", "x", "vx", "y"))
PARAMS = CoordinatedTurnParams(process_noise=0.1, turn_rate_noise=1e-4)
STATE = {"x": 3.0, "y": -2.0, "vx": 20.0, "vy": 5.0}


def state(layout, rate):
    return np.array([{**STATE, "turn_rate": rate}[axis] for axis in layout.axes])


def slope_by_differences(f, x):
    """Derivative by central differences, extrapolated once."""
    found = []
    for step in (1e-3, 5e-4):
        h = step * np.maximum(1.0, np.abs(x))
        found.append(np.stack([(f(x + d) - f(x - d)) / (2 * h[i]) for i, d in enumerate(np.diag(h))], -1))
    return (4 * found[1] - found[0]) / 3


@pytest.mark.parametrize("layout", [TURN, SHUFFLED])
@pytest.mark.parametrize("rate", [0.0, 1e-12, 1e-3, -np.pi / 60, 0.7])
def test_coordinated_turn_solves_its_differential_equation(layout, rate):
    def flow(_, s):
        x, y, vx, vy, w = s
        return [vx, vy, -w * vy, w * vx, 0.0]

    begin = [*STATE.values(), rate]
    end = solve_ivp(flow, (0.0, 2.5), begin, rtol=1e-12, atol=1e-12).y[:, -1]
    moved = CoordinatedTurn(layout, PARAMS).over(2.5).advance(state(layout, rate))
    np.testing.assert_allclose(moved[list(layout.indices(TURN.axes))], end, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("layout", [TURN, SHUFFLED])
@pytest.mark.parametrize("rate", [0.0, 1e-9, 0.02, -0.0999, 0.101, 1.3])
def test_jacobian_of_the_coordinated_turn(layout, rate):
    transition, x = CoordinatedTurn(layout, PARAMS).over(1.0), state(layout, rate)
    np.testing.assert_allclose(transition.jacobian(x), slope_by_differences(transition.advance, x), atol=2e-8)
    batch = np.stack([x, 2 * x, -x]).reshape(3, 1, -1)
    np.testing.assert_array_equal(transition.jacobian(batch)[1, 0], transition.jacobian(2 * x))


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-8, 1e-3, -0.05, 0.09999999, 0.10000001, -0.3, 2.0, 3.14, -6.0])
def test_turn_coefficients_to_the_last_digits(angle):
    mp.dps = 60
    a = mp.mpf(angle)
    if angle:
        exact = mp.sin(a) / a, (1 - mp.cos(a)) / a
        slopes = (a * mp.cos(a) - mp.sin(a)) / a**2, (a * mp.sin(a) - 1 + mp.cos(a)) / a**2
        if abs(angle) < 1e-100:
            exact, slopes = (1, a / 2), (-a / 3, mp.mpf(1) / 2)
    else:
        exact, slopes = (1, 0), (0, mp.mpf(1) / 2)
    np.testing.assert_allclose(turn_coefficients(np.array(angle)), [float(v) for v in exact], rtol=1e-15)
    np.testing.assert_allclose(turn_coefficient_slopes(np.array(angle)), [float(v) for v in slopes], rtol=5e-13)


@pytest.mark.parametrize("layout", [TURN, SHUFFLED])
def test_noise_of_the_coordinated_turn_is_block_diagonal(layout):
    """Li 2022: Q = diag(I2 kron G, sigma_u^2) with q1 = .1, sigma_u^2 = 1e-4 at one second."""
    noise = CoordinatedTurn(layout, PARAMS).over(1.0).noise(state(layout, 0.1))
    order = layout.indices(("x", "vx", "y", "vy", "turn_rate"))
    block = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    wanted = np.zeros((5, 5))
    wanted[:2, :2] = wanted[2:4, 2:4] = block
    wanted[4, 4] = 1e-4
    np.testing.assert_allclose(noise[np.ix_(order, order)], wanted, rtol=1e-14)
    factor = CoordinatedTurn(layout, PARAMS).over(1.0).noise_factor(state(layout, 0.1))
    np.testing.assert_allclose(factor @ factor.T, noise, rtol=1e-13, atol=1e-18)


@pytest.mark.parametrize("axes", [("x", "y", "vx", "vy"), ("x", "y", "vx", "vy", "yaw"), ("x", "vx")])
def test_coordinated_turn_refuses_other_axes(axes):
    with pytest.raises(ValueError, match="needs axes x, y, vx, vy, turn_rate. Got " + ", ".join(axes)):
        CoordinatedTurn(StateLayout(axes), PARAMS)


@pytest.mark.parametrize("rate", [0.0, 0.05, -0.15])
def test_known_turn_moves_as_the_coordinated_turn(rate):
    known = KnownTurn(planar_layout(), KnownTurnParams(turn_rate=rate)).over(3.0)
    free = CoordinatedTurn(TURN, PARAMS).over(3.0)
    x = state(TURN, rate)
    np.testing.assert_allclose(known.advance(x[:4]), free.advance(x)[:4], rtol=1e-13)
    np.testing.assert_allclose(known.jacobian(x[:4]), free.jacobian(x)[:4, :4], atol=1e-13)


def test_known_turn_at_rate_zero_is_nearly_constant_velocity():
    known = KnownTurn(planar_layout(), KnownTurnParams(turn_rate=0.0, process_noise=2.0)).matrices(1.7)
    straight = NearlyConstantVelocity(planar_layout(), MotionParams(process_noise=2.0)).matrices(1.7)
    for a, b in zip(known, straight, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)


def test_noise_of_a_known_turn_by_sampling_the_differential_equation():
    rng, rate, dt, pieces, strength = np.random.default_rng(0), 0.5, 2.0, 100, 3.0
    x = np.zeros((4, 20_000))
    for _ in range(pieces):
        x[:2] += x[2:] * dt / pieces
        x[2:] += np.array([-rate * x[3], rate * x[2]]) * dt / pieces
        x[2:] += np.sqrt(strength * dt / pieces) * rng.normal(size=x[2:].shape)
    noise = KnownTurn(planar_layout(), KnownTurnParams(turn_rate=rate, process_noise=strength)).matrices(dt)[1]
    np.testing.assert_allclose(noise, np.cov(x), atol=0.05 * np.abs(noise).max())


@pytest.mark.parametrize("seed", range(8))
def test_van_loan_against_quadrature(seed):
    rng = np.random.default_rng(seed)
    drift, root, dt = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.uniform(0.0, 2.0)
    diffusion = root @ root.T
    transition, noise = van_loan(drift, diffusion, dt)
    np.testing.assert_allclose(transition, expm(drift * dt), rtol=1e-10, atol=1e-12)
    wanted = quad_vec(lambda s: expm(drift * s) @ diffusion @ expm(drift * s).T, 0.0, dt)[0]
    np.testing.assert_allclose(noise, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())


def test_van_loan_batches_and_refuses_to_go_back():
    drift = np.random.default_rng(1).normal(size=(4, 2, 2))
    transition, noise = van_loan(drift, np.eye(2), 0.5)
    for i in range(4):
        alone = van_loan(drift[i], np.eye(2), 0.5)
        np.testing.assert_allclose(transition[i], alone[0], rtol=1e-14)
        np.testing.assert_allclose(noise[i], alone[1], rtol=1e-14)
    with pytest.raises(ValueError, match=r"The 'dt' of a prediction must be >= 0 s. Got -1."):
        van_loan(np.eye(2), np.eye(2), -1.0)


def test_linear_transition_finds_a_noise_factor():
    root = np.random.default_rng(2).normal(size=(3, 2))
    transition = Transition.linear(np.eye(3), root @ root.T)
    factor = transition.noise_factor(np.zeros(3))
    np.testing.assert_allclose(factor @ factor.T, root @ root.T, atol=1e-14)


SENSORS = {
    "range_bearing": RangeBearingSensor(SHUFFLED, 10.0, 0.02, (500.0, -3.0)),
    "range_range_rate": RangeRangeRateSensor(planar_layout(), 20.0, 1.0, (100.0, 7.0), (3.0, -1.0)),
    "in_space": RangeRangeRateSensor(StateLayout(("x", "vx", "z", "vz", "y", "vy")), 20.0, 1.0, (1.0, 2.0, 3.0)),
    "linear": LinearSensor.position(planar_layout(), 3.0),
}


@pytest.mark.parametrize("name", SENSORS)
def test_jacobians_of_the_sensors(name):
    sensor, rng = SENSORS[name], np.random.default_rng(3)
    size = {"range_bearing": 5, "in_space": 6}.get(name, 4)
    for x in 100.0 * rng.normal(size=(5, size)):
        np.testing.assert_allclose(sensor.jacobian(x), slope_by_differences(sensor.observe, x), atol=1e-7)
    batch = rng.normal(size=(3, 2, size))
    assert sensor.observe(batch).shape == (3, 2, len(sensor.noise))
    np.testing.assert_array_equal(sensor.jacobian(batch)[2, 1], sensor.jacobian(batch[2, 1]))


def test_range_and_bearing_of_known_points():
    sensor = RangeBearingSensor(planar_layout(), 1.0, 1.0, (1.0, 1.0))
    points = np.array([[4.0, 5.0, 9, 9], [1.0, 0.0, 9, 9], [0.0, 1.0, 9, 9], [0.0, 0.0, 9, 9]])
    wanted = [[5.0, np.arctan2(4, 3)], [1.0, -np.pi / 2], [1.0, np.pi], [np.sqrt(2), -3 * np.pi / 4]]
    np.testing.assert_allclose(sensor.observe(points), wanted, rtol=1e-15)


def test_range_rate_is_the_derivative_of_range():
    sensor, x = SENSORS["range_range_rate"], np.array([30.0, -50.0, 7.0, 11.0])
    moving = x[2:] - sensor.velocity

    def range_at(t):
        return np.hypot(*(x[:2] + t * moving - sensor.location))

    np.testing.assert_allclose(sensor.observe(x)[1], (range_at(1e-4) - range_at(-1e-4)) / 2e-4, rtol=1e-8)


@pytest.mark.parametrize("name", ["range_bearing", "range_range_rate"])
def test_derivatives_at_the_sensor_itself_are_zero(name):
    sensor = SENSORS[name]
    layout = SHUFFLED if name == "range_bearing" else planar_layout()
    x = np.full(layout.size, 4.0)
    x[list(layout.position)] = sensor.location
    jacobian = sensor.jacobian(x)
    np.testing.assert_array_equal(jacobian, np.zeros_like(jacobian))
    assert sensor.observe(x)[0] == 0.0


@given(st.floats(-50.0, 50.0), st.floats(-3.1, 3.1))
def test_bearing_residuals_are_the_short_way_round(bearing, other):
    residual = SENSORS["range_bearing"].residual(np.array([7.0, bearing]), np.array([2.0, other]))
    assert residual[0] == 5.0
    assert -np.pi <= residual[1] < np.pi
    assert np.exp(1j * residual[1]) == pytest.approx(np.exp(1j * (bearing - other)), abs=1e-13)


def test_a_linear_sensor_wraps_angular_axes():
    sensor = LinearSensor(("yaw",), np.eye(1), np.eye(1))
    np.testing.assert_allclose(sensor.residual(np.array([3.0]), np.array([-3.0])), [6.0 - 2 * np.pi], rtol=1e-12)


def test_positions_of_detections_by_sampling():
    sensor, rng = RangeBearingSensor(planar_layout(), 50.0, 0.004, (1e3, 2e3)), np.random.default_rng(4)
    z = np.array([40e3, 2.2])
    mean, cov = sensor.positions(z)
    drawn = z + rng.normal(size=(200_000, 2)) * [50.0, 0.004]
    points = sensor.location + drawn[:, :1] * np.stack([np.cos(drawn[:, 1]), np.sin(drawn[:, 1])], -1)
    np.testing.assert_allclose(sensor.observe(np.array([*mean, 0, 0])), z, rtol=1e-12)
    np.testing.assert_allclose(cov, np.cov(points.T), rtol=0.02)


@pytest.mark.parametrize("make", [RangeBearingSensor, RangeRangeRateSensor])
def test_a_sensor_elsewhere_needs_as_many_coordinates(make):
    with pytest.raises(ValueError, match="The location and velocity of a sensor must hold 2 numbers. Got 3."):
        make(planar_layout(), 1.0, 1.0, (1.0, 2.0, 3.0))


def earth_fixed(latitude, longitude, altitude):
    """WGS 84 geodetic coordinates (degrees) to earth-centred ones, from the ellipsoid's definition."""
    a, f = 6378137.0, 1 / 298.257223563
    b, p, q = a * (1 - f), np.radians(latitude), np.radians(longitude)
    n = a**2 / np.sqrt((a * np.cos(p)) ** 2 + (b * np.sin(p)) ** 2)
    return np.array([(n + altitude) * np.cos(p) * np.cos(q), (n + altitude) * np.cos(p) * np.sin(q),
                     ((b / a) ** 2 * n + altitude) * np.sin(p)])  # fmt: skip


def test_local_frame_against_the_definition_of_the_ellipsoid():
    pytest.importorskip("pymap3d")
    frame = LocalFrame(60.76, -55.76, 120.0)
    points = np.array([[60.86, -56.37, 9000.0], [60.76, -55.76, 120.0], [58.35, -56.44, 0.0]])
    p, q = np.radians([frame.latitude_deg, frame.longitude_deg])
    axes = np.array([[-np.sin(q), np.cos(q), 0.0],
                     [-np.sin(p) * np.cos(q), -np.sin(p) * np.sin(q), np.cos(p)],
                     [np.cos(p) * np.cos(q), np.cos(p) * np.sin(q), np.sin(p)]])  # fmt: skip
    origin = earth_fixed(frame.latitude_deg, frame.longitude_deg, frame.altitude_m)
    wanted = np.stack([axes @ (earth_fixed(*point) - origin) for point in points])
    found = frame.enu_from_geodetic(points)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_allclose(frame.enu_from_geodetic(points[0]), found[0], atol=1e-9)


def test_local_frame_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymap3d", None)
    with pytest.raises(ImportError, match="Geodetic coordinates need pymap3d: pip install pymap3d"):
        LocalFrame(0.0, 0.0).enu_from_geodetic(np.zeros(3))
