"""Li et al., AA density fusion, section IV-A: one target, two position sensors, linear and Gaussian."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from track_fusion.filters.kalman import predict, update, update_joint
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate, armse
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES, SourceTracks
from track_fusion.rules.arithmetic_average import ArithmeticAverageParams
from track_fusion.rules.covariance_intersection import CovarianceIntersectionParams
from track_fusion.rules.naive import NaiveParams
from track_fusion.scenarios.base import RuleChoice, Scenario, Tracking
from track_fusion.tracks import planar_layout

#: Table I: ARMSE of position (m) and velocity (m/s).
TABLE_1 = {
    "kf-alone": (19.95, 10.86),
    "kf-ic": (18.13, 10.51),
    "kf-naive": (39.99, 13.32),
    "kf-arithmetic_average": (18.57, 10.91),
    "kf-covariance_intersection": (18.85, 10.70),
}
QUANTITIES = ("position_armse_m", "velocity_armse_mps")

RULE_CHOICES = (
    RuleChoice("naive", NaiveParams()),
    RuleChoice("arithmetic_average", ArithmeticAverageParams(criterion="diversity")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="trace")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="uniform"), "uniform"),
)


def _tracking() -> Tracking:
    layout = planar_layout()
    motion = NearlyConstantVelocity(layout, MotionParams(noise_form="piecewise_constant", process_noise=5.0))
    return Tracking(
        motion=motion,
        dt_s=1.0,
        steps=100,
        initial_mean=np.array([1000.0, 1000.0, 20.0, 0.0]),
        initial_cov=np.diag([500.0, 500.0, 50.0, 50.0]),
        sensors={"sensor_1": LinearSensor.position(layout, 20.0), "sensor_2": LinearSensor.position(layout, 40.0)},
    )


TRACKING = _tracking()


def study(runs: int, seed: int, progress: Callable[[float], None]) -> dict[str, Estimate]:
    """Run every row of Table I over `runs` Monte Carlo runs.

    Returns
    -------
    {figure name: Estimate}, names like kf-alone/position_armse_m
    """
    truth = np.stack([TRACKING.truth(seed, run) for run in range(runs)])
    drawn = [TRACKING.measurements(truth[run], seed, run) for run in range(runs)]
    seen = [np.stack([d[name] for d in drawn]) for name in TRACKING.sensors]
    rows: dict[str, Callable[[], Iterator[Array]]] = {
        "kf-alone": lambda: _one_filter(seen[:1], runs),
        "kf-ic": lambda: _one_filter(seen, runs),
    }
    for choice in RULE_CHOICES:
        rows[f"kf-{choice.name}"] = lambda choice=choice: _fused(choice, seen, runs)  # type: ignore[misc]
    measured: dict[str, Estimate] = {}
    for done, (row, estimates) in enumerate(rows.items()):
        squares = np.empty((2, runs, TRACKING.steps))
        for k, mean in enumerate(estimates()):
            error = mean - truth[:, k + 1]
            squares[0, :, k], squares[1, :, k] = (error[:, :2] ** 2).sum(1), (error[:, 2:] ** 2).sum(1)
            progress((done + (k + 1) / TRACKING.steps) / len(rows))
        measured |= {f"{row}/{q}": armse(s) for q, s in zip(QUANTITIES, squares, strict=True)}
    return measured


def _start(runs: int) -> tuple[Array, Array]:
    mean, cov = TRACKING.initial_mean, TRACKING.initial_cov
    return np.tile(mean, (runs, 1)), np.tile(cov, (runs, 1, 1))


def _one_filter(seen: list[Array], runs: int) -> Iterator[Array]:
    """One filter that uses the measurements of the given sensors jointly."""
    sensors = list(TRACKING.sensors.values())[: len(seen)]
    mean, cov = _start(runs)
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, *TRACKING.motion.matrices(TRACKING.dt_s))
        z = [s[:, k] for s in seen]
        mean, cov, _ = update_joint(mean, cov, z, [s.matrix for s in sensors], [s.noise for s in sensors])
        yield mean


def _fused(choice: RuleChoice, seen: list[Array], runs: int) -> Iterator[Array]:
    """One filter a sensor, fused after each step, the fused posterior fed back to all of them."""
    rule, sensors = RULES[choice.key], list(TRACKING.sensors.values())
    mean, cov = _start(runs)
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, *TRACKING.motion.matrices(TRACKING.dt_s))
        local = [update(mean, cov, z[:, k], s.matrix, s.noise)[:2] for z, s in zip(seen, sensors, strict=True)]
        tracks = SourceTracks(np.stack([m for m, _ in local], 1), np.stack([c for _, c in local], 1))
        fused = rule.fuse(tracks, choice.params)
        mean, cov = fused.mean, fused.cov
        yield mean


SCENARIO = Scenario(
    key="li2022-linear",
    title="Two position sensors, one target, linear and Gaussian",
    paper="Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average Density Fusion, IV-A",
    shows="what fusing with unknown correlation costs and gains when the fused posterior is fed back to both filters",
    published={f"{row}/{q}": v for row, values in TABLE_1.items() for q, v in zip(QUANTITIES, values, strict=True)},
    published_runs=100,
    default_runs=200,
    assumptions=(
        "the fused posterior is fed back to both filters at every step",
        "the truth starts exactly at the initial mean, the filters at the initial mean and covariance",
        "error: 2-norm, root-mean-square over runs at each step, averaged over the 100 steps",
    ),
    study=study,
    tracking=TRACKING,
    rules=RULE_CHOICES,
)
