"""The geometric average and what shares its kernel: fast and fault-tolerant covariance intersection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracles.exact import Intersection, errors, mp
from rules.examples import covariances, rotated
from scipy.optimize import minimize, minimize_scalar

from track_fusion.densities.gaussian import kl_divergence
from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks, get_rule

EPS = float(np.finfo(float).eps)
SOUGHT = pytest.mark.parametrize("criterion", ["chernoff", "minimax_information_loss"])


def fuse(key: str, mean: Array, cov: Array, **params: Any) -> FusedTracks:
    rule = get_rule(key)
    return rule(SourceTracks(mean, cov), rule.params(**params))


def average(mean: Array, cov: Array, **params: Any) -> FusedTracks:
    return fuse("geometric_average", mean, cov, **params)


# Weights ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("distance", [0.0, 1.0, 50.0])
def test_chernoff_is_as_far_from_every_track(count: int, distance: float) -> None:
    """Ahmed (10), Li 2022 (38): equal divergences of the average; a track without weight is nearer."""
    rng = np.random.default_rng(1)
    mean, cov = distance * rng.normal(size=(40, count, 4)), covariances(rng, 40, count)
    fused = average(mean, cov, criterion="chernoff")
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    divergence = kl_divergence(fused.mean[:, None], fused.cov[:, None], mean, cov)
    largest = divergence.max(1, keepdims=True)
    used = fused.weights > 0.0
    assert used.sum() > 40 * count / 2
    np.testing.assert_allclose((divergence / largest)[used], 1.0, atol=1e-6)


def _log_integral(weights: Array, mean: Array, cov: Array) -> float:
    """Logarithm of the integral of the product of p_i^w_i, one axis, by summation over a grid."""
    x = np.linspace(-60.0, 60.0, 24001)
    logs = [w * (-0.5 * (x - m) ** 2 / p - 0.5 * np.log(2 * np.pi * p)) for w, m, p in zip(weights, mean, cov)]  # noqa: B905
    return float(np.log(np.exp(np.sum(logs, 0)).sum() * (x[1] - x[0])))


@pytest.mark.parametrize("pair", [(0.0, 1.0, 1.0, 9.0), (0.0, 4.0, 7.0, 1.0), (-2.0, 25.0, 2.0, 25.0)])
def test_chernoff_minimises_the_integral_it_stands_for(pair: tuple[float, ...]) -> None:
    mean, cov = np.array(pair[::2]), np.array(pair[1::2])
    fused = average(mean[:, None], cov[:, None, None], criterion="chernoff")
    found = minimize_scalar(
        lambda w: _log_integral(np.array([w, 1.0 - w]), mean, cov), bounds=(0, 1), method="bounded",
        options={"xatol": 1e-8},
    )  # fmt: skip
    assert fused.weights is not None
    assert _log_integral(fused.weights, mean, cov) <= found.fun + 1e-9
    assert fused.weights[0] == pytest.approx(found.x, abs=1e-3)


def test_fast_intersection_is_the_chernoff_average() -> None:
    rng = np.random.default_rng(2)
    for count in (2, 4):
        mean, cov = rng.normal(size=(20, count, 4)), covariances(rng, 20, count)
        fast, chernoff = fuse("fast_covariance_intersection", mean, cov), average(mean, cov, criterion="chernoff")
        np.testing.assert_array_equal(fast.cov, chernoff.cov)
        np.testing.assert_array_equal(fast.mean, chernoff.mean)


def _loss(weights: Array, mean: Array, cov: Array) -> float:
    """Divergence of the naive product relative to the average at these weights, as a user would write it."""
    info = np.linalg.inv(cov)
    naive, total = np.linalg.inv(info.sum(0)), np.einsum("k,kij->ij", weights, info)
    centre = naive @ np.einsum("kij,kj->i", info, mean)
    pooled = np.linalg.solve(total, np.einsum("k,kij,kj->i", weights, info, mean))
    shift = centre - pooled
    ratio = total @ naive
    return float(0.5 * (np.trace(ratio) - len(shift) - np.linalg.slogdet(ratio)[1] + shift @ total @ shift))


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("distance", [0.0, 1.0, 10.0])
def test_minimax_information_loss_against_slsqp(count: int, distance: float) -> None:
    """Ahmed (11)."""
    rng = np.random.default_rng(3)
    mean, cov = distance * rng.normal(size=(8, count, 4)), covariances(rng, 8, count)
    fused = average(mean, cov, criterion="minimax_information_loss")
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    for m, p, weights in zip(mean, cov, fused.weights, strict=True):
        found = minimize(
            lambda w, m=m, p=p: _loss(w, m, p), np.full(count, 1.0 / count), method="SLSQP",
            bounds=[(0.0, 1.0)] * count, constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
            options={"ftol": 1e-13, "maxiter": 300},
        )  # fmt: skip
        simplex = np.maximum(found.x, 0.0) / np.maximum(found.x, 0.0).sum()
        assert _loss(weights, m, p) <= _loss(simplex, m, p) + 1e-9
        assert _loss(weights, m, p) >= found.fun - 1e-6


def test_loss_is_the_divergence_it_stands_for() -> None:
    rng = np.random.default_rng(4)
    mean, cov = rng.normal(size=(2, 3)), covariances(rng, 2, n=3)
    naive, pooled = fuse("naive", mean, cov), average(mean, cov, criterion="given", weights=(0.3, 0.7))
    wanted = kl_divergence(naive.mean, naive.cov, pooled.mean, pooled.cov)
    assert _loss(np.array([0.3, 0.7]), mean, cov) == pytest.approx(float(wanted), rel=1e-10)


@SOUGHT
@pytest.mark.parametrize("count", [2, 3])
def test_equal_tracks_weigh_the_same(criterion: str, count: int) -> None:
    cov = np.broadcast_to(rotated(np.random.default_rng(5), np.geomspace(1.0, 1e8, 4)), (7, count, 4, 4))
    fused = average(np.zeros((7, count, 4)), cov, criterion=criterion)
    np.testing.assert_allclose(fused.weights, 1.0 / count, atol=1e-12)
    np.testing.assert_allclose(fused.cov, cov[:, 0], rtol=1e-6)


@SOUGHT
@pytest.mark.parametrize("condition", [1e7, 1e13])
@pytest.mark.parametrize("kind", ["rotated", "complementary"])
def test_hard_pairs_against_mpmath(kind: str, condition: float, criterion: str) -> None:
    """Rotated, and each track vague where the other is sharp."""
    rng = np.random.default_rng(6)
    if kind == "rotated":
        cov = np.stack([rotated(rng, rng.permutation(np.geomspace(1.0, condition, 4))) for _ in range(2)])
    else:
        axes = np.array([[1.0, 1.0, condition, condition], [condition, condition, 1.0, 1.0]])
        cov = np.stack([rotated(np.random.default_rng(7), d * rng.uniform(0.5, 2.0, 4)) for d in axes])
    mean = rng.normal(size=(2, 4))
    fused = average(mean, cov, criterion=criterion)
    assert np.all(fused.info["converged"])
    oracle, weights = Intersection(cov), [mp.mpf(float(w)) for w in fused.weights]
    tolerance = 1e-12 + 100 * EPS * condition
    assert max(errors(fused.mean, fused.cov, oracle.mean(weights, mean), oracle.cov(weights))) <= tolerance
    assert np.linalg.eigvalsh(fused.cov).min() > 0.1
    if criterion == "chernoff":
        first, second = (_exact_divergence(fused, m, p) for m, p in zip(mean, cov, strict=True))
        assert first == pytest.approx(second, rel=1e-9 + tolerance)


def _exact_divergence(fused: FusedTracks, mean: Array, cov: Array) -> float:
    """Divergence of the fused density relative to a track, in 40 digits."""
    own, other = mp.matrix(fused.cov.tolist()), mp.matrix(cov.tolist())
    shift = mp.matrix(fused.mean.tolist()) - mp.matrix(mean.tolist())
    ratio = other**-1 * own
    distance = (shift.T * other**-1 * shift)[0]
    return float((sum(ratio[i, i] for i in range(len(mean))) - len(mean) - mp.log(mp.det(ratio)) + distance) / 2)


# Given weights, and weights of sum delta ----------------------------------------------------------------------------


def test_at_given_weights_it_is_covariance_intersection() -> None:
    rng = np.random.default_rng(8)
    mean, cov = rng.normal(size=(9, 3, 4)), covariances(rng, 9, 3)
    given = {"criterion": "given", "weights": (0.2, 0.5, 0.3)}
    one, other = average(mean, cov, **given), fuse("covariance_intersection", mean, cov, **given)
    np.testing.assert_array_equal(one.cov, other.cov)
    np.testing.assert_array_equal(one.mean, other.mean)


def test_weight_one_returns_the_track_itself() -> None:
    rng = np.random.default_rng(9)
    mean, cov = rng.normal(size=(5, 2, 4)), covariances(rng, 5, 2)
    fused = average(mean, cov, criterion="given", weights=(0.0, 1.0))
    np.testing.assert_array_equal(fused.mean, mean[:, 1])
    np.testing.assert_array_equal(fused.cov, cov[:, 1])


@pytest.mark.parametrize("criterion", ["det", "trace", "uniform"])
@pytest.mark.parametrize("delta", [0.25, 0.9, 1.0])
def test_fault_tolerant_inflates_the_intersection(criterion: str, delta: float) -> None:
    """Li 2022 II-C: weights of sum delta; delta 1 is covariance intersection."""
    rng = np.random.default_rng(10)
    mean, cov = rng.normal(size=(9, 3, 4)), covariances(rng, 9, 3)
    fused = fuse("fault_tolerant_covariance_intersection", mean, cov, criterion=criterion, delta=delta)
    plain = fuse("covariance_intersection", mean, cov, criterion=criterion)
    assert fused.weights is not None
    np.testing.assert_allclose(fused.weights.sum(-1), delta, rtol=1e-12)
    info = np.einsum("bk,bkij->bij", fused.weights, np.linalg.inv(cov))
    np.testing.assert_allclose(fused.cov, np.linalg.inv(info), rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(fused.mean, plain.mean)
    if delta == 1.0:
        np.testing.assert_array_equal(fused.cov, plain.cov)


def test_fault_tolerant_covers_tracks_that_claim_too_little() -> None:
    """Errors of covariance P / delta that are all the same: covariance intersection is 1 / delta too small."""
    rng = np.random.default_rng(11)
    cov = np.broadcast_to(covariances(rng, 1)[0], (3, 4, 4))
    true, delta = cov[0] / 0.6, 0.6
    fused = fuse("fault_tolerant_covariance_intersection", np.zeros((3, 4)), cov, delta=delta)
    np.testing.assert_allclose(fused.cov, true, rtol=1e-9)
    with pytest.raises(ValueError, match=r"The 'delta' parameter must be a number > 0 and <= 1. Got 0.0."):
        fuse("fault_tolerant_covariance_intersection", np.zeros((3, 4)), cov, delta=0.0)
