"""Chen and Zhou 2022, section 5.2: a target on a line, heavy-tailed noises, Student-t filters and fusion with feedback.

Everything is in covariances: with kappa = dof / (dof - 2) of t(3), a nominal Q, R or P(0|0) of the paper, which is a
scatter, stands here as kappa times itself, and so does every state. Setting the dof of a posterior back to 3 by moment
matching, and feeding back a fused scatter, then change no number.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.filters import gaussian_student_t_mixture, student_t
from track_fusion.filters.student_t import cov_from_scatter, scatter_from_cov
from track_fusion.linalg import Array
from track_fusion.models.base import Sensor
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.noise import Noise
from track_fusion.scenarios.base import Tracking
from track_fusion.scenarios.one_target import GaussianFilter
from track_fusion.tracks import StateLayout

#: Degrees of freedom of all densities, and covariance over scatter.
DOF = 3.0
KAPPA = DOF / (DOF - 2.0)
#: (69)-(71): one draw in ten has this many times the variance. The sensors' (u) depends on the filter studied.
OUTLIER_SHARE, PROCESS_OUTLIERS = 0.1, 200.0
MEASUREMENT_OUTLIERS = {"stf": 200.0, "gstm": 100.0}

LAYOUT = StateLayout(("x", "vx"))


def linear_sensor(axes: tuple[str, ...], scatter: list[list[float]]) -> LinearSensor:
    """Make a sensor of these axes whose noise has the nominal scatter R of the paper."""
    return LinearSensor(axes, np.eye(LAYOUT.size)[list(LAYOUT.indices(axes))], KAPPA * np.array(scatter))


#: (72), (74). Sensor 2 sees the velocity alone.
SENSOR_1, SENSOR_2 = linear_sensor(("x",), [[16.0]]), linear_sensor(("vx",), [[16.0]])
SENSOR_3 = linear_sensor(("x", "vx"), [[16.0, 4.0], [4.0, 6.0]])


def tracking(*sensors: LinearSensor) -> Tracking:
    """Make the scenario of so many sensors as the Student-t filter meets it."""
    return Tracking(
        motion=NearlyConstantVelocity(
            LAYOUT, MotionParams(noise_form="piecewise_constant", process_noise=float(np.sqrt(KAPPA)))
        ),
        dt_s=1.0,
        steps=100,
        initial_mean=np.array([0.0, 5.0]),
        initial_cov=KAPPA * np.diag([10.0, 25.0]),
        sensors={f"sensor_{i}": sensor for i, sensor in enumerate(sensors, 1)},
        process_noise=Noise(1.0 / KAPPA, OUTLIER_SHARE, PROCESS_OUTLIERS),
        measurement_noise=Noise(1.0 / KAPPA, OUTLIER_SHARE, MEASUREMENT_OUTLIERS["stf"]),
        initial_noise=Noise(1.0 / KAPPA),
    )


def for_filter(base: Tracking, name: str) -> Tracking:
    """Return the scenario as a filter meets it: only the outliers of the measurements differ."""
    noise = dataclasses.replace(base.measurement_noise, outlier_scale=MEASUREMENT_OUTLIERS[name])
    return dataclasses.replace(base, measurement_noise=noise)


def student_t_update(
    mean: Array, cov: Array, z: Array, sensor: Sensor
) -> tuple[Array, Array, student_t.StudentInnovation]:
    """Update of the Student-t filter; the dof is set back to 3, which keeps mean and covariance."""
    mean, cov, _, innovation = student_t.update(mean, cov, DOF, z, sensor)
    return mean, cov, innovation


def mixture_update(
    mean: Array, cov: Array, z: Array, sensor: Sensor
) -> tuple[Array, Array, gaussian_student_t_mixture.Robustness]:
    """Update of the Gaussian-Student-t-mixture filter, whose nominal matrices and result are scatters of t(3)."""
    assert isinstance(sensor, LinearSensor)
    nominal = dataclasses.replace(sensor, noise=sensor.noise / KAPPA)
    mean, scatter, robustness = gaussian_student_t_mixture.update(mean, scatter_from_cov(cov, DOF), z, nominal)
    return mean, cov_from_scatter(scatter, DOF), robustness


#: The filters of Table 1. Both predict as the Kalman filter does.
FILTERS = {
    "stf": GaussianFilter(student_t.predict, student_t_update, DOF),
    "gstm": GaussianFilter(gaussian_student_t_mixture.predict, mixture_update, DOF),
}
