"""Averages of variables: the checked figures of Li 2019, Monte Carlo, scipy's quadrature and searches."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenarios.li2019.quadrature import positive_normal_pair
from scipy.integrate import dblquad
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from track_fusion.densities.gaussian import weighted_product
from track_fusion.linalg import Array, merged_moments
from track_fusion.scenarios.li2019.averages import (
    arithmetic_average,
    arithmetic_moments,
    average_moments,
    best_pair_weights,
    density_average,
    density_moments,
    error_moments,
    geometric_average,
    lognormal_moments,
    relative_variance,
    variance_bounds,
)

MEAN, VARIANCES = np.array([50.0, 60.0]), np.array([100.0, 200.0])


def _cov(correlation: float) -> Array:
    sigma = np.sqrt(VARIANCES)
    return np.outer(sigma, sigma) * np.array([[1.0, correlation], [correlation, 1.0]])


def _pair(first: Array | float) -> Array:
    return np.stack([first, 1.0 - np.asarray(first)], -1)


# Figures -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("correlation", "aa", "ga", "aa_at", "ga_at"), [(0.0, 66.67, 69.67, 0.667, 0.64), (0.6, 98.23, 98.99, None, None)]
)
def test_figure_1_minima(correlation: float, aa: float, ga: float, aa_at: float | None, ga_at: float | None) -> None:
    values, probability = positive_normal_pair(MEAN, _cov(correlation))
    for geometric, least, at in ((False, aa, aa_at), (True, ga, ga_at)):

        def variance(w: float, geometric: bool = geometric) -> float:
            return float(average_moments(values, probability, _pair(w), geometric)[1])

        found = minimize_scalar(variance, bounds=(0, 1), method="bounded")
        assert found.fun == pytest.approx(least, abs=0.03)
        if at is not None:
            assert found.x == pytest.approx(at, abs=0.005)
    exact = variance_bounds(*VARIANCES, np.asarray(correlation))[0]
    assert exact == pytest.approx(aa, abs=0.01)  # the closed form (20)


def test_figure_1_crosses_over_and_dual_bounds() -> None:
    """Remark 2, and the bound (21) at the correlation .70846 > alpha^-1/2."""
    values, probability = positive_normal_pair(MEAN, _cov(0.0))
    w = _pair(np.array([0.1, 0.9]))
    aa, ga = (average_moments(values, probability, w, g)[1] for g in (False, True))
    assert aa[0] > ga[0]
    assert aa[1] < ga[1]
    assert variance_bounds(*VARIANCES, np.asarray(0.70846)) == (100.0, 200.0)


@pytest.mark.parametrize(("variances", "aa", "ga"), [((100.0, 200.0), 175.0, 133.33), ((400.0, 200.0), 325.0, 266.67)])
def test_figures_5_and_6_averages_of_densities(variances: tuple[float, float], aa: float, ga: float) -> None:
    """Moments of the rules' kernels (32)-(35) and on a grid; the mean square errors (40), (41) follow."""
    cov, half = np.array(variances)[:, None, None], np.array([0.5, 0.5])
    nodes, width = np.linspace(-150.0, 260.0, 40_001), np.full(40_001, 410.0 / 40_000)
    densities = np.stack([multivariate_normal(m, v).pdf(nodes) for m, v in zip(MEAN, variances, strict=True)])
    for geometric, kernel, wanted in ((False, merged_moments, aa), (True, weighted_product, ga)):
        mean, fused = kernel(MEAN[:, None], cov, half)
        assert fused[0, 0] == pytest.approx(wanted, abs=0.005)
        density = density_average(densities, width, half, geometric)
        np.testing.assert_allclose(density_moments(nodes, density, width), (mean[0], fused[0, 0]), rtol=1e-6)
        mse = ((nodes - 80.0) ** 2 * density) @ width
        assert mse == pytest.approx(fused[0, 0] + (mean[0] - 80.0) ** 2, rel=1e-6)
        if not geometric:
            assert mse == pytest.approx(0.5 * sum(v + (m - 80.0) ** 2 for m, v in zip(MEAN, variances, strict=True)))


def test_appendix_b() -> None:
    """Two unbiased densities, one of them not symmetric: the geometric average is biased, 3 sqrt(2) / 5."""
    end = 4.0 * math.sqrt(2.0) / 3.0
    points, share = np.polynomial.legendre.leggauss(400)
    inner, outer = math.sqrt(2.0), end  # the second density ends at sqrt(2): two panels
    nodes = np.concatenate([0.5 * inner * (points + 1), inner + 0.5 * (outer - inner) * (points + 1)])
    width = np.concatenate([0.5 * inner * share, 0.5 * (outer - inner) * share])
    densities = np.stack([np.full(800, 1.0 / end), np.where(nodes < inner, nodes, 0.0)])
    half, theta = np.array([0.5, 0.5]), 2.0 * math.sqrt(2.0) / 3.0
    for density in densities:
        assert density_moments(nodes, density, width)[0] == pytest.approx(theta, rel=1e-12)
    averages = {g: density_average(densities, width, half, g) for g in (False, True)}
    assert density_moments(nodes, averages[False], width)[0] == pytest.approx(theta, rel=1e-12)
    assert density_moments(nodes, averages[True], width)[0] == pytest.approx(3.0 * math.sqrt(2.0) / 5.0, rel=1e-6)


# Formulas ------------------------------------------------------------------------------------------------------------


def test_moments_against_monte_carlo() -> None:
    """(12)-(13), (23)-(24) for four correlated lognormal variables, each within four standard errors."""
    rng = np.random.default_rng(1)
    root = 0.2 * rng.normal(size=(4, 4))
    log_mean, log_cov = np.array([1.0, 1.2, 0.8, 1.1]), root @ root.T
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    x = np.exp(rng.multivariate_normal(log_mean, log_cov, size=400_000))
    mean, variance = lognormal_moments(log_mean, np.diagonal(log_cov))
    cov = np.outer(mean, mean) * np.expm1(log_cov)
    np.testing.assert_allclose(np.diagonal(cov), variance, rtol=1e-12)
    log_moments = arithmetic_moments(log_mean, log_cov, weights)
    geometric = lognormal_moments(*log_moments)
    arithmetic = arithmetic_moments(mean, cov, weights)
    uniform = np.full(len(x), 1.0 / len(x))
    for average, moments, flag in ((arithmetic_average, arithmetic, False), (geometric_average, geometric, True)):
        sample = average(x, weights)
        deviation = (sample - sample.mean()) ** 2
        assert abs(sample.mean() - moments[0]) < 4.0 * sample.std() / math.sqrt(len(x))
        assert abs(deviation.mean() - moments[1]) < 4.0 * deviation.std() / math.sqrt(len(x))
        np.testing.assert_allclose(average_moments(x, uniform, weights, flag), (sample.mean(), sample.var()), rtol=1e-9)
    truth = 2.7
    square = (arithmetic_average(x, weights) - truth) ** 2
    mse = arithmetic_moments(mean, error_moments(mean, cov, truth), weights)[1]
    assert abs(square.mean() - mse) < 4.0 * square.std() / math.sqrt(len(x))
    assert mse == pytest.approx(arithmetic[1] + (arithmetic[0] - truth) ** 2)
    assert geometric[0] < arithmetic[0]  # section 3.1


def test_geometric_moments_against_scipy_quadrature() -> None:
    cov, w = _cov(0.6), np.array([0.3, 0.7])
    pdf = multivariate_normal(MEAN, cov).pdf

    def moment(power: float) -> float:

        def integrand(y: float, x: float) -> float:
            return float(pdf([x, y]) * (x ** w[0] * y ** w[1]) ** power)

        return float(dblquad(integrand, 0.0, 120.0, 0.0, 160.0, epsabs=1e-7, epsrel=1e-7)[0])

    mass, mean = moment(0.0), moment(1.0)
    got = average_moments(*positive_normal_pair(MEAN, cov), w, True)
    assert got[0] == pytest.approx(mean / mass, rel=1e-6)
    assert got[1] == pytest.approx(moment(2.0) / mass - (mean / mass) ** 2, rel=1e-4)


def test_best_pair_weights_against_a_search() -> None:
    """(19)-(21) for ratios on both sides of one; the variance is never below the bound nor above (16)."""
    for ratio in (0.05, 0.5, 1.0, 2.0, 30.0):
        for correlation in (-0.99, -0.3, 0.0, 0.2, 0.6, 0.9, 0.999):
            best = minimize_scalar(
                lambda w, a=ratio, r=correlation: float(relative_variance(w, a, r)), bounds=(0, 1), method="bounded",
                options={"xatol": 1e-12},
            )  # fmt: skip
            weights = best_pair_weights(np.asarray(ratio), np.asarray(correlation))
            assert weights.sum() == 1.0
            low, high = variance_bounds(np.asarray(3.0), np.asarray(3.0 * ratio), np.asarray(correlation))
            assert low == pytest.approx(3.0 * best.fun, rel=1e-6)
            inside = 0.0 < weights[1] < 1.0
            assert inside == (correlation < math.sqrt(min(ratio, 1.0 / ratio)))  # (22)
            if inside:  # (20)
                cross = correlation * math.sqrt(ratio)
                assert low == pytest.approx(3 * ratio * (1 - correlation**2) / (1 + ratio - 2 * cross), rel=1e-9)
            w = np.linspace(0.0, 1.0, 101)
            every = 3.0 * relative_variance(w, np.asarray(ratio), np.asarray(correlation))
            assert every.min() >= low * (1 - 1e-12)
            assert every.max() <= high * (1 + 1e-12)
            cov = 3.0 * np.array([[1.0, correlation * math.sqrt(ratio)], [correlation * math.sqrt(ratio), ratio]])
            np.testing.assert_allclose(arithmetic_moments(np.zeros(2), cov, _pair(1.0 - w))[1], every, rtol=1e-12)
    np.testing.assert_array_equal(best_pair_weights(np.asarray(1.0), np.asarray(1.0)), [0.5, 0.5])


def test_conclusion_2_does_not_hold_for_any_two_variables() -> None:
    """Two i.i.d. lognormals: the geometric average has less variance than the best arithmetic one."""
    mean, variance = lognormal_moments(np.zeros(2), np.ones(2))
    half = np.array([0.5, 0.5])
    aa = variance_bounds(variance[0], variance[1], np.asarray(0.0))[0]
    ga = lognormal_moments(*arithmetic_moments(np.zeros(2), np.eye(2), half))[1]
    assert ga < 0.5 * aa
    assert mean[0] > 1.0


def test_wrong_input() -> None:
    with pytest.raises(ValueError, match="must be non-negative and sum to 1"):
        arithmetic_average(np.ones(2), np.array([0.5, 0.6]))
    with pytest.raises(ValueError, match=r"values that are not negative\. Got -1\.0"):
        geometric_average(np.array([-1.0, 2.0]), np.array([0.5, 0.5]))
    with pytest.raises(ValueError, match="needs a common support"):
        density_average(np.array([[1.0, 0.0], [0.0, 1.0]]), np.ones(2), np.array([0.5, 0.5]), True)
    assert geometric_average(np.array([0.0, 5.0]), np.array([0.0, 1.0])) == pytest.approx(5.0)
    assert geometric_average(np.array([0.0, 5.0]), np.array([0.5, 0.5])) == 0.0
