"""Densities of few axes on a grid: moments and divergence by sums. Given by their logarithms, up to a constant."""

from __future__ import annotations

import numpy as np

from track_fusion.densities.log_domain import log_sum_exp, normalised
from track_fusion.linalg import Array


def grid(lower: Array, upper: Array, count: int) -> Array:
    """Cell centres (count^n, n) of a regular grid over the box from `lower` (n,) to `upper` (n,)."""
    edges = [np.linspace(a, b, count + 1) for a, b in zip(lower, upper, strict=True)]
    axes = np.meshgrid(*[0.5 * (e[1:] + e[:-1]) for e in edges], indexing="ij")
    return np.stack([a.ravel() for a in axes], -1)


def kl_on_grid(log_first: Array, log_second: Array) -> Array:
    """Kullback-Leibler divergence first || second (...), in nats, of densities (..., S) on one grid."""
    first, second = (a - log_sum_exp(a)[..., None] for a in (log_first, log_second))
    share = np.exp(first)
    with np.errstate(invalid="ignore"):  # where neither is, there is no ratio, and it does not count
        return np.asarray(np.where(share > 0.0, share * (first - second), 0.0).sum(-1))


def moments_on_grid(log_density: Array, points: Array) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of a density (S,) at the points (S, n) of a grid."""
    share = normalised(log_density)
    mean = share @ points
    centred = points - mean
    return np.asarray(mean), np.asarray((share[:, None] * centred).T @ centred)
