"""The filters that a single-target tracker can be given by name; each maps a track, a TrackBatch of one, to a track."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from track_fusion.densities.log_domain import log_of
from track_fusion.filters import cubature, extended, kalman, particle, student_t, unscented
from track_fusion.filters.particle import Particles
from track_fusion.filters.unscented import UnscentedParams
from track_fusion.linalg import Array
from track_fusion.models.base import Motion, Sensor, Transition
from track_fusion.models.choices import Choice
from track_fusion.models.measurement import LinearSensor
from track_fusion.params import ParameterError, Params, param
from track_fusion.random_streams import RandomParams
from track_fusion.tracks import TrackBatch

GaussianUpdate = Callable[[Array, Array, Array, Sensor], tuple[Array, Array]]


class TrackFilter(Protocol):
    """What a tracker does with the density of its target, which it keeps as a track in the form of its filter."""

    def begin(self, track: TrackBatch) -> TrackBatch:
        """Bring a Gaussian track into the filter's form; random numbers start anew."""

    def predict(self, track: TrackBatch, transition: Transition) -> TrackBatch:
        """Return the track moved by x' = f(x) + w; times are the caller's."""

    def update(self, track: TrackBatch, z: Array, sensor: Sensor) -> TrackBatch:
        """Return the track conditioned on z = h(x) + v, z (m,)."""

    def adopt(self, track: TrackBatch, fused: TrackBatch) -> TrackBatch:
        """Return the track with the density of another, fused one."""


def _with_moments(track: TrackBatch, mean: Array, cov: Array) -> TrackBatch:
    return track.replace(mean=mean[None, None], cov=cov[None, None])


@dataclasses.dataclass(frozen=True)
class GaussianTrackFilter:
    """A filter of means (n,) and covariances (n, n), with those of filters/."""

    move: Callable[[Array, Array, Transition], tuple[Array, Array]]
    condition: GaussianUpdate
    dof: float = np.inf

    def begin(self, track: TrackBatch) -> TrackBatch:
        """Give the track the filter's tails."""
        return track.replace(dof=np.array([self.dof]))

    def predict(self, track: TrackBatch, transition: Transition) -> TrackBatch:
        """Predict the moments."""
        return _with_moments(track, *self.move(track.mean[0, 0], track.cov[0, 0], transition))

    def update(self, track: TrackBatch, z: Array, sensor: Sensor) -> TrackBatch:
        """Condition the moments."""
        return _with_moments(track, *self.condition(track.mean[0, 0], track.cov[0, 0], z, sensor))

    def adopt(self, track: TrackBatch, fused: TrackBatch) -> TrackBatch:
        """Take the moments; a mixture is merged."""
        (mean,), (cov,) = fused.moments
        return _with_moments(track, mean, cov)


@dataclasses.dataclass(frozen=True)
class StudentTParams(Params):
    """The Student-t filter: tails of state and noises; initial, process and sensor covariances stay covariances."""

    dof: float = param(
        3.0, "degrees of freedom, the same after each update and after feedback (moments matched)", low=2.0, strict=True
    )


@dataclasses.dataclass(frozen=True)
class SirParams(RandomParams):
    """The particle filter (sampling importance resampling), which draws from the stream of seed, run and role."""

    particles: int = param(500, "number of particles", low=2)
    resampling: str = param("systematic", "how particles are drawn again", choices=tuple(particle.RESAMPLING))


class SirTrackFilter:
    """Particles, as a track of several components without covariance; drawn again before they move on."""

    def __init__(self, params: SirParams) -> None:
        self._params, self._resample = params, particle.RESAMPLING[params.resampling]

    def begin(self, track: TrackBatch) -> TrackBatch:
        """Draw the particles."""
        self._rng = self._params.stream()
        return self._drawn(track, track)

    def predict(self, track: TrackBatch, transition: Transition) -> TrackBatch:
        """Draw again those that were weighed, then move them."""
        cloud = _particles(track)
        if np.ptp(cloud.log_weight):
            cloud = self._resample(cloud, self._rng, self._params.particles)
        return _with_particles(track, particle.predict(cloud, transition, self._rng))

    def update(self, track: TrackBatch, z: Array, sensor: Sensor) -> TrackBatch:
        """Weigh the particles."""
        return _with_particles(track, particle.update(_particles(track), z, sensor)[0])

    def adopt(self, track: TrackBatch, fused: TrackBatch) -> TrackBatch:
        """Draw from the fused particles, or from a Gaussian of the fused moments."""
        if fused.components == 1 or fused.cov.any():
            return self._drawn(track, fused)
        return _with_particles(track, self._resample(_particles(fused), self._rng, self._params.particles))

    def _drawn(self, track: TrackBatch, other: TrackBatch) -> TrackBatch:
        (mean,), (cov,) = other.moments
        return _with_particles(track, particle.from_gaussian(mean, cov, self._rng, self._params.particles))


def _particles(track: TrackBatch) -> Particles:
    return Particles(track.mean[0], log_of(track.weight[0]))


def _with_particles(track: TrackBatch, cloud: Particles) -> TrackBatch:
    # None may vanish: a track of a single row without covariance would be an error.
    weight = np.maximum(cloud.weight, np.finfo(float).tiny)
    size = cloud.points.shape[-1]
    return track.replace(weight=weight[None], mean=cloud.points[None], cov=np.zeros((1, cloud.count, size, size)))


def _plain(condition: Callable[..., tuple[Array, Array, object]]) -> GaussianUpdate:
    return lambda mean, cov, z, sensor: condition(mean, cov, z, sensor)[:2]


def _kalman(motion: Motion, sensor: Sensor, params: Params) -> TrackFilter:
    if motion.over(0.0).matrix is None or not isinstance(sensor, LinearSensor):
        raise ParameterError(
            "The 'filter' parameter must be one for non-linear models, such as extended, unscented or cubature, with "
            "this motion or sensor. Got 'kalman'."
        )

    def move(mean: Array, cov: Array, transition: Transition) -> tuple[Array, Array]:
        return kalman.predict(mean, cov, transition.jacobian(mean), transition.noise(mean))

    def condition(mean: Array, cov: Array, z: Array, sensor: Sensor) -> tuple[Array, Array]:
        return kalman.update(mean, cov, z, sensor.jacobian(mean), sensor.noise)[:2]

    return GaussianTrackFilter(move, condition)


def _unscented(motion: Motion, sensor: Sensor, params: UnscentedParams) -> TrackFilter:
    return GaussianTrackFilter(
        lambda mean, cov, transition: unscented.predict(mean, cov, transition, params),
        lambda mean, cov, z, sensor: unscented.update(mean, cov, z, sensor, params)[:2],
    )


def _student_t(motion: Motion, sensor: Sensor, params: StudentTParams) -> TrackFilter:
    return GaussianTrackFilter(
        student_t.predict,
        lambda mean, cov, z, sensor: student_t.update(mean, cov, params.dof, z, sensor)[:2],
        params.dof,
    )


#: Single-target filters by key, made from (motion, sensor, params).
TRACK_FILTERS: Mapping[str, Choice[TrackFilter]] = {
    "kalman": Choice(Params, _kalman),
    "extended": Choice(Params, lambda *_: GaussianTrackFilter(extended.predict, _plain(extended.update))),
    "unscented": Choice(UnscentedParams, _unscented),
    "cubature": Choice(Params, lambda *_: GaussianTrackFilter(cubature.predict, _plain(cubature.update))),
    "particle": Choice(SirParams, lambda motion, sensor, params: SirTrackFilter(params)),
    "student_t": Choice(StudentTParams, _student_t),
}
