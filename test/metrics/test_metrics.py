"""Errors with their Monte Carlo error, consistency with its bounds."""

import numpy as np
import pytest
from scipy.stats import chi2

from track_fusion.metrics.accuracy import Estimate, armse, rmse
from track_fusion.metrics.consistency import consistency, consistency_of_sum, nees


def test_rmse_is_over_runs_and_armse_the_average_over_steps():
    squared = np.array([[9.0, 0.0], [16.0, 2.0]])
    np.testing.assert_allclose(rmse(squared), [np.sqrt(12.5), 1.0])
    assert armse(squared).value == pytest.approx((np.sqrt(12.5) + 1.0) / 2)
    assert armse(squared).runs == 2


@pytest.mark.parametrize("runs", [2, 3, 17])
def test_standard_error_is_the_jackknife(runs):
    rng = np.random.default_rng(runs)
    squared = rng.chisquare(2, (runs, 6))
    left_out = []
    for i in range(runs):
        others = np.array([squared[j] for j in range(runs) if j != i])
        left_out.append(np.mean([np.sqrt(np.mean(others[:, k])) for k in range(6)]))
    wanted = np.sqrt((runs - 1) / runs * sum((v - np.mean(left_out)) ** 2 for v in left_out))
    assert armse(squared).standard_error == pytest.approx(wanted, rel=1e-10)


def test_a_ratio_of_averages_has_the_spread_of_repeated_studies():
    rng = np.random.default_rng(2)
    below = rng.chisquare(4, (2000, 40))
    studies = [Estimate.ratio(0.5 * b + rng.chisquare(2, 40), b) for b in below]
    assert np.mean([s.value for s in studies]) == pytest.approx(1.0, abs=0.02)
    spread = np.std([s.value for s in studies])
    assert np.mean([s.standard_error for s in studies]) == pytest.approx(spread, rel=0.06)
    assert Estimate.ratio(np.array([3.0]), np.array([2.0])).value == 1.5


def test_standard_error_of_a_median_is_the_spread_of_repeated_studies():
    studies = [Estimate.median(v) for v in np.exp(np.random.default_rng(5).normal(size=(4000, 50)))]
    spread = np.std([s.value for s in studies])
    assert np.mean([s.standard_error for s in studies]) == pytest.approx(spread, rel=0.1)


@pytest.mark.parametrize("runs", [2, 5, 20])
def test_the_order_statistics_about_a_median_lie_alike_on_either_side(runs):
    values = np.random.default_rng(runs).normal(size=runs) ** 3
    assert Estimate.median(-values).standard_error == pytest.approx(Estimate.median(values).standard_error)
    assert Estimate.median(np.arange(4.0)).standard_error == pytest.approx(1.0)  # half of 2.5 - .5
    assert np.isnan(Estimate.median(values[:1]).standard_error)


def test_standard_error_is_the_spread_of_repeated_studies():
    """With errors as correlated over the steps as those of a filter."""
    rng = np.random.default_rng(0)
    common = rng.normal(size=(400, 50, 1, 2))
    errors = common + 0.5 * rng.normal(size=(400, 50, 10, 2))
    studies = [armse((e**2).sum(-1)) for e in errors]
    spread = np.std([s.value for s in studies])
    claimed = np.mean([s.standard_error for s in studies])
    assert claimed == pytest.approx(spread, rel=0.15)  # four standard deviations of a spread over 400


def test_one_run_has_no_standard_error():
    assert np.isnan(armse(np.ones((1, 3))).standard_error)


def test_spread_of_a_table_of_other_size():
    assert Estimate(20.0, 0.05, 1000).spread(100) == pytest.approx(0.05 * np.sqrt(10))


def test_nees_is_the_squared_length_in_standard_deviations():
    assert nees(np.array([3.0, 4.0]), np.diag([9.0, 4.0])) == pytest.approx(1.0 + 4.0)
    rng = np.random.default_rng(1)
    a, error = rng.normal(size=(5, 4, 4)), rng.normal(size=(5, 4))
    cov = a @ np.swapaxes(a, 1, 2)
    np.testing.assert_allclose(nees(error, cov), [e @ np.linalg.inv(p) @ e for e, p in zip(error, cov, strict=True)])


@pytest.mark.parametrize("count", [1, 25, 1000])
def test_bounds_hold_a_consistent_filter_in_19_of_20_studies(count):
    found = consistency(np.ones(count), 4)
    assert chi2.cdf(found.low * 4 * count, 4 * count) == pytest.approx(0.025, abs=1e-9)
    assert chi2.cdf(found.high * 4 * count, 4 * count) == pytest.approx(0.975, abs=1e-9)


@pytest.mark.parametrize(("scale", "verdict"), [(0.5, "underconfident"), (1.0, "consistent"), (1.5, "overconfident")])
def test_verdict(scale, verdict):
    values = scale * np.random.default_rng(2).chisquare(4, 500)
    found = consistency(values, 4)
    assert found.verdict == verdict
    assert found.anees == pytest.approx(values.mean() / 4)
    assert consistency_of_sum(float(values.sum()), 500, 4) == found


def test_no_sample_proves_nothing():
    found = consistency(np.zeros(0), 4)
    assert (found.verdict, found.samples) == ("unknown", 0)


def test_what_is_the_same_in_all_runs_has_no_error_at_all():
    found = Estimate.mean(np.full(1000, 0.1))
    assert (found.value, found.standard_error) == (0.1, 0.0)
    assert np.isnan(Estimate.mean(np.array([0.1])).standard_error)  # one run proves nothing
