"""The filters that a single-target tracker can be given by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from track_fusion.filters.base import Likelihood, TrackFilter
from track_fusion.filters.cubature import Cubature
from track_fusion.filters.extended import Extended
from track_fusion.filters.kalman import Kalman
from track_fusion.filters.particle import Sir, SirParams
from track_fusion.filters.student_t import StudentT, StudentTParams
from track_fusion.filters.unscented import Unscented, UnscentedParams
from track_fusion.linalg import Array
from track_fusion.models.base import Motion, Sensor, Transition
from track_fusion.models.choices import Choice
from track_fusion.models.measurement import LinearSensor
from track_fusion.params import ParameterError, Params

#: A filter whose states are TrackStates.
OneTargetFilter = TrackFilter[Any, Transition, Array, Any, Likelihood]


def _kalman(motion: Motion, sensor: Sensor, params: Params) -> Kalman:
    if motion.over(0.0).matrix is None or not isinstance(sensor, LinearSensor):
        raise ParameterError(
            "The 'filter' parameter must be one for non-linear models, such as extended, unscented or cubature, with "
            "this motion or sensor. Got 'kalman'."
        )
    return Kalman()


#: Filters by key, made from (motion, sensor, params).
FILTERS: Mapping[str, Choice[OneTargetFilter]] = {
    "kalman": Choice(Params, _kalman),
    "extended": Choice(Params, lambda motion, sensor, params: Extended()),
    "unscented": Choice(UnscentedParams, lambda motion, sensor, params: Unscented(params)),
    "cubature": Choice(Params, lambda motion, sensor, params: Cubature()),
    "particle": Choice(SirParams, lambda motion, sensor, params: Sir(params, periods=motion.layout.periods)),
    "student_t": Choice(StudentTParams, lambda motion, sensor, params: StudentT(params)),
}
