"""Fusion weights by themselves: no other weights are better by the objective written out; laws of every way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from rules.examples import covariances
from scipy.stats import multivariate_normal

from track_fusion.linalg import Array
from track_fusion.solvers.optimise import Solution
from track_fusion.weights.bound import bound_weights
from track_fusion.weights.merging import merging_weights
from track_fusion.weights.pooling import chernoff_weights, minimax_weights

Objective = Callable[[Array, Array, Array], float]


def diversity(weights: Array, mean: Array, cov: Array) -> float:
    """Li 2022 (40), to be least: sum of w_i log det P_i - log det P_AA."""
    centre = weights @ mean
    merged = sum(w * (p + np.outer(m - centre, m - centre)) for w, m, p in zip(weights, mean, cov, strict=True))
    return float(weights @ np.linalg.slogdet(cov)[1] - np.linalg.slogdet(merged)[1])


def bound(weights: Array, mean: Array, cov: Array) -> float:
    """Li 2022 (45)."""
    z = [
        [multivariate_normal.pdf(x, y, p + q) for y, q in zip(mean, cov, strict=True)]
        for x, p in zip(mean, cov, strict=True)
    ]
    return float(weights @ (0.5 * np.linalg.slogdet(cov)[1] + np.log(np.array(z) @ weights)))


def pooled(weights: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    info = np.linalg.inv(cov)
    whole = np.linalg.inv(np.einsum("k,kij->ij", weights, info))
    return whole @ np.einsum("k,kij,kj->i", weights, info, mean), whole


def log_mass(weights: Array, mean: Array, cov: Array) -> float:
    """log of the integral of the product of p_i^w_i: its value at the mode over that of the normalised average."""
    centre, whole = pooled(weights, mean, cov)
    logs = [w * multivariate_normal.logpdf(centre, m, p) for w, m, p in zip(weights, mean, cov, strict=True)]
    return float(sum(logs) - multivariate_normal.logpdf(centre, centre, whole))


def loss(weights: Array, mean: Array, cov: Array) -> float:
    """Divergence of the naive product from the average at these weights."""
    (a, p), (b, q) = pooled(np.ones(len(mean)), mean, cov), pooled(weights, mean, cov)
    ratio, shift = np.linalg.solve(q, p), a - b
    return float(0.5 * (np.trace(ratio) - np.linalg.slogdet(ratio)[1] + shift @ np.linalg.solve(q, shift)))


WAYS = pytest.mark.parametrize(
    ("way", "objective"),
    [(merging_weights, diversity), (bound_weights, bound), (chernoff_weights, log_mass), (minimax_weights, loss)],
)
Way = Callable[[Array, Array], Solution]


@WAYS
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("batch", [0, 1, 9])
def test_no_weights_are_better(way: Way, objective: Objective, batch: int, count: int) -> None:
    rng = np.random.default_rng(count)
    mean, cov = rng.normal(size=(batch, count, 3)), covariances(rng, batch, count, n=3)
    solution = way(mean, cov)
    assert solution.weights.shape == (batch, count)
    assert solution.converged.all()
    np.testing.assert_allclose(solution.weights.sum(1), 1.0, atol=1e-12)
    assert (solution.weights >= 0).all()
    for weights, m, p in zip(solution.weights, mean, cov, strict=True):
        least = objective(weights, m, p)
        assert all(objective(w, m, p) >= least - 1e-9 for w in rng.dirichlet(np.ones(count), 20))
        near = np.abs(weights + 1e-3 * rng.normal(size=(20, count)))
        assert all(objective(w, m, p) >= least - 1e-9 for w in near / near.sum(1, keepdims=True))


@WAYS
@pytest.mark.parametrize("count", [2, 3])
def test_laws(way: Way, objective: Objective, count: int) -> None:
    """Equal tracks weigh the same; order, affine maps and the rest of the batch change nothing."""
    rng = np.random.default_rng(10 + count)
    mean, cov = rng.normal(size=(12, count, 3)), covariances(rng, 12, count, n=3)
    weights, same = way(mean, cov).weights, way(np.zeros((1, count, 3)), np.repeat(cov[:1, :1], count, 1)).weights
    np.testing.assert_allclose(same, 1.0 / count, atol=1e-9)
    order, a = rng.permutation(count), rng.normal(size=(3, 3))
    np.testing.assert_allclose(way(mean[:, order], cov[:, order]).weights, weights[:, order], atol=1e-6)
    np.testing.assert_allclose(way(mean @ a.T + 5.0, a @ cov @ a.T).weights, weights, atol=1e-6)
    alone = [way(mean[i : i + 1], cov[i : i + 1]).weights[0] for i in range(12)]
    np.testing.assert_allclose(alone, weights, atol=1e-6)


@pytest.mark.parametrize("count", [2, 3])
def test_a_linear_term_pulls_towards_the_track_it_favours(count: int) -> None:
    rng = np.random.default_rng(20)
    mean, cov = rng.normal(size=(5, count, 3)), covariances(rng, 5, count, n=3)
    linear = np.full((5, count), 1e3)
    linear[:, 0] = 0.0
    np.testing.assert_allclose(merging_weights(mean, cov, linear).weights[:, 0], 1.0, atol=1e-6)
    own = np.linalg.slogdet(cov)[1]
    np.testing.assert_allclose(merging_weights(mean, cov, own).weights, merging_weights(mean, cov).weights, atol=1e-6)
