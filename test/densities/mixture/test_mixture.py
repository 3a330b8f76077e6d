"""Gaussian mixtures against scipy, quadrature and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from densities.mixture.examples import draw
from oracles.mixtures import by_scipy
from scipy import integrate
from scipy.stats import multivariate_normal

from track_fusion.densities.log_domain import effective_sample_size, log_mean_exp, log_sum_exp, normalised
from track_fusion.densities.mixture import mixture as mixtures
from track_fusion.densities.mixture.algebra import LogMixture, gaussian_quotient, power, product
from track_fusion.densities.mixture.mixture import Factored, Mixture


def test_log_pdf_is_that_of_scipy_with_and_without_a_batch() -> None:
    rng = np.random.default_rng(0)
    mixture, points = draw(rng, 2, 3, n=3, count=4), 4.0 * rng.normal(size=(2, 3, 50, 3))
    got = mixtures.log_pdf(mixture, points)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(got[i], by_scipy(mixture.at(i), points[i]), rtol=1e-11)
    shared = mixtures.log_pdf(mixture.at((0, 0)), points)  # leading axes broadcast
    np.testing.assert_allclose(shared[1, 2], by_scipy(mixture.at((0, 0)), points[1, 2]), rtol=1e-11)
    assert mixtures.log_pdf(mixture.at((slice(0, 0),)), points[:0]).shape == (0, 3, 50)
    assert mixtures.log_pdf(mixture, points[..., :0, :]).shape == (2, 3, 0)


def test_log_pdf_does_not_depend_on_the_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    mixture, points = draw(rng, 5, count=7), rng.normal(size=(5, 333, 2))
    whole = mixtures.log_pdf(mixture, points)
    for size in (1, 50, 4000, 10**9):
        monkeypatch.setattr(mixtures, "CHUNK", size)
        np.testing.assert_allclose(mixtures.log_pdf(mixture, points), whole, rtol=1e-13)


def test_log_pdf_far_from_every_component_and_without_weight() -> None:
    mixture = Mixture(np.array([0.5, 0.5, 0.0]), np.array([[0.0], [1.0], [1e4]]), np.ones((3, 1, 1)))
    got = mixtures.log_pdf(mixture, np.array([[1e4]]))
    wanted = np.log(0.5) - 0.5 * (1e4 - 1.0) ** 2 - 0.5 * np.log(2 * np.pi)
    assert got[0] == pytest.approx(wanted, rel=1e-14)  # the component of weight 0 does not count
    with pytest.raises(np.linalg.LinAlgError):
        mixtures.log_pdf(Mixture(np.ones(1), np.zeros((1, 2)), np.zeros((1, 2, 2))), np.zeros((1, 2)))


def test_derivatives_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(2)
    factored = Factored.of(draw(rng, 2, n=3))
    points, step = 3.0 * rng.normal(size=(2, 6, 3)), 1e-5
    value, gradient, hessian = factored.derivatives(points)
    np.testing.assert_allclose(value, factored.log_pdf(points), rtol=1e-12)
    for i in range(3):
        move = step * np.eye(3)[i]
        ahead, behind = factored.derivatives(points + move), factored.derivatives(points - move)
        np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * step), gradient[..., i], atol=1e-7)
        np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * step), hessian[..., i], atol=1e-7)


def test_samples_have_the_moments_and_shares_of_the_mixture() -> None:
    rng = np.random.default_rng(3)
    mixture = draw(rng, 2)
    drawn = mixtures.sample(mixture, np.random.default_rng(1), 40000)
    mean, cov = mixtures.moments(mixture)
    share = (drawn.label[..., None] == np.arange(3)).mean(1)
    np.testing.assert_allclose(share, mixture.weight, atol=2 / 40000)
    for k in range(2):
        sigma = np.sqrt(np.diag(cov[k]))
        assert (np.abs(drawn.points[k].mean(0) - mean[k]) < 4 * sigma / 200).all()
        np.testing.assert_allclose(np.cov(drawn.points[k].T), cov[k], atol=0.05 * np.trace(cov[k]))
        alone = mixtures.sample(mixture.at(k), np.random.default_rng(1), 40000)
        np.testing.assert_array_equal(alone.points, drawn.points[k])  # whatever else is in the batch


def test_product_is_the_product_of_the_densities() -> None:
    rng = np.random.default_rng(4)
    first, second = draw(rng, 3, count=2), draw(rng, 3, count=4)
    both = product(LogMixture.of(first), LogMixture.of(second))
    points = 3.0 * rng.normal(size=(3, 20, 2))
    got = Factored.of(Mixture(np.exp(both.log_weight), both.mean, both.cov)).log_pdf(points)
    np.testing.assert_allclose(got, mixtures.log_pdf(first, points) + mixtures.log_pdf(second, points), rtol=1e-10)


def test_product_of_disjoint_mixtures_keeps_its_logarithms() -> None:
    first = Mixture(np.array([0.5, 0.5]), np.array([[0.0], [1.0]]), np.ones((2, 1, 1)))
    second = Mixture(np.array([1.0]), np.array([[1e4]]), np.ones((1, 1, 1)))
    both = product(LogMixture.of(first), LogMixture.of(second))
    assert np.isfinite(both.log_weight).all()
    np.testing.assert_allclose(both.mean[:, 0], [5000.0, 5000.5])
    assert both.log_weight[1] - both.log_weight[0] == pytest.approx((1e8 - 9999.0**2) / 4)
    np.testing.assert_allclose(both.normalised.weight, [0.0, 1.0])


def test_product_of_vague_and_sharp_axes_against_mpmath() -> None:
    import mpmath

    angle = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    p1, p2 = angle @ np.diag([1e-4, 1e6]) @ angle.T, angle @ np.diag([1e5, 1e-3]) @ angle.T
    m1, m2 = np.array([1.0, 2.0]), np.array([-1.0, 2.5])
    both = product(LogMixture(np.zeros(1), m1[None], p1[None]), LogMixture(np.zeros(1), m2[None], p2[None]))
    with mpmath.workdps(60):
        i1, i2 = mpmath.matrix(p1.tolist()) ** -1, mpmath.matrix(p2.tolist()) ** -1
        cov = (i1 + i2) ** -1
        mean = cov * (i1 * mpmath.matrix(m1.tolist()) + i2 * mpmath.matrix(m2.tolist()))
    wanted = np.array(cov.tolist(), float)
    np.testing.assert_allclose(both.cov[0], wanted, rtol=1e-5, atol=1e-5 * wanted.diagonal().min())
    np.testing.assert_allclose(both.mean[0], np.array(mean.tolist(), float)[:, 0], atol=1e-5)


def test_power_of_one_component_is_exact_and_of_several_adds_up() -> None:
    rng = np.random.default_rng(5)
    one, points = draw(rng, 3, count=1), 3.0 * rng.normal(size=(3, 20, 2))
    omega = np.array([0.2, 0.5, 0.9])
    raised = power(LogMixture.of(one), omega)
    got = Factored.of(Mixture(np.exp(raised.log_weight), raised.mean, raised.cov)).log_pdf(points)
    np.testing.assert_allclose(got, omega[:, None] * mixtures.log_pdf(one, points), rtol=1e-10)
    several = draw(rng, count=3)
    raised = power(LogMixture.of(several), 0.3)
    got = np.exp(Factored.of(Mixture(np.exp(raised.log_weight), raised.mean, raised.cov)).log_pdf(points[0]))
    wanted = (np.exp(Factored.of(several).joint(points[0])) ** 0.3).sum(0)
    np.testing.assert_allclose(got, wanted, rtol=1e-10)


def test_gaussian_quotient_times_denominator_is_the_numerator() -> None:
    rng = np.random.default_rng(6)
    one = draw(rng, 4, count=1, n=3)
    mean, cov = one.mean[:, 0], one.cov[:, 0]
    other_cov = 1.5 * cov + np.eye(3)
    other = mean + rng.normal(size=(4, 3))
    found = gaussian_quotient(mean, cov, other, other_cov)
    assert found.proper.all()
    for k in range(4):
        x = mean[k] + rng.normal(size=(5, 3))
        got = found.log_scale[k] + multivariate_normal.logpdf(x, found.mean[k], found.cov[k])
        wanted = multivariate_normal.logpdf(x, mean[k], cov[k]) - multivariate_normal.logpdf(x, other[k], other_cov[k])
        np.testing.assert_allclose(got, wanted, rtol=1e-9)


def test_gaussian_quotient_that_is_no_gaussian_says_so() -> None:
    cov = np.stack([np.diag([1.0, 4.0])] * 3)
    other = np.stack([cov[0], np.diag([2.0, 3.0]), 2 * cov[0]])
    found = gaussian_quotient(np.zeros((3, 2)), cov, np.ones((3, 2)), other)
    np.testing.assert_array_equal(found.proper, [False, False, True])
    assert np.isfinite(found.log_scale).all()


def test_effective_sample_size_and_log_sums() -> None:
    even = np.zeros((2, 100)) - 1e5
    np.testing.assert_allclose(effective_sample_size(even), 100.0)
    one = np.full(100, -np.inf)
    one[3] = -5.0
    assert effective_sample_size(one) == pytest.approx(100 / 101)  # cv^2 is 100
    assert effective_sample_size(np.full(100, -np.inf)) == 0.0
    weight = np.random.default_rng(0).random(50)
    variation = weight.var(ddof=1) / weight.mean() ** 2
    assert effective_sample_size(np.log(weight)) == pytest.approx(50 / (1 + variation))  # Ahmed (40)
    assert log_sum_exp(np.array([-1e6, -1e6])) == pytest.approx(-1e6 + np.log(2))
    assert log_mean_exp(np.log(weight)) == pytest.approx(np.log(weight.mean()))
    assert log_sum_exp(np.array([-np.inf, -np.inf])) == -np.inf
    np.testing.assert_allclose(normalised(np.array([0.0, -np.inf, 0.0])), [0.5, 0.0, 0.5])


def test_the_integral_of_a_product_is_the_sum_of_its_weights() -> None:
    rng = np.random.default_rng(7)
    first, second = draw(rng, count=2, n=1, spread=1.0), draw(rng, count=3, n=1, spread=1.0)
    both = product(LogMixture.of(first), LogMixture.of(second))

    def density(x: float) -> float:
        point = np.array([[x]])
        return float(np.exp(mixtures.log_pdf(first, point) + mixtures.log_pdf(second, point))[0])

    wanted = integrate.quad(density, -60, 60, points=[0.0], limit=400)[0]
    assert np.exp(both.log_weight).sum() == pytest.approx(wanted, rel=1e-8)
