"""Li et al., AA density fusion, section IV-A: one target, two position sensors, linear and Gaussian."""

from __future__ import annotations

from functools import partial

import numpy as np

from track_fusion.filters.kalman import Kalman
from track_fusion.filters.particle import SirParams
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.scenarios.li2022 import PAPER
from track_fusion.scenarios.li2022.claims import ASSUMPTIONS, linear_claims
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
    claims=linear_claims(),
    piece=50,
    tracking=TRACKING,
    rules=RULE_CHOICES,
    scores=STUDY.scores,
)
