"""The sampling-importance-resampling (SIR) particle filter, in the log domain, batched over runs.

Every function that draws takes a generator, or one generator a run: a run then draws the same numbers
whatever batch it is computed in.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_of, log_sum_exp
from track_fusion.linalg import Array, cholesky, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition
from track_fusion.random_streams import Generators, exponentials, normals, uniforms

LOG_2PI = float(np.log(2.0 * np.pi))
#: The largest double below one.
BELOW_ONE = float(np.nextafter(1.0, 0.0))


@dataclasses.dataclass(frozen=True)
class Particles:
    """Weighted samples of a density.

    Attributes
    ----------
    points : (..., N, n)
    log_weight : (..., N)    logarithms of weights that sum to one
    """

    points: Array
    log_weight: Array

    @property
    def count(self) -> int:
        """Number of particles N."""
        return int(self.points.shape[-2])

    @property
    def weight(self) -> Array:
        """Weights (..., N)."""
        return np.exp(self.log_weight)


def from_gaussian(mean: Array, cov: Array, rng: Generators, count: int) -> Particles:
    """Draw `count` particles of N(mean, cov) with equal weights.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)    positive definite
    rng : Generators
    count : int

    Raises
    ------
    LinAlgError    a covariance is not positive definite
    """
    draws = normals(rng, (*mean.shape[:-1], count, mean.shape[-1]))
    points = mean[..., None, :] + draws @ transpose(cholesky(cov))
    return Particles(points, _even(points.shape[:-1]))


def _even(shape: tuple[int, ...]) -> Array:
    return np.full(shape, -np.log(shape[-1]))


def moments(particles: Particles) -> tuple[Array, Array]:
    """Mean (..., n) and covariance (..., n, n): the particles' conversion to a Gaussian.

    The covariance is that of the weighted samples; it is singular when n or fewer of them carry all weight.
    """
    origin = particles.points[..., :1, :]
    offset, weight = particles.points - origin, particles.weight
    shift = weight[..., None, :] @ offset
    offset -= shift
    return (origin + shift)[..., 0, :], symmetrise(transpose(weight[..., None] * offset) @ offset)


def effective_sample_size(particles: Particles) -> Array:
    """Return 1 / (sum of squared weights), between 1 and N: (...)."""
    return np.asarray(np.exp(-log_sum_exp(2.0 * particles.log_weight)))


def predict(particles: Particles, transition: Transition, rng: Generators) -> Particles:
    """Move every particle, x' = f(x) + w, w drawn from N(0, Q).

    Parameters
    ----------
    particles : Particles    (..., N)
    transition : Transition
    rng : Generators
    """
    points = particles.points
    draws = normals(rng, (*points.shape[:-1], transition.noise_factor(points).shape[-1]))
    return Particles(transition.advance(points) + transition.disturbance(points, draws), particles.log_weight)


def update(particles: Particles, z: Array, sensor: Sensor) -> tuple[Particles, Array]:
    """Weigh the particles by their likelihood of z = h(x) + v; nothing is resampled.

    Parameters
    ----------
    particles : Particles    (..., N)
    z : (..., m)
    sensor : Sensor

    Returns
    -------
    Particles, log-likelihood of z (...)

    Notes    Several sensors are used one after the other, which multiplies their likelihoods, Li 2022 (46).
             Weights cannot all vanish: they are kept by their logarithms.
    """
    residual = sensor.residual(z[..., None, :], sensor.observe(particles.points))
    lower = cholesky(sensor.noise)
    white = residual @ transpose(np.asarray(np.linalg.inv(lower), np.float64))
    scale = np.log(np.diagonal(lower)).sum() + 0.5 * LOG_2PI * len(lower)
    joint = particles.log_weight - 0.5 * (white**2).sum(-1) - scale
    total = log_sum_exp(joint)
    return Particles(particles.points, joint - total[..., None]), total


def union(sets: Sequence[Particles], weights: Array) -> Particles:
    """Join K sets of particles: the arithmetic average of their densities, a particle density itself.

    Parameters
    ----------
    sets : K Particles, (..., N_i) each
    weights : (..., K)    non-negative, sum one
    """
    share = log_of(weights)
    lead = np.broadcast_shapes(*(s.points.shape[:-2] for s in sets), weights.shape[:-1])
    points = [np.broadcast_to(s.points, (*lead, *s.points.shape[-2:])) for s in sets]
    logs = [np.broadcast_to(s.log_weight + share[..., i, None], (*lead, s.count)) for i, s in enumerate(sets)]
    return Particles(np.concatenate(points, -2), np.concatenate(logs, -1))


def take(particles: Particles, index: NDArray[np.intp]) -> Particles:
    """Pick particles (..., M) by index, with equal weights."""
    *lead, count, n = particles.points.shape
    sets = int(np.prod(lead))
    rows = index.reshape(sets, index.shape[-1]) + count * np.arange(sets)[:, None]
    points = particles.points.reshape(sets * count, n)[rows]
    return Particles(points.reshape(*index.shape, n), _even(index.shape))


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
