"""Li et al., AA density fusion, section IV-B: a turning target, two range-bearing sensors."""

from __future__ import annotations

from functools import partial

import numpy as np

from track_fusion.filters.cubature import Cubature
from track_fusion.filters.particle import SirParams
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.scenarios.li2022 import PAPER
from track_fusion.scenarios.li2022.claims import (
    ASSUMPTIONS,
    AVERAGE,
    INTERSECTION,
    POSITION,
    UNION,
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


ROWS = gaussian_rows("ckf", TRACKING, CKF, RULE_CHOICES) | sir_rows(TRACKING, SIR, RULE_CHOICES)
STUDY = OneTargetStudy(TRACKING, QUANTITIES, ROWS, ("ckf", partial(fused_row, TRACKING, CKF)))

#: Two rows are close to each other if all of Table II that the text calls so are: SIR-CI is 7 % above CKF-IC.
CLOSE = 0.08
#: Naive fusion has lost the target if it errs so many times as much as every other row of its filter.
LOST = 3.0


def _claims() -> tuple[Claim, ...]:
    first, last = named("sensor_1_weight_first_1", "ckf", AVERAGE), named("sensor_1_weight_last_1", "ckf", AVERAGE)
    but_ic = ("alone", "naive", AVERAGE, INTERSECTION, UNION)
    claims = [
        Claim.order(
            "SIR with both sensors' measurements (IC) is worse than CKF-IC, and even than SIR with covariance union",
            "IV-B", f"ckf-ic/{POSITION}", f"sir-{UNION}/{POSITION}", f"sir-ic/{POSITION}",
        ),
        Claim.each("the particle filter does better than the cubature filter with every rule and alone, except IC",
                   "IV-B", named(POSITION, "sir", *but_ic), named(POSITION, "ckf", *but_ic), ascending),
        Claim.order("the weight on sensor 1 falls from the first step to the last", "IV-B, Fig. 11", *last, *first),
        *weight_claims("ckf", "IV-B, Fig. 11"),
    ]  # fmt: skip
    for rule in (AVERAGE, INTERSECTION):
        names = [f"{one}-{rule}/{POSITION}" for one in ("ckf", "sir")]
        claims.append(
            Claim.close(f"particles do not degenerate under {rule}: SIR is within 8 % of CKF", "IV-B", CLOSE, *names)
        )  # fmt: skip
    for one in ("ckf", "sir"):
        name, naive = one.upper(), f"{one}-naive/{POSITION}"
        best = named(POSITION, one, AVERAGE, INTERSECTION)
        claims += [
            Claim.greatest(f"{name} with naive fusion loses the target: three times the error of every other row",
                           "IV-B, Fig. 7", naive, named(POSITION, one, "alone", "ic", AVERAGE, INTERSECTION, UNION),
                           LOST),
            Claim.order(
                f"{name} with covariance union is worse than with naive fusion (as the text has it, against Table II)",
                "IV-B", naive, f"{one}-{UNION}/{POSITION}",
            ),
            Claim(f"{name}: average and intersection are better than naive fusion and union", "IV-B",
                  (*best, naive, f"{one}-{UNION}/{POSITION}"),
                  lambda *errors: [worse - better for better in errors[:2] for worse in errors[2:]]),
            Claim.close(
                f"{name}: the average is close to CKF-IC (within 8 %)", "IV-B", CLOSE, f"ckf-ic/{POSITION}", best[0]
            ),
            Claim.close(f"{name}: the intersection is close to CKF-IC (within 8 %)", "IV-B",
                        CLOSE, f"ckf-ic/{POSITION}", best[1]),
            *union_claims(one, "IV-B"),
            *balance_claims(one, "IV-B"),
        ]  # fmt: skip
    return tuple(claims)


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
    claims=_claims(),
    piece=50,
    tracking=TRACKING,
    rules=RULE_CHOICES,
    scores=STUDY.scores,
)
