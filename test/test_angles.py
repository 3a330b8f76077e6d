"""Axes that wrap: laws of the circle, against arithmetic on the line, brute force and numerical integration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from track_fusion.angles import (
    HALF_TURN,
    TURN,
    center,
    difference,
    heaviest,
    interpolate,
    moments,
    most_certain,
    named_period,
    periods_of,
    shifted,
    within_half_circle,
    wrap,
)
from track_fusion.linalg import Array
from track_fusion.tracks import StateLayout, TrackBatch

law = settings(deadline=None, derandomize=True)
#: A position, a direction, a direction without sign.
PERIODS = (np.inf, TURN, HALF_TURN)
angles = st.floats(-50.0, 50.0)
turns = st.integers(-3, 3)


@st.composite
def components(draw: Any, widest: float = 0.999) -> tuple[Array, Array, Array]:
    """Weights (C,), means (C, 3) within a share of the half circle, not wrapped, and covariances (C, 3, 3)."""
    rng, count = np.random.default_rng(draw(st.integers(0, 2**32))), draw(st.integers(1, 5))
    reach = widest * np.array([100.0, HALF_TURN, HALF_TURN / 2])
    mean = np.array([4e6, draw(angles), draw(angles)]) + reach * rng.uniform(-0.5, 0.5, (count, 3))
    root = rng.normal(size=(count, 3, 5))
    return rng.uniform(0.1, 1.0, count), mean, root @ np.swapaxes(root, -1, -2)


def on_the_line(weight: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Moments of a mixture whose axes do not wrap."""
    center = np.average(mean, axis=0, weights=weight)
    gap = mean - center
    return center, np.average(cov + gap[:, :, None] * gap[:, None, :], axis=0, weights=weight)


def assert_same_state(a: Array, b: Array, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(a[..., 0], b[..., 0], rtol=1e-15, atol=1e-13)
    np.testing.assert_allclose(difference(a, b, PERIODS)[..., 1:], 0.0, atol=atol)


# Wrapping -----------------------------------------------------------------------------------------------------------


@law
@given(angles, st.sampled_from([HALF_TURN, TURN, 360.0, 1.0]))
def test_a_wrapped_value_is_the_same_direction_between_the_ends(value: float, period: float) -> None:
    wrapped = float(wrap(value, period))
    assert -period / 2 <= wrapped < period / 2
    assert np.exp(2j * np.pi * wrapped / period) == pytest.approx(np.exp(2j * np.pi * value / period), abs=1e-12)
    assert wrap(wrapped, period) == wrapped


def test_small_angles_are_wrapped_without_loss() -> None:
    assert wrap(1e-20, TURN) == 1e-20
    assert wrap(np.pi, TURN) == -np.pi
    assert wrap(np.nextafter(-np.pi, -4.0), TURN) == -np.pi
    assert wrap(np.nextafter(-np.pi / 2, -4.0), HALF_TURN) == -np.pi / 2


def test_axes_that_do_not_wrap_keep_any_value() -> None:
    values = np.array([[1e300, 7.0, 7.0], [-np.inf, -7.0, 0.5]])
    np.testing.assert_allclose(
        wrap(values, PERIODS), [[1e300, 7.0 - TURN, 7.0 - 2 * HALF_TURN], [-np.inf, TURN - 7.0, 0.5]], rtol=1e-15
    )
    np.testing.assert_array_equal(wrap(values, np.inf), values)
    assert wrap(np.zeros((0, 3)), PERIODS).shape == (0, 3)


@law
@given(angles, angles, turns, turns)
def test_a_difference_is_the_short_way_whatever_the_turns(a: float, b: float, i: int, j: int) -> None:
    states = np.array([a, a, a]), np.array([b, b, b])
    gap = difference(*states, PERIODS)
    assert (np.abs(gap[1:]) <= [HALF_TURN, HALF_TURN / 2]).all()
    assert_same_state(shifted(states[1], gap, PERIODS), states[0])
    more = np.array([0.0, i * TURN, i * HALF_TURN]), np.array([0.0, j * TURN, j * HALF_TURN])
    assert_same_state(difference(states[0] + more[0], states[1] + more[1], PERIODS), gap)


# Moments ------------------------------------------------------------------------------------------------------------


@law
@given(components())
def test_within_a_half_circle_moments_are_those_of_the_line(parts: tuple[Array, Array, Array]) -> None:
    wanted_mean, wanted_cov = on_the_line(*parts)
    mean, cov = moments(*parts, PERIODS)
    assert_same_state(mean, wanted_mean)
    assert (np.abs(mean[1:]) <= [HALF_TURN, HALF_TURN / 2]).all()
    np.testing.assert_allclose(cov, wanted_cov, rtol=1e-12, atol=1e-12 * np.abs(wanted_cov).max())


@law
@given(components(), st.integers(0, 4), turns)
def test_a_turn_more_of_one_component_changes_nothing(
    parts: tuple[Array, Array, Array], which: int, turns: int
) -> None:
    weight, mean, cov = parts
    more = mean.copy()
    more[which % len(mean), 1:] += turns * np.array([TURN, HALF_TURN])
    a, b = moments(weight, mean, cov, PERIODS), moments(weight, more, cov, PERIODS)
    assert_same_state(a[0], b[0])
    np.testing.assert_allclose(a[1], b[1], rtol=1e-12, atol=1e-12 * np.abs(b[1]).max())


@law
@given(components(widest=3.0), angles, angles)
def test_turning_all_turns_the_mean_and_leaves_the_covariance(
    parts: tuple[Array, Array, Array], first: float, second: float
) -> None:
    """Also beyond a half circle, unless rounding decides between two components or on which side one lies."""
    weight, mean, cov = parts
    at = difference(mean, heaviest(weight, mean), PERIODS)
    if (np.abs(np.abs(at[:, 1:]) - [HALF_TURN, HALF_TURN / 2]) < 1e-9).any():
        return
    turn = np.array([0.0, first, second])
    (a, p), (b, q) = moments(weight, mean, cov, PERIODS), moments(weight, mean + turn, cov, PERIODS)
    assert_same_state(b, a + turn)
    np.testing.assert_allclose(q, p, rtol=1e-12, atol=1e-12 * np.abs(p).max())


@pytest.mark.parametrize("period", [TURN, HALF_TURN])
def test_beside_the_cut_is_as_at_zero(period: float) -> None:
    weight, cov = np.array([0.3, 0.7]), np.array([[[0.1]], [[0.2]]])
    near, p = moments(weight, np.array([[0.01], [-0.01]]), cov, [period])
    cut, q = moments(weight, np.array([[-period / 2 + 0.01], [period / 2 - 0.01]]), cov, [period])
    np.testing.assert_allclose(difference(cut, near, [period]), -period / 2, atol=1e-12)
    np.testing.assert_allclose(q, p, rtol=1e-12)


def test_moments_take_leading_axes_and_weights_of_any_sum() -> None:
    rng = np.random.default_rng(0)
    weight, mean = rng.uniform(size=(4, 2, 3)), rng.normal(size=(4, 2, 3, 3))
    cov = np.broadcast_to(np.eye(3), (4, 2, 3, 3, 3))
    merged = moments(weight, mean, cov, PERIODS)
    for i in np.ndindex(4, 2):
        for whole, alone in zip(merged, moments(7.0 * weight[i], mean[i], cov[i], PERIODS), strict=True):
            np.testing.assert_allclose(whole[i], alone, rtol=1e-13)
    assert [m.shape for m in moments(weight[:0], mean[:0], cov[:0], PERIODS)] == [(0, 2, 3), (0, 2, 3, 3)]


@pytest.mark.parametrize("center", [0.0, 1.0, np.pi - 0.01, -np.pi])
@pytest.mark.parametrize("degrees", [20.0, 90.0, 180.0])
def test_moments_of_a_wide_bearing_against_numerical_integration(center: float, degrees: float) -> None:
    """A bearing of 90 degrees standard deviation wraps: its variance on the circle is that of the wrapped density."""
    sd = np.radians(degrees)
    wanted, _ = quad(
        lambda d: d**2 * sum(norm.pdf(d + k * TURN, scale=sd) for k in range(-8, 9)), -np.pi, np.pi, epsabs=1e-13
    )
    grid = np.linspace(-8.1 * sd, 8.1 * sd, 400_001)  # symmetric, and no point at the cut
    mean, cov = moments(norm.pdf(grid, scale=sd), (center + grid)[:, None], np.zeros((len(grid), 1, 1)), [TURN])
    np.testing.assert_allclose(difference(mean, center, [TURN]), 0.0, atol=1e-11)
    np.testing.assert_allclose(cov, [[wanted]], rtol=1e-4)


# References and the half circle -------------------------------------------------------------------------------------


def smallest_arc(values: Array, period: float) -> float:
    """Length of the shortest arc that holds all values, from the widest gap between neighbours."""
    around = np.sort(np.mod(values, period))
    return period - float(np.max(np.diff(around, append=around[0] + period)))


@law
@given(st.lists(angles, min_size=1, max_size=6), st.sampled_from([TURN, HALF_TURN]), st.integers(0, 5))
def test_half_circles_by_the_widest_gap(values: list[float], period: float, which: int) -> None:
    states = np.array(values)[:, None]
    relative = difference(states, states[which % len(values)], [period])
    arc = smallest_arc(states[:, 0], period)
    if abs(arc - period / 2 + 1e-6) > 1e-9:
        assert within_half_circle(relative, [period]) == (arc < period / 2 - 1e-6)


def test_a_half_circle_is_asked_of_every_axis_that_wraps() -> None:
    relative = np.zeros((4, 2, 3))
    relative[0, 1] = 1e9, 3.1, 1.5
    relative[1, 1, 1] = np.pi - 1e-7
    relative[2, 1, 2] = np.pi / 2 - 1e-7
    relative[3, 1, 2] = np.pi / 2 - 2e-6
    assert within_half_circle(relative, PERIODS).tolist() == [True, False, False, True]


def test_the_center_of_a_cloud_is_where_its_vectors_point_and_of_opposites_the_heaviest() -> None:
    mean = np.array([[4e6, 3.0, 1.5], [2.0, -3.0, -1.5], [7.0, 0.5, 0.3]])
    got = center(np.array([0.4, 0.4, 0.2]), mean, PERIODS)
    assert got[0] == 4e6  # the heaviest, the first of equals
    for axis, period in enumerate(PERIODS[1:], 1):
        total = (np.array([0.4, 0.4, 0.2]) * np.exp(2j * np.pi / period * mean[:, axis])).sum()
        assert got[axis] == pytest.approx(np.angle(total) * period / TURN, abs=1e-12)
    opposite = np.array([[1.0, 2.0, 0.2], [5.0, 2.0 - np.pi, 0.2 + np.pi / 2]])
    np.testing.assert_array_equal(center(np.array([0.5, 0.5]), opposite, PERIODS), opposite[0])


def test_the_reference_is_the_heaviest_or_the_most_certain_and_the_first_of_equals() -> None:
    mean = np.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_array_equal(heaviest(np.array([[0.2, 0.5, 0.3], [0.4, 0.2, 0.4]]), mean), [[2, 3], [6, 7]])
    cov = np.eye(2) * np.array([[4.0, 1.0, 2.0], [3.0, 3.0, 5.0]])[..., None, None]
    np.testing.assert_array_equal(most_certain(mean, cov), [[2, 3], [6, 7]])
    kilometres = np.diag([1e-3, 1.0])
    np.testing.assert_array_equal(most_certain(mean, kilometres @ cov @ kilometres), [[2, 3], [6, 7]])


# Interpolation ------------------------------------------------------------------------------------------------------


@law
@given(angles, st.floats(-1.5, 1.5), st.floats(0.0, 1.0), angles, turns)
def test_interpolation_goes_the_short_way(start: float, gap: float, share: float, turn: float, more: int) -> None:
    begin = np.array([5.0, start, start])
    end = begin + np.array([gap, gap, gap])
    between = interpolate(begin, end, np.array(share), PERIODS)
    assert_same_state(between, begin + share * gap)
    change = np.array([0.0, more * TURN, more * HALF_TURN])
    assert_same_state(interpolate(begin, end + change, np.array(share), PERIODS), between)
    turned = np.array([0.0, turn, turn])
    assert_same_state(interpolate(begin + turned, end + turned, np.array(share), PERIODS), between + turned)


def test_interpolation_takes_leading_axes() -> None:
    start, end = np.zeros((4, 3)), np.tile([1.0, 6.0, 3.0], (4, 1))
    between = interpolate(start, end, np.array([0.0, 0.25, 0.5, 1.0]), PERIODS)
    shares = np.array([[0.0], [0.25], [0.5], [1.0]])
    np.testing.assert_allclose(between, shares * [1.0, 6.0 - TURN, 3.0 - HALF_TURN], atol=1e-15)


# Layouts and tracks -------------------------------------------------------------------------------------------------


def test_periods_follow_from_names_unless_given() -> None:
    assert periods_of(("x", "yaw", "phase"), {"phase": 1.0}) == (np.inf, TURN, 1.0)
    assert periods_of(("yaw",), {"yaw": HALF_TURN}) == (HALF_TURN,)
    with pytest.raises(ValueError) as caught:
        periods_of(("x", "yaw"), {"heading": TURN})
    assert str(caught.value) == "The angular axis 'heading' is none of the axes x, yaw."
    layout = StateLayout(("x", "yaw"))
    assert layout.periods == (np.inf, TURN)
    assert layout == StateLayout(("x", "yaw"), (np.inf, TURN))
    assert layout != StateLayout(("x", "yaw"), (np.inf, HALF_TURN))
    for wrong in ((TURN,), (np.inf, 0.0), (np.inf, np.nan)):
        with pytest.raises(ValueError, match="must be 2 numbers > 0, infinite where an axis does not wrap. Got"):
            StateLayout(("x", "yaw"), wrong)


def test_an_angular_axis_is_spelt_with_pi_where_its_sign_is_unknown() -> None:
    assert [named_period(spelt) for spelt in ("psi", "yaw:pi")] == [("psi", TURN), ("yaw", HALF_TURN)]


def test_a_part_of_a_layout_keeps_its_periods() -> None:
    layout = StateLayout(("x", "yaw", "phase"), PERIODS)
    assert layout.part(("phase", "x")) == StateLayout(("phase", "x"), (HALF_TURN, np.inf))
    assert layout.part(("yaw",)).angular.tolist() == [True]


def test_an_axis_is_read_with_its_own_period_or_a_part_of_it() -> None:
    cov, mean = np.eye(2)[None], np.array([[3.0, 3.0]])
    line, signed, unsigned = (StateLayout(("x", "phase"), (np.inf, p)) for p in (np.inf, TURN, HALF_TURN))
    for source in (line, signed):
        read = TrackBatch.gaussian(source, "map", mean, cov).to_axes(unsigned)
        np.testing.assert_allclose(read.mean[0, 0], [3.0, 3.0 - np.pi], rtol=1e-15)
    with pytest.raises(ValueError) as caught:
        TrackBatch.gaussian(unsigned, "map", mean, cov).to_axes(signed)
    assert str(caught.value) == "The axis 'phase', of period 3.14159, cannot be read as one of period 6.28319."
    with pytest.raises(ValueError, match="cannot be read as one of period inf"):
        TrackBatch.gaussian(signed, "map", mean, cov).to_axes(line)


def test_a_track_that_points_along_the_cut_is_not_turned_around() -> None:
    layout = StateLayout(("x", "yaw"))
    mean = np.array([[[0.0, np.pi - 0.1], [2.0, -np.pi + 0.1]]])
    batch = TrackBatch.gaussian(layout, "map", mean[:, 0], np.eye(2)[None])
    batch = batch.replace(weight=np.array([[0.5, 0.5]]), mean=mean, cov=np.tile(np.eye(2), (1, 2, 1, 1)))
    merged, cov = batch.moments
    np.testing.assert_allclose(np.abs(merged), [[1.0, np.pi]], rtol=1e-14)
    np.testing.assert_allclose(cov, [[[2.0, 0.1], [0.1, 1.01]]], rtol=1e-12)
