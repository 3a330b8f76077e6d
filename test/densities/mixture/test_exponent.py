"""The exponent of a weighted exponential product: against quadrature, with an error that is true, and small by default.

The 80 problems: 40 of ten components a source as Ahmed draws them, 40 of three.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import pytest
from densities.mixture.examples import FIRST, SECOND, draw
from rules.mixtures import as_tracks
from scipy.optimize import minimize_scalar

from track_fusion.densities.log_domain import log_sum_exp, normalised
from track_fusion.densities.mixture.exponent import optimise_omega
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, stacked
from track_fusion.densities.on_grid import grid, kl_on_grid, moments_on_grid
from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import FusedTracks, SourceTracks, get_rule
from track_fusion.scenarios.ahmed.random import study_problem

CRITERIA = ("chernoff", "minimax_information_loss")
EVERY_CRITERION = pytest.mark.parametrize("criterion", CRITERIA)


def by_quadrature(first: Mixture, second: Mixture, criterion: str, points: Array) -> float:
    """Omega by summation over a fine grid."""
    a, b = log_pdf(first, points), log_pdf(second, points)
    pull = 0.0 if criterion == "chernoff" else float((normalised(a + b) * (a - b)).sum())
    return float(minimize_scalar(
        lambda w: float(log_sum_exp(w * a + (1.0 - w) * b)) - w * pull, bounds=(0, 1), method="bounded",
        options={"xatol": 1e-8},
    ).x)  # fmt: skip


LINE = grid(np.array([-40.0]), np.array([40.0]), 4000)


@EVERY_CRITERION
def test_omega_is_that_of_quadrature(criterion: str) -> None:
    search = optimise_omega(FIRST, SECOND, np.random.default_rng(0), 40000, criterion)
    assert search.converged
    assert search.omega == pytest.approx(
        by_quadrature(FIRST, SECOND, criterion, LINE), abs=0.04
    )  # four standard errors
    w = float(search.omega)
    wanted = log_sum_exp(w * log_pdf(FIRST, LINE) + (1 - w) * log_pdf(SECOND, LINE)) + np.log(80.0 / 4000)
    assert search.samples.log_eta == pytest.approx(float(wanted), abs=0.01)
    mean, cov = moments_on_grid(w * log_pdf(FIRST, LINE) + (1 - w) * log_pdf(SECOND, LINE), LINE)
    got = search.samples.moments()
    assert got[0][0] == pytest.approx(mean[0], abs=4 * np.sqrt(cov[0, 0] / float(search.samples.ess)))
    assert got[1][0, 0] == pytest.approx(cov[0, 0], rel=0.05)


def test_chernoff_point_is_equally_far_from_both() -> None:
    """Ahmed (10), which the paper gives as necessary and sufficient."""
    w = float(optimise_omega(FIRST, SECOND, np.random.default_rng(0), 40000).omega)
    logs = log_pdf(FIRST, LINE), log_pdf(SECOND, LINE)
    far = [kl_on_grid(w * logs[0] + (1 - w) * logs[1], log) for log in logs]
    assert far[0] == pytest.approx(far[1], rel=0.2)


def test_importance_weights_of_algorithm_1_are_bounded_at_one_half() -> None:
    """The square root of a sum is no more than the sum of square roots: target over proposal is at most its mass."""
    rng = np.random.default_rng(1)
    first, second = draw(rng, 20, count=4), draw(rng, 20, count=3)
    search = optimise_omega(first, second, rng, 2000, omega=np.full(20, 0.5))
    assert (search.samples.log_weight.max(-1) - search.samples.log_eta < np.log(2 * 2 * 12)).all()
    assert (search.samples.ess > 0.4 * 2000).all()
    assert (search.error == 0.0).all()  # it is given


# The error of omega.


class Problem(NamedTuple):
    """Two mixtures to be fused, and the points of a grid that holds all of both."""

    first: Mixture
    second: Mixture
    points: Array


@functools.cache
def problems() -> list[Problem]:
    wide, narrow = (grid(np.full(2, -half), np.full(2, half), 100) for half in (28.0, 17.0))
    many = [Problem(p.first, p.second, wide) for p in (study_problem(0, run) for run in range(40))]
    parts = draw(np.random.default_rng(0), 40, 2, count=3)
    return many + [Problem(parts.at((i, 0)), parts.at((i, 1)), narrow) for i in range(40)]


@functools.cache
def truth(criterion: str) -> Array:
    return np.array([by_quadrature(p.first, p.second, criterion, p.points) for p in problems()])


def fused(criterion: str, seed: int, **values: float) -> list[FusedTracks]:
    """Fuse each problem by the rule, as quickly as gives omega."""
    rule = get_rule("mixture_wep")
    params = from_dict(rule.params, {"criterion": criterion, "method": "foci", **values})
    return [rule(_tracks(p, seed), params) for p in problems()]


def _tracks(problem: Problem, seed: int) -> SourceTracks:
    tracks = as_tracks(stacked(problem.first, problem.second))
    return SourceTracks(tracks.mean, tracks.cov, mixture=tracks.mixture, extras={"seed": seed})


@EVERY_CRITERION
def test_by_default_omega_is_right_to_two_hundredths(criterion: str) -> None:
    results = fused(criterion, 0)
    off = np.abs([float(r.weights[0]) for r in results if r.weights is not None] - truth(criterion))
    told = np.array([float(r.info["omega_error"]) for r in results])
    assert (off < 0.02).mean() >= 0.95
    assert all(r.info["converged"] for r in results)
    assert (told <= 0.02).all()


@EVERY_CRITERION
def test_the_error_that_is_told_is_true(criterion: str) -> None:
    """Two standard errors hold 95 % of the errors, and are not far too many; with one set of samples, of 400."""
    results = [fused(criterion, seed, samples=400, omega_error=1.0) for seed in range(3)]
    omega = np.array([[float(r.weights[0]) for r in row if r.weights is not None] for row in results])
    told = np.array([[float(r.info["omega_error"]) for r in row] for row in results])
    off = np.abs(omega - truth(criterion)) / told
    assert 0.90 <= (off <= 1.0).mean() <= 0.99
    assert 0.8 < 2.0 * np.sqrt(np.mean(off**2)) < 1.25


def test_what_does_not_get_there_says_so() -> None:
    results = fused("chernoff", 0, max_omega_samples=2000)
    told = np.array([float(r.info["omega_error"]) for r in results])
    converged = np.array([bool(r.info["converged"]) for r in results])
    np.testing.assert_array_equal(converged, told <= 0.02)
    assert 0.1 < converged.mean() < 0.9


def test_more_samples_do_not_depend_on_the_batch() -> None:
    parts = draw(np.random.default_rng(2), 6, 2, count=3)
    first, second = parts.at((slice(None), 0)), parts.at((slice(None), 1))
    once = optimise_omega(first, second, np.random.default_rng(3), 500)
    enough = float(np.median(once.error)) / 2.0
    whole = optimise_omega(first, second, np.random.default_rng(3), 500, tolerance=enough, most=64000)
    assert len(np.unique(np.ceil(np.log2(once.error / enough)))) > 1  # some need more doublings than others
    assert whole.converged.all()
    for i in range(6):
        alone = optimise_omega(first.at(i), second.at(i), np.random.default_rng(3), 500, tolerance=enough, most=64000)
        assert alone.omega == pytest.approx(float(whole.omega[i]), abs=1e-8)
        assert alone.samples.log_weight.shape == (500,)


def test_an_omega_at_the_end_is_sure() -> None:
    """A sharp density beside a vague one: the least information loss is at the end, far beyond any sampling error."""
    first = Mixture(np.full(2, 0.5), np.array([[0.0], [0.1]]), np.full((2, 1, 1), 0.01))
    second = Mixture(np.full(2, 0.5), np.array([[0.0], [0.1]]), np.full((2, 1, 1), 100.0))
    search = optimise_omega(first, second, np.random.default_rng(0), 1000, "minimax_information_loss")
    assert search.omega == 1.0
    assert search.error == 0.0
    same = optimise_omega(first, first, np.random.default_rng(0), 1000)
    assert (same.omega, same.error) == (0.5, 0.0)
