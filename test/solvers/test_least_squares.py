"""Sums of squares over the simplex against many searches by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from track_fusion.linalg import Array, matvec
from track_fusion.solvers.least_squares import minimise_squares_on_simplex


@pytest.mark.parametrize("sources", [1, 2, 4])
def test_linear_residuals_have_one_minimum_and_it_is_found(sources: int) -> None:
    rng = np.random.default_rng(sources)
    slope, rest = rng.normal(size=(10, 6, sources)), rng.normal(size=(10, 6))

    def residuals(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        return matvec(slope[rows], w) - rest[rows], slope[rows]

    solution, value = minimise_squares_on_simplex(residuals, np.full((10, sources), 1.0 / sources))
    assert solution.converged.all()
    np.testing.assert_allclose(solution.weights.sum(1), 1.0, atol=1e-14)
    assert (solution.weights >= 0).all()
    for i in range(10):
        best = minimize(
            lambda w, i=i: 0.5 * float(((slope[i] @ w - rest[i]) ** 2).sum()), np.full(sources, 1.0 / sources),
            method="SLSQP", bounds=[(0.0, 1.0)] * sources, options={"ftol": 1e-14, "maxiter": 500},
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
        )  # fmt: skip
        assert value[i] == pytest.approx(best.fun, rel=1e-6)
        assert value[i] == pytest.approx(0.5 * ((slope[i] @ solution.weights[i] - rest[i]) ** 2).sum(), rel=1e-12)


def test_residuals_that_bend_end_where_no_near_weights_are_better() -> None:
    rng = np.random.default_rng(0)
    slope, start = 3.0 * rng.normal(size=(8, 5, 3)), rng.dirichlet(np.ones(3), 8)

    def residuals(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        inner = matvec(slope[rows], w)
        return np.sin(inner) + 0.2 * inner, (np.cos(inner) + 0.2)[..., None] * slope[rows]

    def total(w: Array) -> Array:
        return np.asarray(0.5 * (residuals(w, np.arange(8))[0] ** 2).sum(1))

    solution, value = minimise_squares_on_simplex(residuals, start)
    assert solution.converged.all()
    assert (value <= total(start)).all()
    for _ in range(50):
        near = np.maximum(solution.weights + 1e-4 * rng.normal(size=(8, 3)), 0.0)
        assert (total(near / near.sum(1, keepdims=True)) >= value - 1e-12).all()
