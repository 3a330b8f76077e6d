"""Elliptical families against scipy's densities, quadrature and sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal, multivariate_t

from track_fusion.densities.elliptical.elliptical import (
    Family,
    gaussian,
    generalized_gaussian,
    student_t,
)

FAMILIES = {
    "t3": lambda m: student_t(3.0, m),
    "t2.1": lambda m: student_t(2.1, m),
    "gauss": gaussian,
    "gg0.65": lambda m: generalized_gaussian(0.65, m),
    "gg1.5": lambda m: generalized_gaussian(1.5, m),
}
EVERY_FAMILY = pytest.mark.parametrize("make", FAMILIES.values(), ids=FAMILIES.keys())


def test_log_pdf_against_scipy() -> None:
    rng = np.random.default_rng(1)
    mean, scatter = np.array([1.0, -2.0, 0.5]), np.array([[4.0, 1.0, 0.3], [1.0, 2.0, -0.4], [0.3, -0.4, 1.0]])
    x = mean + 5.0 * rng.normal(size=(50, 3))
    wanted = multivariate_t(mean, scatter, df=3.0).logpdf(x)
    np.testing.assert_allclose(student_t(3.0, 3).log_pdf(x, mean, scatter), wanted, rtol=1e-12)
    normal = multivariate_normal(mean, scatter).logpdf(x)
    np.testing.assert_allclose(gaussian(3).log_pdf(x, mean, scatter), normal, rtol=1e-12)
    np.testing.assert_allclose(generalized_gaussian(1.0, 3).log_pdf(x, mean, scatter), normal, rtol=1e-12)


def _radial(family: Family, power: float, slope: bool) -> float:
    """E[xi^2 u^power] or E[u^power] over u = |z|^2 by scipy's adaptive quadrature over the radius."""
    m = family.axes
    sphere = 2.0 * math.pi ** (m / 2) / math.gamma(m / 2)

    def integrand(r: float) -> float:
        u, step = r * r, 1e-5 * r * r
        density = sphere * r ** (m - 1) * math.exp(float(family.log_generator(np.asarray(u))))
        if not slope:
            return density * u**power
        change = family.log_generator(np.asarray(u + step)) - family.log_generator(np.asarray(u - step))
        return density * float(change / (2.0 * step)) ** 2 * u**power

    return float(quad(integrand, 0.0, 1.0, limit=400)[0] + quad(integrand, 1.0, np.inf, limit=400)[0])


@EVERY_FAMILY
@pytest.mark.parametrize("axes", [1, 2, 4])
def test_constants_are_the_expectations_of_eq_9(make: object, axes: int) -> None:
    family = make(axes)  # type: ignore[operator]
    assert _radial(family, 0.0, False) == pytest.approx(1.0, abs=1e-6)
    assert family.a == pytest.approx(_radial(family, 1.0, True) / axes, rel=1e-5)
    assert family.b == pytest.approx(_radial(family, 2.0, True) / (axes * (axes + 2)), rel=1e-5)
    if family.kappa < 10.0:  # scipy's rule does not converge for the tail u^-1.05
        assert family.kappa == pytest.approx(_radial(family, 1.0, False) / axes, rel=1e-5)


def test_dof_to_infinity_is_the_gaussian() -> None:
    for axes in (1, 3, 6):
        limit, normal = student_t(1e12, axes), gaussian(axes)
        for name in ("a", "b", "kappa", "pull", "radius_squared", "geodesic_pull"):
            assert getattr(limit, name) == pytest.approx(float(getattr(normal, name)), rel=1e-9)
        assert normal.a == normal.b == 0.25
        assert normal.pull == pytest.approx(1.0 / axes)
        assert normal.geodesic_pull == pytest.approx(1.0)
        assert generalized_gaussian(1.0, axes).a == pytest.approx(0.25, rel=1e-14)


def test_geodesic_constants_of_one_axis_are_those_of_theorem_1() -> None:
    for make in FAMILIES.values():
        family = make(1)
        assert family.geodesic_pull == pytest.approx(8.0 * family.a / (12.0 * family.b - 1.0), rel=1e-14)
        assert family.pull == pytest.approx(float(family.geodesic_pull), rel=1e-14)


def test_families_of_a_batch() -> None:
    family = student_t(np.array([3.0, np.inf]), 2)
    u = np.array([1.0, 1.0])
    for i, nu in enumerate((3.0, np.inf)):
        one = student_t(nu, 2)
        assert (family.a[i], family.kappa[i]) == (one.a, one.kappa)
        assert family.log_generator(u)[i] == one.log_generator(u[0])


def test_families_that_do_not_exist() -> None:
    with pytest.raises(ValueError, match=r"The 'dof' of a Student-t family must exceed 2\. Got 2\.0\."):
        student_t(np.array([3.0, 2.0]), 2)
    with pytest.raises(ValueError, match=r"The 'beta' of a generalised .* 1 axes must exceed 0\.25\. Got 0\.2"):
        generalized_gaussian(0.2, 1)
