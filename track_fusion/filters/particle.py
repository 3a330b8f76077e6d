"""The sampling-importance-resampling (SIR) particle filter, in the log domain, batched over runs.

Whatever draws takes a generator, or one generator a run: a run then draws the same numbers whatever batch it is
computed in.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from track_fusion.angles import sample_moments
from track_fusion.densities.log_domain import log_of, log_sum_exp
from track_fusion.densities.mixture.mixture import LOG_2PI, Mixture
from track_fusion.filters.base import Density, Evidence
from track_fusion.linalg import Array, cholesky, transpose
from track_fusion.models.base import Sensor, Transition
from track_fusion.params import param
from track_fusion.random_streams import Generators, RandomParams, exponentials, normals, stream, uniforms

#: The largest double below one.
BELOW_ONE = float(np.nextafter(1.0, 0.0))
#: The smallest weight of a component.
TINY = float(np.finfo(float).tiny)


@dataclasses.dataclass(frozen=True)
class Particles:
    """Weighted samples of a density.

    Attributes
    ----------
    points : (..., N, n)
    log_weight : (..., N)    logarithms of weights that sum to one
    periods : (n,)           of axes that wrap, infinite for the others; empty: none wraps
    """

    points: Array
    log_weight: Array
    periods: Sequence[float] = dataclasses.field(default=(), kw_only=True)
    dof: ClassVar[float] = np.inf

    @property
    def count(self) -> int:
        """Number of particles N."""
        return int(self.points.shape[-2])

    @property
    def weight(self) -> Array:
        """Weights (..., N)."""
        return np.exp(self.log_weight)

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n): the particles' conversion to a Gaussian.

        The covariance is that of the weighted samples; it is singular when n or fewer of them carry all weight.
        """
        return sample_moments(self.weight, self.points, self.periods)

    @property
    def components(self) -> Mixture:
        """The particles as components without covariance; none vanishes: one alone would be no density."""
        n = self.points.shape[-1]
        return Mixture(np.maximum(self.weight, TINY), self.points, np.zeros((*self.points.shape, n)))


@dataclasses.dataclass(frozen=True)
class SirState(Particles):
    """The particles of a filter, and the generator that it draws from."""

    rng: Generators


def union(sets: Sequence[Particles], weights: Array) -> Particles:
    """Join K sets of particles: the arithmetic average of their densities, a particle density itself.

    Parameters
    ----------
    sets : K Particles, (..., N_i) each    of the same periods
    weights : (..., K)    non-negative, sum one
    """
    share = log_of(weights)
    lead = np.broadcast_shapes(*(s.points.shape[:-2] for s in sets), weights.shape[:-1])
    points = [np.broadcast_to(s.points, (*lead, *s.points.shape[-2:])) for s in sets]
    logs = [np.broadcast_to(s.log_weight + share[..., i, None], (*lead, s.count)) for i, s in enumerate(sets)]
    return Particles(np.concatenate(points, -2), np.concatenate(logs, -1), periods=sets[0].periods)


def even(shape: tuple[int, ...]) -> Array:
    """Logarithms of equal weights (..., N)."""
    return np.full(shape, -np.log(shape[-1]))


def take(particles: Particles, index: NDArray[np.intp]) -> Particles:
    """Pick particles (..., M) by index, with equal weights."""
    *lead, count, n = particles.points.shape
    sets = int(np.prod(lead))
    rows = index.reshape(sets, index.shape[-1]) + count * np.arange(sets)[:, None]
    points = particles.points.reshape(sets * count, n)[rows]
    return Particles(points.reshape(*index.shape, n), even(index.shape), periods=particles.periods)


def resample_multinomial(particles: Particles, rng: Generators, count: int | None = None) -> Particles:
    """Draw `count` particles (as many as there are by default), each independently by weight.

    Notes    O(N): sorted uniforms from exponential spacings are merged with the cumulated weights.
    """
    count = particles.count if count is None else count
    spacing = np.cumsum(exponentials(rng, (*particles.points.shape[:-2], count + 1)), -1)
    return take(particles, _inverse_cdf(particles, spacing[..., :-1] / spacing[..., -1:]))


def resample_systematic(particles: Particles, rng: Generators, count: int | None = None) -> Particles:
    """Draw `count` particles at evenly spaced positions with one common shift: each appears N w_i times to within one.

    Of all schemes it adds the least noise; its draws are not independent.
    """
    count = particles.count if count is None else count
    shift = uniforms(rng, (*particles.points.shape[:-2], 1))
    return take(particles, _inverse_cdf(particles, (np.arange(count) + shift) / count))


def _inverse_cdf(particles: Particles, position: Array) -> NDArray[np.intp]:
    """Find the particle at each position in [0, 1) of the cumulated weights; positions (..., M) ascend."""
    cumulated = np.cumsum(particles.weight, -1)
    cumulated = cumulated / cumulated[..., -1:]
    lead, count, size = position.shape[:-1], position.shape[-1], particles.count
    both = np.concatenate([cumulated, np.minimum(position, BELOW_ONE)], -1).reshape(-1, size + count)
    # A stable sort merges the two ascending lists; before each position stand the particles wholly below it.
    order = np.argsort(both, axis=-1, kind="stable")
    place = np.nonzero(order >= size)[1].reshape(*lead, count)
    return np.asarray(place - np.arange(count), np.intp)


RESAMPLING = {"multinomial": resample_multinomial, "systematic": resample_systematic}


@dataclasses.dataclass(frozen=True)
class SirParams(RandomParams):
    """The particle filter (sampling importance resampling), which draws from the stream of seed, run and role."""

    particles: int = param(500, "number of particles", low=2)
    resampling: str = param("systematic", "how particles are drawn again", choices=tuple(RESAMPLING))


@dataclasses.dataclass(frozen=True)
class Sir:
    """The particle filter; particles that were weighed are drawn again before they move on.

    Attributes
    ----------
    params : SirParams
    runs : tuple of int or None    the runs of a batch, (R, ...), each with its stream; None: that of `params.run` alone
    periods : (n,)                   of axes of the state that wrap; empty: none does
    """

    params: SirParams = SirParams()
    runs: tuple[int, ...] | None = None
    periods: Sequence[float] = ()

    def begin(self, mean: Array, cov: Array) -> SirState:
        """Draw particles of equal weights from N(mean, cov), streams from their beginning.

        Raises
        ------
        LinAlgError    a covariance is not positive definite
        """
        p, runs = self.params, self.runs
        return self._drawn(mean, cov, p.stream() if runs is None else [stream(p.seed, run, p.role) for run in runs])

    def adopt(self, state: SirState, density: Density) -> SirState:
        """Draw from the particles of a density that consists of them, else from the Gaussian of its moments."""
        if isinstance(density, Particles):
            return self._resampled(density, state.rng)
        return self._drawn(*density.moments, state.rng)

    def predict(self, state: SirState, transition: Transition) -> SirState:
        """Move every particle (..., N), x' = f(x) + w, w drawn from N(0, Q)."""
        if (state.log_weight != state.log_weight[..., :1]).any():
            state = self._resampled(state, state.rng)
        points = state.points
        draws = normals(state.rng, (*points.shape[:-1], transition.noise_factor(points).shape[-1]))
        moved = transition.advance(points) + transition.disturbance(points, draws)
        return dataclasses.replace(state, points=moved)

    def update(self, state: SirState, z: Array, sensor: Sensor) -> tuple[SirState, Evidence]:
        """Weigh the particles (..., N) by their likelihood of z = h(x) + v, (..., m).

        Notes    Several sensors are used one after the other, which multiplies their likelihoods, Li 2022 (46).
                 Weights cannot all vanish: they are kept by their logarithms.
        """
        residual = sensor.residual(z[..., None, :], sensor.observe(state.points))
        lower = cholesky(sensor.noise)
        white = residual @ transpose(np.asarray(np.linalg.inv(lower), np.float64))
        scale = np.log(np.diagonal(lower)).sum() + 0.5 * LOG_2PI * len(lower)
        joint = state.log_weight - 0.5 * (white**2).sum(-1) - scale
        total = log_sum_exp(joint)
        return dataclasses.replace(state, log_weight=joint - total[..., None]), Evidence(total)

    def _drawn(self, mean: Array, cov: Array, rng: Generators) -> SirState:
        draws = normals(rng, (*mean.shape[:-1], self.params.particles, mean.shape[-1]))
        points = mean[..., None, :] + draws @ transpose(cholesky(cov))
        return SirState(points, even(points.shape[:-1]), rng, periods=self.periods)

    def _resampled(self, particles: Particles, rng: Generators) -> SirState:
        drawn = RESAMPLING[self.params.resampling](particles, rng, self.params.particles)
        return SirState(drawn.points, drawn.log_weight, rng, periods=self.periods)
