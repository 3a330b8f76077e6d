"""Rao distances against the metric itself, the printed formulas and shortest paths found by search."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from densities.elliptical import distances
from rules.examples import covariances
from scipy.integrate import quad
from scipy.optimize import minimize, minimize_scalar

from track_fusion.densities.elliptical.elliptical import Family, gaussian, generalized_gaussian, student_t
from track_fusion.densities.elliptical.rao import informative_barycenter, rao_distance_scalar, scalar_geodesic
from track_fusion.linalg import Array

SCALAR = [student_t(3.0, 1), generalized_gaussian(0.65, 1), gaussian(1)]
ENDS = [(2.0, 5.0, 4.0, 7.0), (4.0, 7.0, 2.0, 5.0), (1.0, 9.0, 1.0, 0.5), (0.0, 1.0, 80.0, 3.0)]
PLANE = [student_t(3.0, 2), generalized_gaussian(0.65, 2), gaussian(2)]


def _speed_squared(family: Family, scatter: Array, mean_rate: Array, rate: Array) -> float:
    """Squared line element (11)."""
    step = np.linalg.solve(scatter, rate)
    return float(
        4.0 * family.a * mean_rate @ np.linalg.solve(scatter, mean_rate)
        + 2.0 * family.b * np.trace(step @ step)
        + 0.25 * (4.0 * family.b - 1.0) * np.trace(step) ** 2
    )


@pytest.mark.parametrize("family", SCALAR)
@pytest.mark.parametrize("ends", ENDS)
def test_scalar_geodesic_has_the_length_of_the_metric(family: Family, ends: tuple[float, ...]) -> None:
    """Integrating (11) along the curve gives the distance (14), at constant speed; no detour is shorter."""
    points = [np.asarray(v) for v in ends]
    wanted = float(rao_distance_scalar(family, *points))

    def speed(t: float) -> float:
        h = 1e-5
        (m0, s0), (m1, s1) = (scalar_geodesic(family, *points, t + k * h) for k in (-1, 1))
        middle = scalar_geodesic(family, *points, t)[1]
        mean_rate, rate = np.array([m1 - m0]) / (2 * h), np.array([[s1 - s0]]) / (2 * h)
        return math.sqrt(_speed_squared(family, middle.reshape(1, 1), mean_rate, rate))

    assert quad(speed, 0.0, 1.0)[0] == pytest.approx(wanted, rel=1e-6)
    assert speed(0.2) == pytest.approx(wanted, rel=1e-5)
    for t, (m, s) in ((0.0, ends[:2]), (1.0, ends[2:])):
        np.testing.assert_allclose(scalar_geodesic(family, *points, t), (m, s), rtol=1e-12)
    via = np.asarray(0.5 * (ends[0] + ends[2]) + 0.1), np.asarray(0.5 * (ends[1] + ends[3]))
    detour = rao_distance_scalar(family, *points[:2], *via) + rao_distance_scalar(family, *via, *points[2:])
    assert detour > wanted


Curve = Callable[[float], tuple[float, float]]


def _printed(family: Family, m1: float, s1: float, m2: float, s2: float) -> tuple[Curve, float]:
    """Eqs. (17)-(21) as printed, mu1 < mu2: the curve over its arc length and the arc length of the far end."""
    c, d = 8 * family.a / (12 * family.b - 1), math.sqrt(12 * family.b - 1)
    delta1 = (2 * s2 + c * m2**2 - 2 * s1 - c * m1**2) / (2 * math.sqrt(c) * (m2 - m1))
    delta2 = 0.5 * math.sqrt(2 * s1 + (math.sqrt(c) * m1 - delta1) ** 2)
    shift = math.atanh((math.sqrt(c) * m1 - delta1) / (2 * delta2))
    length = d * math.acosh((c * (m2 - m1) ** 2 + 2 * (s1 + s2)) / (4 * math.sqrt(s1 * s2)))

    def curve(s: float) -> tuple[float, float]:
        return (
            (delta1 + 2 * delta2 * math.tanh(s / d + shift)) / math.sqrt(c),
            2 * delta2**2 / math.cosh(s / d + shift) ** 2,
        )

    return curve, length


@pytest.mark.parametrize("family", SCALAR)
def test_scalar_geodesic_as_printed(family: Family) -> None:
    for m1, s1, m2, s2 in ((2.0, 5.0, 4.0, 7.0), (-1.0, 3.0, 6.0, 0.4)):
        curve, length = _printed(family, m1, s1, m2, s2)
        ends = [np.asarray(v) for v in (m1, s1, m2, s2)]
        assert rao_distance_scalar(family, *ends) == pytest.approx(length, rel=1e-12)
        for t in (0.1, 0.5, 0.8):
            np.testing.assert_allclose(scalar_geodesic(family, *ends, t), curve(t * length), rtol=1e-10)


def test_informative_barycenter() -> None:
    """The midpoint of the static example, and for more densities what a search finds."""
    for family in SCALAR:
        mean, scatter = informative_barycenter(family, np.array([2.0, 4.0]), np.array([5.0, 7.0]))
        assert mean == pytest.approx(2.91608, abs=5e-6)
        ends = [np.asarray(v) for v in (2.0, 5.0, 4.0, 7.0)]
        np.testing.assert_allclose((mean, scatter), scalar_geodesic(family, *ends, 0.5), rtol=1e-12)
        far, wide = np.array([1.0, 4.0, -30.0]), np.array([2.0, 0.1, 9.0])

        def total(v: Array, family: Family = family, far: Array = far, wide: Array = wide) -> float:
            return float((rao_distance_scalar(family, far, wide, v[0], np.exp(v[1])) ** 2).sum())

        best = minimize(total, [0.0, 1.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14})
        mean, scatter = informative_barycenter(family, far, wide)
        assert total(np.array([mean, np.log(scatter)])) <= best.fun * (1 + 1e-12)
        assert mean == pytest.approx(best.x[0], abs=1e-5)
    with pytest.raises(ValueError, match="families of one axis. Got 2"):
        informative_barycenter(gaussian(2), np.zeros(2), np.ones(2))


def test_distance_at_one_mean() -> None:
    rng = np.random.default_rng(1)
    first, second = covariances(rng, 2, n=2)
    for family in PLANE:
        logs = np.log(np.linalg.eigvals(np.linalg.solve(first, second)))
        wanted = math.sqrt(2 * family.b * (logs**2).sum() + (family.b - 0.25) * logs.sum() ** 2)
        assert distances.same_mean(family, first, second) == pytest.approx(wanted, rel=1e-10)


def test_distance_at_one_shape_in_one_axis_is_the_scalar_distance() -> None:
    for family in SCALAR:
        for m, s, other, scale in ((0.0, 2.0, 1.5, 1.0), (0.0, 2.0, 20.0, 0.1), (1.0, 3.0, 1.0, 4.0)):
            got = distances.same_shape(family, np.array([m]), np.array([[s]]), np.array([other]), np.asarray(scale))
            wanted = rao_distance_scalar(family, *(np.asarray(v) for v in (m, s, other, scale * s)))
            assert got == pytest.approx(float(wanted), rel=1e-12)


def test_projection_distance_is_the_least_at_one_shape() -> None:
    rng = np.random.default_rng(2)
    scatter, mean, other = covariances(rng, n=2), rng.normal(size=2), 6.0 * rng.normal(size=2)
    for family in PLANE:
        best = minimize_scalar(
            lambda u, f=family: float(distances.same_shape(f, mean, scatter, other, np.exp(u))),
            bounds=(-5, 5), method="bounded", options={"xatol": 1e-10},
        )  # fmt: skip
        distance, scale = distances.projection(family, mean, scatter, other)
        assert distance == pytest.approx(best.fun, rel=1e-10)
        assert math.log(scale) == pytest.approx(best.x, abs=1e-4)


def _path_length(family: Family, knots: Array) -> float:
    """Length by (11) of a polygon in two axes, knots (N, 5): mean, log of the Cholesky diagonal, what is below it."""
    middle, step = 0.5 * (knots[:-1] + knots[1:]), np.diff(knots, axis=0)
    lower, rate = np.zeros((2, len(step), 2, 2))
    for i in (0, 1):
        lower[:, i, i] = np.exp(middle[:, 2 + i])
        rate[:, i, i] = lower[:, i, i] * step[:, 2 + i]
    lower[:, 1, 0], rate[:, 1, 0] = middle[:, 4], step[:, 4]
    back = np.linalg.inv(lower)
    shift = (back @ step[:, :2, None])[..., 0]
    turn = back @ rate
    turn = turn + np.swapaxes(turn, -1, -2)
    trace = np.trace(turn, axis1=-2, axis2=-1)
    square = 4 * family.a * (shift**2).sum(1) + 2 * family.b * (turn**2).sum((1, 2)) + (family.b - 0.25) * trace**2
    return float(np.sqrt(square).sum())


@pytest.mark.parametrize("family", PLANE, ids=["t3", "gg", "gauss"])
def test_geodesic_projection_against_a_search_over_paths(family: Family) -> None:
    """No path through the whole manifold to another mean is shorter, and one comes as near as its corners allow."""
    corners, other = 12, np.array([2.5, 0.0])
    wanted = float(distances.geodesic_projection(family, np.zeros(2), np.eye(2), other))
    share = np.linspace(0.0, 1.0, corners + 1)[1:]

    def length(v: Array) -> float:
        knots = np.zeros((corners + 1, 5))
        knots[1:, 2:] = v[: 3 * corners].reshape(corners, 3)
        knots[1:-1, 0] = v[3 * corners :]
        knots[-1, :2] = other
        return _path_length(family, knots)

    start = np.concatenate([np.zeros(3 * corners), other[0] * share[:-1]])
    found = minimize(length, start, method="BFGS", options={"maxiter": 60}).fun
    assert wanted <= found * (1 + 2e-3)  # the midpoint rule errs by the square of a step
    assert found <= wanted * 1.01
    distance, _ = distances.projection(family, np.zeros(2), np.eye(2), other)
    assert wanted < distance


def test_minimal_manhattan_distance_against_a_search() -> None:
    rng = np.random.default_rng(3)
    for family in PLANE + [student_t(4.0, 5)]:
        n = family.axes
        for spread in (0.0, 0.5, 8.0):
            first, second = covariances(rng, 2, n=n)
            mean, other = rng.normal(size=n), rng.normal(size=n)
            mean = other + spread * (mean - other)

            def path(u: float, family: Family = family, m: Array = mean, o: Array = other, p: Array = first,
                     q: Array = second) -> float:  # fmt: skip
                along = distances.same_shape(family, m, p, o, np.exp(u))
                return float(along + distances.same_mean(family, np.exp(u) * p, q))

            best = minimize_scalar(path, bounds=(-6, 8), method="bounded", options={"xatol": 1e-10})
            got = float(distances.minimal_manhattan(family, mean, first, other, second))
            assert got == pytest.approx(best.fun, rel=1e-9)


def test_minimal_manhattan_distance_in_one_axis_is_exact() -> None:
    rng = np.random.default_rng(4)
    mean, other = rng.normal(size=(2, 40))
    scatter, wide = np.exp(rng.normal(size=(2, 40)))
    mean[:3], scatter[5:8] = other[:3], wide[5:8]
    for family in SCALAR:
        got = distances.minimal_manhattan(
            family, mean[:, None], scatter[:, None, None], other[:, None], wide[:, None, None]
        )
        np.testing.assert_allclose(got, rao_distance_scalar(family, mean, scatter, other, wide), rtol=1e-9)
    assert distances.minimal_manhattan(gaussian(2), np.ones(2), np.eye(2), np.ones(2), np.eye(2)) == 0.0


def test_distances_that_are_tiny_keep_their_digits() -> None:
    family = gaussian(1)
    near = rao_distance_scalar(family, *(np.asarray(v) for v in (0.0, 1.0, 1e-9, 1.0)))
    assert near == pytest.approx(1e-9, rel=1e-6)  # ds = |d mu| / sigma
