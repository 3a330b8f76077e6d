"""Quotients of mixtures: bounds, integrability, modes and moments against quadrature and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from densities.mixture.examples import COMMON, FIRST, SECOND, draw, mixand_moments, scalar
from scipy.optimize import minimize

from track_fusion.densities.mixture.algebra import LogMixture
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, moments
from track_fusion.densities.mixture.quotient import (
    exact_bound,
    exact_quotient,
    laplace,
    moment_matched,
    wep_bound,
    wep_quotient,
)
from track_fusion.linalg import Array


@pytest.mark.parametrize("z", range(4))
def test_bounds_lie_above_the_mixands(z: int) -> None:
    exact = exact_quotient(FIRST, SECOND, COMMON)
    bound = exact_bound(exact, COMMON)
    assert bound.sure.all()
    assert np.exp(bound.log_weight[z]) >= mixand_moments(exact, z)[0]
    omega = np.array(0.3)
    assert np.exp(wep_bound(FIRST, SECOND, omega)[z]) >= mixand_moments(wep_quotient(FIRST, SECOND, omega), z)[0]


def test_bounds_are_the_integrals_where_there_is_one_component() -> None:
    """The constant of (56), which the paper omits, is what makes them so."""
    one, other, common = (Mixture(np.ones(1), m.mean[:1], m.cov[:1]) for m in (FIRST, SECOND, COMMON))
    exact = exact_quotient(one, other, common)
    assert np.exp(exact_bound(exact, common).log_weight[0]) == pytest.approx(mixand_moments(exact, 0)[0], rel=1e-8)
    product = wep_quotient(one, other, np.array(0.3))
    wanted = mixand_moments(product, 0)[0]
    assert np.exp(wep_bound(one, other, np.array(0.3))[0]) == pytest.approx(wanted, rel=1e-8)


def test_laplace_finds_the_modes_and_their_curvature() -> None:
    rng = np.random.default_rng(0)
    first, second = draw(rng, count=3), draw(rng, count=2)
    wide = draw(rng, count=4)
    common = Mixture(wide.weight, wide.mean, wide.cov + 12 * np.eye(2))
    quotient = exact_quotient(first, second, common)
    found = laplace(quotient)
    assert found.converged.all()
    for z in range(6):
        one = quotient.take(np.array([z])).numerator

        def cost(x: Array, one: LogMixture = one) -> float:
            above = log_pdf(Mixture(np.ones(1), one.mean, one.cov), x[None])
            return float(quotient.log_denominator(x[None])[0] - above[0])

        best = minimize(cost, one.mean[0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-13})
        assert cost(found.mean[z]) <= best.fun + 1e-7
        step, eye = 1e-3, np.eye(2)
        hessian = np.array([[
            (cost(found.mean[z] + step * (a + b)) - cost(found.mean[z] + step * (a - b))
             - cost(found.mean[z] - step * (a - b)) + cost(found.mean[z] - step * (a + b))) / (4 * step**2)
            for a in eye] for b in eye])  # fmt: skip
        np.testing.assert_allclose(np.linalg.inv(found.cov[z]), hessian, rtol=1e-3, atol=1e-3)


def test_laplace_is_exact_for_single_gaussians_and_so_is_the_moment_matched_denominator() -> None:
    rng = np.random.default_rng(1)
    first, second = draw(rng, 3, count=2), draw(rng, 3, count=2)
    mean, cov = np.zeros((3, 1, 2)), np.stack([40.0 * np.eye(2)] * 3)[:, None]
    common = Mixture(np.ones((3, 1)), mean, cov)
    quotient = exact_quotient(first, second, common)
    found = laplace(quotient)
    matched, proper = moment_matched(quotient, *moments(common))
    assert proper.all()
    np.testing.assert_allclose(found.log_moment, matched.log_weight, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.mean, matched.mean, atol=1e-4)
    np.testing.assert_allclose(found.cov, matched.cov, rtol=1e-6, atol=1e-8)


def test_laplace_of_a_saddle_falls_back_to_the_numerator() -> None:
    """Dividing by a sharp bump at the numerator's mean: two modes, and at the start a minimum."""
    quotient = exact_quotient(
        scalar((1.0, 0.0, 2.0)), scalar((1.0, 0.0, 2.0)), scalar((0.9, 0.0, 0.2), (0.1, 0.0, 50.0))
    )
    found = laplace(quotient)
    assert np.isfinite(found.log_moment).all()
    assert (np.linalg.eigvalsh(found.cov) > 0).all()
