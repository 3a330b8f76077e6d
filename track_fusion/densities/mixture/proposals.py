"""Algorithms 4 and 5 of Ahmed: proposals for quotients of mixtures, sampled as a whole or mixand by mixand.

Batched over leading axes, in the log domain, seeded by the generator they are given; all members of a batch share the
same random numbers, so that a result does not depend on the batch around it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_mean_exp, log_sum_exp, normalised
from track_fusion.densities.mixture.mixture import LOG_2PI, Factored, Mixture, sample
from track_fusion.densities.mixture.quotient import Laplace, Quotient
from track_fusion.densities.mixture.sampling import Weighted, floored, single_shot_em
from track_fusion.linalg import Array, cholesky, logdet, symmetrise, transpose, whitener


def laplace_proposal(part: Laplace, inflation: float = 2.0) -> Mixture:
    """Algorithm 4: a mixture to draw samples of a whole quotient from, by Laplace's approximation of its mixands.

    Parameters
    ----------
    part : Laplace           of (..., M) mixands, each integrable
    inflation : float >= 1   factor on the covariances, for heavier tails

    Returns
    -------
    Mixture    (..., M), weights of sum 1: each mixand's own times its zeroth moment (49), which the paper omits
    """
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
    joint = quotient.numerator.factored.joint(points)
    below = quotient.log_denominator(points) + Factored.of(proposal).log_pdf(points)
    samples = Weighted(points, log_sum_exp(joint, -2) - below)
    return Global(single_shot_em(samples, quotient.numerator, floor, joint), samples)


class Proposal(NamedTuple):
    """One proposal a mixand: N(mean, scale cov) with equal shares of the scales (..., M, H).

    With `above`, the mean (..., M, n) and covariance (..., M, n, n) of another Gaussian, every other sample is drawn
    from that.
    """

    mean: Array
    cov: Array
    scale: Array
    above: tuple[Array, Array] | None = None

    def drawn(self, normal: Array) -> Array:
        """Turn standard normal vectors (M, S, n) into samples (..., M, S, n); scales take turns, and `above` with them.

        So fewer samples still see each of them.
        """
        turn = np.arange(normal.shape[-2])
        stretch = np.sqrt(self.scale)[..., turn % self.scale.shape[-1], None]
        points = self.mean[..., None, :] + stretch * (normal @ transpose(cholesky(self.cov)))
        if self.above is None:
            return points
        mean, cov = self.above
        return np.where(turn[:, None] % 2, points, mean[..., None, :] + normal @ transpose(cholesky(cov)))

    def log_pdf(self, points: Array) -> Array:
        """Log-density at points (..., M, S, n), each mixand's own: (..., M, S)."""
        near = _log_normals(points, self.mean, self.cov, self.scale)
        if self.above is None:
            return near
        far = _log_normals(points, *self.above, np.ones((*self.scale.shape[:-1], 1)))
        return np.asarray(np.logaddexp(near, far) - math.log(2.0))


def inflated_naive(
    quotient: Quotient, first: Mixture, second: Mixture, variance: float = 0.0, order: NDArray[np.intp] | None = None
) -> Proposal:
    """INGIS (52): the naive mean, with the largest by determinant of both components' covariances and variance * 1.

    `order` (..., P) tells which pairs of components the mixands of the quotient are, if not all in their order.
    """
    n = first.mean.shape[-1]
    det1, det2 = logdet(first.cov)[..., :, None], logdet(second.cov)[..., None, :]
    cov = np.where((det1 >= det2)[..., None, None], first.cov[..., :, None, :, :], second.cov[..., None, :, :, :])
    if variance > 0.0:
        small = np.maximum(det1, det2) < n * np.log(variance)
        cov = np.where(small[..., None, None], variance * np.eye(n), cov)
    cov = cov.reshape(*cov.shape[:-4], first.count * second.count, n, n)
    if order is not None:
        cov = np.take_along_axis(cov, order[..., None, None], -3)
    return Proposal(quotient.numerator.mean, cov, np.ones((*cov.shape[:-2], 1)))


def laplace_proposals(part: Laplace) -> Proposal:
    """LAGIS (53): Laplace's approximation of each mixand."""
    return Proposal(part.mean, part.cov, np.ones((*part.log_moment.shape, 1)))


#: Number of scales of the heavy-tailed proposal, and the range in which its largest lies.
SCALES, LEAST_SPREAD, MOST_SPREAD = 5, 2.0, 8.0


def heavy_tail(part: Laplace, wide: Array) -> Proposal:
    """Heavy tail (54): scales in geometric order from 1 up to the largest that `wide` (..., M, n, n) has of Laplace's.

    `wide` is the covariance of the Gaussian above the mixand, (55); the largest scale is clipped to [2, 8].
    """
    white = whitener(part.cov)
    largest = np.linalg.eigvalsh(symmetrise(white @ wide @ transpose(white)))[..., -1]
    top = np.clip(largest, LEAST_SPREAD, MOST_SPREAD)
    return Proposal(part.mean, part.cov, top[..., None] ** np.linspace(0.0, 1.0, SCALES))


def bounded(near: Laplace, mean: Array, cov: Array) -> Proposal:
    """Heavy tail (54), and for every other sample the Gaussian N(mean, cov) above the mixand, (..., M, n).

    Then no importance weight exceeds twice the bound's mass: what the mode does not show, such as the hole that sharp
    components of the denominator make in a wide mixand, is sampled too.
    """
    return heavy_tail(near, cov)._replace(above=(mean, cov))


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
    proposal : Proposal      INGIS, LAGIS, heavy tail or bounded, one a mixand
    rng, count               generator and number of samples a mixand
    floor : float            smallest covariance, as a share of the numerator's

    Returns
    -------
    Local    mixture of weight 1; the zeroth moment (35) is that of the un-normalised mixand

    References    N. R. Ahmed, Algorithm 5, eqs. (35)-(37).
    """
    log_weight, centre, cov = quotient.numerator
    *lead, mixands, n = centre.shape
    x = proposal.drawn(_standard_normals(rng, mixands, count, n))
    log_m = _log_normals(x, centre, cov, np.ones((*log_weight.shape, 1)))
    log_m -= quotient.log_denominator(x.reshape(*lead, mixands * count, n)).reshape(log_m.shape)
    local = Weighted(x, log_m - proposal.log_pdf(x))
    mean, spread = local.moments()
    weight = log_weight + local.log_eta
    return Local(Mixture(normalised(weight), mean, floored(spread, cov, floor)), local.ess, log_sum_exp(weight))


def _standard_normals(rng: np.random.Generator, sets: int, count: int, n: int) -> Array:
    """Draw sets (sets, count, n) of standard normal vectors, each shifted and scaled to mean 0 and covariance 1.

    Matching the moments quarters the number of samples that nearly Gaussian mixands need. Sets too small for
    it stay as they are.
    """
    normal = rng.normal(size=(sets, count, n))
    if count < 4 * n:
        return normal
    normal -= normal.mean(1, keepdims=True)
    return np.asarray(normal @ transpose(whitener(transpose(normal) @ normal / count)))


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
