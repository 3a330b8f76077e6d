"""Measurement models: what a sensor sees of a state."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.angles import TURN, difference, periods_of
from track_fusion.layouts import StateLayout
from track_fusion.linalg import Array

#: Distances are not taken shorter than this when dividing by them: at the sensor itself derivatives are zero.
SHORTEST_M = 1e-100


@dataclasses.dataclass(frozen=True)
class LinearSensor:
    """A sensor that reads some axes of the state: z = H x + v, v ~ N(0, R).

    Attributes
    ----------
    axes : tuple of str    what a detection holds
    matrix : (m, n)        H
    noise : (m, m)         R, squared SI units
    periods : (m,)         of angular axes, infinite for the others; empty: as the names say
    """

    axes: tuple[str, ...]
    matrix: Array
    noise: Array
    periods: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.periods:
            object.__setattr__(self, "periods", periods_of(self.axes))

    @classmethod
    def reading(cls, layout: StateLayout, axes: tuple[str, ...], noise: Array) -> LinearSensor:
        """Make a sensor that reads some axes of a layout as they are, with noise (m, m).

        Raises
        ------
        ValueError    an axis is missing
        """
        return cls(axes, np.eye(layout.size)[list(layout.indices(axes))], noise, layout.part(axes).periods)

    @classmethod
    def position(cls, layout: StateLayout, sd: float) -> LinearSensor:
        """Make a sensor of all position axes with standard deviation sd in metres, as Li 2022 (48)."""
        axes = tuple(layout.axes[i] for i in layout.position)
        return cls.reading(layout, axes, sd**2 * np.eye(len(axes)))

    def observe(self, state: Array) -> Array:
        """Return H x, (..., n) -> (..., m)."""
        return np.asarray(state @ self.matrix.T)

    def jacobian(self, state: Array) -> Array:
        """Return H, (..., n) -> (..., m, n)."""
        return np.broadcast_to(self.matrix, (*state.shape[:-1], *self.matrix.shape))

    def residual(self, z: Array, expected: Array) -> Array:
        """Return z - expected, (..., m), angles wrapped."""
        return difference(z, expected, self.periods)


def _location(location: tuple[float, ...], axes: int) -> Array:
    """Return a sensor's place or velocity, the origin or rest when it is not given.

    Raises
    ------
    ValueError    it has not as many coordinates as the layout has position axes
    """
    array = np.asarray(location or (0.0,) * axes, float)
    if array.shape != (axes,):
        raise ValueError(f"The location and velocity of a sensor must hold {axes} numbers. Got {len(array)}.")
    return array


class RangeBearingSensor:
    """Range and bearing in the plane, z = (|p - s|, atan2(p_y - s_y, p_x - s_x)) + v, bearing wrapped.

    Parameters
    ----------
    layout : StateLayout            has axes x and y
    range_sd : float                metres
    bearing_sd : float              radians, counted from x towards y
    location : two floats           the sensor's place s in metres; empty = the origin

    References     Li 2022 (50) with atan2; Sharma (85b).
    """

    axes = ("range", "bearing")
    periods = (np.inf, TURN)

    def __init__(
        self, layout: StateLayout, range_sd: float, bearing_sd: float, location: tuple[float, ...] = ()
    ) -> None:
        self._at, self._size = list(layout.indices(("x", "y"))), layout.size
        self.location = _location(location, 2)
        self.noise = np.diag([range_sd**2, bearing_sd**2])

    def observe(self, state: Array) -> Array:
        """Return range and bearing, (..., n) -> (..., 2)."""
        gap = state[..., self._at] - self.location
        return np.stack([np.hypot(gap[..., 0], gap[..., 1]), np.arctan2(gap[..., 1], gap[..., 0])], -1)

    def jacobian(self, state: Array) -> Array:
        """Return the derivative, (..., n) -> (..., 2, n); zero at the sensor itself."""
        gap = state[..., self._at] - self.location
        unit = gap / np.maximum(np.hypot(gap[..., 0], gap[..., 1]), SHORTEST_M)[..., None]
        inverse_range = 1.0 / np.maximum(np.hypot(gap[..., 0], gap[..., 1]), SHORTEST_M)
        x, y = self._at
        jacobian = np.zeros((*state.shape[:-1], 2, self._size))
        jacobian[..., 0, x], jacobian[..., 0, y] = unit[..., 0], unit[..., 1]
        jacobian[..., 1, x], jacobian[..., 1, y] = -unit[..., 1] * inverse_range, unit[..., 0] * inverse_range
        return jacobian

    def residual(self, z: Array, expected: Array) -> Array:
        """Return z - expected, (..., 2), the bearing wrapped."""
        return difference(z, expected, self.periods)

    def positions(self, z: Array, noise: Array | None = None) -> tuple[Array, Array]:
        """Turn detections into positions (..., 2) with covariances (..., 2, 2), by linearisation.

        `noise`, (2, 2), stands for the sensor's own.

        Its bias along the range, r sd^2 / 2, is neglected.
        """
        r, bearing = z[..., 0], z[..., 1]
        unit = np.stack([np.cos(bearing), np.sin(bearing)], -1)
        across = np.stack([-unit[..., 1], unit[..., 0]], -1) * r[..., None]
        factor = np.stack([unit, across], -1)
        cov = factor @ (self.noise if noise is None else noise) @ np.swapaxes(factor, -1, -2)
        return self.location + r[..., None] * unit, 0.5 * (cov + np.swapaxes(cov, -1, -2))


class RangeRangeRateSensor:
    """Range and its rate, z = (|p - s|, (p - s)'(v - u) / |p - s|) + noise, in the plane or in space.

    Parameters
    ----------
    layout : StateLayout            has a velocity axis for each position axis
    range_sd, range_rate_sd : float    metres, metres a second
    location, velocity : floats     place s and velocity u of the sensor; empty = at the origin, at rest

    References     Ahmed (63)-(65), whose minus signs are misprints.
    """

    axes = ("range", "range_rate")
    periods = (np.inf, np.inf)

    def __init__(
        self,
        layout: StateLayout,
        range_sd: float,
        range_rate_sd: float,
        location: tuple[float, ...] = (),
        velocity: tuple[float, ...] = (),
    ) -> None:
        names = [layout.axes[i] for i in layout.position]
        self._at, self._size = list(layout.position), layout.size
        self._rate_at = list(layout.indices(["v" + name for name in names]))
        self.location, self.velocity = _location(location, len(names)), _location(velocity, len(names))
        self.noise = np.diag([range_sd**2, range_rate_sd**2])

    def _geometry(self, state: Array) -> tuple[Array, Array, Array]:
        """Distance (..., 1), unit vector towards the target and relative velocity (..., d)."""
        gap = state[..., self._at] - self.location
        distance = np.linalg.norm(gap, axis=-1, keepdims=True)
        return distance, gap / np.maximum(distance, SHORTEST_M), state[..., self._rate_at] - self.velocity

    def observe(self, state: Array) -> Array:
        """Return range and range rate, (..., n) -> (..., 2)."""
        distance, unit, speed = self._geometry(state)
        return np.concatenate([distance, (unit * speed).sum(-1, keepdims=True)], -1)

    def jacobian(self, state: Array) -> Array:
        """Return the derivative, (..., n) -> (..., 2, n); zero at the sensor itself."""
        distance, unit, speed = self._geometry(state)
        jacobian = np.zeros((*state.shape[:-1], 2, self._size))
        jacobian[..., 0, self._at] = jacobian[..., 1, self._rate_at] = unit
        across = speed - unit * (unit * speed).sum(-1, keepdims=True)
        jacobian[..., 1, self._at] = np.where(distance > SHORTEST_M, across / np.maximum(distance, SHORTEST_M), 0.0)
        return jacobian

    def residual(self, z: Array, expected: Array) -> Array:
        """Return z - expected, (..., 2)."""
        return np.asarray(z - expected)
