"""Densities on a grid and reduction of Gaussian mixtures: quadrature, a naive oracle, laws."""

from __future__ import annotations

import numpy as np
import pytest
from densities.mixture.examples import draw
from scipy import integrate

from track_fusion.densities.mixture import reduction
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, moments
from track_fusion.densities.on_grid import grid, kl_on_grid, moments_on_grid
from track_fusion.linalg import Array


def _kl_by_quadrature(first: Mixture, second: Mixture) -> float:
    def density(x: float) -> float:
        a, b = (float(log_pdf(m, np.array([[x]]))[0]) for m in (first, second))
        return float(np.exp(a) * (a - b))

    return float(integrate.quad(density, -40, 40, points=list(first.mean[:, 0]), limit=400)[0])


@pytest.mark.parametrize("seed", range(4))
def test_kl_of_mixtures_on_a_grid_is_that_by_quadrature(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = draw(rng, count=2, n=1, spread=1.0), draw(rng, count=3, n=1, spread=1.0)
    wanted = _kl_by_quadrature(first, second)
    points = grid(np.array([-40.0]), np.array([40.0]), 8000)
    logs = log_pdf(first, points), log_pdf(second, points)
    assert kl_on_grid(*logs) == pytest.approx(wanted, rel=1e-6)
    both = np.stack(logs)  # several at once; a constant in a logarithm changes nothing
    np.testing.assert_allclose(kl_on_grid(both + 7.0, both[::-1]), [wanted, kl_on_grid(logs[1], logs[0])], rtol=1e-6)


def test_moments_on_a_grid() -> None:
    mixture = draw(np.random.default_rng(3), count=3, spread=1.0)
    points = grid(np.full(2, -25.0), np.full(2, 25.0), 250)
    mean, cov = moments_on_grid(log_pdf(mixture, points), points)
    np.testing.assert_allclose(mean, moments(mixture)[0], atol=1e-6)
    np.testing.assert_allclose(cov, moments(mixture)[1], atol=1e-2)  # the cells' own spread, .2^2 / 12


# Reduction.


def _naive_runnalls(mixture: Mixture, count: int) -> Mixture:
    weight, mean, cov = (list(a) for a in (mixture.weight, mixture.mean, mixture.cov))

    def merged(i: int, j: int) -> tuple[float, Array, Array]:
        total = weight[i] + weight[j]
        gap = mean[i] - mean[j]
        spread = weight[i] * weight[j] / total**2 * np.outer(gap, gap)
        return (
            total,
            (weight[i] * mean[i] + weight[j] * mean[j]) / total,
            (weight[i] * cov[i] + weight[j] * cov[j]) / total + spread,
        )

    def cost(pair: tuple[int, int]) -> float:
        i, j = pair
        total, _, both = merged(i, j)
        logs = [np.linalg.slogdet(c)[1] for c in (both, cov[i], cov[j])]
        return 0.5 * float(total * logs[0] - weight[i] * logs[1] - weight[j] * logs[2])

    while len(weight) > count:
        i, j = min(((i, j) for i in range(len(weight)) for j in range(i + 1, len(weight))), key=cost)
        weight[i], mean[i], cov[i] = merged(i, j)
        del weight[j], mean[j], cov[j]
    return Mixture(np.array(weight), np.array(mean), np.array(cov))


def test_runnalls_is_the_naive_loop() -> None:
    batch = draw(np.random.default_rng(4), 3, count=14, n=3)
    before = batch.cov.copy()
    got = reduction.runnalls(batch, 4)
    np.testing.assert_array_equal(batch.cov, before)
    for k in range(3):
        wanted = _naive_runnalls(batch.at(k), 4)
        order, other = np.argsort(got.weight[k]), np.argsort(wanted.weight)
        np.testing.assert_allclose(got.weight[k][order], wanted.weight[other], rtol=1e-10)
        np.testing.assert_allclose(got.mean[k][order], wanted.mean[other], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(got.cov[k][order], wanted.cov[other], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", ["runnalls", "salmond"])
def test_merging_keeps_the_moments_and_drops_padding_first(name: str) -> None:
    rng = np.random.default_rng(5)
    reduce = reduction.REDUCTIONS[name]
    mixture = draw(rng, 4, count=9)
    for count in (1, 3, 8):
        less = reduce(mixture, count)
        assert less.count == count
        for got, wanted in zip(moments(less), moments(mixture), strict=True):
            np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9)
    assert reduce(mixture, 9) is mixture
    padded = Mixture(np.where(np.arange(9) < 4, mixture.weight, 0.0), mixture.mean, mixture.cov)
    less = reduce(padded, 4)
    np.testing.assert_allclose(np.sort(less.weight), np.sort(padded.weight[:, :4]))
    none = reduce(mixture.at((slice(0, 0),)), 2)
    assert none.weight.shape == (0, 2)


def test_salmond_merges_the_nearest_whatever_their_shapes() -> None:
    """Of three equal weights, the two nearest means merge although their covariances differ most."""
    weight, mean = np.full(3, 1 / 3), np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]])
    cov = np.stack([np.eye(2), 9 * np.eye(2), np.eye(2)])
    less = reduction.salmond(Mixture(weight, mean, cov), 2)
    assert sorted(less.mean[:, 0]) == pytest.approx([0.5, 3.0])


def test_cap_and_prune() -> None:
    rng = np.random.default_rng(6)
    mixture = draw(rng, 2, count=5)
    capped = reduction.cap(mixture, 2)
    np.testing.assert_allclose(capped.weight.sum(-1), 1.0)
    np.testing.assert_array_equal(capped.mean[:, 0], mixture.mean[np.arange(2), mixture.weight.argmax(-1)])
    weight = np.array([[0.5, 0.3, 0.15, 0.04, 0.01], [0.9, 0.09, 0.005, 0.004, 0.001]])
    kept, dropped = reduction.prune(Mixture(weight, mixture.mean, mixture.cov), 0.02)
    assert kept.count == 4
    np.testing.assert_allclose(dropped, [0.01, 0.01])
    np.testing.assert_allclose(kept.weight[1], [0.9 / 0.99, 0.09 / 0.99, 0.0, 0.0])
    with pytest.raises(ValueError, match="must be >= 1. Got 0."):
        reduction.cap(mixture, 0)
    with pytest.raises(ValueError, match="must be >= 1. Got 0."):
        reduction.runnalls(mixture, 0)
