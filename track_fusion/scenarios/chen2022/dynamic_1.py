"""Chen and Zhou 2022, section 5.2, case I: one sensor of the position, one of the velocity."""

from __future__ import annotations

from track_fusion.scenarios.chen2022.dynamic import SENSOR_1, SENSOR_2, scenario, tracking
from track_fusion.study.scenario import Printed

#: Table 1, case I: position ARMSE in metres by DCI, GP, FCI, KLA, QMMHD, MHDP-E and MHDP-I.
TABLE_1 = {
    "stf": (28.99, 8.54, 8.23, 7.92, 7.06, 5.72, 5.72),
    "gstm": (46.01, 10.35, 7.82, 9.47, 7.78, 5.91, Printed("5.90")),
}

TRACKING = tracking(SENSOR_1, SENSOR_2)
SCENARIO = scenario(
    "chen2022-dynamic-1",
    "Heavy-tailed noises: one sensor of the position, one of the velocity",
    TRACKING,
    TABLE_1,
    runs=100,
)
