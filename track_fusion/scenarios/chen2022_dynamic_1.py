"""Chen and Zhou 2022, section 5.2, case I: one sensor of the position, one of the velocity."""

from __future__ import annotations

from track_fusion.scenarios.chen2022_dynamic import (
    DCI,
    FCI,
    GP,
    KLA,
    MHDP_E,
    MHDP_I,
    QMMHD,
    SENSOR_1,
    SENSOR_2,
    scenario,
    tracking,
)

#: Table 1, case I: position ARMSE in metres with the Student-t and the Gaussian-Student-t-mixture filter.
TABLE_1 = {
    DCI: (28.99, 46.01),
    GP: (8.54, 10.35),
    FCI: (8.23, 7.82),
    KLA: (7.92, 9.47),
    QMMHD: (7.06, 7.78),
    MHDP_E: (5.72, 5.91),
    MHDP_I: (5.72, 5.90),
}

TRACKING = tracking(SENSOR_1, SENSOR_2)
SCENARIO = scenario(
    "chen2022-dynamic-1",
    "Heavy-tailed noises: one sensor of the position, one of the velocity",
    TRACKING,
    TABLE_1,
    runs=100,
)
