"""Li 2019, variables: against quadrature, sums over the joint probabilities and ERRATA; claims true and false."""

from __future__ import annotations

import numpy as np
import pytest
from scenarios.li2019.quadrature import positive_normal_pair
from scipy.stats import kstest, multivariate_normal, norm, poisson

from track_fusion.params import ParameterError
from track_fusion.scenarios.li2019.averages import average_moments
from track_fusion.scenarios.li2019.variable_pairs import RATES, copula_correlation, normal_pair, poisson_pair
from track_fusion.scenarios.li2019.variables import (
    AA,
    FIGURE_1,
    GA,
    SCENARIO,
    VARIABLES,
    WEIGHT,
    WEIGHTS,
    greater_share,
    lowest,
    variance_curve,
)
from track_fusion.study.judgement import judged_claims

RUNS = 150


def _outcomes(runs=range(RUNS), only=""):
    return SCENARIO.simulate(runs, 4, lambda share: None, only)


@pytest.fixture(scope="module")
def outcomes():
    return _outcomes()


@pytest.fixture(scope="module")
def measured(outcomes):
    return SCENARIO.figures(outcomes)


def _close(estimate, value, rounding=0.005):
    assert abs(estimate.value - value) <= 3.5 * estimate.standard_error + rounding, (estimate, value)


def test_minima_of_figure_1_are_those_of_the_errata(measured):
    for variant, aa, ga in (("rho0", 66.67, 69.67), ("rho60", 98.23, 98.99)):
        _close(measured[f"{AA}@{variant}/least_variance_1"], aa)
        _close(measured[f"{GA}@{variant}/least_variance_1"], ga)
    _close(measured[f"{AA}@rho0/weight_least_variance_1"], 0.667)
    _close(measured[f"{GA}@rho0/weight_least_variance_1"], 0.64)


@pytest.mark.parametrize("variant", ["rho0", "rho70736"])
def test_normal_variables_against_quadrature(outcomes, measured, variant):
    """Variance curves and least errors; a curve's points share their draws, so bounds are those of one point."""
    correlation = {"rho0": 0.0, "rho70736": 0.70736}[variant]
    cross = correlation * np.sqrt(2.0) * 100.0
    nodes = positive_normal_pair(np.array([50.0, 60.0]), np.array([[100.0, cross], [cross, 200.0]]), 120)
    for row, geometric in ((AA, False), (GA, True)):
        mean, variance = average_moments(*nodes, WEIGHTS, geometric)
        runs = outcomes[f"{row}@{variant}"]
        error = variance_curve(runs).std(0) / np.sqrt(RUNS)
        assert (np.abs(variance_curve(runs.mean(0)) - variance) < 4.0 * error).all()
        assert (error < 0.01 * variance).all()
        for truth in (45, 55, 65):
            least = (variance + (mean - truth) ** 2).min()
            _close(measured[f"{row}@{variant}/least_mse_theta{truth}_1"], least, rounding=0.02)


def test_the_copula_couples_poisson_variables_as_wanted():
    """Its correlation by the joint probabilities of the normal variables behind, term by term."""
    for correlation in (0.6, 0.95):
        r = copula_correlation(RATES, correlation)
        edges = [norm.ppf(poisson.cdf(np.arange(-1, 36), rate)).clip(-9, 9) for rate in RATES]
        corners = np.stack(np.meshgrid(*edges, indexing="ij"), -1)
        cumulative = multivariate_normal([0, 0], [[1, r], [r, 1]]).cdf(corners)
        joint = np.diff(np.diff(cumulative, axis=0), axis=1)
        count = np.arange(36)
        first, second = joint.sum(1) @ count, joint.sum(0) @ count
        covariance = (joint * np.outer(count - first, count - second)).sum()
        assert covariance / np.sqrt(RATES[0] * RATES[1]) == pytest.approx(correlation, abs=1e-4)


def test_marginals_of_the_variables():
    normals = np.random.default_rng(1).standard_normal((20_000, 2))
    values = normal_pair(normals, 0.6)
    assert kstest(values[:, 1], norm(60.0, np.sqrt(200.0)).cdf).pvalue > 1e-3
    assert np.corrcoef(values.T)[0, 1] == pytest.approx(0.6, abs=0.02)
    counts = poisson_pair(normals, 0.95)
    for rate, column in zip(RATES, counts.T, strict=True):
        share = np.bincount(column.astype(int), minlength=40)[:40] / len(column)
        np.testing.assert_allclose(share, poisson.pmf(np.arange(40), rate), atol=0.01)
        assert column.mean() == pytest.approx(rate, abs=0.1)
    assert np.corrcoef(counts.T)[0, 1] == pytest.approx(0.95, abs=0.003)
    far = np.array([[-5.5, 0.0], [0.0, 0.0]])
    assert normal_pair(far, 0.0).shape == (1, 2)  # the first variable of the first pair would be negative


def test_poisson_minima_against_sums_over_independent_counts(measured):
    count = np.arange(60)
    values = np.stack(np.meshgrid(count, count, indexing="ij"), -1).reshape(-1, 2).astype(float)
    probability = np.outer(*(poisson.pmf(count, rate) for rate in RATES)).ravel()
    for row, geometric in ((AA, False), (GA, True)):
        variance = average_moments(values, probability / probability.sum(), WEIGHTS, geometric)[1]
        _close(measured[f"{row}@poisson_rho0/least_variance_1"], variance.min())
    _close(measured[f"{AA}@poisson_rho0/least_variance_1"], 120 / 22)


def test_curves_are_searched_by_parabola_and_by_straight_lines():
    curve = np.stack([3.0 + 2.0 * (WEIGHT - at) ** 2 for at in (0.333, 0.0, 1.0, 0.013)])
    value, weight = lowest(curve)
    np.testing.assert_allclose(value, 3.0)
    np.testing.assert_allclose(weight, [0.333, 0.0, 1.0, 0.013], atol=1e-9)
    assert lowest(1.0 + WEIGHT + 0.1 * WEIGHT**2)[1] == pytest.approx(0.0, abs=1e-12)
    assert lowest(2.0 - 3.0 * WEIGHT + WEIGHT**2)[0] == pytest.approx(0.0, abs=1e-12)
    crossing = WEIGHT * (1.0 - WEIGHT) * (0.505 - WEIGHT)
    assert greater_share(crossing) == pytest.approx(0.505, abs=1e-3)
    assert greater_share(-crossing) == pytest.approx(0.495, abs=1e-3)
    assert greater_share(WEIGHT * (1.0 - WEIGHT) + 1e-14) == pytest.approx(1.0)


def test_claims_of_the_paper_that_do_not_hold(measured):
    judged = {(c["source"], c["claim"].split(":")[0]): c["verdict"] for c in judged_claims(SCENARIO, measured)}
    false = {k for k, verdict in judged.items() if verdict == "contradicts"}
    assert len(judged_claims(SCENARIO, measured)) == len(SCENARIO.claims)
    assert {source for source, _ in false} == {
        "6, v-fusion, conclusion 2", "Remark 3", "sentence after (26)", "(19)-(20)",
    }  # fmt: skip
    assert {claim for source, claim in false if source == "Remark 3"} == {"Parameter 45"}
    assert sum(c["verdict"] == "contradicts" for c in judged_claims(SCENARIO, measured)) == 6


def test_figures_without_chance(measured):
    """Lognormals: e^2 - e halved, e - sqrt(e); errors about 55 and 50; a weight outside (0, 1)."""
    e = np.e
    exact = {
        f"{AA}@lognormal/least_variance_1": (e**2 - e) / 2,
        f"{GA}@lognormal/least_variance_1": e - np.sqrt(e),
        f"{AA}@theta55/beta_1": (0.70736 * np.sqrt(2) * 100 - 25) / np.sqrt(125 * 225),
        f"{AA}@theta50/beta_1": 0.70736 * np.sqrt(2 / 3),
        f"{AA}@theta50/limit_26_1": np.sqrt(1 / 3),
        f"{AA}@swapped/least_variance_1": 100.0,
    }
    for name, value in exact.items():
        assert measured[name].value == pytest.approx(value, rel=1e-9), name
        assert measured[name].standard_error == 0.0
    assert measured[f"{AA}@swapped/weight_19_1"].value > 1.0


def test_pieces_equal_the_whole_and_rows_can_be_chosen():
    whole = _outcomes(range(4), f"{AA}@rho")
    assert set(whole) == {f"{AA}@{v}" for v in VARIABLES if v.startswith("rho")}
    for name, values in whole.items():
        pieces = [_outcomes(part, name)[name] for part in ([0, 1], [2], [3])]
        np.testing.assert_allclose(np.concatenate(pieces), values, rtol=1e-9)
    assert set(SCENARIO.figures(_outcomes(range(2), f"{AA}@lognormal"))) == {f"{AA}@lognormal/least_variance_1"}
    one = SCENARIO.figures(_outcomes([0], f"{GA}@rho0"))
    assert all(np.isnan(e.standard_error) for e in one.values())
    with pytest.raises(ParameterError, match="row"):
        _outcomes([0], "given-naive")


def test_charts(outcomes):
    panels = SCENARIO.charts(outcomes)
    assert [len(chart.series) for chart in panels] == [6, 6, 6, 6]
    ends = [line.y[[0, -1]] for line in panels[0].series]
    np.testing.assert_allclose(ends, np.broadcast_to([200.0, 100.0], (6, 2)), rtol=0.03)
    assert len(SCENARIO.charts(_outcomes([0], f"{GA}@{FIGURE_1[1]}"))[0].series) == 1
