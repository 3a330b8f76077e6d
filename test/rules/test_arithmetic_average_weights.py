"""Weights of the arithmetic average by a target, a bound, likelihoods; merging of near components; Lemma 5."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rules.examples import covariances
from scipy.optimize import minimize
from scipy.stats import multivariate_normal, norm

from track_fusion.densities.gaussian import kl_divergence
from track_fusion.densities.on_grid import grid
from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, Mixture, SourceTracks
from track_fusion.rules.arithmetic_average import RULE, ArithmeticAverageParams


def fuse(mean: Array, cov: Array, extras: dict[str, Any] | None = None, **params: Any) -> FusedTracks:
    return RULE(SourceTracks(mean, cov, extras=extras or {}), ArithmeticAverageParams(**params))


def gaussian(mean: Array, cov: Array) -> Mixture:
    return Mixture(np.ones((*mean.shape[:-1], 1)), mean[..., None, :], cov[..., None, :, :])


# Target (39), on Fig. 2 of Li 2022: test/scenarios/li2022/test_target_fit.py ---------------------------------


@pytest.mark.parametrize("count", [2, 3, 5])
def test_target_weights_against_slsqp(count: int) -> None:
    rng = np.random.default_rng(1)
    mean, cov = 1.5 * rng.normal(size=(8, count, 4)), covariances(rng, 8, count)
    target = rng.normal(size=(8, 4)), 1.5 * covariances(rng, 8)
    fused = fuse(mean, cov, {"target": gaussian(*target)}, criterion="target")
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    ours = kl_divergence(fused.mean, fused.cov, *target)
    for i in range(8):

        def divergence(w: Array, i: int = i) -> float:
            centre = w @ mean[i]
            spread = np.einsum("k,kij->ij", w, cov[i]) + np.einsum("k,ki,kj->ij", w, mean[i] - centre, mean[i] - centre)
            return float(kl_divergence(centre, spread, target[0][i], target[1][i]))

        found = minimize(
            divergence, np.full(count, 1.0 / count), method="SLSQP", bounds=[(0.0, 1.0)] * count,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0}, options={"ftol": 1e-13, "maxiter": 300},
        )  # fmt: skip
        assert ours[i] <= divergence(np.maximum(found.x, 0.0) / np.maximum(found.x, 0.0).sum()) + 1e-10
        assert ours[i] >= found.fun - 1e-6


# Target (33): the mixture itself --------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("count", [2, 4])
def test_a_target_that_is_a_mixture_of_the_tracks_gives_its_weights(n: int, count: int) -> None:
    """There the divergence is zero, by any sums."""
    rng = np.random.default_rng(3)
    mean, cov = 2.0 * rng.normal(size=(40, count, n)), covariances(rng, 40, count, n=n)
    weights = rng.dirichlet(2.0 * np.ones(count), 40)
    fused = fuse(mean, cov, {"target": Mixture(weights, mean, cov)}, criterion="target_mixture")
    assert np.all(fused.info["converged"])
    np.testing.assert_allclose(fused.weights, weights, atol=1e-5)


@pytest.mark.parametrize("n", [1, 2])
def test_weights_of_the_mixture_against_a_search_on_a_grid(n: int) -> None:
    rng = np.random.default_rng(4)
    cells = 4000 if n == 1 else 300
    points = grid(np.full(n, -30.0), np.full(n, 30.0), cells)
    for _ in range(4):
        mean, cov = 1.5 * rng.normal(size=(3, n)), covariances(rng, 3, n=n)
        target = Mixture(np.array([0.4, 0.6]), rng.normal(size=(2, n)), 1.5 * covariances(rng, 2, n=n))
        fused = fuse(mean, cov, {"target": target}, criterion="target_mixture")
        logs = np.stack([multivariate_normal(m, c).logpdf(points) for m, c in zip(mean, cov, strict=True)])
        parts = [multivariate_normal(m, c).pdf(points) for m, c in zip(target.mean, target.cov, strict=True)]
        log_target, cell = np.log(target.weight @ parts), (60.0 / cells) ** n

        def divergence(w: Array) -> float:
            density = np.maximum(w @ np.exp(logs), 1e-300)  # noqa: B023
            return float((density * (np.log(density) - log_target)).sum() * cell)  # noqa: B023

        least = minimize(
            divergence, np.full(3, 1.0 / 3.0), method="SLSQP", bounds=[(0.0, 1.0)] * 3,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0}, options={"ftol": 1e-13, "maxiter": 300},
        )  # fmt: skip
        assert fused.weights is not None
        assert divergence(fused.weights) <= least.fun + 1e-5


def test_the_mixture_and_the_merged_gaussian_are_fitted_by_other_weights() -> None:
    """Two tracks apart, one target about the first: merging hides the second mode, the mixture does not."""
    mean, cov = np.array([[0.0], [6.0]]), np.ones((2, 1, 1))
    target = {"target": gaussian(np.array([1.0]), np.array([[4.0]]))}
    whole, merged = (fuse(mean, cov, target, criterion=c).weights for c in ("target_mixture", "target"))
    assert whole is not None
    assert merged is not None
    assert whole[1] < 0.5 * merged[1]


def test_large_batches_are_fitted_in_pieces() -> None:
    rng = np.random.default_rng(5)
    mean, cov = rng.normal(size=(70, 3, 2)), covariances(rng, 70, 3, n=2)
    target = gaussian(np.zeros((70, 2)), np.tile(2.0 * np.eye(2), (70, 1, 1)))
    whole = fuse(mean, cov, {"target": target}, criterion="target_mixture").weights
    assert whole is not None
    alone = fuse(mean[69], cov[69], {"target": target.at(69)}, criterion="target_mixture").weights
    np.testing.assert_allclose(whole[69], alone, atol=1e-9)


def test_a_target_of_one_track_takes_that_track_and_a_mixture_counts_by_its_moments() -> None:
    rng = np.random.default_rng(2)
    mean, cov = rng.normal(size=(6, 3, 4)), covariances(rng, 6, 3)
    fused = fuse(mean, cov, {"target": gaussian(mean[:, 1], cov[:, 1])}, criterion="target")
    np.testing.assert_allclose(fused.weights, np.broadcast_to([0.0, 1.0, 0.0], (6, 3)), atol=1e-7)
    share, parts = np.array([0.3, 0.7]), (rng.normal(size=(2, 4)), covariances(rng, 2))
    merged = fuse(parts[0], parts[1], criterion="given", weights=tuple(share))
    by_mixture = fuse(mean, cov, {"target": Mixture(share, *parts)}, criterion="target")
    by_moments = fuse(mean, cov, {"target": gaussian(merged.mean, merged.cov)}, criterion="target")
    np.testing.assert_allclose(by_mixture.weights, by_moments.weights, atol=1e-9)


# Bound (45) -----------------------------------------------------------------------------------------------------------


def _bound(weights: Array, mean: Array, cov: Array) -> float:
    """Sum of w_i log(|P_i|^1/2 sum of w_j N(m_i; m_j, P_i + P_j)), as the paper prints it."""
    overlap = np.array(
        [
            [multivariate_normal(m, p + q).pdf(x) for m, q in zip(mean, cov, strict=True)]
            for x, p in zip(mean, cov, strict=True)
        ]
    )
    return float(weights @ (0.5 * np.linalg.slogdet(cov)[1] + np.log(overlap @ weights)))


@pytest.mark.parametrize("distance", [0.0, 0.5, 2.0])
@pytest.mark.parametrize(("count", "n"), [(2, 2), (2, 6), (3, 4), (4, 6)])
def test_bound_weights_are_the_best_of_many_searches(count: int, n: int, distance: float) -> None:
    """The program has several minima from four axes on: no start finds a better one."""
    rng = np.random.default_rng(3)
    mean, cov = distance * rng.normal(size=(5, count, n)), covariances(rng, 5, count, n=n)
    fused = fuse(mean, cov, criterion="bound")
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    for x, p, weights in zip(mean, cov, fused.weights, strict=True):
        starts = [*rng.dirichlet(np.ones(count), 3), *(0.9 * np.eye(count) + 0.1 / count)]
        overlap = np.exp([[_log_overlap(x[i], x[j], p[i], p[j]) for j in range(count)] for i in range(count)])

        def cost(w: Array, overlap: Array = overlap) -> float:
            return float(w @ np.log(overlap @ np.maximum(w, 1e-15)))

        found = min(
            minimize(cost, s, method="SLSQP", bounds=[(0.0, 1.0)] * count, options={"ftol": 1e-13, "maxiter": 200},
                     constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0}).fun for s in starts
        )  # fmt: skip
        assert cost(weights) <= found + 1e-9
        assert cost(weights) >= found - 1e-6
        assert cost(weights) == pytest.approx(_bound(weights, x, p) + 0.5 * n * np.log(4 * np.pi), abs=1e-9)


def _log_overlap(x: Array, y: Array, p: Array, q: Array) -> float:
    """log(|P|^1/2 N(x; y, P + Q)) relative to its value for equal densities."""
    size = 0.5 * np.linalg.slogdet(p)[1] + 0.5 * len(x) * np.log(4 * np.pi)
    return float(size + multivariate_normal(y, p + q).logpdf(x))


def test_the_bound_weighs_equal_and_far_tracks_alike() -> None:
    rng = np.random.default_rng(4)
    cov = np.repeat(covariances(rng, 5, 1), 3, 1)
    np.testing.assert_allclose(fuse(np.zeros((5, 3, 4)), cov, criterion="bound").weights, 1.0 / 3.0, atol=1e-9)
    far = 1e4 * np.arange(3.0)[:, None] * np.ones(4)
    np.testing.assert_allclose(fuse(np.stack([far] * 5), cov, criterion="bound").weights, 1.0 / 3.0, atol=1e-7)


# Likelihood -----------------------------------------------------------------------------------------------------------


def test_weights_in_proportion_to_the_likelihood() -> None:
    rng = np.random.default_rng(5)
    mean, cov = rng.normal(size=(4, 3, 4)), covariances(rng, 4, 3)
    likelihood = np.array([[1.0, 2.0, 1.0], [0.0, 1e-300, 3e-300], [1e308, 1e308, 0.0], [0.0, 0.0, 0.0]])
    fused = fuse(mean, cov, {"likelihood": likelihood}, criterion="likelihood")
    wanted = [[0.25, 0.5, 0.25], [0.0, 0.25, 0.75], [0.5, 0.5, 0.0], [1 / 3, 1 / 3, 1 / 3]]
    np.testing.assert_allclose(fused.weights, wanted, rtol=1e-12)
    with pytest.raises(ValueError, match=r"The 'likelihood' of source tracks must have shape \(4, 3\). Got \(3,\)."):
        fuse(mean, cov, {"likelihood": np.ones(3)}, criterion="likelihood")
    with pytest.raises(ValueError, match=r"must be finite and not negative. Got -1.0."):
        fuse(mean, cov, {"likelihood": -np.ones((4, 3))}, criterion="likelihood")


# Merging below a threshold --------------------------------------------------------------------------------------------


def test_only_near_modes_are_merged() -> None:
    """Li 2022 II-E: tracks at 0, 1 and 2 merge by way of each other, one at 9 stays a mode."""
    mean, cov = np.array([[0.0], [9.0], [1.0], [2.0]]), np.full((4, 1, 1), 0.5)
    weights = (0.1, 0.4, 0.3, 0.2)
    fused = fuse(mean, cov, criterion="given", weights=weights, output="mixture", merge_threshold=1.5)
    assert fused.mixture is not None
    kept = fused.mixture.weight > 0
    np.testing.assert_allclose(fused.mixture.weight[kept], [0.6, 0.4])
    centre = (0.3 * 1.0 + 0.2 * 2.0) / 0.6
    np.testing.assert_allclose(fused.mixture.mean[kept, 0], [centre, 9.0])
    spread = (0.1 * centre**2 + 0.3 * (1 - centre) ** 2 + 0.2 * (2 - centre) ** 2) / 0.6
    np.testing.assert_allclose(fused.mixture.cov[kept, 0, 0], [0.5 + spread, 0.5])
    whole = fuse(mean, cov, criterion="given", weights=weights)
    np.testing.assert_allclose(fused.mean, whole.mean)  # the moments are those of the mixture, merged or not
    np.testing.assert_allclose(fused.cov, whole.cov)


@pytest.mark.parametrize(("threshold", "modes"), [(0.0, 3), (0.999, 3), (1.001, 2), (8.0, 1), (np.inf, 1)])
def test_the_threshold_is_a_distance_in_standard_deviations(threshold: float, modes: int) -> None:
    """The tracks at 0 and 1 are one standard deviation of their difference apart, those at 1 and 8 seven."""
    mean, cov = np.array([[0.0], [1.0], [8.0]]), np.full((3, 1, 1), 0.5)
    if np.isinf(threshold):
        threshold = 1e9
    fused = fuse(mean, cov, criterion="uniform", output="mixture", merge_threshold=threshold)
    assert fused.mixture is not None
    assert (fused.mixture.weight > 0).sum() == modes
    assert fused.mixture.weight.sum() == pytest.approx(1.0)


def test_a_chain_of_near_components_is_one() -> None:
    count = 9
    mean, cov = np.arange(float(count))[::-1, None], np.full((count, 1, 1), 0.5)
    fused = fuse(mean, cov, criterion="uniform", output="mixture", merge_threshold=1.01)
    assert fused.mixture is not None
    assert (fused.mixture.weight > 0).sum() == 1
    whole = fuse(mean, cov, criterion="uniform")
    np.testing.assert_allclose(fused.mixture.cov[0], whole.cov)


def test_particles_and_padding_are_left_alone() -> None:
    weight = np.array([[0.5, 0.5], [1.0, 0.0]])
    part_mean = np.array([[[0.0], [0.1]], [[0.05], [0.05]]])
    part_cov = np.array([[[[0.0]], [[0.0]]], [[[1.0]], [[1.0]]]])
    tracks = SourceTracks(
        np.array([[0.05], [0.05]]), np.array([[[0.0025]], [[1.0]]]), mixture=Mixture(weight, part_mean, part_cov)
    )
    params = ArithmeticAverageParams(criterion="uniform", output="mixture", merge_threshold=5.0)
    fused = RULE(tracks, params)
    assert fused.mixture is not None
    np.testing.assert_array_equal(fused.mixture.weight, [0.25, 0.25, 0.5, 0.0])
    np.testing.assert_array_equal(fused.mixture.cov[:, 0, 0], [0.0, 0.0, 1.0, 1.0])


# Lemma 5 --------------------------------------------------------------------------------------------------------------


def test_lemma_5_the_mixture_fits_better_than_its_components_on_average() -> None:
    """Li 2022 (31)-(32), by summation over a grid, for the mixture that the rule returns."""
    x = np.linspace(-40.0, 45.0, 17001)
    cell, target = x[1] - x[0], norm(1.0, 3.0).logpdf(x)
    mean, cov, weights = np.array([[-2.0], [0.0], [6.0]]), np.array([4.0, 1.0, 9.0])[:, None, None], (0.5, 0.3, 0.2)
    fused = fuse(mean, cov, criterion="given", weights=weights, output="mixture")
    assert fused.mixture is not None
    logs = [
        norm(m, np.sqrt(p)).logpdf(x) for m, p in zip(fused.mixture.mean[:, 0], fused.mixture.cov[:, 0, 0], strict=True)
    ]
    mixture = np.log(np.einsum("k,kx->x", fused.mixture.weight, np.exp(logs)))

    def divergence(f: Array, g: Array) -> float:
        return float((np.exp(f) * (f - g)).sum() * cell)

    whole = divergence(mixture, target)
    parts = sum(w * divergence(f, target) for w, f in zip(weights, logs, strict=True))
    spread = sum(w * divergence(f, mixture) for w, f in zip(weights, logs, strict=True))
    assert whole == pytest.approx(parts - spread, rel=1e-8)
    assert spread > 0.1
    single = SourceTracks(np.zeros((3, 1)), np.ones((3, 1, 1)))
    same = RULE(single, ArithmeticAverageParams(criterion="given", weights=weights, output="mixture"))
    assert same.mixture is not None  # equal tracks: the bound is met
    np.testing.assert_allclose(same.cov, 1.0)
