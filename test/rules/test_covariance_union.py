"""Covariance union: bounds of every track, smallest by an independent referee, in closed form where there is one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rules.examples import covariances, rotated
from scipy.linalg import eigh
from scipy.optimize import minimize

from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks, get_rule
from track_fusion.rules.covariance_union import RULE, CovarianceUnionParams

EPS = float(np.finfo(float).eps)
CRITERIA = pytest.mark.parametrize("criterion", ["det", "trace"])
MEANS = pytest.mark.parametrize("mean", ["arithmetic", "optimal"])


def fuse(x: Array, p: Array, /, **params: Any) -> FusedTracks:
    return RULE(SourceTracks(x, p), CovarianceUnionParams(**params))


def slack(fused: FusedTracks, mean: Array, cov: Array) -> Array:
    """Lowest eigenvalue of P - P_i - (x - x_i)(x - x_i)', relative to P, (..., K)."""
    offset = fused.mean[..., None, :] - mean
    rest = fused.cov[..., None, :, :] - cov - offset[..., :, None] * offset[..., None, :]
    white = np.linalg.inv(np.linalg.cholesky(fused.cov))[..., None, :, :]
    return np.asarray(np.linalg.eigvalsh(white @ rest @ np.swapaxes(white, -1, -2))[..., 0])


def value(cov: Array, criterion: str) -> float:
    return float(np.linalg.slogdet(cov)[1] if criterion == "det" else np.trace(cov))


# Bounds ---------------------------------------------------------------------------------------------------------------


@CRITERIA
@MEANS
@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("distance", [0.0, 1.0, 100.0])
def test_it_bounds_every_track_and_touches(criterion: str, mean: str, count: int, distance: float) -> None:
    """(7) of Li 2022: the fused covariance covers each track about the fused mean."""
    rng = np.random.default_rng(1)
    x, p = distance * rng.normal(size=(20, count, 4)), covariances(rng, 20, count)
    fused = fuse(x, p, criterion=criterion, mean=mean)
    assert np.all(fused.info["converged"])
    gap = slack(fused, x, p)
    assert gap.min() > -1e-12
    assert np.sort(gap, -1)[:, 0].max() < 1e-8  # not larger than it must be


@CRITERIA
@MEANS
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("condition", [1e7, 1e13])
def test_hard_tracks(criterion: str, mean: str, count: int, condition: float) -> None:
    rng = np.random.default_rng(2)
    p = np.stack(
        [[rotated(rng, rng.permutation(np.geomspace(1.0, condition, 4))) for _ in range(count)] for _ in range(6)]
    )
    x = rng.normal(size=(6, count, 4))
    fused = fuse(x, p, criterion=criterion, mean=mean)
    assert np.all(fused.info["converged"])
    assert slack(fused, x, p).min() > -(1e-12 + 100 * EPS * condition)
    assert np.linalg.eigvalsh(fused.cov)[:, 0].min() > 0.9


def test_the_bound_of_largest_trace_breaks_lemma_1() -> None:
    """ERRATA.md, footnote 3: P1 = diag(1, 4), P2 = diag(5, 1)."""
    cov = np.stack([np.diag([1.0, 4.0]), np.diag([5.0, 1.0])])
    assert slack(fuse(np.zeros((2, 2)), cov, bound="max_trace"), np.zeros((2, 2)), cov).min() == pytest.approx(-3.0)
    np.testing.assert_array_equal(fuse(np.zeros((2, 2)), cov, bound="max_trace").cov, cov[1])
    np.testing.assert_array_equal(fuse(np.zeros((2, 2)), cov, bound="min_trace").cov, cov[0])
    for criterion in ("det", "trace"):
        np.testing.assert_allclose(fuse(np.zeros((2, 2)), cov, criterion=criterion).cov, np.diag([5.0, 4.0]))


def test_bounds_as_printed_are_sides_of_largest_and_smallest_trace() -> None:
    rng = np.random.default_rng(3)
    x, p = rng.normal(size=(50, 3, 4)), covariances(rng, 50, 3)
    weights = (0.5, 0.3, 0.2)
    centre = np.einsum("k,bki->bi", weights, x)
    sides = p + np.einsum("bki,bkj->bkij", x - centre[:, None], x - centre[:, None])
    traces = np.trace(sides, axis1=-2, axis2=-1)
    for bound, chosen in (("max_trace", traces.max(1)), ("min_trace", traces.min(1))):
        fused = fuse(x, p, bound=bound, weights=weights)
        np.testing.assert_allclose(fused.mean, centre, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(np.trace(fused.cov, axis1=-2, axis2=-1), chosen, rtol=1e-12)
        assert (np.abs(sides - fused.cov[:, None]).max((2, 3)).min(1) < 1e-12).all()


# What it promises -----------------------------------------------------------------------------------------------------


def _ratio(errors: Array, cov: Array, **params: Any) -> float:
    """Largest mean squared error over the mean claim, in any direction, of errors (S, K, n) that all happen."""
    fused = fuse(errors, np.broadcast_to(cov, (*errors.shape[:2], *cov.shape[1:])), **params)
    error, claim = np.einsum("si,sj->ij", fused.mean, fused.mean), fused.cov.sum(0)
    return float(eigh(error, claim, eigvals_only=True)[-1])


def test_one_track_alone_that_is_right_leaves_twice_the_claim() -> None:
    """Track 1 exact, N(0, 1); track 2 claims 1 with three times track 1's error: 2; independent, sd 3: 2.5 / 3.5."""
    z = np.linspace(-8.0, 8.0, 4001)
    z = np.repeat(z, np.round(4000.0 * np.exp(-0.5 * z**2)).astype(int))
    z /= np.sqrt(np.mean(z**2))
    assert _ratio(np.stack([z, 3.0 * z], 1)[..., None], np.ones((2, 1, 1))) == pytest.approx(2.0)
    first, second = (a.ravel() for a in np.meshgrid([-1.0, 1.0], [-3.0, 3.0]))
    apart = _ratio(np.stack([first, second], 1)[..., None], np.ones((2, 1, 1)))
    assert apart == pytest.approx(2.5 / 3.5)


@CRITERIA
@pytest.mark.parametrize("mean", ["arithmetic", "diversity", "optimal"])
def test_twice_the_claim_is_the_most_when_one_track_is_right(mean: str, criterion: str) -> None:
    """P >= P_1 + d d', the error is that of track 1 plus d, and (a + b)(a + b)' <= 2 a a' + 2 b b': about any mean."""
    rng = np.random.default_rng(11)
    worst = 0.0
    for _ in range(12):
        count = int(rng.integers(2, 4))
        cov = covariances(rng, count, n=2)
        size = 10.0 ** rng.uniform(-1.0, 1.0, size=(count - 1, 1, 1))
        mix = size * rng.normal(size=(count - 1, 2, 2))
        right = rng.normal(size=(60, 2))
        right = right @ np.linalg.inv(np.linalg.cholesky(right.T @ right / 60)).T @ np.linalg.cholesky(cov[0]).T
        rest = np.einsum("kij,sj->ski", mix, right) + 0.2 * rng.uniform() * rng.normal(size=(60, count - 1, 2))
        errors = np.concatenate([right[:, None], rest], 1)
        worst = max(worst, _ratio(errors, cov, criterion=criterion, mean=mean))
    assert 1.2 < worst <= 2.0 + 1e-9


def test_the_descriptor_says_so() -> None:
    assert RULE.guarantee_at() == "conservative"
    assert "twice" in RULE.caveat
    assert "twice" in (RULE.fuse.__doc__ or "")
    for values in ({"mean": "optimal"}, {"mean": "diversity"}, {"bound": "max_trace"}, {"bound": "min_trace"}):
        assert RULE.guarantee_at(CovarianceUnionParams(**values)) == "none"


# Closed forms ---------------------------------------------------------------------------------------------------------


def test_two_tracks_about_one_mean_by_trace() -> None:
    """ERRATA.md: B + (A - B)_+, which is smaller in trace than T max(a, b) T'; that is smaller in determinant."""
    rng = np.random.default_rng(4)
    x, p = np.zeros((30, 2, 4)), covariances(rng, 30, 2)
    least = {c: fuse(x, p, criterion=c).cov for c in ("det", "trace")}
    values, vectors = np.linalg.eigh(p[:, 0] - p[:, 1])
    wanted = p[:, 1] + np.einsum("bij,bj,bkj->bik", vectors, np.maximum(values, 0.0), vectors)
    np.testing.assert_allclose(least["trace"], wanted, rtol=1e-12, atol=1e-12)
    gain = [np.trace(c, axis1=-2, axis2=-1) for c in least.values()]
    assert (gain[1] <= gain[0] * (1.0 + 1e-12)).all()
    assert (gain[1] < gain[0] - 1e-3).mean() > 0.8  # the others have one track that covers the other
    assert (np.linalg.det(least["det"]) <= np.linalg.det(least["trace"]) * (1.0 + 1e-12)).all()


@CRITERIA
def test_equal_covariances_meet_half_way(criterion: str) -> None:
    """P + d d' / 4 about the middle, d the difference of the means, whether the mean is sought or not."""
    rng = np.random.default_rng(5)
    p = np.repeat(covariances(rng, 20, 1), 2, 1)
    x = 3.0 * rng.normal(size=(20, 2, 4))
    d = x[:, 0] - x[:, 1]
    for mean in ("arithmetic", "optimal"):
        fused = fuse(x, p, criterion=criterion, mean=mean)
        np.testing.assert_allclose(fused.mean, x.mean(1), atol=1e-7)
        np.testing.assert_allclose(fused.cov, p[:, 0] + d[:, :, None] * d[:, None] / 4.0, rtol=1e-7, atol=1e-7)


def test_one_axis() -> None:
    """Two intervals: sqrt(P + ...) is the distance from x at which both variances are equal."""
    fused = fuse(np.array([[0.0], [4.0]]), np.array([[[9.0]], [[1.0]]]), mean="optimal")
    x = 1.0  # x^2 + 9 = (4 - x)^2 + 1
    assert fused.mean[0] == pytest.approx(x, abs=1e-7)
    assert fused.cov[0, 0] == pytest.approx(10.0, rel=1e-9)


@MEANS
@CRITERIA
@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_track_that_covers_all_others_is_returned(mean: str, criterion: str, count: int) -> None:
    rng = np.random.default_rng(6)
    p = covariances(rng, 9, count)
    p[:, 1] = 10.0 * p.sum(1)
    x = np.repeat(rng.normal(size=(9, 1, 4)), count, 1)
    fused = fuse(x, p, criterion=criterion, mean=mean)
    np.testing.assert_allclose(fused.cov, p[:, 1], rtol=1e-10)
    np.testing.assert_allclose(fused.mean, x[:, 1], rtol=1e-12)


# Referee --------------------------------------------------------------------------------------------------------------


def _two_about(x: Array, first: Array, second: Array, means: Array, criterion: str) -> float:
    """Smallest bound of two tracks about x, with scipy's eigenvalues."""
    a, b = (p + np.outer(x - m, x - m) for p, m in zip((first, second), means, strict=True))
    if criterion == "trace":
        return float(np.trace(b) + np.maximum(eigh(a - b, eigvals_only=True), 0.0).sum())
    return float(np.linalg.slogdet(b)[1] + np.log(np.maximum(eigh(a, b, eigvals_only=True), 1.0)).sum())


@CRITERIA
@pytest.mark.parametrize("distance", [0.5, 2.0, 20.0])
def test_the_optimal_mean_of_two_against_nelder_mead(criterion: str, distance: float) -> None:
    rng = np.random.default_rng(7)
    x, p = distance * rng.normal(size=(4, 2, 2)), covariances(rng, 4, 2, n=2)
    fused = fuse(x, p, criterion=criterion, mean="optimal")
    for m, q, cov in zip(x, p, fused.cov, strict=True):
        found = minimize(
            _two_about, m.mean(0), (q[0], q[1], m, criterion), method="Nelder-Mead",
            options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 800},
        )  # fmt: skip
        assert value(cov, criterion) == pytest.approx(found.fun, rel=1e-6)
        assert value(cov, criterion) <= found.fun + 1e-8 * abs(found.fun)


def _certificate(x: Array, p: Array, mean: Array, cov: Array, criterion: str, free: bool) -> tuple[float, float]:
    """Look for multipliers that prove the bound (mean, cov) smallest; return their residual and lowest eigenvalue.

    With Z_i positive semi-definite, on the directions in which track i touches the bound: sum of Z_i = the gradient of
    the criterion (one for log det, L' L for the trace, where the bound L L' is whitened), and, if the mean
    is free, the sum of their borders = 0. The problem is convex, so that this suffices.
    """
    lower, n = np.linalg.cholesky(cov), len(mean)
    white = np.linalg.inv(lower)
    gradient = np.eye(n) if criterion == "det" else lower.T @ lower
    wanted = np.zeros((n + free, n + free))
    wanted[:n, :n] = gradient / np.trace(gradient)
    seen = np.ones(wanted.shape, bool)
    seen[n:, n:] = False
    frames, columns = [], []
    for m, q in zip(x, p, strict=True):
        offset = (white @ (mean - m))[:, None]
        rest = np.eye(n) - white @ q @ white.T
        whole = np.block([[rest, offset], [offset.T, np.ones((1, 1))]]) if free else rest - offset @ offset.T
        values, vectors = np.linalg.eigh(whole)
        frame = vectors[:, values < 1e-6]
        frames.append(frame)
        for i, j in zip(*np.triu_indices(frame.shape[1]), strict=True):
            part = np.outer(frame[:, i], frame[:, j])
            columns.append((part + part.T if i < j else part)[seen])
    matrix = np.array(columns).T
    found = np.linalg.lstsq(matrix, wanted[seen], rcond=1e-9)[0]
    lowest, at = 0.0, 0
    for frame in frames:
        size = frame.shape[1]
        z, (i, j) = np.zeros((size, size)), np.triu_indices(size)
        z[i, j] = z[j, i] = found[at : at + len(i)]
        at += len(i)
        lowest = min([lowest, *np.linalg.eigvalsh(z)])
    return float(np.abs(matrix @ found - wanted[seen]).max()), float(lowest)


@CRITERIA
@MEANS
@pytest.mark.parametrize(("n", "count"), [(1, 3), (2, 2), (2, 3), (3, 3), (4, 5)])
def test_multipliers_prove_that_no_bound_is_smaller(criterion: str, mean: str, n: int, count: int) -> None:
    rng = np.random.default_rng(7)
    x, p = 2.0 * rng.normal(size=(12, count, n)), covariances(rng, 12, count, n=n)
    fused = fuse(x, p, criterion=criterion, mean=mean)
    for i in range(12):
        found = _certificate(x[i], p[i], fused.mean[i], fused.cov[i], criterion, mean == "optimal")
        assert found[0] < 1e-5
        assert found[1] > -1e-6


def test_the_certificate_is_refused_to_larger_bounds() -> None:
    """But where one track covers the others, and every criterion gives the same."""
    rng = np.random.default_rng(8)
    x, p = 2.0 * rng.normal(size=(8, 3, 3)), covariances(rng, 8, 3, n=3)
    other = fuse(x, p, criterion="trace", mean="arithmetic")
    for criterion, free in (("det", False), ("trace", True)):
        proofs = [_certificate(x[i], p[i], other.mean[i], other.cov[i], criterion, free) for i in range(8)]
        assert sum(max(residual, -lowest) > 1e-3 for residual, lowest in proofs) >= 5


@CRITERIA
@pytest.mark.parametrize("count", [2, 4])
def test_the_optimal_mean_is_better_than_any_other(criterion: str, count: int) -> None:
    rng = np.random.default_rng(8)
    x, p = 2.0 * rng.normal(size=(4, count, 3)), covariances(rng, 4, count, n=3)
    best = fuse(x, p, criterion=criterion, mean="optimal")
    for _ in range(15):
        weights = tuple(rng.dirichlet(np.ones(count)))
        other = fuse(x, p, criterion=criterion, weights=weights)
        for i in range(4):
            assert value(best.cov[i], criterion) <= value(other.cov[i], criterion) + 1e-9


def test_above_the_arithmetic_average_about_the_same_mean() -> None:
    """ERRATA.md: AA <= CU in the Loewner order when CU is a true upper bound."""
    rng = np.random.default_rng(9)
    x, p = rng.normal(size=(50, 3, 4)), covariances(rng, 50, 3)
    rule = get_rule("arithmetic_average")
    average = rule(SourceTracks(x, p), rule.params(criterion="uniform"))  # type: ignore[call-arg]
    for criterion in ("det", "trace"):
        assert np.linalg.eigvalsh(fuse(x, p, criterion=criterion).cov - average.cov).min() > -1e-9


@CRITERIA
@pytest.mark.parametrize("count", [2, 3])
def test_about_the_mean_of_the_arithmetic_average(criterion: str, count: int) -> None:
    """x_AA of Li 2022, at the weights (40), and still above the average itself."""
    rng = np.random.default_rng(10)
    x, p = rng.normal(size=(30, count, 4)), covariances(rng, 30, count)
    average = get_rule("arithmetic_average")(SourceTracks(x, p))
    fused = fuse(x, p, mean="diversity", criterion=criterion)
    np.testing.assert_allclose(fused.mean, average.mean, atol=1e-9)
    np.testing.assert_allclose(fused.weights, average.weights, atol=1e-12)
    assert np.linalg.eigvalsh(fused.cov - average.cov).min() > -1e-9
    assert slack(fused, x, p).min() > -1e-12


def test_parameters_that_do_not_go_together() -> None:
    x, p = np.zeros((2, 2)), np.stack([np.eye(2)] * 2)
    with pytest.raises(ValueError) as caught:
        fuse(x, p, mean="optimal", bound="max_trace")
    assert str(caught.value) == "The 'mean' parameter 'optimal' needs bound 'optimal'. Got bound 'max_trace'."
    for mean in ("optimal", "diversity"):
        with pytest.raises(ValueError) as caught:
            fuse(x, p, mean=mean, weights=(0.5, 0.5))
        assert str(caught.value) == f"The 'weights' parameter needs mean 'arithmetic'. Got mean '{mean}'."
    with pytest.raises(ValueError, match=r"The 'weights' parameter must hold one weight a source, 2. Got 3."):
        fuse(x, p, weights=(0.5, 0.25, 0.25))
