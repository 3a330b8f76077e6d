"""Li et al., AA density fusion, section IV-A: one target, two position sensors, linear and Gaussian."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

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
from track_fusion.scenarios.base import Progress, RuleChoice, Samples, Scenario, Tracking, chosen, fuse_runs
from track_fusion.scenarios.one_target import Quantity, Row, Sir, charts, sir_alone, sir_fused
from track_fusion.scenarios.one_target import squared_errors as collect
from track_fusion.tracks import planar_layout

#: Table I: ARMSE of position (m) and velocity (m/s).
TABLE_1 = {
    "kf-alone": (19.95, 10.86),
    "kf-ic": (18.13, 10.51),
    "kf-naive": (39.99, 13.32),
    "kf-arithmetic_average": (18.57, 10.91),
    "kf-covariance_intersection": (18.85, 10.70),
    "sir-alone": (22.90, 11.74),
    "sir-ic": (20.62, 11.36),
    "sir-naive": (66.07, 16.16),
    "sir-arithmetic_average": (19.55, 11.30),
    "sir-covariance_intersection": (20.76, 11.23),
}
LAYOUT = planar_layout()
QUANTITIES = {"position_armse_m": Quantity(LAYOUT.position), "velocity_armse_mps": Quantity(LAYOUT.velocity)}
SIR = Sir(200)

RULE_CHOICES = (
    RuleChoice("naive", NaiveParams()),
    RuleChoice("arithmetic_average", ArithmeticAverageParams(criterion="diversity")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="trace")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="uniform"), "uniform"),
)


MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(noise_form="piecewise_constant", process_noise=5.0))
SENSORS = {"sensor_1": LinearSensor.position(LAYOUT, 20.0), "sensor_2": LinearSensor.position(LAYOUT, 40.0)}
TRACKING = Tracking(
    motion=MOTION,
    dt_s=1.0,
    steps=100,
    initial_mean=np.array([1000.0, 1000.0, 20.0, 0.0]),
    initial_cov=np.diag([500.0, 500.0, 50.0, 50.0]),
    sensors=SENSORS,
)


def sample(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Samples:
    """Run the rows of Table I whose names start with `only`: squared norms of the errors, (R, T)."""
    return squared_errors(runs, seed, progress, chosen(kalman_rows() | particle_rows(), only))


def figures(samples: Samples) -> dict[str, Estimate]:
    """Average over steps of the root-mean-square over runs, names like kf-alone/position_armse_m."""
    return {name: armse(squares) for name, squares in samples.items()}


def squared_errors(
    runs: Sequence[int], seed: int, progress: Progress, rows: Mapping[str, Row] | None = None
) -> dict[str, Array]:
    """Run rows of Table I, by default the Kalman filters', over these Monte Carlo runs.

    Returns
    -------
    {figure name: squared norm of the error (R, T)}
    """
    return collect(TRACKING, kalman_rows() if rows is None else rows, QUANTITIES, runs, seed, progress)


def kalman_rows() -> dict[str, Row]:
    """Rows of Table I by Kalman filters."""
    table = {"kf-alone": Row(lambda s: one_filter(s.seen[:1])), "kf-ic": Row(lambda s: one_filter(s.seen))}
    for choice in RULE_CHOICES:
        table[f"kf-{choice.name}"] = Row(lambda s, choice=choice: fused_filters(choice, s.seen))  # type: ignore[misc]
    return table


def particle_rows() -> dict[str, Row]:
    """Rows of Table I by particle filters."""
    table = {"sir-alone": sir_alone(TRACKING, SIR, 1), "sir-ic": sir_alone(TRACKING, SIR, 2)}
    for choice in RULE_CHOICES:
        averaged = choice.key == "arithmetic_average"
        table[f"sir-{choice.name}"] = sir_fused(TRACKING, SIR, choice, union=averaged)
        if averaged:
            table[f"sir-{choice.name}@gaussian"] = sir_fused(TRACKING, SIR, choice)
    return table


def _start(runs: int) -> tuple[Array, Array]:
    """State of all runs, (R, n), and its covariance, (1, n, n), which they share as long as it depends on no data."""
    return np.tile(TRACKING.initial_mean, (runs, 1)), TRACKING.initial_cov[None]


def one_filter(seen: Sequence[Array]) -> Iterator[Array]:
    """One filter that uses the measurements of the given sensors, (R, T, m) each, jointly."""
    sensors = list(SENSORS.values())[: len(seen)]
    mean, cov = _start(len(seen[0]))
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, *MOTION.matrices(TRACKING.dt_s))
        z = [s[:, k] for s in seen]
        mean, cov, _ = update_joint(mean, cov, z, [s.matrix for s in sensors], [s.noise for s in sensors])
        yield mean


def fused_filters(choice: RuleChoice, seen: Sequence[Array]) -> Iterator[Array]:
    """One filter a sensor, fused after each step, the fused posterior fed back to all of them."""
    rule, sensors = RULES[choice.key], list(SENSORS.values())
    mean, cov = _start(len(seen[0]))
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, *MOTION.matrices(TRACKING.dt_s))
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
    publication_runs=1000,
    assumptions=(
        "the fused posterior is fed back to both filters at every step",
        "the truth starts exactly at the initial mean, the filters at the initial mean and covariance",
        "error: 2-norm, root-mean-square over runs at each step, averaged over the 100 steps",
        "SIR: systematic resampling after every step; estimates before it; each filter draws again from the fused "
        "density by itself (arithmetic average: from the union of the weighted particles, @gaussian: after conversion)",
        "particles turned into a Gaussian: 1e-9 of the initial variances is added",
    ),
    sample=sample,
    figures=figures,
    charts=charts,
    piece=50,
    tracking=TRACKING,
    rules=RULE_CHOICES,
)
