"""Constant turn rate and speed: a target that goes where it points, such as a car."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np

from track_fusion.angles import HALF_TURN
from track_fusion.layouts import StateLayout
from track_fusion.linalg import Array, transpose
from track_fusion.models.base import Transition
from track_fusion.models.random_walk import random_walk, random_walk_param
from track_fusion.models.turn import turn_coefficient_slopes, turn_coefficients
from track_fusion.params import Params, param

AXES = ("x", "y", "yaw", "speed", "turn_rate")
#: Places along the path at which the noise is summed: the sum is exact to 1e-12 of itself for turns up to a radian an
#: interval, to 1e-9 up to half a turn, to 1e-4 up to a whole one.
NODES = 8
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(NODES)


@dataclasses.dataclass(frozen=True)
class TurnRateAndSpeedParams(Params):
    """Constant turn rate and speed, both disturbed by white noise."""

    process_noise: float = param(
        1.0, "power spectral density of the white acceleration along the way", unit="m^2/s^3", low=0.0
    )
    turn_rate_noise: float = param(
        0.01, "power spectral density of the white turn acceleration: variance a second", unit="rad^2/s^3", low=0.0
    )
    random_walk_noise: tuple[float, ...] = random_walk_param()


class ConstantTurnRateAndSpeed:
    """Constant turn rate and speed over axes x, y, yaw, speed and turn_rate, in any order: the yaw is the course.

    dx = speed cos(yaw) dt, dy = speed sin(yaw) dt, dyaw = turn_rate dt; speed and turn_rate are Wiener processes of
    the densities q_a and q_w. The yaw counts from x towards y and is not wrapped here: a prediction is continuous in
    the state. Other axes follow a random walk.

    Notes     f is the exact solution without noise. A disturbance at time s reaches the end of an interval T through
              the Jacobian Phi of f over the rest of it, T - s, so that

                  Q = integral over [0, T] of Phi(T - s) diag(q) Phi(T - s)' ds,    q = (0, 0, 0, q_a, q_w),

              along the path without noise: first order in the densities; what is left out is of the order of the
              variance that the yaw gains, q_w T^3 / 3, beside 1. Summed by Gauss and Legendre, hence never indefinite.
    References    R. Schubert, E. Richter, G. Wanielik, Comparison and evaluation of advanced motion models for vehicle
              tracking, 2008 (CTRV), whose noise is held over each interval instead.
    """

    def __init__(self, layout: StateLayout, params: TurnRateAndSpeedParams) -> None:
        wanted = f"Constant turn rate and speed needs axes {', '.join(AXES)}"
        self._walk = random_walk(layout, AXES, params.random_walk_noise, wanted)
        self.layout, self.params = layout, params
        self._at = layout.indices(AXES)
        if layout.periods[self._at[2]] == HALF_TURN:
            raise ValueError(
                "Constant turn rate and speed needs a yaw that tells front from back. Got one of period pi."
            )
        self._others = [i for i in range(layout.size) if i not in self._at]
        self.over = lru_cache(maxsize=256)(self._over)

    def _over(self, dt: float) -> Transition:
        """Return the motion over dt seconds.

        Raises
        ------
        ValueError    dt is negative
        """
        if dt < 0:
            raise ValueError(f"The 'dt' of a prediction must be >= 0 s. Got {dt:g}.")

        def noise(state: Array) -> Array:
            factor = self._noise_factor(state, dt)
            return np.asarray(factor @ transpose(factor))

        return Transition(
            lambda x: self._advance(x, dt), lambda x: self._jacobian(x, dt), noise, lambda x: self._noise_factor(x, dt)
        )

    def _advance(self, state: Array, dt: float) -> Array:
        x, y, yaw, speed, rate = (state[..., i] for i in self._at)
        way, _ = _ways(yaw, rate, dt)
        moved = np.array(state)
        moved[..., self._at[0]] = x + speed * way[0]
        moved[..., self._at[1]] = y + speed * way[1]
        moved[..., self._at[2]] = yaw + dt * rate
        return moved

    def _jacobian(self, state: Array, dt: float) -> Array:
        _, _, yaw, speed, rate = (state[..., i] for i in self._at)
        way, bend = _ways(yaw, rate, dt)
        x, y, heading, v, w = self._at
        jacobian = np.zeros((*state.shape, self.layout.size))
        jacobian[..., range(self.layout.size), range(self.layout.size)] = 1.0
        jacobian[..., x, heading], jacobian[..., y, heading] = -speed * way[1], speed * way[0]
        jacobian[..., x, v], jacobian[..., y, v] = way
        jacobian[..., x, w], jacobian[..., y, w] = speed * bend[0], speed * bend[1]
        jacobian[..., heading, w] = dt
        return jacobian

    def _noise_factor(self, state: Array, dt: float) -> Array:
        """Return G, (..., n, 2 NODES + others): what each disturbance along the path leaves at its end."""
        _, _, yaw, speed, rate = (state[..., i, None] for i in self._at)
        rest = 0.5 * dt * (1.0 - _NODE)  # seconds from each node to the end
        way, bend = _ways(yaw + rate * (dt - rest), rate, rest)
        x, y, heading, v, w = self._at
        factor = np.zeros((*state.shape, 2 * NODES + len(self._others)))
        by_speed, by_rate = factor[..., :NODES], factor[..., NODES : 2 * NODES]
        by_speed[..., x, :], by_speed[..., y, :], by_speed[..., v, :] = *way, 1.0
        by_rate[..., x, :], by_rate[..., y, :], by_rate[..., heading, :] = speed * bend[0], speed * bend[1], rest
        by_rate[..., w, :] = 1.0
        by_speed *= np.sqrt(0.5 * dt * _WEIGHT * self.params.process_noise)
        by_rate *= np.sqrt(0.5 * dt * _WEIGHT * self.params.turn_rate_noise)
        factor[..., 2 * NODES :] = np.diag(np.sqrt(dt * self._walk))[:, self._others]
        return factor


def _ways(yaw: Array, rate: Array, dt: Array | float) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the way of unit speed in x and y, integral over dt of (cos, sin)(yaw + rate t), and its slope in rate."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along, across = turn_coefficients(rate * dt)
    along_slope, across_slope = turn_coefficient_slopes(rate * dt)
    way = dt * (along * cosine - across * sine), dt * (along * sine + across * cosine)
    square = np.square(dt)
    bend = along_slope * cosine - across_slope * sine, along_slope * sine + across_slope * cosine
    return way, (square * bend[0], square * bend[1])
