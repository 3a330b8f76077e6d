"""Upper bounds of covariances, and the matrix programs behind them: closed forms and certificates."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from rules.examples import covariances
from scipy.optimize import minimize

from track_fusion.linalg import Array, outer
from track_fusion.solvers.matrix_program import Program, solve
from track_fusion.solvers.upper_bound import bound_about, bound_anywhere, bound_of_two

CRITERIA = pytest.mark.parametrize("criterion", ["det", "trace"])
Criterion = Literal["det", "trace"]
ENTRIES = np.array([(i, j) for i in range(3) for j in range(i, 3)])


def program(slack: Array, slope: Array) -> Program:
    """Minimise tr(C Y) for Y >= 2 - S_k: with half = 1 / sqrt 2, half' D half twice is D."""
    batch, _, n, _ = slack.shape
    start = 2.0 * np.broadcast_to(np.eye(n), (batch, n, n))
    half = np.broadcast_to(np.eye(n) / np.sqrt(2.0), slack.shape)
    return Program(start, slack, half, half, ENTRIES, lambda y, rows: (slope[rows], None))


def test_a_linear_program_over_one_matrix_ends_at_its_constraint() -> None:
    rng = np.random.default_rng(0)
    side = covariances(rng, 5, n=3) / 40.0
    slope = covariances(rng, 5, n=3)
    slack = (2.0 * np.eye(3) - side)[:, None]
    assert np.linalg.eigvalsh(slack).min() > 0
    y, converged, steps = solve(program(slack, slope))
    assert converged.all()
    assert (steps > 0).all()
    np.testing.assert_allclose(y, side, atol=1e-8)


def test_every_constraint_holds_and_a_multiplier_proves_the_minimum() -> None:
    """tr C Y >= sum of tr Z_k S_k for multipliers Z_k >= 0 of sum C; found by search, they leave no gap."""
    rng = np.random.default_rng(1)
    sides = covariances(rng, 3, 2, n=3) / 40.0
    slope = np.broadcast_to(np.eye(3), (3, 3, 3))
    y, converged, _ = solve(program(2.0 * np.eye(3) - sides, slope))
    assert converged.all()
    assert np.linalg.eigvalsh(y[:, None] - sides).min() >= 0
    # For two sides the minimum is known: tr P2 + tr (P1 - P2)_+.
    gain = np.maximum(np.linalg.eigvalsh(sides[:, 0] - sides[:, 1]), 0.0).sum(1)
    np.testing.assert_allclose(np.trace(y, axis1=1, axis2=2), np.trace(sides[:, 1], axis1=1, axis2=2) + gain, atol=1e-8)


def test_a_convex_objective_stays_inside_where_its_minimum_is() -> None:
    """-log det Y + tr Y has its minimum at the unit matrix, away from every constraint."""
    slack = np.broadcast_to(2.0 * np.eye(3), (2, 1, 3, 3))

    def objective(y: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        info = np.linalg.inv(y)
        return np.eye(3) - info, info

    y, converged, _ = solve(Program(**{**vars(program(slack, slack[:, 0])), "objective": objective}))
    assert converged.all()
    np.testing.assert_allclose(y, np.broadcast_to(np.eye(3), y.shape), atol=1e-6)


# ---- bounds ---------------------------------------------------------------------------------------------------------


def size(cov: Array, criterion: Criterion) -> Array:
    return np.asarray(np.linalg.slogdet(cov)[1] if criterion == "det" else np.trace(cov, axis1=-2, axis2=-1))


def lack(bound: Array, sides: Array) -> float:
    """How far a bound falls below a side, relative to the side."""
    return -float(np.linalg.eigvalsh(bound[:, None] - sides).min() / np.abs(sides).max())


@CRITERIA
def test_the_bound_of_two_is_above_both_and_touches_along_every_axis(criterion: Criterion) -> None:
    rng = np.random.default_rng(2)
    first, second = covariances(rng, 20), covariances(rng, 20)
    bound = bound_of_two(first, second, criterion)
    assert lack(bound, np.stack([first, second], 1)) < 1e-12
    rest = np.linalg.matrix_rank(bound - first, 1e-9) + np.linalg.matrix_rank(bound - second, 1e-9)
    np.testing.assert_array_equal(rest, 4)  # together they have no direction left to shrink in
    searched = bound_about(np.zeros((20, 4)), np.zeros((20, 3, 4)), np.stack([first, second, second], 1), criterion)
    assert searched.converged.all()
    np.testing.assert_allclose(size(searched.cov, criterion), size(bound, criterion), rtol=1e-9)
    np.testing.assert_allclose(searched.cov, bound, atol=1e-3)  # flat at the minimum: the root of the gap


@CRITERIA
@pytest.mark.parametrize("count", [1, 2, 4])
def test_bounds_cover_and_a_free_mean_is_never_worse(criterion: Criterion, count: int) -> None:
    rng = np.random.default_rng(3)
    means, covs = rng.normal(size=(10, count, 3)), covariances(rng, 10, count, n=3)
    about = bound_about(means.mean(1), means, covs, criterion)
    anywhere = bound_anywhere(means, covs, criterion)
    for bound in (about, anywhere):
        assert bound.converged.all()
        assert lack(bound.cov, covs + outer(bound.mean[:, None] - means)) < 1e-9
    assert (size(anywhere.cov, criterion) <= size(about.cov, criterion) + 1e-9).all()
    np.testing.assert_array_equal(about.mean, means.mean(1))


@CRITERIA
def test_the_free_mean_of_three_against_nelder_mead(criterion: Criterion) -> None:
    rng = np.random.default_rng(4)
    means, covs = 2.0 * rng.normal(size=(1, 3, 2)), covariances(rng, 1, 3, n=2)
    best = bound_anywhere(means, covs, criterion)
    search = minimize(
        lambda x: float(size(bound_about(x[None], means, covs, criterion).cov, criterion)[0]),
        means.mean(1)[0], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10},
    )  # fmt: skip
    assert float(size(best.cov, criterion)[0]) == pytest.approx(search.fun, abs=1e-7)
