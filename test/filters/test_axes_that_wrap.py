"""Directions in filters: at the seam as elsewhere, wide ones against the Kalman filter, exact grids and many draws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filters.plain import Floats, Plain
from scipy.stats import chi2

from track_fusion.angles import TURN, difference
from track_fusion.filters.cubature import Cubature
from track_fusion.filters.extended import Extended
from track_fusion.filters.gaussian_student_t_mixture import GaussianStudentTMixture
from track_fusion.filters.kalman import Kalman
from track_fusion.filters.particle import Particles, Sir, SirParams
from track_fusion.filters.square_root_cubature import SquareRootCubature
from track_fusion.filters.student_t import StudentT
from track_fusion.filters.unscented import Unscented, UnscentedParams
from track_fusion.models.constant_turn_rate_and_speed import ConstantTurnRateAndSpeed, TurnRateAndSpeedParams
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.tracks import StateLayout

LAYOUT = StateLayout(("x", "y", "yaw", "speed", "turn_rate"))
YAW = 2
MOTION = ConstantTurnRateAndSpeed(LAYOUT, TurnRateAndSpeedParams())
COMPASS = LinearSensor.reading(LAYOUT, ("yaw",), np.array([[0.01]]))
FILTERS: dict[str, Any] = {
    "extended": Extended(),
    "unscented": Unscented(),
    "unscented, wide": Unscented(UnscentedParams(kappa=3.0)),
    "cubature": Cubature(),
    "square root cubature": SquareRootCubature(),
    "student t": StudentT(),
    "gaussian and student t": GaussianStudentTMixture(),
    "particle": Sir(SirParams(particles=200), periods=LAYOUT.periods),
}
SIGMA = ("unscented", "unscented, wide", "cubature", "square root cubature")
COV = np.diag([1.0, 1.0, 0.04, 1.0, 0.01])


@pytest.mark.parametrize("name", FILTERS)
def test_a_scene_at_the_seam_is_that_at_zero_turned(name: str) -> None:
    """Twenty steps of prediction and a compass; the seam is crossed again and again, and detections come wrapped."""
    one, rng = FILTERS[name], np.random.default_rng(1)
    seen = 0.2 * rng.normal(size=20)

    def run(turn: float) -> tuple[Floats, Floats]:
        mean = np.array([0.0, 0.0, turn, 0.0, 0.0])  # at rest: x and y stay, so that the noise is the same in both
        state = one.begin(mean[None], 1e-9 * np.eye(5)[None] + COV * np.diag([0.0, 0.0, 1.0, 0.0, 1.0]))
        for z in seen:
            state = one.predict(state, MOTION.over(0.5))
            state, _ = one.update(state, difference([[turn + z]], 0.0, TURN), COMPASS)
        found: tuple[Floats, Floats] = state.moments
        return found

    (mean, cov), (turned, same) = run(0.0), run(np.pi)
    assert difference(turned[0, YAW] - mean[0, YAW], np.pi, TURN) == pytest.approx(0.0, abs=1e-9)
    at = [YAW, 4]
    np.testing.assert_allclose(same[0][np.ix_(at, at)], cov[0][np.ix_(at, at)], rtol=1e-6, atol=1e-12)


def test_the_kalman_filter_goes_the_short_way() -> None:
    layout = StateLayout(("x", "yaw"))
    sensor = LinearSensor.reading(layout, ("x", "yaw"), np.eye(2))
    mean, cov, _ = Plain(Kalman()).update(np.array([0.0, 3.1]), np.eye(2), np.array([1.0, -3.1]), sensor)
    np.testing.assert_allclose(mean, [0.5, np.pi], atol=1e-12)
    np.testing.assert_allclose(cov, 0.5 * np.eye(2), atol=1e-12)


@pytest.mark.parametrize("name", SIGMA)
@pytest.mark.parametrize("degrees", [20.0, 90.0, 120.0])
def test_a_wide_direction_is_measured_as_by_the_kalman_filter(name: str, degrees: float) -> None:
    """Sigma points lie up to a turn from the mean, and correlations with other axes are kept."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(50, 5, 7))
    cov = root @ np.swapaxes(root, -1, -2)
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    cov *= (np.radians(degrees) / scale[:, YAW])[:, None, None] ** 2
    mean, z = rng.normal(size=(50, 5)), rng.uniform(-np.pi, np.pi, (50, 1))
    got, got_cov, _ = Plain(FILTERS[name]).update(mean, cov, z, COMPASS)
    wanted, wanted_cov, _ = Plain(Extended()).update(mean, cov, z, COMPASS)
    np.testing.assert_allclose(got, wanted, atol=1e-8)
    np.testing.assert_allclose(got_cov, wanted_cov, atol=1e-8)


@pytest.mark.parametrize("name", SIGMA)
def test_a_bearing_prior_of_90_degrees_is_consistent(name: str) -> None:
    """Of 4000 draws of truth and compass the NEES, its yaw on the circle, lies within 99.9 % of its distribution."""
    draws, rng = 4000, np.random.default_rng(3)
    cov = COV.copy()
    cov[YAW, YAW] = np.radians(90.0) ** 2
    cov[YAW, 4] = cov[4, YAW] = 0.5 * np.sqrt(cov[YAW, YAW] * cov[4, 4])
    mean = np.array([5.0, 0.0, 2.5, 3.0, 0.0])
    truth = mean + rng.normal(size=(draws, 5)) @ np.linalg.cholesky(cov).T
    z = difference(truth[:, [YAW]] + 0.1 * rng.normal(size=(draws, 1)), 0.0, TURN)
    # Turns more than a half of the prior's yaw cannot be told from the other way round, nor can what goes with them.
    told = np.abs(truth[:, YAW] - mean[YAW]) < np.pi - 0.3
    posterior, spread, _ = Plain(FILTERS[name]).update(
        np.tile(mean, (draws, 1)), np.tile(cov, (draws, 1, 1)), z, COMPASS
    )
    error = difference(posterior, truth, LAYOUT.periods)
    yaw = error[:, YAW] ** 2 / spread[:, YAW, YAW]
    low, high = chi2.ppf([0.0005, 0.9995], draws) / draws
    assert low < yaw.mean() < high
    nees = (error * np.linalg.solve(spread, error[..., None])[..., 0]).sum(-1)[told]
    assert nees.mean() < chi2.ppf(0.9995, 5 * told.sum()) / told.sum()


@pytest.mark.parametrize("degrees", [20.0, 60.0, 90.0])
def test_wide_particles_at_the_seam_have_the_moments_of_those_at_zero_turned(degrees: float) -> None:
    """Some lie more than a half circle from each other; the heaviest is far from the mean."""
    rng = np.random.default_rng(4)
    points = np.stack([rng.normal(size=(20, 500)), np.radians(degrees) * rng.normal(size=(20, 500))], -1)
    weight = rng.dirichlet(np.ones(500), 20)
    periods = (np.inf, TURN)
    here = Particles(points, np.log(weight), periods=periods).moments
    there = Particles(points + [4e6, np.pi], np.log(weight), periods=periods).moments
    np.testing.assert_allclose(difference(there[0] - here[0] - [4e6, np.pi], 0.0, periods), 0.0, atol=1e-8)
    np.testing.assert_allclose(there[1], here[1], atol=1e-8)
    # Of what lies within a half circle of the mean direction, unrolled by the direction of the sum of unit vectors.
    direction = np.angle((weight * np.exp(1j * points[..., 1])).sum(-1))
    gap = difference(points[..., 1], direction[:, None], TURN)
    wanted = direction + (weight * gap).sum(-1)
    np.testing.assert_allclose(difference(here[0][:, 1], wanted, TURN), 0.0, atol=1e-12)
    np.testing.assert_allclose(here[1][:, 1, 1], (weight * gap**2).sum(-1) - (weight * gap).sum(-1) ** 2, rtol=1e-9)


@pytest.mark.parametrize("name", SIGMA)
def test_a_bearing_that_the_prior_does_not_bound_is_refused(name: str) -> None:
    """Around the sensor bearings have no mean; beside it they have, on whichever side of the seam."""
    layout = StateLayout(("x", "y"))
    sensor, cov = RangeBearingSensor(layout, 5.0, 0.05), np.diag([900.0, 1e4])
    z = np.array([100.0, 3.0])
    for x in (0.0, -20.0):
        with pytest.raises(np.linalg.LinAlgError, match="no mean direction"):
            Plain(FILTERS[name]).update(np.array([x, 0.0]), cov, z, sensor)
    left, left_cov, _ = Plain(FILTERS[name]).update(np.array([-200.0, 0.0]), cov, np.array([210.0, 3.1]), sensor)
    right, right_cov, _ = Plain(FILTERS[name]).update(
        np.array([200.0, 0.0]), cov, np.array([210.0, 3.1 - np.pi]), sensor
    )
    np.testing.assert_allclose(left, -right, atol=1e-9)
    np.testing.assert_allclose(left_cov, right_cov, atol=1e-8)
