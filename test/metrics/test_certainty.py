"""On which side of zero a mean lies: against scipy's t interval and signed ranks, and how often it is wrong."""

import numpy as np
import pytest
from scipy import stats

from track_fusion.metrics.certainty import LEAST_RUNS, TAIL, rank_sigmas, surely_positive


@pytest.mark.parametrize("runs", [30, 300])
def test_where_nothing_is_skewed_it_is_the_t_interval(runs):
    shape = np.linspace(-1.0, 1.0, runs)
    error = stats.sem(shape)
    limit = stats.t(runs - 1).ppf(1.0 - TAIL) * error
    assert surely_positive(shape + 1.001 * limit)
    assert not surely_positive(shape + 0.999 * limit)


@pytest.mark.parametrize("runs", [25, 200])
def test_signed_ranks_are_those_of_wilcoxon(runs):
    values = np.random.default_rng(runs).normal(size=runs).round(1) + 0.1
    wanted = stats.wilcoxon(values, method="approx")
    assert 2.0 * stats.norm.sf(abs(rank_sigmas(values))) == pytest.approx(wanted.pvalue, rel=1e-9)
    assert rank_sigmas(-values) == pytest.approx(-rank_sigmas(values))
    assert rank_sigmas(np.zeros(runs)) == 0.0


def test_a_few_runs_prove_nothing_and_equal_ones_all():
    assert not surely_positive(np.ones(LEAST_RUNS - 1))
    assert surely_positive(np.ones(LEAST_RUNS))
    assert not surely_positive(np.zeros(LEAST_RUNS))
    assert not surely_positive(-np.ones(LEAST_RUNS))


def test_ten_runs_far_above_zero_are_sure_however_skewed():
    """Where the spread is a thousandth of the mean its shape does not matter."""
    skewed = np.array([0.0] * 9 + [1.0])
    for values in (skewed, -skewed):
        assert surely_positive(1000.0 + values)
        assert not surely_positive(0.05 + values)


def test_a_mean_that_a_few_large_runs_make_is_not_sure():
    """The t interval alone would say yes: 4 of 40 runs make the mean, against all others."""
    values = np.where(np.arange(40) < 10, 8.0, -0.5) + 1e-3 * np.arange(40)
    assert values.mean() > stats.t(39).ppf(1.0 - 0.01) * stats.sem(values)
    assert not surely_positive(values, tail=0.01)


@pytest.mark.parametrize("runs", [10, 100])
@pytest.mark.parametrize("kind", ["normal", "skewed", "heavy"])
def test_a_wrong_yes_is_as_rare_as_it_says(kind, runs):
    rng = np.random.default_rng(4)
    draws = {
        "normal": lambda: rng.normal(size=runs),
        "skewed": lambda: 2.0 - rng.chisquare(2, runs),  # its rare runs are the low ones
        "heavy": lambda: rng.standard_t(3, runs),
    }
    wrong = np.mean([surely_positive(draws[kind](), tail=0.01) for _ in range(4000)])
    assert wrong <= 0.02 + 3.0 * np.sqrt(0.02 / 4000)
