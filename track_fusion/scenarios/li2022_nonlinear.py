"""Li et al., AA density fusion, section IV-B: a turning target, two range-bearing sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from track_fusion.filters import cubature
from track_fusion.metrics.accuracy import Estimate, armse
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.rules.arithmetic_average import ArithmeticAverageParams
from track_fusion.rules.covariance_intersection import CovarianceIntersectionParams
from track_fusion.rules.naive import NaiveParams
from track_fusion.scenarios.base import Progress, RuleChoice, Samples, Scenario, Tracking, chosen
from track_fusion.scenarios.one_target import (
    GaussianFilter,
    Quantity,
    Row,
    Sir,
    charts,
    gaussian_alone,
    gaussian_fused,
    sir_alone,
    sir_fused,
    squared_errors,
)
from track_fusion.tracks import StateLayout

#: Table II: ARMSE of position (m), velocity (m/s) and turn rate (deg/s).
TABLE_2 = {
    "ckf-alone": (13.80, 3.20, 1.69),
    "ckf-ic": (11.94, 2.97, 1.66),
    "ckf-naive": (247.49, 15.76, 3.74),
    "ckf-arithmetic_average": (12.42, 3.10, 1.66),
    "ckf-covariance_intersection": (12.39, 3.02, 1.95),
    "sir-alone": (26.80, 4.11, 1.91),
    "sir-ic": (44.40, 4.49, 2.29),
    "sir-naive": (286.29, 16.20, 3.35),
    "sir-arithmetic_average": (12.54, 3.13, 1.71),
    "sir-covariance_intersection": (12.81, 3.09, 1.69),
}
LAYOUT = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
QUANTITIES = {
    "position_armse_m": Quantity(LAYOUT.position),
    "velocity_armse_mps": Quantity(LAYOUT.velocity),
    "turn_rate_armse_degps": Quantity((4,), float(np.degrees(1.0))),
}
CKF = GaussianFilter(cubature.predict, cubature.update)
SIR = Sir(500)

RULE_CHOICES = (
    RuleChoice("naive", NaiveParams()),
    RuleChoice("arithmetic_average", ArithmeticAverageParams(criterion="diversity")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="trace")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="uniform"), "uniform"),
)


TRACKING = Tracking(
    motion=CoordinatedTurn(LAYOUT, CoordinatedTurnParams(process_noise=0.1, turn_rate_noise=1e-4)),
    dt_s=1.0,
    steps=100,
    initial_mean=np.array([1000.0, 1000.0, 20.0, 0.0, -np.pi / 60]),
    initial_cov=np.diag([500.0, 500.0, 50.0, 50.0, 0.01]),
    sensors={
        "sensor_1": RangeBearingSensor(LAYOUT, 10.0, np.pi / 180, (0.0, 0.0)),
        "sensor_2": RangeBearingSensor(LAYOUT, 20.0, np.pi / 90, (500.0, 0.0)),
    },
)


def rows() -> dict[str, Row]:
    """Every row of Table II."""
    table = {"ckf-alone": gaussian_alone(TRACKING, CKF, 1), "ckf-ic": gaussian_alone(TRACKING, CKF, 2)}
    table |= {f"ckf-{choice.name}": gaussian_fused(TRACKING, CKF, choice) for choice in RULE_CHOICES}
    table |= {"sir-alone": sir_alone(TRACKING, SIR, 1), "sir-ic": sir_alone(TRACKING, SIR, 2)}
    for choice in RULE_CHOICES:
        averaged = choice.key == "arithmetic_average"
        table[f"sir-{choice.name}"] = sir_fused(TRACKING, SIR, choice, union=averaged)
        if averaged:
            table[f"sir-{choice.name}@gaussian"] = sir_fused(TRACKING, SIR, choice)
    return table


def sample(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Samples:
    """Run the rows of Table II whose names start with `only`: squared norms of the errors, (R, T)."""
    return squared_errors(TRACKING, chosen(rows(), only), QUANTITIES, runs, seed, progress)


def figures(samples: Samples) -> dict[str, Estimate]:
    """Average over steps of the root-mean-square over runs, names like ckf-alone/position_armse_m."""
    return {name: armse(squares) for name, squares in samples.items()}


SCENARIO = Scenario(
    key="li2022-nonlinear",
    title="Two range-bearing sensors, one turning target",
    paper="Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average Density Fusion, IV-B",
    shows="cubature and particle filters under fusion with feedback; how naive fusion loses the target",
    published={f"{row}/{q}": v for row, values in TABLE_2.items() for q, v in zip(QUANTITIES, values, strict=True)},
    published_runs=100,
    default_runs=100,
    publication_runs=1000,
    assumptions=(
        "the fused posterior is fed back to both filters at every step",
        "the truth starts exactly at the initial mean, the filters at the initial mean and covariance",
        "error: 2-norm, root-mean-square over runs at each step, averaged over the 100 steps",
        "the transition uses the turn rate before the step; the process noise is block-diagonal; sigma_theta is "
        "positive; bearings by atan2, residuals wrapped",
        "SIR: systematic resampling after every step; estimates before it; each filter draws again from the fused "
        "density by itself (arithmetic average: from the union of the weighted particles, @gaussian: after conversion)",
        "particles turned into a Gaussian: 1e-9 of the initial variances is added",
    ),
    sample=sample,
    figures=figures,
    charts=charts,
    piece=50,
    rules=RULE_CHOICES,
)
