"""Chen and Zhou 2022, section 5.2, case II: a third sensor sees both."""

from __future__ import annotations

from track_fusion.scenarios.chen2022.dynamic import SENSOR_1, SENSOR_2, SENSOR_3, scenario, tracking

#: Table 1, case II: position ARMSE in metres by DCI, GP, FCI, KLA, QMMHD, MHDP-E and MHDP-I.
TABLE_1 = {
    "stf": (26.76, 5.93, 6.15, 5.96, 5.45, 3.35, 3.36),
    "gstm": (35.84, 6.47, 5.36, 6.49, 5.65, 3.64, 3.63),
}

TRACKING = tracking(SENSOR_1, SENSOR_2, SENSOR_3)
SCENARIO = scenario("chen2022-dynamic-2", "Heavy-tailed noises: a third sensor sees both", TRACKING, TABLE_1, runs=50)
