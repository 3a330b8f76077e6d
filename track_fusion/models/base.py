"""What every filter asks of a motion and of a sensor, linear or not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np

from track_fusion.layouts import StateLayout
from track_fusion.linalg import Array, matvec


@dataclasses.dataclass(frozen=True)
class Transition:
    """Motion over one interval: x' = f(x) + w, w ~ N(0, Q(x)).

    Attributes
    ----------
    advance : (..., n) -> (..., n)             f, for any leading axes
    jacobian : (..., n) -> (..., n, n)         its derivative
    noise : (..., n) -> (..., n, n)            Q, or (n, n) where it is the same in every state
    noise_factor : (..., n) -> (..., n, r)     G with G G' = Q, what a simulation draws through; (n, r) likewise
    matrix : (n, n) or None                    F of a linear motion, f(x) = F x
    """

    advance: Callable[[Array], Array]
    jacobian: Callable[[Array], Array]
    noise: Callable[[Array], Array]
    noise_factor: Callable[[Array], Array]
    matrix: Array | None = None

    @classmethod
    def additive(
        cls,
        advance: Callable[[Array], Array],
        jacobian: Callable[[Array], Array],
        noise: Array,
        noise_factor: Array,
        matrix: Array | None = None,
    ) -> Transition:
        """Make x' = f(x) + w whose Q, (n, n), and G, (n, r), are the same in every state."""
        return cls(advance, jacobian, lambda _: noise, lambda _: noise_factor, matrix)

    @classmethod
    def linear(cls, matrix: Array, noise: Array, noise_factor: Array | None = None) -> Transition:
        """Make x' = F x + w from F and Q, both (n, n); G is the symmetric root of Q unless given."""
        if noise_factor is None:
            value, vector = np.linalg.eigh(noise)
            noise_factor = vector * np.sqrt(value.clip(0.0)) @ vector.T
        return cls.additive(
            lambda x: np.asarray(x @ matrix.T),
            lambda x: np.broadcast_to(matrix, (*x.shape[:-1], *matrix.shape)),
            noise,
            noise_factor,
            matrix,
        )

    def disturbance(self, state: Array, draws: Array) -> Array:
        """Return G(x) z, the noise of standard normal draws: (..., n), (..., r) -> (..., n)."""
        factor = self.noise_factor(state)
        return np.asarray(draws @ factor.T) if factor.ndim == 2 else matvec(factor, draws)


class Motion(Protocol):
    """How a target moves, in the axes of `layout`."""

    @property
    def layout(self) -> StateLayout:
        """Axes of the state."""

    def over(self, dt: float) -> Transition:
        """Return the motion over dt seconds."""


class Sensor(Protocol):
    """What a sensor sees: z = h(x) + v, v ~ N(0, R)."""

    @property
    def axes(self) -> tuple[str, ...]:
        """What a detection holds."""

    @property
    def noise(self) -> Array:
        """R, (m, m), squared SI units."""

    @property
    def periods(self) -> tuple[float, ...]:
        """Periods of the axes of a detection that wrap, infinite for the others, (m,)."""

    def observe(self, state: Array) -> Array:
        """Return h(x), (..., n) -> (..., m)."""

    def jacobian(self, state: Array) -> Array:
        """Return the derivative of h, (..., n) -> (..., m, n)."""

    def residual(self, z: Array, expected: Array) -> Array:
        """Return z - expected, (..., m), angles the short way round."""
