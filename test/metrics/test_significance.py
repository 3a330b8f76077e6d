"""Paired differences against scipy's t-test, Holm's adjustment by hand, ties and single runs."""

import numpy as np
import pytest
from scipy import stats

from track_fusion.metrics.significance import paired_differences


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
