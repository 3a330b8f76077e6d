"""The harmonic mean of K Gaussians over one Gaussian: its definition by summation, its ends, hard covariances."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np
import pytest
from rules.examples import covariances, rotated
from scipy.optimize import minimize
from scipy.stats import norm

from track_fusion.densities.harmonic import HarmonicMean
from track_fusion.densities.log_domain import log_sum_exp
from track_fusion.linalg import Array, merged_moments
from track_fusion.rules import SourceTracks, get_rule
from track_fusion.weights.merging import merging_weights, merging_weights_by_trace


def test_the_denominator_is_the_mixture_of_products_of_all_but_one() -> None:
    """In one axis, by summation: their integrals, moments, and P^-1 = sum of P_j^-1 - M^-1."""
    x = np.linspace(-30.0, 30.0, 60001)
    mean, variance, weights = np.array([-1.0, 0.5, 2.0]), np.array([1.0, 2.0, 0.7]), np.array([0.2, 0.5, 0.3])
    logs = norm(mean[:, None], np.sqrt(variance)[:, None]).logpdf(x)
    parts = np.exp(logs.sum(0) - logs)  # of all but each
    denominator = (weights[:, None] * parts).sum(0)
    share = denominator / denominator.sum()
    centre = share @ x
    spread = share @ (x - centre) ** 2
    harmonic = HarmonicMean.of(mean[None, :, None], variance[None, :, None, None])
    shares = harmonic.shares(weights[None])
    np.testing.assert_allclose(shares[0], weights * parts.sum(1) / (weights @ parts.sum(1)), rtol=1e-9)
    np.testing.assert_allclose(harmonic.weights(shares)[0], weights, rtol=1e-12)
    info = (1.0 / variance).sum() - 1.0 / spread
    fused_mean, fused_cov = harmonic.at(shares)
    assert fused_cov[0, 0, 0] == pytest.approx(1.0 / info, rel=1e-9)
    assert fused_mean[0, 0] == pytest.approx(((mean / variance).sum() - centre / spread) / info, rel=1e-9)


def test_two_gaussians_are_those_of_the_rule() -> None:
    rng = np.random.default_rng(0)
    mean, cov = 2.0 * rng.normal(size=(20, 2, 4)), covariances(rng, 20, 2)
    fused = get_rule("harmonic_mean")(SourceTracks(mean, cov))
    assert fused.weights is not None
    got = HarmonicMean.of(mean, cov).at(fused.weights)
    np.testing.assert_allclose(got[0], fused.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got[1], fused.cov, rtol=1e-9, atol=1e-9)


def _by_mpmath(mean: Array, cov: Array, shares: list[float]) -> tuple[Any, Any]:
    """Mean and covariance by their definition, with eighty digits."""
    infos = [mpmath.matrix(c.tolist()) ** -1 for c in cov]
    means = [mpmath.matrix(m.tolist()) for m in mean]
    n = len(mean[0])
    total = sum(infos, mpmath.zeros(n))
    pull = sum((i * m for i, m in zip(infos, means, strict=True)), mpmath.zeros(n, 1))
    covs = [(total - i) ** -1 for i in infos]
    points = [c * (pull - i * m) for c, i, m in zip(covs, infos, means, strict=True)]
    centre = sum((s * p for s, p in zip(shares, points, strict=True)), mpmath.zeros(n, 1))
    spread = [c + (p - centre) * (p - centre).T for c, p in zip(covs, points, strict=True)]
    rest = sum((s * q for s, q in zip(shares, spread, strict=True)), mpmath.zeros(n)) ** -1
    fused = (total - rest) ** -1
    return fused * (pull - rest * centre), fused


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize(("condition", "worst"), [(1.0, 1e-12), (1e7, 1e-8), (1e13, 5e-3)])
def test_hard_covariances(count: int, condition: float, worst: float) -> None:
    """Each vague where others are sharp, in random orientations; of condition 1e13 an input itself is known to 1e-3."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(10):
        cov = np.array([rotated(rng, rng.permutation(np.geomspace(1.0 / condition, 1.0, 4))) for _ in range(count)])
        mean, shares = rng.normal(size=(count, 4)) * condition**-0.5, rng.dirichlet(np.ones(count))
        harmonic = HarmonicMean.of(mean[None], cov[None])
        got = [a[0] for a in harmonic.at(shares[None])]
        with mpmath.workdps(80):
            wanted = _by_mpmath(mean, cov, shares.tolist())
            white = mpmath.cholesky(wanted[1]) ** -1
            gap = white * (mpmath.matrix(got[0].tolist()) - wanted[0])
            error = white * (mpmath.matrix(got[1].tolist()) - wanted[1]) * white.T
            errors.append(float(max(abs(v) for v in (*error, *gap))))
        for k in range(count):  # a single share gives that Gaussian itself
            alone = harmonic.at(np.eye(count)[k][None])
            np.testing.assert_array_equal(alone[0][0], mean[k])
            np.testing.assert_array_equal(alone[1][0], cov[k])
    assert max(errors) < worst


def test_it_claims_no_more_than_intersection_at_the_shares_and_no_less_than_the_naive_product() -> None:
    rng = np.random.default_rng(2)
    mean, cov = 2.0 * rng.normal(size=(30, 4, 3)), covariances(rng, 30, 4, n=3)
    harmonic = HarmonicMean.of(mean, cov)
    shares = rng.dirichlet(np.ones(4), 30)
    fused, info = np.linalg.inv(harmonic.at(shares)[1]), np.linalg.inv(cov)
    assert np.linalg.eigvalsh(info.sum(1) - fused).min() > 0.0
    assert np.linalg.eigvalsh(fused - np.einsum("bk,bkij->bij", shares, info)).min() > -1e-12


def test_far_apart_a_weight_is_small_and_never_forgotten() -> None:
    """Two agree, one is a thousand standard deviations away: its weight is below all floats, and still no zero."""
    harmonic = HarmonicMean.of(np.array([[[0.0], [0.5], [1000.0]]]), np.ones((1, 3, 1, 1)))
    weights = harmonic.weights(np.array([[0.25, 0.25, 0.5]]))
    assert (weights > 0.0).all()
    assert np.isfinite(harmonic.at(np.array([[0.25, 0.25, 0.5]]))[0]).all()
    np.testing.assert_array_equal(harmonic.weights(np.array([[0.5, 0.0, 0.5]]))[:, 1], 0.0)


# Weights.


def _least(value: object, count: int) -> float:
    """Lowest value over the simplex that SciPy finds."""
    starts = [np.full(count, 1.0 / count), *(0.9 * np.eye(count) + 0.1 / count)]
    return min(
        minimize(
            value, start, method="SLSQP", bounds=[(0.0, 1.0)] * count, options={"ftol": 1e-14, "maxiter": 500},
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
        ).fun
        for start in starts
    )  # fmt: skip


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_no_weights_make_the_denominator_larger(criterion: str, count: int) -> None:
    rng = np.random.default_rng(3)
    mean, cov = 2.0 * rng.normal(size=(6, count, 3)), covariances(rng, 6, count, n=3)
    cov[:, :, 0] *= 10.0
    cov[:, :, :, 0] *= 10.0  # an axis in other units, which the trace sees
    if criterion == "trace":
        search = merging_weights_by_trace(mean, cov)
    else:
        search = merging_weights(mean, cov, np.zeros((6, count)))
    assert search.converged.all()
    for b in range(6):

        def value(w: Array, b: int = b) -> float:
            spread = merged_moments(mean[b], cov[b], w / w.sum())[1]
            return float(np.trace(np.linalg.inv(spread)) if criterion == "trace" else -np.linalg.slogdet(spread)[1])

        least = _least(value, count)
        assert value(search.weights[b]) <= least + 1e-7 * abs(least)


def test_logarithms_of_sums_hold_at_the_scale_of_the_shares() -> None:
    """c_i of equal Gaussians are equal, and shares are then the weights."""
    harmonic = HarmonicMean.of(np.zeros((1, 3, 2)), np.tile(np.eye(2), (1, 3, 1, 1)))
    np.testing.assert_allclose(harmonic.log_scale - log_sum_exp(harmonic.log_scale)[:, None], -np.log(3.0))
    np.testing.assert_allclose(harmonic.shares(np.array([[0.2, 0.3, 0.5]])), [[0.2, 0.3, 0.5]])
