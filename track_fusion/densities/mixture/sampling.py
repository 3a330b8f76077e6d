"""Algorithms 2 and 3 of Ahmed: mixtures learned from weighted samples of a fused mixture; in the log domain.

Each is callable by itself, batched over leading axes, and seeded by the generator it is given. All members of a batch
share the same random numbers, so that a result does not depend on the batch around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import effective_sample_size, log_mean_exp, log_sum_exp, normalised
from track_fusion.densities.mixture.algebra import LogMixture
from track_fusion.densities.mixture.mixture import Factored, Mixture, chosen
from track_fusion.linalg import Array, cholesky, eliminate, is_positive_definite, outer, symmetrise, transpose, whitener


class Weighted(NamedTuple):
    """Samples with importance weights: points (..., S, n), log_weight (..., S), not normalised."""

    points: Array
    log_weight: Array

    @property
    def ess(self) -> Array:
        """Effective sample size (...), Ahmed (40)."""
        return effective_sample_size(self.log_weight)

    @property
    def log_eta(self) -> Array:
        """Logarithm (...) of the integral of what was sampled: very low where the densities are disjoint."""
        return log_mean_exp(self.log_weight)

    def moments(self) -> tuple[Array, Array]:
        """Weighted mean (..., n) and covariance (..., n, n)."""
        share = normalised(self.log_weight)
        mean = (share[..., None, :] @ self.points)[..., 0, :]
        centred = self.points - mean[..., None, :]
        return mean, symmetrise(transpose(share[..., None] * centred) @ centred)


class Learned(NamedTuple):
    """A mixture learned from weighted samples, with the number of iterations and whether they converged (...)."""

    mixture: Mixture
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


#: Expectation maximisation ends when the mean log-likelihood, in nats, grows by less than this in a step.
GROWTH = 1e-5
#: Covariances learned by Algorithm 2 keep this share of the samples' own.
EM_FLOOR = 1e-3
#: A covariance of samples is singular if it is not positive definite without this share of its variances.
SINGULAR = 1e-13


def weighted_em(
    samples: Weighted, count: int, rng: np.random.Generator, steps: int = 500, floor: float = EM_FLOOR
) -> Learned:
    """Algorithm 2: fit a mixture of `count` components to weighted samples by expectation maximisation.

    Starts at `count` samples drawn by their weights, each with the covariance of all samples over
    count^(2/n). A component that dies keeps its place with weight near 0.

    Parameters
    ----------
    samples : Weighted       (..., S)
    count, rng, steps        components, generator, most iterations
    floor : float            smallest covariance, as a share of the samples' own

    Raises
    ------
    ValueError    so few samples have weight that they have no covariance

    References    N. R. Ahmed, Algorithm 2, with the weights normalised.
    """
    points, theta = samples.points, normalised(samples.log_weight)
    n = points.shape[-1]
    mean, cov = samples.moments()
    # Rounding makes some singular covariances positive definite.
    if not is_positive_definite(cov - SINGULAR * np.diagonal(cov, axis1=-2, axis2=-1)[..., None] * np.eye(n)).all():
        raise ValueError(
            f"No mixture can be learned from the samples: no more than {samples.ess.min():.3g} of {points.shape[-2]} "
            "are effective, and their covariance is singular. What they are drawn from is far from what they are to "
            "stand for."
        )
    start = np.cumsum(theta, -1)
    at = (np.arange(count) + rng.random(count)) / count
    picked = np.minimum((start[..., None, :] < at[:, None]).sum(-1), points.shape[-2] - 1)
    centres = np.take_along_axis(points, picked[..., None], -2)
    spread = np.broadcast_to(cov[..., None, :, :] / count ** (2.0 / n), (*centres.shape, n))
    mixture = Mixture(np.full(centres.shape[:-1], 1.0 / count), centres, spread)
    least = np.broadcast_to(cov[..., None, :, :], spread.shape)
    before = np.full(theta.shape[:-1], -np.inf)
    converged, taken = np.zeros(before.shape, bool), np.zeros(before.shape, np.intp)
    for _ in range(steps):
        joint = Factored.of(mixture).joint(points)
        total = log_sum_exp(joint, -2)
        likelihood = (theta * total).sum(-1)
        converged |= likelihood - before < GROWTH
        if converged.all():
            break
        before = likelihood
        new = _maximise(points, np.exp(joint - total[..., None, :]) * theta[..., None, :], mixture, least, floor)
        mixture = chosen(converged, mixture, new)
        taken += ~converged
    return Learned(mixture, converged, taken)


def single_shot_em(samples: Weighted, numerator: LogMixture, floor: float = 0.1, joint: Array | None = None) -> Mixture:
    """Algorithm 3: share weighted samples of a quotient among its mixands once, and match their moments.

    The responsibilities are the true ones: those of the numerator's Gaussians, as the denominator cancels (45).

    Parameters
    ----------
    samples : Weighted          (..., S) of the whole quotient
    numerator : LogMixture      (..., M)
    floor : float               smallest covariance, as a share of the numerator's
    joint : (..., M, S) or None log of the numerator's parts at the samples, if known

    Returns
    -------
    Mixture    (..., M), weights of sum 1; a mixand that no sample belongs to keeps the numerator's moments

    References    N. R. Ahmed, Algorithm 3, eqs. (44)-(45).
    """
    parts = numerator.normalised
    if joint is None:
        joint = numerator.factored.joint(samples.points)
    theta = normalised(samples.log_weight)
    top = joint.max(-2, keepdims=True)
    gamma = np.exp(joint - np.where(np.isfinite(top), top, 0.0))
    total = gamma.sum(-2)
    gamma *= (theta / np.where(total > 0.0, total, 1.0))[..., None, :]
    return _maximise(samples.points, gamma, parts, parts.cov, floor)


#: A component with less than this share of the samples has no moments of its own.
EMPTY = 1e-12


def _maximise(points: Array, gamma: Array, old: Mixture, least: Array, floor: float) -> Mixture:
    """M-step: weights, means and covariances from shares gamma (..., M, S) of the points (..., S, n).

    Covariances are at least `floor` times `least` (..., M, n, n); empty components keep their old moments.
    """
    n, origin = points.shape[-1], points.mean(-2)
    x = points - origin[..., None, :]
    weight = gamma.sum(-1)
    alive = weight > EMPTY
    safe = np.where(alive, weight, 1.0)[..., None]
    some = alive[..., None, None]
    first = gamma @ x / safe
    second = gamma @ outer(x).reshape(*x.shape[:-1], n * n) / safe
    cov = symmetrise(second.reshape(*weight.shape, n, n) - outer(first))
    cov = np.where(some, floored(np.where(some, cov, old.cov), least, floor), old.cov)
    mean = np.where(alive[..., None], first + origin[..., None, :], old.mean)
    total = weight.sum(-1, keepdims=True)
    return Mixture(weight / np.where(total > 0.0, total, 1.0), mean, cov)


def floored(cov: Array, least: Array, floor: float) -> Array:
    """Raise eigenvalues of covariances (..., n, n) relative to `least` to at least `floor`."""
    scale = np.sqrt(np.diagonal(least, axis1=-2, axis2=-1))
    low = ~eliminate((cov - floor * least) / outer(scale), scale)[0]
    if not low.any():
        return cov
    cov = np.array(cov)
    lower = cholesky(np.broadcast_to(least, cov.shape)[low])
    white = whitener(np.broadcast_to(least, cov.shape)[low])
    values, axes = np.linalg.eigh(symmetrise(white @ cov[low] @ transpose(white)))
    root = lower @ axes * np.sqrt(np.maximum(values, floor))[..., None, :]
    cov[low] = symmetrise(root @ transpose(root))
    return cov
