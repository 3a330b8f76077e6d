"""Turning targets: coordinated turn with the turn rate in the state, and turns of known rate."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np

from track_fusion.layouts import StateLayout
from track_fusion.linalg import Array
from track_fusion.models.base import Transition
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.random_walk import random_walk, random_walk_param
from track_fusion.models.van_loan import van_loan
from track_fusion.params import Params, param

#: Angles below this, in radians, use series: closed forms lose digits there.
SMALL_ANGLE = 0.1
PLANE = ("x", "y", "vx", "vy")


@dataclasses.dataclass(frozen=True)
class CoordinatedTurnParams(Params):
    """Coordinated turn: speed and turn rate nearly constant, both disturbed by white noise."""

    process_noise: float = param(
        1.0, "power spectral density of the white acceleration of each axis", unit="m^2/s^3", low=0.0
    )
    turn_rate_noise: float = param(
        1e-4, "power spectral density of the white turn acceleration: variance a second", unit="rad^2/s^3", low=0.0
    )
    random_walk_noise: tuple[float, ...] = random_walk_param()


def turn_coefficients(angle: Array) -> tuple[Array, Array]:
    """Return sin a / a and (1 - cos a) / a of angles turned, with their limits 1 and 0 at a = 0."""
    half = np.asarray(angle) / 2.0
    return np.sinc(np.asarray(angle) / np.pi), np.asarray(np.sin(half) * np.sinc(half / np.pi))


def turn_coefficient_slopes(angle: Array) -> tuple[Array, Array]:
    """Return the derivatives of :func:`turn_coefficients` over the angle, with their limits 0 and 1/2 at 0."""
    angle = np.asarray(angle)
    small = np.abs(angle) < SMALL_ANGLE
    a = np.where(small, 1.0, angle)
    s2 = np.where(small, angle, 0.0) ** 2
    first = -angle * (1 / 3 - s2 * (1 / 30 - s2 * (1 / 840 - s2 / 45360)))
    second = 1 / 2 - s2 * (1 / 8 - s2 * (1 / 144 - s2 * (1 / 5760 - s2 / 403200)))
    sine, cosine = np.sin(a), np.cos(a)
    return (
        np.where(small, first, (a * cosine - sine) / a**2),
        np.where(small, second, (a * sine - (1.0 - cosine)) / a**2),
    )


class CoordinatedTurn:
    """Coordinated turn over axes x, y, vx, vy and turn_rate, in any order; the turn rate is a state.

    The velocity turns by turn_rate dt, positive from x towards y. Noise is added to a nearly constant
    velocity of each axis and to the turn rate, without correlation. Other axes follow a random walk.

    References     Li 2022 (49), with F(turn rate before the step) and its limit at turn rate zero.
    """

    def __init__(self, layout: StateLayout, params: CoordinatedTurnParams) -> None:
        own, wanted = (*PLANE, "turn_rate"), "Coordinated turn needs axes x, y, vx, vy, turn_rate"
        self._walk = random_walk(layout, own, params.random_walk_noise, wanted)
        self.layout, self.params = layout, params
        self._at = layout.indices(own)
        self.over = lru_cache(maxsize=256)(self._over)

    def _over(self, dt: float) -> Transition:
        """Return the motion over dt seconds.

        Raises
        ------
        ValueError    dt is negative
        """
        straight = NearlyConstantVelocity(StateLayout(PLANE), MotionParams(process_noise=self.params.process_noise))
        plane, (_, block), factor = list(self._at[:4]), straight.matrices(dt), straight.noise_factor(dt)
        alone = dt * self._walk  # variances of the axes that gain noise by themselves
        alone[self._at[4]] = dt * self.params.turn_rate_noise
        noise = np.diag(alone)
        noise[np.ix_(plane, plane)] = block
        others = [i for i in range(self.layout.size) if i not in plane]
        root = np.concatenate([np.zeros((self.layout.size, factor.shape[1])), np.diag(np.sqrt(alone))[:, others]], 1)
        root[plane, : factor.shape[1]] = factor
        return Transition.additive(lambda x: self._advance(x, dt), lambda x: self._jacobian(x, dt), noise, root)

    def _advance(self, state: Array, dt: float) -> Array:
        x, y, vx, vy, rate = (state[..., i] for i in self._at)
        angle = rate * dt
        along, across = turn_coefficients(angle)
        cosine, sine = np.cos(angle), np.sin(angle)
        moved = np.array(state)
        moved[..., self._at[0]] = x + dt * (along * vx - across * vy)
        moved[..., self._at[1]] = y + dt * (across * vx + along * vy)
        moved[..., self._at[2]] = cosine * vx - sine * vy
        moved[..., self._at[3]] = sine * vx + cosine * vy
        return moved

    def _jacobian(self, state: Array, dt: float) -> Array:
        vx, vy, rate = (state[..., i] for i in self._at[2:])
        angle = rate * dt
        along, across = turn_coefficients(angle)
        along_slope, across_slope = turn_coefficient_slopes(angle)
        cosine, sine = np.cos(angle), np.sin(angle)
        x, y, u, v, w = self._at
        jacobian = np.zeros((*state.shape, self.layout.size))
        jacobian[..., range(self.layout.size), range(self.layout.size)] = 1.0
        jacobian[..., x, u] = jacobian[..., y, v] = dt * along
        jacobian[..., y, u], jacobian[..., x, v] = dt * across, -dt * across
        jacobian[..., u, u] = jacobian[..., v, v] = cosine
        jacobian[..., v, u], jacobian[..., u, v] = sine, -sine
        jacobian[..., x, w] = dt**2 * (along_slope * vx - across_slope * vy)
        jacobian[..., y, w] = dt**2 * (across_slope * vx + along_slope * vy)
        jacobian[..., u, w] = -dt * (sine * vx + cosine * vy)
        jacobian[..., v, w] = dt * (cosine * vx - sine * vy)
        return jacobian


@dataclasses.dataclass(frozen=True)
class KnownTurnParams(Params):
    """A turn of known rate, disturbed by white acceleration in continuous time."""

    turn_rate: float = param(0.0, "turn rate, positive from x towards y", unit="rad/s")
    process_noise: float = param(
        1.0, "power spectral density of the white acceleration of each axis", unit="m^2/s^3", low=0.0
    )
    random_walk_noise: tuple[float, ...] = random_walk_param()


class KnownTurn:
    """Velocity turning at a known rate over axes x, y, vx, vy in any order: linear, noise by van Loan.

    At rate zero it is nearly constant velocity. Other axes follow a random walk.

    References     Ahmed (59)-(60) and the text below (62).
    """

    def __init__(self, layout: StateLayout, params: KnownTurnParams) -> None:
        walk = random_walk(layout, PLANE, params.random_walk_noise, "A turn of known rate needs axes x, y, vx, vy")
        self.layout, self.params = layout, params
        x, y, u, v = layout.indices(PLANE)
        self._drift, self._diffusion = np.zeros((layout.size, layout.size)), np.diag(walk)
        self._drift[x, u] = self._drift[y, v] = 1.0
        self._drift[u, v], self._drift[v, u] = -params.turn_rate, params.turn_rate
        self._diffusion[u, u] = self._diffusion[v, v] = params.process_noise
        self.matrices = lru_cache(maxsize=256)(self._matrices)

    def _matrices(self, dt: float) -> tuple[Array, Array]:
        """Return F and Q, each (n, n), over dt seconds."""
        return van_loan(self._drift, self._diffusion, dt)

    def over(self, dt: float) -> Transition:
        """Return the motion over dt seconds."""
        return Transition.linear(*self.matrices(dt))
