"""Chen and Zhou 2022, section 5.2, case II: a third sensor sees both."""

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
    SENSOR_3,
    scenario,
    tracking,
)

#: Table 1, case II: position ARMSE in metres with the Student-t and the Gaussian-Student-t-mixture filter.
TABLE_1 = {
    DCI: (26.76, 35.84),
    GP: (5.93, 6.47),
    FCI: (6.15, 5.36),
    KLA: (5.96, 6.49),
    QMMHD: (5.45, 5.65),
    MHDP_E: (3.35, 3.64),
    MHDP_I: (3.36, 3.63),
}

TRACKING = tracking(SENSOR_1, SENSOR_2, SENSOR_3)
SCENARIO = scenario(
    "chen2022-dynamic-2",
    "Heavy-tailed noises: a third sensor sees both",
    TRACKING,
    TABLE_1,
    runs=50,
)
