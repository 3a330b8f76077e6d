"""Li et al., AA density fusion, section IV-A: one target, two position sensors, linear and Gaussian."""

from __future__ import annotations

from functools import partial

import numpy as np

from track_fusion.filters.kalman import Kalman
from track_fusion.filters.particle import SirParams
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.scenarios.li2022 import PAPER
from track_fusion.scenarios.li2022.claims import (
    ASSUMPTIONS,
    AVERAGE,
    CREDIBILITY,
    INTERSECTION,
    POSITION,
    RULES,
    VELOCITY,
    balance_claims,
    named,
    union_claims,
    weight_claims,
)
from track_fusion.study.claim import Claim, ascending
from track_fusion.study.one_target import RULE_CHOICES, fused_row, gaussian_rows, same_filters, sir_rows
from track_fusion.study.one_target_study import OneTargetStudy, Quantity, published
from track_fusion.study.scenario import Printed, Scenario
from track_fusion.study.scene import Tracking
from track_fusion.tracks import planar_layout

#: Table I: ARMSE of position (m) and velocity (m/s).
TABLE_1 = {
    "kf-alone": (19.95, 10.86),
    "kf-ic": (18.13, 10.51),
    "kf-naive": (39.99, 13.32),
    "kf-arithmetic_average": (18.57, 10.91),
    "kf-covariance_intersection": (18.85, Printed("10.70")),
    "kf-covariance_union": (24.36, 12.06),
    "sir-alone": (22.90, 11.74),
    "sir-ic": (20.62, 11.36),
    "sir-naive": (66.07, 16.16),
    "sir-arithmetic_average": (19.55, Printed("11.30")),
    "sir-covariance_intersection": (20.76, 11.23),
    "sir-covariance_union": (25.42, 12.72),
}
#: The weight that Fig. 6 shows, as the text reads it off.
SECTION_4A = {"kf-arithmetic_average/sensor_1_weight_1": 0.575}
LAYOUT = planar_layout()
QUANTITIES = (Quantity("position", "m", LAYOUT.position), Quantity("velocity", "mps", LAYOUT.velocity))
KF, SIR = same_filters(Kalman()), SirParams(particles=200)

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


#: Rows of Table I by Kalman filters.
KALMAN_ROWS = gaussian_rows("kf", TRACKING, KF, RULE_CHOICES)
STUDY = OneTargetStudy(
    TRACKING, QUANTITIES, KALMAN_ROWS | sir_rows(TRACKING, SIR, RULE_CHOICES), ("kf", partial(fused_row, TRACKING, KF))
)

#: Two rows are close to each other if all of Table I that the text calls so are: SIR-CI is 6 % above SIR-AA.
CLOSE = 0.06
_OTHERS = ("alone", "ic", AVERAGE, INTERSECTION, "covariance_union")


def _claims() -> tuple[Claim, ...]:
    claims = [
        Claim.least("KF with both sensors' measurements (IC) is the best row of all", "IV-A",
                    f"kf-ic/{POSITION}",
                    [n for one in ("kf", "sir") for n in named(POSITION, one, *RULES) if n != f"kf-ic/{POSITION}"]),
        Claim.each("the Kalman filter does better than the particle filter with every rule and alone", "IV-A",
                   named(POSITION, "kf", *RULES), named(POSITION, "sir", *RULES), ascending),
        Claim.near("KF-IC is Bayes-optimal: what it claims is its mean squared error (credibility within 5 % of 1)",
                   "IV", 1.0, 0.05, *named(CREDIBILITY, "kf", "ic")),
    ]  # fmt: skip
    for one in ("kf", "sir"):
        name = one.upper()
        ic, average, intersection = named(POSITION, one, "ic", AVERAGE, INTERSECTION)
        claims += [
            Claim.greatest(f"{name} with naive fusion is the worst row, worse than sensor 1 alone", "IV-A",
                           f"{one}-naive/{POSITION}", named(POSITION, one, *_OTHERS)),
            Claim.close(
                f"{name}: average and intersection are similar (within 6 %)", "IV-A", CLOSE, average, intersection
            ),
            Claim.close(f"{name}: the average is close to IC (within 6 %)", "IV-A", CLOSE, ic, average),
            Claim.close(f"{name}: the intersection is close to IC (within 6 %)", "IV-A", CLOSE, ic, intersection),
            Claim.order(f"{name}: the average beats the intersection in position", "Table I", average, intersection),
            Claim.order(f"{name}: the intersection beats the average in velocity", "Table I",
                        *named(VELOCITY, one, INTERSECTION, AVERAGE)),
            *union_claims(one, "IV-A"),
            *balance_claims(one, "IV-A"),
        ]  # fmt: skip
    return (*claims, *weight_claims("kf", "IV-A, Fig. 6"))


SCENARIO = Scenario(
    key="li2022-linear",
    title="Two position sensors, one target, linear and Gaussian",
    paper=f"{PAPER}, IV-A",
    shows="what fusing with unknown correlation costs and gains when the fused posterior is fed back to both filters",
    published=published(TABLE_1, QUANTITIES) | SECTION_4A,
    published_runs=100,
    default_runs=150,
    publication_runs=1000,
    assumptions=ASSUMPTIONS,
    simulate=STUDY.simulate,
    figures=STUDY.figures,
    charts=STUDY.charts,
    claims=_claims(),
    piece=50,
    tracking=TRACKING,
    rules=RULE_CHOICES,
    scores=STUDY.scores,
)
