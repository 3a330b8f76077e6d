"""Li et al., AA density fusion, section IV-B: a turning target, two range-bearing sensors."""

from __future__ import annotations

from functools import partial

import numpy as np

from track_fusion.filters.cubature import Cubature
from track_fusion.filters.particle import SirParams
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.scenarios.li2022 import PAPER
from track_fusion.scenarios.li2022.claims import ASSUMPTIONS, nonlinear_claims
from track_fusion.study.one_target import RULE_CHOICES, fused_row, gaussian_rows, same_filters, sir_rows
from track_fusion.study.one_target_study import OneTargetStudy, Quantity, published
from track_fusion.study.scenario import Printed, Scenario
from track_fusion.study.scene import Tracking
from track_fusion.tracks import StateLayout

#: Table II: ARMSE of position (m), velocity (m/s) and turn rate (deg/s). Of CKF-NF the text has "2 15.76".
TABLE_2 = {
    "ckf-alone": (Printed("13.80"), Printed("3.20"), 1.69),
    "ckf-ic": (11.94, 2.97, 1.66),
    "ckf-naive": (247.49, 15.76, 3.74),
    "ckf-arithmetic_average": (12.42, Printed("3.10"), 1.66),
    "ckf-covariance_intersection": (12.39, 3.02, 1.95),
    "ckf-covariance_union": (18.47, 4.53, 1.84),
    "sir-alone": (Printed("26.80"), 4.11, 1.91),
    "sir-ic": (Printed("44.40"), 4.49, 2.29),
    "sir-naive": (286.29, Printed("16.20"), 3.35),
    "sir-arithmetic_average": (12.54, 3.13, 1.71),
    "sir-covariance_intersection": (12.81, 3.09, 1.69),
    "sir-covariance_union": (18.43, 4.18, 1.88),
}
#: The weight that Fig. 11 shows, as the text reads it off: from 0.584 to 0.541.
SECTION_4B = {
    "ckf-arithmetic_average/sensor_1_weight_first_1": 0.584,
    "ckf-arithmetic_average/sensor_1_weight_last_1": 0.541,
}
LAYOUT = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
QUANTITIES = (
    Quantity("position", "m", LAYOUT.position),
    Quantity("velocity", "mps", LAYOUT.velocity),
    Quantity("turn_rate", "degps", (4,), float(np.degrees(1.0))),
)
CKF, SIR = same_filters(Cubature()), SirParams(particles=500)

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


#: Rows of Table II.
ROWS = gaussian_rows("ckf", TRACKING, CKF, RULE_CHOICES) | sir_rows(TRACKING, SIR, RULE_CHOICES)
STUDY = OneTargetStudy(TRACKING, QUANTITIES, ROWS, ("ckf", partial(fused_row, TRACKING, CKF)))

SCENARIO = Scenario(
    key="li2022-nonlinear",
    title="Two range-bearing sensors, one turning target",
    paper=f"{PAPER}, IV-B",
    shows="cubature and particle filters under fusion with feedback; how naive fusion loses the target",
    published=published(TABLE_2, QUANTITIES) | SECTION_4B,
    published_runs=100,
    default_runs=80,
    publication_runs=1000,
    assumptions=(
        *ASSUMPTIONS,
        "the transition uses the turn rate before the step; the process noise is block-diagonal; sigma_theta is "
        "positive; bearings by atan2, residuals wrapped",
    ),
    simulate=STUDY.simulate,
    figures=STUDY.figures,
    charts=STUDY.charts,
    claims=nonlinear_claims(),
    piece=50,
    tracking=TRACKING,
    rules=RULE_CHOICES,
    scores=STUDY.scores,
)
