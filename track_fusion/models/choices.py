"""The motions and sensors that a node can be given by name, each with the parameters of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import numpy as np

from track_fusion.linalg import Array, asymmetric, is_positive_definite
from track_fusion.models.base import Motion, Sensor
from track_fusion.models.constant_turn_rate_and_speed import ConstantTurnRateAndSpeed, TurnRateAndSpeedParams
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams, KnownTurn, KnownTurnParams
from track_fusion.params import ParameterError, Params, param
from track_fusion.plugins import Registry
from track_fusion.tracks import StateLayout

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Choice(Generic[T]):
    """One entry of a table of choices: a parameter dataclass, and what makes the thing of it."""

    params: type[Params]
    make: Callable[..., T]


def square_matrix(name: str, values: tuple[float, ...], size: int) -> Array:
    """Read `size` variances, or size x size numbers row by row, as a matrix (size, size).

    Raises
    ------
    ParameterError    another number of them
    """
    if len(values) not in (size, size * size):
        raise ParameterError(f"The '{name}' parameter must hold {size} or {size * size} numbers. Got {len(values)}.")
    array = np.array(values)
    return np.diag(array) if len(values) == size else array.reshape(size, size)


#: Motions by key, made from (layout, params).
MOTIONS: Registry[Choice[Motion]] = Registry(
    "track_fusion.motions",
    "motion",
    Choice,
    {
        "nearly_constant_velocity": Choice(MotionParams, NearlyConstantVelocity),
        "coordinated_turn": Choice(CoordinatedTurnParams, CoordinatedTurn),
        "known_turn": Choice(KnownTurnParams, KnownTurn),
        "constant_turn_rate_and_speed": Choice(TurnRateAndSpeedParams, ConstantTurnRateAndSpeed),
    },
)


@dataclasses.dataclass(frozen=True)
class MotionChoice(Params):
    """How targets move."""

    motion: str = param("nearly_constant_velocity", "the motion model", choices=MOTIONS)


@dataclasses.dataclass(frozen=True)
class PositionParams(Params):
    """A sensor of the position axes, in metres."""

    sensor_sd: float = param(
        1.0, "standard deviation of a detection that brings no covariance", unit="m", low=0.0, strict=True
    )


@dataclasses.dataclass(frozen=True)
class RangeBearingParams(Params):
    """A sensor of range (m) and bearing (rad, from x towards y), such as a radar."""

    range_sd: float = param(1.0, "standard deviation of the range", unit="m", low=0.0, strict=True)
    bearing_sd: float = param(0.01, "standard deviation of the bearing", unit="rad", low=0.0, strict=True)
    location: tuple[float, ...] = param((0.0, 0.0), "place of the sensor, x and y in the frame of the states")


@dataclasses.dataclass(frozen=True)
class LinearParams(Params):
    """A sensor that reads some axes of the state as they are."""

    sensor_axes: tuple[str, ...] = param(("x", "y"), "axes of the state that a detection holds, in order")
    sensor_cov: tuple[float, ...] = param(
        (1.0, 1.0), "covariance of a detection that brings none: m variances, or m x m row by row, SI units squared"
    )


def _range_bearing(layout: StateLayout, params: RangeBearingParams) -> RangeBearingSensor:
    return RangeBearingSensor(layout, params.range_sd, params.bearing_sd, params.location)


def _linear(layout: StateLayout, params: LinearParams) -> LinearSensor:
    axes = params.sensor_axes
    if not axes or len(set(axes)) < len(axes):
        raise ParameterError(f"The 'sensor_axes' parameter must hold distinct axes, at least one. Got {list(axes)}.")
    noise = square_matrix("sensor_cov", params.sensor_cov, len(axes))
    if not np.isfinite(noise).all() or asymmetric(noise) or not is_positive_definite(noise):
        raise ParameterError(
            f"The 'sensor_cov' parameter must be symmetric and positive definite. Got {list(params.sensor_cov)}."
        )
    return LinearSensor.reading(layout, axes, noise)


#: Sensors by key, made from (layout, params).
SENSORS: Mapping[str, Choice[Sensor]] = {
    "position": Choice(PositionParams, lambda layout, params: LinearSensor.position(layout, params.sensor_sd)),
    "range_bearing": Choice(RangeBearingParams, _range_bearing),
    "linear": Choice(LinearParams, _linear),
}


def make(table: Mapping[str, Choice[T]], key: str, params: Params, *before: Any) -> T:
    """Make what a table lists under a key from (*before, params).

    Raises
    ------
    ParameterError    the choice does not fit, say the axes of the layout
    """
    try:
        return table[key].make(*before, params)
    except ParameterError:
        raise
    except ValueError as error:
        raise ParameterError(str(error)) from None
