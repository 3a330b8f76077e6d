"""Algorithms 1 to 5 of Ahmed: importance sampling for the fusion of Gaussian mixtures, in the log domain.

Each is callable by itself, batched over leading axes, and seeded by the generator it is given. All members of a batch
share the same random numbers, so that a result does not depend on the batch around it.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import effective_sample_size, log_mean_exp, log_sum_exp, normalised
from track_fusion.densities.mixture import LOG_2PI, Factored, Mixture, sample
from track_fusion.densities.mixture_algebra import LogMixture, power, product
from track_fusion.densities.mixture_quotient import Laplace, Quotient, laplace
from track_fusion.linalg import Array, cholesky, eliminate, matvec, outer, symmetrise, transpose, whitener
from track_fusion.optimise import minimise_on_interval


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


class Omega(NamedTuple):
    """What Algorithm 1 gives: omega (...), samples weighted for it, how the search went (...)."""

    omega: Array
    samples: Weighted
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


#: Exponent of the proposal of Algorithm 1; the paper's choice.
PROPOSAL_OMEGA = 0.5


def optimise_omega(
    first: Mixture,
    second: Mixture,
    rng: np.random.Generator,
    count: int,
    criterion: str = "chernoff",
    omega: Array | None = None,
) -> Omega:
    """Algorithm 1: find the exponent of the weighted exponential product and samples of it.

    Parameters
    ----------
    first, second : Mixture    (..., C1), (..., C2), normalised; the leading axes are equal
    rng, count                 generator and number of samples
    criterion : str            chernoff (9), minimax_information_loss (11)
    omega : (...) or None      given exponent, instead of any criterion

    Returns
    -------
    Omega    the samples' weights are p_i^omega p_j^(1 - omega) / q

    Notes         The proposal q is the component-wise product of powers at 1/2, (49)-(51) of Li 2019. It has the
                  components of (14)-(16) of Ahmed, but weights that count their overlap, and at 1/2
                  lies above the target up to a constant, so the importance weights are bounded. On
                  fixed samples both criteria are convex and smooth in omega: Newton's method.
    References    N. R. Ahmed, Decentralized Gaussian Mixture Fusion through Unified Quotient Approximations,
                  Algorithm 1, eqs. (8)-(11), (18)-(21), kappa of (21) normalised.
    """
    proposal = product(power(LogMixture.of(first), PROPOSAL_OMEGA), power(LogMixture.of(second), 1 - PROPOSAL_OMEGA))
    drawn = proposal.normalised
    points = sample(drawn, rng, count).points
    log_first, log_second = Factored.of(first).log_pdf(points), Factored.of(second).log_pdf(points)
    log_q = Factored.of(drawn).log_pdf(points)
    lead = log_q.shape[:-1]
    converged, iterations = np.ones(lead, bool), np.zeros(lead, np.intp)
    if omega is None:
        contrast, base = log_first - log_second, log_second - log_q
        if criterion == "chernoff":
            pull = np.zeros(lead)
        else:
            naive = normalised(log_first + log_second - log_q)
            pull = -(naive * contrast).sum(-1)  # kappa of (21)
        omega, converged, iterations = _minimise(contrast, base, pull)
    weight = omega[..., None] * log_first + (1.0 - omega[..., None]) * log_second - log_q
    return Omega(omega, Weighted(points, weight), converged, iterations)


def _minimise(contrast: Array, base: Array, pull: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.intp]]:
    """Minimise omega * pull + log mean exp(omega contrast + base) over [0, 1], arrays (..., S) and (...)."""
    lead, count = pull.shape, contrast.shape[-1]
    contrast, base, flat = contrast.reshape(-1, count), base.reshape(-1, count), pull.reshape(-1)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        c = contrast[rows]
        share = normalised(w[:, None] * c + base[rows])
        mean = (share * c).sum(-1)
        return flat[rows] + mean, (share * (c - mean[:, None]) ** 2).sum(-1)

    found = minimise_on_interval(derivatives, flat.size)
    return found.weights.reshape(lead), found.converged.reshape(lead), found.iterations.reshape(lead)


class Learned(NamedTuple):
    """A mixture learned from weighted samples, with the number of iterations and whether they converged (...)."""

    mixture: Mixture
    converged: NDArray[np.bool_]
    iterations: int


#: Expectation maximisation ends when the mean log-likelihood, in nats, grows by less than this in a step.
GROWTH = 1e-6
#: Covariances learned by Algorithm 2 keep this share of the samples' own.
EM_FLOOR = 1e-3


def weighted_em(
    samples: Weighted, count: int, rng: np.random.Generator, steps: int = 100, floor: float = EM_FLOOR
) -> Learned:
    """Algorithm 2: fit a mixture of `count` components to weighted samples by expectation maximisation.

    Starts at `count` samples drawn by their weights, each with the covariance of all samples over
    count^(2/n). A component that dies keeps its place with weight near 0.

    Parameters
    ----------
    samples : Weighted       (..., S)
    count, rng, steps        components, generator, most iterations
    floor : float            smallest covariance, as a share of the samples' own

    References    N. R. Ahmed, Algorithm 2, with the weights normalised.
    """
    points, theta = samples.points, normalised(samples.log_weight)
    n = points.shape[-1]
    mean, cov = samples.moments()
    start = np.cumsum(theta, -1)
    at = (np.arange(count) + rng.random(count)) / count
    chosen = np.minimum((start[..., None, :] < at[:, None]).sum(-1), points.shape[-2] - 1)
    centres = np.take_along_axis(points, chosen[..., None], -2)
    spread = np.broadcast_to(cov[..., None, :, :] / count ** (2.0 / n), (*centres.shape, n))
    mixture = Mixture(np.full(centres.shape[:-1], 1.0 / count), centres, spread)
    least = np.broadcast_to(cov[..., None, :, :], spread.shape)
    before = np.full(theta.shape[:-1], -np.inf)
    converged, step = np.zeros(before.shape, bool), 0
    for step in range(1, steps + 1):
        joint = Factored.of(mixture).joint(points)
        total = log_sum_exp(joint, -2)
        likelihood = (theta * total).sum(-1)
        converged = np.abs(likelihood - before) < GROWTH
        if converged.all():
            break
        before = likelihood
        mixture = _maximise(points, np.exp(joint - total[..., None, :]) * theta[..., None, :], mixture, least, floor)
    return Learned(mixture, converged, step)


def single_shot_em(
    samples: Weighted, numerator: LogMixture, floor: float = 0.1, joint: Array | None = None
) -> Mixture:
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
        joint = Factored.of(parts, numerator.log_weight).joint(samples.points)
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
    first = gamma @ x / safe
    second = gamma @ outer(x).reshape(*x.shape[:-1], n * n) / safe
    cov = symmetrise(second.reshape(*weight.shape, n, n) - outer(first))
    cov = np.where(alive[..., None, None], floored(np.where(alive[..., None, None], cov, old.cov), least, floor), old.cov)
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


# Exact fusion: proposals.


def laplace_proposal(quotient: Quotient, inflation: float = 2.0, found: Laplace | None = None) -> Mixture:
    """Algorithm 4: a mixture to draw samples of a whole quotient from, by Laplace's approximation of its mixands.

    Parameters
    ----------
    quotient : Quotient          (..., M) mixands, each integrable
    inflation : float >= 1       factor on the covariances, for heavier tails
    found : Laplace or None      the approximation, if known

    Returns
    -------
    Mixture    (..., M), weights of sum 1: each mixand's own times its zeroth moment (49), which the paper omits
    """
    part = laplace(quotient) if found is None else found
    return Mixture(normalised(part.log_moment), part.mean, inflation * part.cov)


class Global(NamedTuple):
    """What indirect global sampling gives: the fused mixture (..., M) and the samples behind it."""

    mixture: Mixture
    samples: Weighted


def indirect_global_sampling(
    quotient: Quotient, proposal: Mixture, rng: np.random.Generator, count: int, floor: float = 0.1
) -> Global:
    """IGS for exact fusion: samples of a whole quotient from one proposal, shared out by Algorithm 3.

    Parameters
    ----------
    quotient : Quotient      (..., M) mixands
    proposal : Mixture       (..., C), by :func:`laplace_proposal`
    rng, count, floor        generator, number of samples in all, smallest covariance as in `single_shot_em`
    """
    points = sample(proposal, rng, count).points
    weight, mean, cov = quotient.numerator
    joint = Factored.of(Mixture(np.ones(weight.shape), mean, cov), weight).joint(points)
    below = quotient.log_denominator(points) + Factored.of(proposal).log_pdf(points)
    samples = Weighted(points, log_sum_exp(joint, -2) - below)
    return Global(single_shot_em(samples, quotient.numerator, floor, joint), samples)


class Proposal(NamedTuple):
    """One proposal a mixand: N(mean, scale cov) with equal shares of the scales (..., M, H)."""

    mean: Array
    cov: Array
    scale: Array


def inflated_naive(quotient: Quotient, first: Mixture, second: Mixture, variance: float = 0.0) -> Proposal:
    """INGIS (52): the naive mean, with the largest by determinant of both components' covariances and variance * 1."""
    n, shape = first.mean.shape[-1], quotient.numerator.cov.shape
    one = np.broadcast_to(first.cov[..., :, None, :, :], (*shape[:-3], first.count, second.count, n, n))
    other = np.broadcast_to(second.cov[..., None, :, :, :], one.shape)
    det = [_logdet(c).reshape(shape[:-2]) for c in (one, other)]
    cov = np.where((det[0] >= det[1])[..., None, None], one.reshape(shape), other.reshape(shape))
    if variance > 0.0:
        small = np.maximum(*det) < n * np.log(variance)
        cov = np.where(small[..., None, None], variance * np.eye(n), cov)
    return Proposal(quotient.numerator.mean, cov, np.ones((*shape[:-2], 1)))


def _logdet(cov: Array) -> Array:
    return np.asarray(np.linalg.slogdet(cov)[1])


def laplace_proposals(found: Laplace) -> Proposal:
    """LAGIS (53): Laplace's approximation of each mixand."""
    return Proposal(found.mean, found.cov, np.ones((*found.log_moment.shape, 1)))


#: Number of scales of the heavy-tailed proposal, and the range in which its largest lies.
SCALES, LEAST_SPREAD, MOST_SPREAD = 5, 2.0, 8.0


def heavy_tail(found: Laplace, wide: Array) -> Proposal:
    """Heavy tail (54): scales in geometric order from 1 up to the largest that `wide` (..., M, n, n) has of Laplace's.

    `wide` is the covariance of the Gaussian above the mixand, (55); the largest scale is clipped to [2, 8].
    """
    white = whitener(found.cov)
    largest = np.linalg.eigvalsh(symmetrise(white @ wide @ transpose(white)))[..., -1]
    top = np.clip(largest, LEAST_SPREAD, MOST_SPREAD)
    return Proposal(found.mean, found.cov, top[..., None] ** np.linspace(0.0, 1.0, SCALES))


@dataclasses.dataclass(frozen=True)
class Local:
    """What Algorithm 5 gives: the fused mixture (..., M), ESS of each mixand (..., M), log of the integral (...)."""

    mixture: Mixture
    ess: Array
    log_eta: Array


def direct_local_sampling(
    quotient: Quotient, proposal: Proposal, rng: np.random.Generator, count: int, floor: float = 0.05
) -> Local:
    """Algorithm 5: match each mixand of a quotient by a Gaussian, from samples of its own.

    Parameters
    ----------
    quotient : Quotient      (..., M) mixands, each integrable
    proposal : Proposal      INGIS, LAGIS or heavy tail, one a mixand
    rng, count               generator and number of samples a mixand
    floor : float            smallest covariance, as a share of the numerator's

    Returns
    -------
    Local    mixture of weight 1; the zeroth moment (35) is that of the un-normalised mixand

    References    N. R. Ahmed, Algorithm 5, eqs. (35)-(37).
    """
    log_weight, centre, cov = quotient.numerator
    (*lead, mixands, n), scales = centre.shape, proposal.scale.shape[-1]
    normal = rng.normal(size=(mixands, count, n))
    # Scales take turns, so that fewer samples still see each of them.
    stretch = np.sqrt(proposal.scale)[..., np.arange(count) % scales, None]
    x = proposal.mean[..., None, :] + stretch * (normal @ transpose(cholesky(proposal.cov)))
    log_m = _log_normals(x, centre, cov, np.ones((*log_weight.shape, 1)))
    log_m -= quotient.log_denominator(x.reshape(*lead, mixands * count, n)).reshape(log_m.shape)
    theta = log_m - _log_normals(x, proposal.mean, proposal.cov, proposal.scale)
    local = Weighted(x, theta)
    mean, spread = local.moments()
    weight = log_weight + local.log_eta
    found = Mixture(normalised(weight), mean, floored(spread, cov, floor))
    return Local(found, local.ess, log_sum_exp(weight))


def _log_normals(x: Array, mean: Array, cov: Array, scale: Array) -> Array:
    """Log-density (..., M, S) of the mean over scales of N(mean, scale cov), one of M for each set of points."""
    white = whitener(cov)
    z = (x - mean[..., None, :]) @ transpose(white)
    half = -0.5 * (z * z).sum(-1)
    half_logdet = np.log(np.diagonal(white, axis1=-2, axis2=-1)).sum(-1)[..., None]
    constant = half_logdet - 0.5 * x.shape[-1] * LOG_2PI
    if scale.shape[-1] == 1:
        return np.asarray(half / scale + constant - 0.5 * x.shape[-1] * np.log(scale))
    each = half[..., None, :] / scale[..., None] - 0.5 * x.shape[-1] * np.log(scale)[..., None]
    return np.asarray(log_mean_exp(each, -2) + constant)


# Which mixands to sample.


class Pruned(NamedTuple):
    """The mixands worth sampling, heaviest bound first, and which of them (..., P) are kept.

    `share` (...) bounds how much of the fused density's weight was dropped.
    """

    quotient: Quotient
    order: NDArray[np.intp]
    keep: NDArray[np.bool_]
    share: Array


def prune_mixands(quotient: Quotient, bound: Array, likely: Array, nats: float = 14.0) -> Pruned:
    """Drop mixands whose upper bound (..., M) lies `nats` below the largest of min(likely, bound).

    Parameters
    ----------
    bound : (..., M)     log of an upper bound on each mixand's weight, (56); infinite where there is none
    likely : (..., M)    log of an estimate of it, by Laplace: the bound alone may be far too high

    Returns
    -------
    Pruned    the weights of mixands not kept are minus infinity
    """
    top = np.minimum(likely, bound).max(-1, keepdims=True)
    keep = bound >= top - nats
    order = np.argsort(np.where(keep, -bound, np.inf), axis=-1, kind="stable")
    most = int(keep.sum(-1).max(initial=1))
    order = order[..., :most]
    kept = np.take_along_axis(keep, order, -1)
    less = quotient.take(order)
    numerator = less.numerator._replace(log_weight=np.where(kept, less.numerator.log_weight, -np.inf))
    lost = log_sum_exp(np.where(keep, -np.inf, bound)) - log_sum_exp(np.where(keep, np.minimum(likely, bound), -np.inf))
    return Pruned(dataclasses.replace(less, numerator=numerator), order, kept, np.exp(np.minimum(lost, 0.0)))
