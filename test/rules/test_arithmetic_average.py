"""The arithmetic average against mixtures on a grid, and its diversity weights against scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rules.examples import covariances, rotated
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import multivariate_normal

from track_fusion.densities.gaussian import kl_divergence
from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, Mixture, SourceTracks
from track_fusion.rules.arithmetic_average import RULE, ArithmeticAverageParams
from track_fusion.solvers.pair import FEW


def fuse(mean: Array, cov: Array, **params: Any) -> FusedTracks:
    return RULE(SourceTracks(mean, cov), ArithmeticAverageParams(**params))


def _on_grid(weights: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Mean and covariance of a planar mixture by summation over a grid."""
    axis = np.linspace(-14.0, 14.0, 561)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    parts = [w * multivariate_normal(m, p).pdf(points) for w, m, p in zip(weights, mean, cov, strict=True)]
    density = np.sum(parts, 0)
    density /= density.sum()
    centre = np.einsum("ij,ijk->k", density, points)
    return centre, np.einsum("ij,ijk,ijl->kl", density, points - centre, points - centre)


@pytest.mark.parametrize("params", [{}, {"criterion": "uniform"}, {"criterion": "given", "weights": (0.2, 0.5, 0.3)}])
def test_moments_of_the_mixture_on_a_grid(params: dict[str, Any]) -> None:
    rng = np.random.default_rng(1)
    mean, cov = 2.0 * rng.normal(size=(3, 2)), covariances(rng, 3, n=2) / 6.0
    fused = fuse(mean, cov, **params)
    assert fused.weights is not None
    centre, spread = _on_grid(fused.weights, mean, cov)
    np.testing.assert_allclose(fused.mean, centre, atol=1e-6)
    np.testing.assert_allclose(fused.cov, spread, atol=1e-5)


def test_mixture_output_keeps_the_modes() -> None:
    mean, cov = np.array([[-6.0, 0.0], [6.0, 1.0]]), np.stack([np.eye(2), 2.0 * np.eye(2)])
    fused = fuse(mean, cov, criterion="given", weights=(0.25, 0.75), output="mixture")
    assert fused.mixture is not None
    np.testing.assert_array_equal(fused.mixture.weight, [0.25, 0.75])
    np.testing.assert_array_equal(fused.mixture.mean, mean)
    np.testing.assert_array_equal(fused.mixture.cov, cov)
    np.testing.assert_allclose(fused.mean, _on_grid(fused.mixture.weight, mean, cov)[0], atol=1e-6)
    assert fuse(mean, cov).mixture is None


def test_sources_that_are_mixtures_are_averaged_component_by_component() -> None:
    rng = np.random.default_rng(2)
    weight = np.array([[0.3, 0.7], [1.0, 0.0]])
    part_mean, part_cov = rng.normal(size=(2, 2, 2)), covariances(rng, 2, 2, n=2) / 8.0
    moments = [_on_grid(w, m, p) for w, m, p in zip(weight, part_mean, part_cov, strict=True)]
    mean, cov = (np.stack(m) for m in zip(*moments, strict=True))
    tracks = SourceTracks(mean, cov, mixture=Mixture(weight, part_mean, part_cov))
    params = ArithmeticAverageParams(criterion="given", weights=(0.4, 0.6), output="mixture")
    fused = RULE(tracks, params)
    assert fused.mixture is not None
    np.testing.assert_allclose(fused.mixture.weight, [0.12, 0.28, 0.6, 0.0])
    whole = _on_grid(fused.mixture.weight, fused.mixture.mean, fused.mixture.cov)
    np.testing.assert_allclose(fused.mean, whole[0], atol=1e-6)
    np.testing.assert_allclose(fused.cov, whole[1], atol=1e-4)


# Weights by diversity -----------------------------------------------------------------------------------------------


def _diversity(weights: Array, mean: Array, cov: Array) -> float:
    """Objective of (40), to be maximised: log det P_AA(w) - sum of w_i log det P_i, second moments minus the mean's."""
    weights = np.asarray(weights)
    centre = weights @ mean
    second = sum(w * (p + np.outer(m, m)) for w, m, p in zip(weights, mean, cov, strict=True))
    return float(np.linalg.slogdet(second - np.outer(centre, centre))[1] - weights @ np.linalg.slogdet(cov)[1])


@pytest.mark.parametrize("distance", [0.0, 0.3, 3.0, 300.0])
def test_pair_weights_against_scipy(distance: float) -> None:
    rng = np.random.default_rng(3)
    mean, cov = distance * rng.normal(size=(30, 2, 4)), covariances(rng, 30, 2)
    fused = fuse(mean, cov)
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    # Six steps of Newton, fewer where the means decide; a wrong second derivative takes more.
    assert np.mean(fused.info["iterations"]) <= (6.5 if distance < 1.0 else 6.0)
    for m, p, weights in zip(mean, cov, fused.weights, strict=True):
        result = minimize_scalar(
            lambda w, m=m, p=p: -_diversity(np.array([w, 1.0 - w]), m, p), bounds=(0.0, 1.0), method="bounded"
        )
        ours = _diversity(weights, m, p)
        assert ours >= -result.fun - 1e-11
        assert ours <= -result.fun + 1e-6


@pytest.mark.parametrize("count", [3, 5])
@pytest.mark.parametrize("distance", [0.0, 1.0, 100.0])
def test_many_weights_against_slsqp(count: int, distance: float) -> None:
    rng = np.random.default_rng(4)
    mean, cov = distance * rng.normal(size=(10, count, 4)), covariances(rng, 10, count)
    fused = fuse(mean, cov)
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    for m, p, weights in zip(mean, cov, fused.weights, strict=True):
        result = minimize(
            lambda w, m=m, p=p: -_diversity(w, m, p), np.full(count, 1.0 / count), method="SLSQP",
            bounds=[(0.0, 1.0)] * count, constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
            options={"ftol": 1e-12, "maxiter": 300},
        )  # fmt: skip
        simplex = np.maximum(result.x, 0.0) / np.maximum(result.x, 0.0).sum()
        ours = _diversity(weights, m, p)
        assert ours >= _diversity(simplex, m, p) - 1e-10
        assert ours <= -result.fun + 1e-6


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("batch", [1, FEW + 5])
def test_divergences_are_equal_at_an_interior_optimum(count: int, batch: int) -> None:
    """Li 2022 (37): every source is equally far from the average; one that is left out is nearer."""
    rng = np.random.default_rng(5)
    mean, cov = 1.5 * rng.normal(size=(batch, count, 4)), covariances(rng, batch, count)
    fused = fuse(mean, cov)
    assert fused.weights is not None
    divergence = kl_divergence(mean, cov, fused.mean[:, None], fused.cov[:, None])
    used = fused.weights > 0.0
    assert used.sum() > batch * count / 2
    largest = divergence.max(1, keepdims=True)
    np.testing.assert_allclose(np.where(used, divergence, largest), np.broadcast_to(largest, used.shape), atol=1e-7)


def test_divergence_is_the_integral_it_stands_for() -> None:
    p, q = (
        multivariate_normal([0.5, -1.0], [[1.0, 0.3], [0.3, 2.0]]),
        multivariate_normal([0.0, 0.4], [[3.0, -1], [-1, 2]]),
    )
    axis = np.linspace(-14.0, 14.0, 701)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    cell = (axis[1] - axis[0]) ** 2
    wanted = float((p.pdf(points) * (p.logpdf(points) - q.logpdf(points))).sum() * cell)
    got = kl_divergence(p.mean, p.cov_object.covariance, q.mean, q.cov_object.covariance)
    assert float(got) == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize("batch", [1, FEW + 1])
def test_equal_covariances_weigh_the_same(batch: int) -> None:
    mean = np.broadcast_to(np.array([[0.0, 0.0], [4.0, 0.0]]), (batch, 2, 2))
    fused = fuse(mean, np.broadcast_to(np.diag([1.0, 3.0]), (batch, 2, 2, 2)))
    np.testing.assert_array_equal(fused.weights, 0.5)
    np.testing.assert_allclose(fused.cov, np.broadcast_to(np.diag([5.0, 3.0]), (batch, 2, 2)), rtol=1e-12)


@pytest.mark.parametrize("batch", [1, FEW + 1])
@pytest.mark.parametrize("condition", [1e8, 1e12])
def test_complementary_vague_axes(batch: int, condition: float) -> None:
    """Each track vague where the other is sharp: symmetric, so the weights are halves whatever the rotation."""
    rng = np.random.default_rng(6)
    cov = np.stack([rotated(np.random.default_rng(7), np.array(d)) for d in ([1.0, condition], [condition, 1.0])])
    mean = np.broadcast_to(rng.normal(size=(2, 2)), (batch, 2, 2))
    fused = fuse(mean, np.broadcast_to(cov, (batch, 2, 2, 2)))
    assert np.all(fused.info["converged"])
    np.testing.assert_allclose(fused.weights, 0.5, atol=1e-4)
    np.testing.assert_allclose(
        fused.cov, np.broadcast_to(cov.mean(0), (batch, 2, 2)), rtol=0, atol=10.0 + 1e-9 * condition
    )


def test_average_is_above_intersection_at_the_same_weights() -> None:
    """ERRATA.md: CI <= AA at the same weights, in the Loewner order."""
    from track_fusion.rules import get_rule

    rng = np.random.default_rng(8)
    mean, cov = rng.normal(size=(200, 3, 4)), covariances(rng, 200, 3)
    weights = (0.5, 0.2, 0.3)
    average = fuse(mean, cov, criterion="given", weights=weights)
    rule = get_rule("covariance_intersection")
    crossed = rule(SourceTracks(mean, cov), rule.params(criterion="given", weights=weights))  # type: ignore[call-arg]
    assert np.linalg.eigvalsh(average.cov - crossed.cov).min() > -1e-10
