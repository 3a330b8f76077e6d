"""Paired differences against scipy's t-test, Holm's adjustment by hand, ties and single runs."""

import numpy as np
import pytest
from scipy import stats

from track_fusion.metrics.significance import diverged_runs, robust_mean
from track_fusion.metrics.significance import paired_differences as of_groups


def paired_differences(scores):
    return of_groups({"": scores})[""]


def test_of_two_methods_it_is_the_paired_t_test():
    rng = np.random.default_rng(1)
    noise = rng.normal(size=50)
    a, b = noise + 0.1 * rng.normal(size=50), noise + 0.05 + 0.1 * rng.normal(size=50)
    (found,) = paired_differences({"b": b, "a": a})
    wanted = stats.ttest_rel(b, a)
    assert (found.first, found.second) == ("a", "b")
    assert found.mean == pytest.approx((b - a).mean())
    assert found.p_value == pytest.approx(wanted.pvalue)
    assert found.mean / found.standard_error == pytest.approx(wanted.statistic)
    assert found.significant == (wanted.pvalue < 0.05)


def test_several_pairs_are_adjusted_by_holm():
    rng = np.random.default_rng(2)
    scores = {name: rng.normal(size=20) + shift for name, shift in (("a", 0.0), ("b", 0.3), ("c", 1.0))}
    found = paired_differences(scores)
    raw = np.array([stats.ttest_rel(scores[d.second], scores[d.first]).pvalue for d in found])
    order = raw.argsort()
    stepwise = np.maximum.accumulate(np.minimum(1.0, raw[order] * np.array([3, 2, 1])))
    np.testing.assert_allclose([found[i].p_value for i in order], stepwise)
    assert all(d.mean >= 0 for d in found)


def test_chance_alone_is_seldom_called_significant():
    rng = np.random.default_rng(3)
    called = [
        any(d.significant for d in paired_differences({n: rng.normal(size=30) for n in "abcd"})) for _ in range(400)
    ]
    assert 0.01 < np.mean(called) < 0.08  # of six pairs at 5 % each, some 20 % would without the adjustment


def test_ties_and_single_runs():
    same = np.arange(5.0)
    (tie,) = paired_differences({"a": same, "b": same})
    assert (tie.mean, tie.p_value, tie.significant) == (0.0, 1.0, False)
    (shift,) = paired_differences({"a": same, "b": same + 1.0})
    assert (shift.mean, shift.p_value, shift.significant) == (1.0, 0.0, True)
    (single,) = paired_differences({"a": same[:1], "b": same[1:2]})
    assert single.mean == 1.0
    assert np.isnan(single.p_value)
    assert not single.significant
    assert paired_differences({"a": same}) == []


def test_rounding_is_no_difference():
    same = np.arange(1.0, 6.0)
    (tie,) = paired_differences({"a": same, "b": same * (1.0 + 1e-13)})
    assert (tie.mean, tie.p_value, tie.significant) == (0.0, 1.0, False)
    (real,) = paired_differences({"a": same, "b": same * (1.0 + 1e-6)})
    assert real.significant


def test_the_adjustment_is_for_all_groups_together():
    rng = np.random.default_rng(4)
    groups = {g: {name: rng.normal(size=20) + shift for name, shift in (("a", 0.0), ("b", 0.7))} for g in range(4)}
    (alone,) = of_groups({0: groups[0]})[0]
    every = [d for (d,) in of_groups(groups).values()]
    raw = np.array([stats.ttest_rel(groups[g][d.second], groups[g][d.first]).pvalue for g, d in enumerate(every)])
    order = raw.argsort()
    stepwise = np.maximum.accumulate(np.minimum(1.0, raw[order] * np.array([4, 3, 2, 1])))
    np.testing.assert_allclose([every[i].p_value for i in order], stepwise)
    assert alone.p_value == pytest.approx(raw[0])


def test_what_is_the_same_in_all_runs_counts_once():
    """A hundred runs of a rule that draws nothing are one, and no test."""
    (found,) = paired_differences({"a": np.ones(100), "b": np.full(100, 1.5)})
    assert found.mean == 0.5
    assert np.isnan(found.p_value)
    assert not found.significant
    rng = np.random.default_rng(5)
    drawn = {"a": rng.normal(size=20), "b": rng.normal(size=20) + 1.0}
    # Nor does it count among the tests for which the others are adjusted.
    (p,) = (d.p_value for d in of_groups({"x": drawn, "y": {"a": np.ones(20), "b": np.zeros(20)}})["x"])
    assert p == pytest.approx(paired_differences(drawn)[0].p_value)


def test_a_method_that_diverges_is_not_better():
    rng = np.random.default_rng(6)
    good = 1.0 + 0.1 * rng.normal(size=1000)
    scores = {"steady": good + 0.5, "wild": np.where(np.arange(1000) == 7, 200.0, good)}
    lost = diverged_runs(scores)
    assert lost["wild"].sum() == 1
    assert not lost["steady"].any()
    (found,) = of_groups({"": scores}, {"": lost})[""]
    assert found.first == "wild"
    assert (found.diverges, found.significant) == (True, False)
    assert robust_mean(scores["wild"]) == pytest.approx(stats.trim_mean(scores["wild"], 0.1))


def test_scores_that_are_not_finite_come_last_and_prove_nothing():
    scores = {"lost": np.array([1.0, np.inf, np.nan] * 4), "kept": np.linspace(5.0, 6.0, 12)}
    (found,) = of_groups({"": scores}, {"": diverged_runs(scores)})[""]
    assert (found.first, found.second) == ("kept", "lost")
    assert np.isnan(found.p_value)
    assert diverged_runs(scores)["lost"].mean() == pytest.approx(2 / 3)
