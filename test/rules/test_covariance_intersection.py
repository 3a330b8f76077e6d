"""Covariance intersection against mpmath and scipy's optimisers, where it is easy and where it is hard."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.exact import Intersection, errors, mp
from rules.examples import covariances, rotated
from scipy.optimize import minimize, minimize_scalar

from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks
from track_fusion.rules.covariance_intersection import RULE, CovarianceIntersectionParams
from track_fusion.solvers.pair import FEW

CRITERIA = pytest.mark.parametrize("criterion", ["det", "trace"])
#: Rounding of the input alone moves a covariance of this condition number by this much, relative to itself.
EPS = float(np.finfo(float).eps)


def fuse(mean: Array, cov: Array, **params: Any) -> FusedTracks:
    return RULE(SourceTracks(mean, cov), CovarianceIntersectionParams(**params))


def hard_pair(kind: str, condition: float, rng: np.random.Generator) -> Array:
    """Two covariances (2, 4, 4) of this condition number."""
    spread = np.geomspace(1.0, condition, 4)
    vague, sharp = np.array([condition, condition, 1.0, 1.0]), np.array([1.0, 1.0, condition, condition])
    if kind == "rotated":
        return np.stack([rotated(rng, rng.permutation(spread)) for _ in range(2)])
    if kind == "complementary":  # one sensor's bearing, the other's range: vague along each other's sharp axes
        return np.stack([rotated(np.random.default_rng(7), d * rng.uniform(0.5, 2.0, 4)) for d in (vague, sharp)])
    if kind == "crossed":
        return np.stack([rotated(rng, d * rng.uniform(0.5, 2.0, 4)) for d in (vague, sharp)])
    assert kind == "alike"
    return np.stack([rotated(np.random.default_rng(7), spread * rng.uniform(0.5, 2.0, 4)) for _ in range(2)])


@CRITERIA
@pytest.mark.parametrize("condition", [1e2, 1e7, 1e13])
@pytest.mark.parametrize("kind", ["rotated", "complementary", "crossed", "alike"])
def test_hard_pairs_against_mpmath(kind: str, condition: float, criterion: str) -> None:
    rng = np.random.default_rng(11)
    cov, mean = hard_pair(kind, condition, rng), rng.normal(size=(2, 4))
    fused = fuse(mean, cov, criterion=criterion)
    assert fused.info["converged"]
    oracle = Intersection(cov)
    weights = [mp.mpf(float(w)) for w in fused.weights]
    tolerance = 1e-12 + 100 * EPS * condition
    excess = oracle.objective(weights, criterion) - oracle.best_pair(criterion)
    assert float(excess) <= 1e-13 + 10.0 * (EPS * condition) ** 2  # of second order in the rounding of the input
    mean_error, cov_error = errors(fused.mean, fused.cov, oracle.mean(weights, mean), oracle.cov(weights))
    assert cov_error <= tolerance
    assert mean_error <= tolerance
    assert np.linalg.eigvalsh(fused.cov).min() > 0.1


@CRITERIA
@pytest.mark.parametrize("condition", [1e2, 1e7, 1e13])
@pytest.mark.parametrize("count", [3, 5])
def test_many_hard_tracks_against_mpmath(count: int, condition: float, criterion: str) -> None:
    rng = np.random.default_rng(12)
    cov = np.stack([rotated(rng, rng.permutation(np.geomspace(1.0, condition, 4))) for _ in range(count)])
    mean = rng.normal(size=(count, 4))
    fused = fuse(mean, cov, criterion=criterion)
    oracle = Intersection(cov)
    weights = [mp.mpf(float(w)) for w in fused.weights]
    tolerance = 1e-11 + 1000 * EPS * condition
    assert fused.info["converged"]
    assert oracle.excess_bound(weights, criterion) <= tolerance
    mean_error, cov_error = errors(fused.mean, fused.cov, oracle.mean(weights, mean), oracle.cov(weights))
    assert max(mean_error, cov_error) <= tolerance


@CRITERIA
@pytest.mark.parametrize("count", [2, 3])
def test_units_that_differ_by_ten_orders(count: int, criterion: str) -> None:
    rng = np.random.default_rng(13)
    unit = np.geomspace(1e-5, 1e5, 4)
    cov = covariances(rng, count) * np.outer(unit, unit)
    mean = rng.normal(size=(count, 4)) * unit
    fused = fuse(mean, cov, criterion=criterion)
    oracle = Intersection(cov)
    weights = [mp.mpf(float(w)) for w in fused.weights]
    assert oracle.excess_bound(weights, criterion) <= 1e-9
    assert max(errors(fused.mean, fused.cov, oracle.mean(weights, mean), oracle.cov(weights))) <= 1e-8


@CRITERIA
@pytest.mark.parametrize("batch", [1, FEW + 1])
def test_hard_pairs_in_units_that_differ(batch: int, criterion: str) -> None:
    """The trace is that in the units given, not in some better scaled ones."""
    rng = np.random.default_rng(24)
    unit = np.geomspace(1e-3, 1e3, 4)
    cov = hard_pair("crossed", 1e10, rng) * np.outer(unit, unit)
    mean = rng.normal(size=(batch, 2, 4)) * unit
    fused = fuse(mean, np.broadcast_to(cov, (batch, 2, 4, 4)), criterion=criterion)
    assert fused.weights is not None
    oracle = Intersection(cov)
    weights = [mp.mpf(float(w)) for w in fused.weights[0]]
    assert float(oracle.objective(weights, criterion) - oracle.best_pair(criterion)) <= 1e-10


@CRITERIA
@pytest.mark.parametrize("scale", [1e-10, 1e10])
@pytest.mark.parametrize("count", [2, 3])
def test_all_units_scaled_alike_change_no_weight(count: int, scale: float, criterion: str) -> None:
    rng = np.random.default_rng(14)
    mean, cov = rng.normal(size=(count, 4)), covariances(rng, count)
    plain = fuse(mean, cov, criterion=criterion)
    scaled = fuse(mean * scale, cov * scale**2, criterion=criterion)
    assert plain.weights is not None
    np.testing.assert_allclose(scaled.weights, plain.weights, atol=1e-8)
    np.testing.assert_allclose(scaled.cov, plain.cov * scale**2, rtol=1e-8, atol=1e-8 * scale**2)


def _value(infos: Array, criterion: str, weights: Array) -> float:
    """Logarithm of the criterion, as a user would write it."""
    cov = np.linalg.inv(np.einsum("k,kij->ij", weights, infos))
    return float(np.linalg.slogdet(cov)[1] if criterion == "det" else np.log(np.trace(cov)))


@CRITERIA
def test_pairs_against_scipy(criterion: str) -> None:
    rng = np.random.default_rng(15)
    mean, cov = rng.normal(size=(40, 2, 4)), covariances(rng, 40, 2)
    fused = fuse(mean, cov, criterion=criterion)
    assert fused.weights is not None
    assert np.max(fused.info["iterations"]) <= 12  # Newton's steps, not those of the bisection that guards it
    for p, weights in zip(cov, fused.weights, strict=True):
        infos = np.linalg.inv(p)
        result = minimize_scalar(
            lambda w, infos=infos: _value(infos, criterion, np.array([w, 1.0 - w])),
            bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-10},
        )  # fmt: skip
        ours = _value(infos, criterion, weights)
        assert ours <= result.fun + 1e-12
        assert ours >= result.fun - 1e-6  # the two agree on what is minimised


@CRITERIA
@pytest.mark.parametrize("count", [3, 5])
def test_many_against_slsqp(count: int, criterion: str) -> None:
    rng = np.random.default_rng(16)
    mean, cov = rng.normal(size=(12, count, 4)), covariances(rng, 12, count)
    fused = fuse(mean, cov, criterion=criterion)
    assert fused.weights is not None
    for p, weights in zip(cov, fused.weights, strict=True):
        infos = np.linalg.inv(p)
        result = minimize(
            lambda w, infos=infos: _value(infos, criterion, w), np.full(count, 1.0 / count), method="SLSQP",
            bounds=[(0.0, 1.0)] * count, constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
            options={"ftol": 1e-13, "maxiter": 300},
        )  # fmt: skip
        ours = _value(infos, criterion, weights)
        assert ours <= _value(infos, criterion, np.maximum(result.x, 0) / np.maximum(result.x, 0).sum()) + 1e-11
        assert ours >= result.fun - 1e-6
    assert (fused.weights == 0.0).any()  # a track that adds nothing is left out altogether


@CRITERIA
@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("batch", [1, FEW + 1])
@pytest.mark.parametrize("condition", [1e1, 1e12])
def test_a_track_better_along_every_axis_is_returned_itself(
    count: int, batch: int, condition: float, criterion: str
) -> None:
    rng = np.random.default_rng(17)
    best = rotated(rng, np.geomspace(1.0, condition, 4))
    cov = np.stack([best * (1.0 if k == 1 else 3.0 + k) for k in range(count)])
    cov = np.broadcast_to(cov, (batch, count, 4, 4))
    mean = rng.normal(size=(batch, count, 4))
    fused = fuse(mean, cov, criterion=criterion)
    assert fused.weights is not None
    np.testing.assert_array_equal(fused.weights, np.broadcast_to(np.arange(count) == 1, (batch, count)))
    np.testing.assert_array_equal(fused.mean, mean[:, 1])
    np.testing.assert_array_equal(fused.cov, cov[:, 1])


@pytest.mark.parametrize("weights", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_given_weight_one_returns_the_input_itself(weights: tuple[float, ...]) -> None:
    rng = np.random.default_rng(18)
    mean, cov = rng.normal(size=(7, 3, 4)), covariances(rng, 7, 3)
    fused = fuse(mean, cov, criterion="given", weights=weights)
    np.testing.assert_array_equal(fused.mean, mean[:, weights.index(1.0)])
    np.testing.assert_array_equal(fused.cov, cov[:, weights.index(1.0)])


@CRITERIA
@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("difference", [0.0, 1e-15, 1e-12, 1e-9, 1e-6])
def test_equal_and_nearly_equal_covariances(count: int, difference: float, criterion: str) -> None:
    """The weight is undefined, or nearly; the fused covariance is not."""
    rng = np.random.default_rng(19)
    base = covariances(rng, 30, 1)
    noise = rng.normal(size=(30, count, 4, 4)) * difference
    cov = base + noise + np.swapaxes(noise, -1, -2)
    fused = fuse(np.ones((30, count, 4)), cov, criterion=criterion)
    assert np.all(fused.info["converged"])
    np.testing.assert_allclose(fused.cov, base[:, 0], rtol=0, atol=20 * difference + 1e-12 * np.abs(base).max())
    np.testing.assert_allclose(fused.mean, 1.0, atol=1e-12)
    assert fused.weights is not None
    np.testing.assert_allclose(fused.weights.sum(-1), 1.0, atol=1e-12)
    if difference <= 1e-15:  # rounding does not decide whose mean is taken
        np.testing.assert_array_equal(fused.weights, 1.0 / count)


@CRITERIA
@pytest.mark.parametrize("batch", [1, FEW + 1])
def test_equal_covariances_of_extreme_spread_weigh_the_same(batch: int, criterion: str) -> None:
    cov = rotated(np.random.default_rng(23), np.geomspace(1.0, 1e13, 4))
    mean = np.broadcast_to(np.array([[0.0] * 4, [2.0] * 4]), (batch, 2, 4))
    fused = fuse(mean, np.broadcast_to(cov, (batch, 2, 4, 4)), criterion=criterion)
    np.testing.assert_array_equal(fused.weights, 0.5)
    np.testing.assert_allclose(fused.mean, 1.0, rtol=1e-6)
    np.testing.assert_allclose(fused.cov, np.broadcast_to(cov, (batch, 4, 4)), rtol=1e-6)


def test_one_axis() -> None:
    """Of two variances the smaller is the intersection."""
    fused = fuse(np.array([[1.0], [5.0]]), np.array([[[4.0]], [[9.0]]]))
    assert (fused.mean[0], fused.cov[0, 0]) == (1.0, 4.0)


def test_det_weights_do_not_depend_on_units_and_trace_weights_do() -> None:
    """From metres to kilometres for the positions alone: NUMERICS.md, a shift of .15 in the median for the trace."""
    rng = np.random.default_rng(20)
    mean, cov = rng.normal(size=(200, 2, 4)), covariances(rng, 200, 2)
    unit = np.array([1e-3, 1e-3, 1.0, 1.0])

    def shift(criterion: str) -> Array:
        here, there = (fuse(mean * u, cov * np.outer(u, u), criterion=criterion).weights for u in (np.ones(4), unit))
        assert here is not None
        assert there is not None
        return np.asarray(np.abs(here - there)[:, 0])

    assert shift("det").max() < 1e-7
    assert np.median(shift("trace")) > 0.05


@CRITERIA
def test_delicate_pairs_among_easy_ones_do_not_change_them(criterion: str) -> None:
    rng = np.random.default_rng(21)
    cov, mean = covariances(rng, 40, 2), rng.normal(size=(40, 2, 4))
    mixed = cov.copy()
    mixed[::3] = hard_pair("crossed", 1e12, rng)
    alone, among = fuse(mean, cov, criterion=criterion), fuse(mean, mixed, criterion=criterion)
    easy = np.arange(40) % 3 > 0
    np.testing.assert_allclose(among.mean[easy], alone.mean[easy], rtol=0, atol=1e-12)
    np.testing.assert_allclose(among.cov[easy], alone.cov[easy], rtol=0, atol=1e-12)
    hard = fuse(mean[::3], mixed[::3], criterion=criterion)
    np.testing.assert_allclose(among.cov[::3], hard.cov, rtol=1e-10)


def test_large_batches_are_worked_on_in_pieces_without_a_seam() -> None:
    rng = np.random.default_rng(22)
    for count, size in ((2, 2500), (3, 1300)):
        mean, cov = rng.normal(size=(size, count, 4)), covariances(rng, size, count)
        whole = fuse(mean, cov)
        part = fuse(mean[1000:1100], cov[1000:1100])
        np.testing.assert_allclose(whole.cov[1000:1100], part.cov, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(whole.mean[1000:1100], part.mean, rtol=1e-7, atol=1e-7)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(2, 4), st.floats(-12.0, 12.0), st.floats(0.0, 8.0),
    st.sampled_from(["det", "trace"]),
)  # fmt: skip
def test_never_worse_than_any_other_weights(
    seed: int, n: int, count: int, power: float, spread: float, criterion: str
) -> None:
    rng = np.random.default_rng(seed)
    cov = np.stack([rotated(rng, 10.0 ** rng.uniform(-spread / 2, spread / 2, n)) for _ in range(count)])
    cov *= 10.0**power
    fused = fuse(rng.normal(size=(count, n)) * 10.0 ** (power / 2), cov, criterion=criterion)
    assert fused.info["converged"]
    assert fused.weights is not None
    infos = np.linalg.inv(cov)
    ours = _value(infos, criterion, fused.weights)
    others = np.concatenate([rng.dirichlet(np.ones(count), 20), np.eye(count)])
    tolerance = 1e-9 + 1e3 * EPS * 10.0**spread
    assert ours <= min(_value(infos, criterion, w) for w in others) + tolerance


def test_equal_tracks_beside_others_in_a_batch() -> None:
    """A fusion that is done at once waits for the rest of its batch, at which its system had no solution."""
    cov = np.array([[1.0, 1.0, 2.0], [3.0, 3.0, 3.0], [4.0, 0.5, 1.0]])[..., None, None]
    fused = fuse(np.zeros((3, 3, 1)), cov)
    np.testing.assert_allclose(fused.cov[:, 0, 0], [1.0, 3.0, 0.5], rtol=1e-9)
