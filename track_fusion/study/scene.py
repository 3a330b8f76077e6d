"""What the library's studies and the ROS nodes are driven by: targets that move and sensors that see them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from track_fusion.angles import wrap
from track_fusion.linalg import Array, matvec
from track_fusion.models.base import Motion, Sensor
from track_fusion.models.noise import Noise
from track_fusion.tracks import StateLayout


class Scene(Protocol):
    """Any number of targets, and sensors that miss and invent: what the replay node publishes scan by scan."""

    @property
    def layout(self) -> StateLayout:
        """Axes of the true states, n."""

    @property
    def dt_s(self) -> float:
        """Seconds from scan to scan, the same for all sensors."""

    @property
    def steps(self) -> int:
        """Number of scans of a whole run, the first one `dt_s` after the start."""

    @property
    def sensors(self) -> Mapping[str, Sensor]:
        """Sensors by name."""

    def states(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Return the true states at steps 0 to T, (T + 1, N, n), NaN where a target does not exist.

        T is `steps`, the scene's own number by default; the first states do not depend on it.
        """

    def detections(self, seed: int, run: int, steps: int | None = None) -> dict[str, list[Array]]:
        """Draw each sensor's scans 1 to T, (D_k, m) each; the first scans do not depend on T."""


@dataclasses.dataclass(frozen=True)
class Tracking:
    """The Scene of one target that every sensor sees at every step, and what its filters are told.

    Attributes
    ----------
    motion : Motion    of the truth and of the filters; its layout is the scenario's
    dt_s, steps                        sampling interval in seconds, number of filtering steps
    initial_mean (n,), initial_cov (n, n)    of every filter
    sensors : mapping name -> Sensor
    process_noise, measurement_noise : Noise    of the truth and of the measurements, in units of the motion's and the
                                                sensors' own, which are what the filters are told
    initial_noise : Noise | None                of the truth's first state, in units of initial_cov; None = it is the
                                                initial mean itself
    """

    motion: Motion
    dt_s: float
    steps: int
    initial_mean: Array
    initial_cov: Array
    sensors: Mapping[str, Sensor]
    process_noise: Noise = Noise()
    measurement_noise: Noise = Noise()
    initial_noise: Noise | None = None

    @property
    def layout(self) -> StateLayout:
        """Axes of the state."""
        return self.motion.layout

    def states(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Draw the target's states, (T + 1, 1, n)."""
        return self.truth(seed, run, steps)[:, None]

    def detections(self, seed: int, run: int, steps: int | None = None) -> dict[str, list[Array]]:
        """Draw each sensor's measurements, one a scan, (1, m) each."""
        drawn = self.measurements(self.truth(seed, run, steps), seed, run)
        return {name: list(z[:, None]) for name, z in drawn.items()}

    def truth(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Draw the target's states at steps 0 to T, (T + 1, n).

        T is `steps`, the scenario's own number by default; the first states do not depend on it.
        """
        states: Array = self.truths(seed, [run], steps)[0]
        return states

    def truths(self, seed: int, runs: Sequence[int], steps: int | None = None) -> Array:
        """Draw the target's states of several runs, (R, T + 1, n)."""
        steps = self.steps if steps is None else steps
        transition = self.motion.over(self.dt_s)
        size = transition.noise_factor(self.initial_mean).shape[-1]
        draws = np.stack([self.process_noise.draw(seed, run, "truth", steps, size) for run in runs])
        states = np.empty((len(runs), steps + 1, len(self.initial_mean)))
        states[:, 0] = [self._initial(seed, run) for run in runs]
        for k in range(steps):
            # One matrix a run: products of larger ones round differently with the number of runs.
            moved, factor = transition.advance(states[:, k, None])[:, 0], transition.noise_factor(states[:, k])
            states[:, k + 1] = moved + matvec(factor, draws[:, k])
        return states

    def _initial(self, seed: int, run: int) -> Array:
        if self.initial_noise is None:
            return self.initial_mean
        draw = self.initial_noise.draw(seed, run, "initial state", 1, len(self.initial_mean))[0]
        return np.asarray(self.initial_mean + np.linalg.cholesky(self.initial_cov) @ draw)

    def measurements(self, truth: Array, seed: int, run: int) -> dict[str, Array]:
        """Draw each sensor's measurements at steps 1 to T, (T, m) each."""
        seen = {}
        for name, sensor in self.sensors.items():
            factor = np.linalg.cholesky(sensor.noise)
            draws = self.measurement_noise.draw(seed, run, name, len(truth) - 1, len(factor))
            z = sensor.observe(truth[1:]) + draws @ factor.T
            seen[name] = wrap(z, sensor.periods)
        return seen
