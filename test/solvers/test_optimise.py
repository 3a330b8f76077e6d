"""Weights on the interval and the simplex: bisection in exact places, the projection onto the simplex, laws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from track_fusion.linalg import Array, matvec
from track_fusion.solvers.optimise import minimise_on_interval, minimise_on_simplex, minimise_one

Rows = NDArray[np.intp]


# ---- the interval ---------------------------------------------------------------------------------------------------


def well(place: Array, power: float) -> Any:
    """Derivatives of |w - place|^power / power: flat at the bottom where the power is large."""

    def derivatives(w: Array, rows: Rows) -> tuple[Array, Array]:
        gap = w - place[rows]
        return np.sign(gap) * np.abs(gap) ** (power - 1), (power - 1) * np.abs(gap) ** (power - 2)

    return derivatives


@pytest.mark.parametrize("power", [2.0, 2.5, 4.0])
def test_the_minimum_is_found_inside_and_at_the_ends(power: float) -> None:
    place = np.array([0.3, 0.999, 1e-7, 0.5, -2.0, 0.0, 1.0, 7.0])
    solution = minimise_on_interval(well(place, power), len(place))
    assert solution.converged.all()
    np.testing.assert_allclose(solution.weights, np.clip(place, 0.0, 1.0), atol=1e-9 if power == 2.0 else 1e-7)


def test_newton_is_held_by_the_bracket_where_it_would_run_away() -> None:
    """sqrt(1 + (50 (w - .93))^2): from afar a step of Newton goes far past the other end."""

    def derivatives(w: Array, rows: Rows) -> tuple[Array, Array]:
        u = 50.0 * (w - 0.93)
        return 50.0 * u / np.sqrt(1.0 + u**2), 2500.0 * (1.0 + u**2) ** -1.5

    solution = minimise_on_interval(derivatives, 1)
    assert solution.weights[0] == pytest.approx(0.93, abs=1e-12)
    one = minimise_one(lambda w: tuple(float(x[0]) for x in derivatives(np.array([w]), np.arange(1))))  # type: ignore[arg-type,return-value]
    assert one[:2] == (pytest.approx(0.93, abs=1e-12), True)


def test_a_constant_has_its_weight_in_the_middle() -> None:
    solution = minimise_on_interval(lambda w, rows: (np.zeros(len(w)), np.zeros(len(w))), 3)
    np.testing.assert_array_equal(solution.weights, 0.5)
    assert minimise_one(lambda w: (0.0, 0.0)) == (0.5, True, 0)
    assert len(minimise_on_interval(lambda w, rows: (w, w), 0).weights) == 0


@pytest.mark.parametrize("place", [0.2, -1.0, 3.0])
def test_one_is_as_many(place: float) -> None:
    """exp(w) - w exp(place) has its minimum at place."""
    many = minimise_on_interval(lambda w, rows: (np.exp(w) - np.exp(place), np.exp(w)), 4)
    w, converged, iterations = minimise_one(lambda w: (np.exp(w) - np.exp(place), np.exp(w)))
    np.testing.assert_allclose(many.weights, w, atol=1e-15)
    assert converged
    assert many.iterations.tolist() == [iterations] * 4


# ---- the simplex ----------------------------------------------------------------------------------------------------


def projection(point: Array) -> Array:
    """The nearest point of the simplex: all entries less a constant, cut at zero; found by trying every support."""
    size = len(point)
    order = np.sort(point)[::-1]
    levels = [(order[: k + 1].sum() - 1.0) / (k + 1) for k in range(size)]
    level = next(t for k, t in reversed(list(enumerate(levels))) if order[k] > t)
    return np.asarray(np.maximum(point - level, 0.0))


@pytest.mark.parametrize("sources", [1, 2, 3, 8])
def test_the_nearest_point_of_the_simplex(sources: int) -> None:
    rng = np.random.default_rng(sources)
    points = rng.normal(size=(40, sources)) * rng.choice([0.1, 1.0, 10.0], (40, 1))

    def gradient_hessian(w: Array, rows: Rows) -> tuple[Array, Array]:
        return w - points[rows], np.broadcast_to(np.eye(sources), (len(w), sources, sources))

    for start in (None, rng.dirichlet(np.ones(sources), 40)):
        solution = minimise_on_simplex(gradient_hessian, 40, sources, start)
        assert solution.converged.all()
        np.testing.assert_allclose(solution.weights, [projection(p) for p in points], atol=1e-6)
        np.testing.assert_allclose(solution.weights.sum(1), 1.0, atol=1e-14)


def test_nothing_on_the_simplex_is_lower() -> None:
    """Badly conditioned quadratics, and entropies, whose minimum -log K is at equal weights."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(20, 4, 4)) * np.geomspace(1e-2, 1e2, 4)
    bend, pull = roots.swapaxes(1, 2) @ roots, rng.normal(size=(20, 4))

    def gradient_hessian(w: Array, rows: Rows) -> tuple[Array, Array]:
        return matvec(bend[rows], w) + pull[rows], bend[rows]

    solution = minimise_on_simplex(gradient_hessian, 20, 4)
    gradient = matvec(bend, solution.weights) + pull
    excess = (solution.weights * gradient).sum(1) - gradient.min(1)  # bounds what is left, by convexity
    assert solution.converged.all()
    assert (excess <= 1e-10 * np.abs(gradient).max(1)).all()
    flat = minimise_on_simplex(lambda w, rows: (np.log(w) + 1.0, np.eye(5) / w[:, :, None]), 1, 5)
    np.testing.assert_allclose(flat.weights, 0.2, atol=1e-9)


def test_a_function_that_knows_no_weight_leaves_them_equal() -> None:
    solution = minimise_on_simplex(lambda w, rows: (np.zeros(w.shape), np.zeros((*w.shape, 3))), 2, 3)
    assert solution.converged.all()
    np.testing.assert_allclose(solution.weights, 1.0 / 3.0, atol=1e-15)


def test_the_weights_do_not_depend_on_the_rest_of_the_batch() -> None:
    points = np.random.default_rng(1).normal(size=(30, 3))

    def solve(points: Array) -> Array:
        return minimise_on_simplex(
            lambda w, rows: (w - points[rows], np.broadcast_to(np.eye(3), (len(w), 3, 3))), len(points), 3
        ).weights

    np.testing.assert_allclose(solve(points), np.concatenate([solve(p[None]) for p in points]), atol=1e-12)
