"""Fewer components: greedy merging by Runnalls or Salmond, pruning, and keeping the heaviest.

No axis wraps here: rules are given mixtures relative to a reference, filters hold theirs unrolled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.mixture.mixture import Mixture, moments
from track_fusion.linalg import Array, cholesky, logdet, matvec, outer, symmetrise, whitener

#: Pairs whose merged covariances are factored at once: few enough to stay in the cache.
PAIRS = 512


class Parts(NamedTuple):
    """Components: weight w (...), entropy term w log det P (...), mean (..., n) and scatter w P (..., n, n)."""

    weight: Array
    entropy: Array
    mean: Array
    scatter: Array

    @classmethod
    def of(cls, rows: Array, n: int) -> Parts:
        """Name the numbers of rows (..., 2 + n + n^2), without copying."""
        scatter = rows[..., 2 + n :]
        return cls(rows[..., 0], rows[..., 1], rows[..., 2 : 2 + n], scatter.reshape(*scatter.shape[:-1], n, n))


#: (components, others) -> cost of merging each with each, broadcast
Cost = Callable[[Parts, Parts], Array]


def runnalls(mixture: Mixture, count: int) -> Mixture:
    """Merge the pair of least cost until `count` components are left.

    The cost of a pair, half of (w_i + w_j) log det P_ij - w_i log det P_i - w_j log det P_j, bounds by how
    much the merger raises the Kullback-Leibler divergence from the original. Each merger keeps the mixture's
    mean and covariance.

    Parameters
    ----------
    mixture : Mixture    (..., C)
    count : int >= 1     components to keep, the same for every mixture of the batch

    Returns
    -------
    Mixture    (..., min(C, count))

    Raises
    ------
    ValueError     count is not positive
    LinAlgError    a covariance is not positive definite

    Notes         All pair costs are computed once, C^2 n^3 / 2; each merger renews one row of them.
                  Components of weight 0 merge at no cost, so padding vanishes first.
    References    A. R. Runnalls, Kullback-Leibler approach to Gaussian mixture reduction, 2007, eq. (21).
    """
    return _merge_pairs(mixture, count, _runnalls_cost)


def salmond(mixture: Mixture, count: int) -> Mixture:
    """Merge the closest pair until `count` components are left: Salmond's joining algorithm.

    The distance of a pair is w_i w_j / (w_i + w_j) (m_i - m_j)' P^-1 (m_i - m_j) with the covariance P of the
    whole mixture: how much of it moves from between to within components. Parameters, results and errors are
    those of :func:`runnalls`.

    References    D. J. Salmond, Mixture reduction algorithms for point and extended object tracking in
                  clutter, 2009.
    """
    n = mixture.mean.shape[-1]
    white = whitener(moments(mixture)[1]).reshape(-1, 1, n, n)

    def cost(first: Parts, second: Parts) -> Array:
        z = matvec(white, first.mean - second.mean)
        return np.asarray(first.weight * second.weight / (first.weight + second.weight) * (z * z).sum(-1))

    return _merge_pairs(mixture, count, cost)


def _runnalls_cost(first: Parts, second: Parts) -> Array:
    weight, n = first.weight + second.weight, first.mean.shape[-1]
    gap = first.mean - second.mean
    gap *= np.sqrt(first.weight * second.weight / weight)[..., None]
    scatter = outer(gap)
    scatter += first.scatter
    scatter += second.scatter
    diagonal = cholesky(scatter).reshape(*weight.shape, n * n)[..., :: n + 1]
    half_logdet: Array = np.log(diagonal) @ np.ones(n) - 0.5 * n * np.log(weight)
    half_logdet *= weight
    half_logdet -= 0.5 * (first.entropy + second.entropy)
    return half_logdet


#: Stands for no weight, so that a component without it can be merged like any other; no weight comes near it.
WEIGHTLESS = 1e-200
#: Components that are gone are cleared away when so small a share is left.
COMPACT_AT = 0.8


def _merge_pairs(mixture: Mixture, count: int, cost: Cost) -> Mixture:
    """Merge greedily, every mixture of the batch one pair a step."""
    if count < 1:
        raise ValueError(f"The 'count' of components must be >= 1. Got {count}.")
    (*lead, size), n = mixture.weight.shape, mixture.mean.shape[-1]
    if size <= count:
        return mixture
    weight, cov = np.maximum(mixture.weight, WEIGHTLESS).reshape(-1, size), mixture.cov.reshape(-1, size, n, n)
    entropy, scatter = weight * logdet(cov), (weight[..., None, None] * cov).reshape(-1, size, n * n)
    mean = mixture.mean.reshape(-1, size, n)
    parts = np.concatenate([weight[..., None], entropy[..., None], mean, scatter], -1)
    costs, gone = _all_costs(parts, n, cost), np.zeros(weight.shape)
    for left in range(size, count, -1):
        if left < COMPACT_AT * costs.shape[-1]:
            parts, costs, gone = _compacted(parts, costs, gone, left)
        _merge_cheapest(parts, costs, gone, n, cost)
    kept = Parts.of(_compacted(parts, costs, gone, count)[0], n)
    cov = symmetrise(kept.scatter / kept.weight[..., None, None])
    weight = np.where(kept.weight > size * WEIGHTLESS, kept.weight, 0.0)
    mean = kept.mean.reshape(*lead, count, n)
    return Mixture(weight.reshape(*lead, count), mean, cov.reshape(*lead, count, n, n))


def _all_costs(parts: Array, n: int, cost: Cost) -> Array:
    """Costs of all pairs, (B, C, C), infinite on the diagonal."""
    batch, size = parts.shape[:2]
    costs = np.full((batch, size, size), np.inf)
    first, second = np.triu_indices(size, 1)
    step = max(1, PAIRS // max(batch, 1))
    for at in range(0, len(first), step):
        i, j = first[at : at + step], second[at : at + step]
        costs[:, i, j] = costs[:, j, i] = cost(Parts.of(parts[:, i], n), Parts.of(parts[:, j], n))
    return costs


def _merge_cheapest(parts: Array, costs: Array, gone: Array, n: int, cost: Cost) -> None:
    """Merge, in each mixture, the cheapest pair i < j into i, in place; `gone` becomes infinite at j."""
    batch, size = gone.shape
    rows = np.arange(batch)
    cheapest = costs.reshape(batch, size * size).argmin(1)
    i, j = np.divmod(cheapest, size)
    one, other = parts[rows, i], parts[rows, j]
    merged = one + other
    gap = other[:, 2 : 2 + n] - one[:, 2 : 2 + n]
    share = other[:, :1] / merged[:, :1]
    merged[:, 1] += 2.0 * costs[rows, i, j]  # Runnalls' cost is half the growth of the entropy terms
    merged[:, 2 : 2 + n] = one[:, 2 : 2 + n] + share * gap
    merged[:, 2 + n :] += (one[:, :1] * share) * outer(gap).reshape(batch, n * n)
    parts[rows, i] = merged
    gone[rows, j] = costs[rows, j] = costs[rows, :, j] = np.inf
    fresh = cost(Parts.of(merged[:, None], n), Parts.of(parts, n))
    fresh += gone
    fresh[rows, i] = np.inf
    costs[rows, i] = costs[rows, :, i] = fresh


def _compacted(parts: Array, costs: Array, gone: Array, left: int) -> tuple[Array, Array, Array]:
    """Clear away the components that are gone: `left` remain of each mixture, in their order."""
    rows = np.arange(len(costs))[:, None]
    alive = np.argsort(gone, axis=1, kind="stable")[:, :left]
    return parts[rows, alive], costs[rows[..., None], alive[:, :, None], alive[:, None, :]], np.zeros(alive.shape)


def cap(mixture: Mixture, count: int) -> Mixture:
    """Keep the `count` heaviest components, in falling order, and scale them to the old total weight.

    Raises
    ------
    ValueError    count is not positive
    """
    if count < 1:
        raise ValueError(f"The 'count' of components must be >= 1. Got {count}.")
    if mixture.count <= count:
        return mixture
    heaviest = np.argsort(-mixture.weight, axis=-1, kind="stable")[..., :count]
    return _rescaled(mixture.take(heaviest), mixture.weight.sum(-1))


def prune(mixture: Mixture, share: float) -> tuple[Mixture, Array]:
    """Drop components lighter than `share` of the total weight, and scale the rest to it.

    The heaviest component always stays. What is dropped has weight 0 where another mixture of the batch has
    more components left.

    Parameters
    ----------
    mixture : Mixture             (..., C)
    share : float in [0, 1)

    Returns
    -------
    Mixture        components in falling order of weight, as many as the largest mixture has left
    dropped (...)  share of the weight that was dropped
    """
    order = np.argsort(-mixture.weight, axis=-1, kind="stable")
    ordered = mixture.take(order)
    total = mixture.weight.sum(-1)
    keep = ordered.weight >= share * total[..., None]
    keep[..., 0] = True
    count = int(keep.sum(-1).max(initial=1))
    weight = np.where(keep, ordered.weight, 0.0)
    kept = Mixture(weight[..., :count], ordered.mean[..., :count, :], ordered.cov[..., :count, :, :])
    dropped = 1.0 - weight.sum(-1) / np.where(total > 0.0, total, 1.0)
    return _rescaled(kept, total), np.asarray(np.maximum(dropped, 0.0))


def _rescaled(mixture: Mixture, total: NDArray[np.float64]) -> Mixture:
    now = mixture.weight.sum(-1)
    factor = total / np.where(now > 0.0, now, 1.0)
    return Mixture(mixture.weight * factor[..., None], mixture.mean, mixture.cov)


#: How to get from many components to at most a given number.
REDUCTIONS: dict[str, Callable[[Mixture, int], Mixture]] = {"runnalls": runnalls, "salmond": salmond, "cap": cap}
