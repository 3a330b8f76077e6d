"""Many targets on given courses, radars that miss and invent: the simulation, scan by scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from track_fusion.angles import TURN, wrap
from track_fusion.linalg import Array
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.random_streams import stream
from track_fusion.tracks import StateLayout


@dataclasses.dataclass(frozen=True)
class Courses:
    """Straight courses at constant speed with a sinusoidal weave across them.

    Attributes
    ----------
    start, end : (N, 2)        metres; a target is at its end after `duration_s`
    duration_s : float
    amplitude_m, period_s      of the weave, which begins at the line
    """

    start: Array
    end: Array
    duration_s: float
    amplitude_m: float
    period_s: float

    def states(self, layout: StateLayout, times_s: Array) -> Array:
        """Return the states at times (T,): (T, N, n), in a layout with x, y, vx and vy."""
        along = self.end - self.start
        across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1, keepdims=True)
        sway, rate, t = self.amplitude_m * across, 2.0 * np.pi / self.period_s, times_s[:, None, None]
        states = np.zeros((len(times_s), len(along), layout.size))
        states[..., layout.indices(("x", "y"))] = self.start + t / self.duration_s * along + np.sin(rate * t) * sway
        states[..., layout.indices(("vx", "vy"))] = along / self.duration_s + rate * np.cos(rate * t) * sway
        return states


@dataclasses.dataclass(frozen=True)
class Radar:
    """A radar that turns all the way round.

    Attributes
    ----------
    sensor : RangeBearingSensor
    reach_m : float                  it sees what is nearer than this
    detection_probability : float    of a target that it sees, in one scan
    clutter_density : float          false detections a scan, per metre and radian, up to its reach
    """

    sensor: RangeBearingSensor
    reach_m: float
    detection_probability: float
    clutter_density: float

    @property
    def clutter_mean(self) -> float:
        """Expected number of false detections in one scan."""
        return self.clutter_density * self.reach_m * 2.0 * np.pi

    def distance(self, states: Array) -> Array:
        """Distance of states (..., n) in metres, (...)."""
        return np.asarray(self.sensor.observe(states)[..., 0])

    def sees(self, states: Array) -> NDArray[np.bool_]:
        """Tell which states (..., n) lie within reach, (...); one that is NaN does not."""
        return np.asarray(self.distance(states) < self.reach_m)

    def scans(self, truth: Array, rng: np.random.Generator) -> Iterator[Array]:
        """Draw the detections of each scan, (D_k, 2) range and bearing, in random order.

        Parameters
        ----------
        truth : (T, N, n)    the targets' states at the scans, NaN where there is none
        rng : Generator      drawn from scan by scan: the first scans do not depend on how many follow
        """
        sd = np.sqrt(np.diagonal(self.sensor.noise))
        for states in truth:
            detected = self.sees(states) & (rng.random(len(states)) < self.detection_probability)
            values = (self.sensor.observe(states) + sd * rng.standard_normal((len(states), 2)))[detected]
            false = rng.uniform([0.0, -np.pi], [self.reach_m, np.pi], (rng.poisson(self.clutter_mean), 2))
            values[:, 1] = wrap(values[:, 1], TURN)
            yield rng.permutation(np.concatenate([values, false]))


@dataclasses.dataclass(frozen=True)
class Surveillance:
    """Targets that are the same in every run, and radars: a Scene.

    Attributes
    ----------
    layout : StateLayout          x, y, vx, vy in a plane
    dt_s, steps                   seconds from scan to scan, number of scans
    courses : Courses
    radars : mapping name -> Radar
    """

    layout: StateLayout
    dt_s: float
    steps: int
    courses: Courses
    radars: Mapping[str, Radar]

    @property
    def sensors(self) -> dict[str, RangeBearingSensor]:
        """Sensors by name."""
        return {name: radar.sensor for name, radar in self.radars.items()}

    def states(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Return the states at steps 0 to T, (T + 1, N, n), the same whatever the seed and the run."""
        count = (self.steps if steps is None else steps) + 1
        return self.courses.states(self.layout, self.dt_s * np.arange(count, dtype=np.float64))

    def scans(self, seed: int, run: int, steps: int | None = None) -> Iterator[dict[str, Array]]:
        """Draw scan after scan, of all radars: (D_k, 2) each."""
        truth = self.states(seed, run, steps)[1:]
        each = [radar.scans(truth, stream(seed, run, name)) for name, radar in self.radars.items()]
        return (dict(zip(self.radars, scan, strict=True)) for scan in zip(*each, strict=True))

    def detections(self, seed: int, run: int, steps: int | None = None) -> dict[str, list[Array]]:
        """Draw each radar's scans 1 to T, (D_k, 2) each: range and bearing."""
        scans = list(self.scans(seed, run, steps))
        return {name: [scan[name] for scan in scans] for name in self.radars}
