"""Kullback-Leibler divergence between Gaussian mixtures: bounds, on a grid, and by Monte Carlo with its error."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from track_fusion.densities.gaussian import kl_divergence
from track_fusion.densities.log_domain import log_of, log_sum_exp, normalised
from track_fusion.densities.mixture.algebra import log_normal
from track_fusion.densities.mixture.mixture import LOG_2PI, Factored, Mixture, sample
from track_fusion.linalg import Array, logdet


def kl_bounds(first: Mixture, second: Mixture) -> tuple[Array, Array]:
    """Bounds in closed form on the divergence of mixtures first || second, in nats.

    Parameters
    ----------
    first, second : Mixture    (..., C1), (..., C2) components; weights are normalised first

    Returns
    -------
    lower, upper (...)    lower may be negative, where zero is the better bound

    Notes         Each term E log p under a component is bounded from above by Jensen's inequality through the
                  overlap of components, and from below by the variational bound through their divergences.
                  Both bounds are exact for one component only if the divergence is 0 (lower) or always (upper).
    References    J.-L. Durrieu, J.-P. Thiran, F. Kelly, Lower and upper bounds for approximation of the
                  Kullback-Leibler divergence between Gaussian mixture models, 2012.
    """
    first, second = first.normalised, second.normalised
    entropy = 0.5 * (logdet(first.cov) + first.mean.shape[-1] * (LOG_2PI + 1.0))
    own_low, own_high = _expected_log(first, first, entropy)
    other_low, other_high = _expected_log(first, second, entropy)
    weight = first.weight
    lower = np.where(weight > 0, weight * (own_low - other_high), 0.0).sum(-1)
    upper = np.where(weight > 0, weight * (own_high - other_low), 0.0).sum(-1)
    return np.asarray(lower), np.asarray(upper)


def _expected_log(first: Mixture, second: Mixture, entropy: Array) -> tuple[Array, Array]:
    """Bounds on the mean of log `second` under each component of `first`, (..., C1) each."""
    mean, cov = first.mean[..., :, None, :], first.cov[..., :, None, :, :]
    other_mean, other_cov = second.mean[..., None, :, :], second.cov[..., None, :, :, :]
    log_weight = log_of(second.weight)[..., None, :]
    apart = kl_divergence(mean, cov, other_mean, other_cov)
    overlap = log_normal(mean - other_mean, cov + other_cov)
    return log_sum_exp(log_weight - apart) - entropy, log_sum_exp(log_weight + overlap)


class Estimate(NamedTuple):
    """A Monte Carlo estimate (...) and its standard error (...)."""

    value: Array
    error: Array


def kl_monte_carlo(first: Mixture, second: Mixture, rng: np.random.Generator, count: int = 1000) -> Estimate:
    """Divergence first || second by `count` samples of the first, in nats, with its standard error.

    Notes    The error is that of independent samples; components are drawn systematically, so the true one
             is no larger.
    """
    first, second = first.normalised, second.normalised
    points = sample(first, rng, count).points
    excess = Factored.of(first).log_pdf(points) - Factored.of(second).log_pdf(points)
    return Estimate(excess.mean(-1), excess.std(-1, ddof=1) / np.sqrt(count))


#: points (S, n) -> log-density (S,), up to a constant
LogDensity = Callable[[Array], Array]


def grid(lower: Array, upper: Array, count: int) -> Array:
    """Cell centres (count^n, n) of a regular grid over the box from `lower` (n,) to `upper` (n,)."""
    edges = [np.linspace(a, b, count + 1) for a, b in zip(lower, upper, strict=True)]
    axes = np.meshgrid(*[0.5 * (e[1:] + e[:-1]) for e in edges], indexing="ij")
    return np.stack([a.ravel() for a in axes], -1)


def kl_on_grid(first: LogDensity, second: LogDensity, points: Array) -> float:
    """Divergence first || second of two densities on the same grid, each normalised there; for up to three axes."""
    log_first, log_second = first(points), second(points)
    log_first, log_second = log_first - log_sum_exp(log_first), log_second - log_sum_exp(log_second)
    share = normalised(log_first)
    used = share > 0
    return float((share[used] * (log_first[used] - log_second[used])).sum())


def moments_on_grid(density: LogDensity, points: Array) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of a density on a grid."""
    share = normalised(density(points))
    mean = share @ points
    centred = points - mean
    return np.asarray(mean), np.asarray((share[:, None] * centred).T @ centred)
