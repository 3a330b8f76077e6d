"""Motion models: transition matrices and process noise over a layout's named axes."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from track_fusion.layouts import StateLayout
from track_fusion.linalg import Array
from track_fusion.models.base import Transition
from track_fusion.models.random_walk import random_walk, random_walk_param
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class MotionParams(Params):
    """Nearly constant velocity: every position axis with its velocity, disturbed by white acceleration."""

    noise_form: str = param(
        "continuous",
        "continuous: white acceleration in continuous time, which does not depend on how often one predicts; "
        "piecewise_constant: an acceleration held over each interval",
        choices=("continuous", "piecewise_constant"),
    )
    process_noise: float = param(
        1.0,
        "strength of the disturbance: power spectral density in m^2/s^3 (continuous), or standard "
        "deviation of the acceleration in m/s^2 (piecewise_constant)",
        low=0.0,
    )
    random_walk_noise: tuple[float, ...] = random_walk_param()


class NearlyConstantVelocity:
    """Nearly constant velocity over a layout that holds each position axis with its velocity.

    Other axes (yaw, length, ...) follow a random walk, in either form of the noise. A position or a velocity without
    its partner, or an acceleration, is refused.

    References     Li 2022 (47) for piecewise_constant.
    """

    def __init__(self, layout: StateLayout, params: MotionParams) -> None:
        names = layout.axes
        paired = [a for a in ("x", "y", "z") if a in names and "v" + a in names]
        own = [*paired, *("v" + a for a in paired)]
        wanted = "Nearly constant velocity needs axes like x, vx in pairs"
        self._walk = random_walk(layout, own, params.random_walk_noise, wanted)
        self.layout, self.params = layout, params
        self._pairs = [(names.index(a), names.index("v" + a)) for a in paired]
        self._others = [i for i, a in enumerate(names) if a not in own]
        position, velocity = np.zeros((layout.size,) * 2), np.zeros((layout.size,) * 2)
        cross, self._drift = np.zeros((layout.size,) * 2), np.zeros((layout.size,) * 2)
        for p, v in self._pairs:
            position[p, p] = velocity[v, v] = cross[p, v] = cross[v, p] = self._drift[p, v] = 1.0
        self._noise = np.stack([position, cross, velocity])
        self.matrices = lru_cache(maxsize=256)(self._matrices)
        self.over = lru_cache(maxsize=256)(self._over)

    def _matrices(self, dt: float) -> tuple[Array, Array]:
        """Return F and Q, each (n, n), over dt seconds."""
        stacked = self.batch(np.array([dt]))
        return stacked[0][0], stacked[1][0]

    def batch(self, dt: NDArray[np.float64]) -> tuple[Array, Array]:
        """Return F and Q, each (N, n, n), over intervals dt (N,) in seconds.

        Raises
        ------
        ValueError    an interval is negative (prediction goes forward)
        """
        if (dt < 0).any():
            raise ValueError(f"The 'dt' of a prediction must be >= 0 s. Got {dt.min():g}.")
        transition = np.eye(self.layout.size) + dt[:, None, None] * self._drift
        strength = self.params.process_noise
        if self.params.noise_form == "continuous":
            terms = strength * np.stack([dt**3 / 3, dt**2 / 2, dt], -1)
        else:
            terms = strength**2 * np.stack([dt**4 / 4, dt**3 / 2, dt**2], -1)
        return transition, np.tensordot(terms, self._noise, 1) + dt[:, None, None] * np.diag(self._walk)

    def noise_factor(self, dt: float) -> Array:
        """Return G, (n, r), with G G' = Q over dt seconds and r draws an interval: what a simulation needs."""
        noise = self.matrices(dt)[1]
        columns = []
        for p, v in self._pairs:
            # The lower Cholesky factor of a 2 x 2 block; the held acceleration leaves it one column.
            first = np.zeros(self.layout.size)
            first[[p, v]] = np.sqrt(noise[p, p]), noise[p, v] / np.sqrt(noise[p, p]) if noise[p, p] > 0 else 0.0
            columns.append(first)
            if self.params.noise_form == "continuous":
                second = np.zeros(self.layout.size)
                second[v] = np.sqrt(noise[v, v] - first[v] ** 2)
                columns.append(second)
        columns += list(np.diag(np.sqrt(dt * self._walk))[self._others])
        return np.stack(columns, 1)

    def _over(self, dt: float) -> Transition:
        """Return the motion over dt seconds."""
        return Transition.linear(*self.matrices(dt), self.noise_factor(dt))
