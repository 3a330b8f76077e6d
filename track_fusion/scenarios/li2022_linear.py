"""Li et al., AA density fusion, section IV-A: one target, two position sensors, linear and Gaussian."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from track_fusion.filters.kalman import predict, update, update_joint
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate, armse
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.rules.arithmetic_average import ArithmeticAverageParams
from track_fusion.rules.covariance_intersection import CovarianceIntersectionParams
from track_fusion.rules.naive import NaiveParams
from track_fusion.scenarios.base import RuleChoice, Scenario, Tracking, fuse_runs
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
    return {name: armse(squares) for name, squares in squared_errors(range(runs), seed, progress).items()}


def squared_errors(runs: Sequence[int], seed: int, progress: Callable[[float], None]) -> dict[str, Array]:
    """Run every row of Table I over these Monte Carlo runs: {figure name: squared norm of the error (R, T)}."""
    truth = TRACKING.truths(seed, runs)
    drawn = [TRACKING.measurements(states, seed, run) for states, run in zip(truth, runs, strict=True)]
    seen = [np.stack([d[name] for d in drawn]) for name in TRACKING.sensors]
    rows = {"kf-alone": one_filter(seen[:1]), "kf-ic": one_filter(seen)}
    rows |= {f"kf-{choice.name}": fused_filters(choice, seen) for choice in RULE_CHOICES}
    squares: dict[str, Array] = {}
    for done, (row, estimates) in enumerate(rows.items()):
        names = [f"{row}/{quantity}" for quantity in QUANTITIES]
        squares |= {name: np.empty((len(runs), TRACKING.steps)) for name in names}
        for k, mean in enumerate(estimates):
            squared = (mean - truth[:, k + 1]) ** 2
            for name, part in zip(names, (squared[:, :2], squared[:, 2:]), strict=True):
                squares[name][:, k] = part.sum(1)
            progress((done + (k + 1) / TRACKING.steps) / len(rows))
    return squares


def _start(runs: int) -> tuple[Array, Array]:
    """State of all runs, (R, n), and its covariance, (1, n, n), which they share as long as it depends on no data."""
    return np.tile(TRACKING.initial_mean, (runs, 1)), TRACKING.initial_cov[None]


def one_filter(seen: list[Array]) -> Iterator[Array]:
    """One filter that uses the measurements of the given sensors, (R, T, m) each, jointly."""
    sensors = list(TRACKING.sensors.values())[: len(seen)]
    mean, cov = _start(len(seen[0]))
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, *TRACKING.motion.matrices(TRACKING.dt_s))
        z = [s[:, k] for s in seen]
        mean, cov, _ = update_joint(mean, cov, z, [s.matrix for s in sensors], [s.noise for s in sensors])
        yield mean


def fused_filters(choice: RuleChoice, seen: list[Array]) -> Iterator[Array]:
    """One filter a sensor, fused after each step, the fused posterior fed back to all of them."""
    rule, sensors = RULES[choice.key], list(TRACKING.sensors.values())
    mean, cov = _start(len(seen[0]))
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, *TRACKING.motion.matrices(TRACKING.dt_s))
        local = [update(mean, cov, z[:, k], s.matrix, s.noise)[:2] for z, s in zip(seen, sensors, strict=True)]
        means, covs = (np.stack(parts, 1) for parts in zip(*local, strict=True))
        mean, cov = fuse_runs(rule, choice.params, means, covs)
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
