"""What scenarios share: rules over runs, verdicts, the list."""

import dataclasses
import json
import math
import os

import numpy as np
import pytest

from track_fusion.angles import TURN, difference, wrap
from track_fusion.linalg import transpose
from track_fusion.metrics.accuracy import Estimate
from track_fusion.params import ParameterError
from track_fusion.rules import RULES, SourceTracks
from track_fusion.scenarios import SCENARIOS, get_scenario, judged_figures
from track_fusion.scenarios.ahmed import search as ahmed_search
from track_fusion.study.judgement import verdict
from track_fusion.study.rule_choice import RuleChoice, check_needs, fuse_runs, rule_by_rule
from track_fusion.study.scenario import Claim, Printed, Scenario

# ---- rules over runs that share their covariances --------------------------------------------------------------------


@pytest.mark.parametrize("key", [key for key, rule in RULES.items() if rule.linear])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_linear_rule_fuses_shared_covariances_once(key, count):
    rng, rule = np.random.default_rng(count), RULES[key]
    a = rng.normal(size=(1, count, 4, 6))
    mean, cov = 100 * rng.normal(size=(50, count, 4)), a @ transpose(a)
    shared = fuse_runs(RuleChoice(key, rule.params()), mean, cov)
    each = rule.fuse(SourceTracks(mean, np.repeat(cov, 50, 0)), rule.params())
    assert shared.cov.shape == (1, 4, 4)
    np.testing.assert_allclose(shared.mean, each.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.broadcast_to(shared.cov, each.cov.shape), each.cov, rtol=1e-9, atol=1e-12)
    assert (shared.weights is None) == (each.weights is None)
    if shared.weights is not None and each.weights is not None:
        assert shared.weights.shape == (1, count)
        np.testing.assert_allclose(np.broadcast_to(shared.weights, each.weights.shape), each.weights, atol=1e-9)


@pytest.mark.parametrize("key", [key for key, rule in RULES.items() if not rule.linear and not rule.needs])
def test_another_rule_sees_every_run(key):
    rng, rule = np.random.default_rng(7), RULES[key]
    mean, cov = rng.normal(size=(5, 2, 4)), np.stack([np.eye(4), np.diag([1.0, 2.0, 3.0, 4.0])])[None]
    fused = fuse_runs(RuleChoice(key, rule.params()), mean, cov)
    each = rule.fuse(SourceTracks(mean, np.repeat(cov, 5, 0)), rule.params())
    np.testing.assert_array_equal(fused.mean, each.mean)
    np.testing.assert_array_equal(fused.cov, each.cov)


@pytest.mark.parametrize("key", ["naive", "covariance_union", "geometric_mean_sampling"])
def test_directions_of_runs_are_fused_on_the_circle(key):
    """At the seam as at zero, turned, also by a linear rule."""
    rng, choice, periods = np.random.default_rng(8), RuleChoice(key, RULES[key].params()), (np.inf, TURN)
    mean, cov = 0.1 * rng.normal(size=(5, 2, 2)), np.stack([np.eye(2), np.diag([2.0, 3.0])])[None]

    def fused(turn):
        turned = wrap(mean + [0.0, turn], periods)
        return fuse_runs(choice, turned, cov, [np.random.default_rng(k) for k in range(5)], periods=periods)

    here, there = fused(0.0), fused(np.pi)
    np.testing.assert_allclose(difference(there.mean - [0.0, np.pi], here.mean, periods), 0.0, atol=1e-9)
    np.testing.assert_allclose(there.cov, here.cov, rtol=1e-9, atol=1e-12)


def test_each_run_of_a_rule_that_samples_draws_its_own_numbers():
    choice = RuleChoice("geometric_mean_sampling", RULES["geometric_mean_sampling"].params(samples=50))
    mean = np.tile(np.random.default_rng(1).normal(size=(1, 2, 4)), (3, 1, 1))
    cov = np.stack([np.eye(4), 2.0 * np.eye(4)])[None]
    whole = fuse_runs(choice, mean, cov, [np.random.default_rng(s) for s in (1, 2, 1)])
    last = fuse_runs(choice, mean[2:], cov, [np.random.default_rng(1)])
    np.testing.assert_array_equal(whole.mean[2:], last.mean)
    np.testing.assert_array_equal(whole.cov[0], whole.cov[2])
    assert np.abs(whole.mean[0] - whole.mean[1]).max() > 1e-3
    assert whole.weights.shape == (3, 2)


def test_a_rule_that_needs_more_than_a_scenario_has_is_refused():
    average = RULES["arithmetic_average"].params
    check_needs([RuleChoice("naive", RULES["naive"].params()), RuleChoice("arithmetic_average", average())])
    check_needs([RuleChoice("arithmetic_average", average(criterion="target"), "target")], ("target",))
    with pytest.raises(ParameterError, match="Got 'arithmetic_average@t', which needs 'target' beside the tracks"):
        check_needs([RuleChoice("arithmetic_average", average(criterion="target"), "t")], ("likelihood",))


# ---- verdicts -------------------------------------------------------------------------------------------------------


def scenario(published, runs=100):
    return Scenario(
        key="key", title="", paper="", shows="", published=published, published_runs=runs,
        simulate=lambda *a: {}, figures=lambda s: {}, charts=lambda s: [],
    )  # fmt: skip


def judge(values, published, name="a/m", standard_error=0.1, runs=100):
    measured = {n: Estimate(v, standard_error, 100) for n, v in values.items()}
    return verdict(scenario(published, runs), name, measured)


def test_agrees_within_three_standard_deviations_of_the_difference():
    # Standard error .1 here, spread of a table of 100 runs .1: 3 sqrt(.02) = .4243.
    assert judge({"a/m": 1.42}, {"a/m": 1}) == "agrees"
    assert judge({"a/m": 0.58}, {"a/m": 1}) == "agrees"
    assert judge({"a/m": 1.43}, {"a/m": 1}) == "does not reproduce"
    # The paper's own table of 25 runs spreads by .2: 3 sqrt(.05) = .6708.
    assert judge({"a/m": 1.67}, {"a/m": 1}, runs=25) == "agrees"
    assert judge({"a/m": 1.68}, {"a/m": 1}, runs=25) == "does not reproduce"


def test_the_rounding_of_the_print_is_allowed_for():
    assert judge({"a/m": 1.044}, {"a/m": 1.0}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 1.051}, {"a/m": 1.0}, standard_error=0.0) == "does not reproduce"
    assert judge({"a/m": 1.51e-3}, {"a/m": 1.5e-3}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 1.56e-3}, {"a/m": 1.5e-3}, standard_error=0.0) == "does not reproduce"


def test_a_zero_at_the_end_of_the_print_is_a_digit():
    assert judge({"a/m": 10.74}, {"a/m": 10.7}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 10.704}, {"a/m": Printed("10.70")}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 10.706}, {"a/m": Printed("10.70")}, standard_error=0.0) == "does not reproduce"
    assert json.dumps(Printed("10.70")) == "10.7"


def test_least_and_greatest_of_figures():
    one, two, four = (Estimate.exact(v) for v in (1.0, 2.0, 4.0))
    assert Claim.least("", "", "a/m", ["b/m", "c/m"]).needs == ("a/m", "b/m", "c/m")
    assert Claim.least("", "", "a/m", ["b/m", "c/m"]).holds(one, four, two)
    assert not Claim.least("", "", "a/m", ["b/m", "c/m"]).holds(two, four, two)
    assert Claim.greatest("", "", "a/m", ["b/m", "c/m"]).holds(four, two, one)
    assert not Claim.greatest("", "", "a/m", ["b/m", "c/m"]).holds(four, one, four)
    assert not Claim.greatest("", "", "a/m", ["b/m"], 2.0).holds(four, two)


def test_comparing_each_names_what_it_measures_and_refuses_first():
    choices, shares = [RuleChoice(key, RULES[key].params()) for key in ("naive", "covariance_union")], []
    found = rule_by_rule("kf", choices, shares.append, lambda choice: {"m_1": np.full(2, len(choice.key))})
    assert {name: values.tolist() for name, values in found.items()} == {
        "kf-naive/m_1": [5.0, 5.0], "kf-covariance_union/m_1": [16.0, 16.0],
    }  # fmt: skip
    assert shares == [0.5, 1.0]
    needy = RuleChoice("split_covariance_intersection", RULES["split_covariance_intersection"].params())
    comparing = dataclasses.replace(scenario({}), scores=lambda *asked: pytest.fail("measured"))
    with pytest.raises(ParameterError, match="which needs 'independent_cov' beside the tracks"):
        comparing.compare([choices[0], needy], [0], 0, shares.append)


def test_ordering_only_where_it_stands_to_every_other_row_as_published():
    published = {"a/m": 1.0, "b/m": 2.0, "c/m": 0.5, "a/s": 7.0}
    assert judge({"a/m": 5.0, "b/m": 6.0, "c/m": 4.0, "a/s": 9.0}, published) == "ordering only"
    assert judge({"a/m": 5.0, "b/m": 4.9, "c/m": 4.0}, published) == "does not reproduce"
    assert judge({"a/m": 5.0, "b/m": 6.0, "c/m": 5.1}, published) == "does not reproduce"


def test_rows_of_another_quantity_or_not_published_order_nothing():
    published = {"a/m": 1.0, "a/s": 7.0}
    assert judge({"a/m": 5.0, "a/s": 1.0}, published) == "does not reproduce"
    assert judge({"a/m": 5.0, "d/m": 9.0}, published) == "does not reproduce"
    assert judge({"a/m": 5.0, "b/m": 9.0, "d/m": 1.0}, published | {"b/m": 2.0}) == "ordering only"


def test_ties():
    """A tie here where the paper has none is not its order; a tie of the paper orders nothing."""
    assert judge({"a/m": 5.0, "b/m": 5.0}, {"a/m": 1.0, "b/m": 2.0}) == "does not reproduce"
    assert judge({"a/m": 5.0, "b/m": 6.0}, {"a/m": 1.0, "b/m": 1.0}) == "does not reproduce"
    assert judge({"a/m": 5.0, "b/m": 4.0, "c/m": 6.0}, {"a/m": 1.0, "b/m": 1.0, "c/m": 2.0}) == "ordering only"


def test_not_given():
    assert judge({"a/m": 1.0}, {}) == "not given"
    assert judge({"a/m": 1.0}, {"a/m": 1.0}, standard_error=math.nan) == "not given"  # one run proves nothing


def test_figures_are_ready_for_json():
    found = judged_figures(scenario({"a/m": 2.0}), {"a/m": Estimate(1.0, math.nan, 1), "b/m": Estimate(3.0, 0.5, 9)})
    assert found == [
        {"name": "a/m", "value": 1.0, "standard_error": None, "published": 2.0, "verdict": "not given"},
        {"name": "b/m", "value": 3.0, "standard_error": 0.5, "published": None, "verdict": "not given"},
    ]


def test_scenarios_are_found_by_key():
    assert get_scenario("li2022-linear") is SCENARIOS["li2022-linear"]
    with pytest.raises(ParameterError, match="Did you mean 'li2022-linear'"):
        get_scenario("li2022-liner")
    assert all(key == s.key for key, s in SCENARIOS.items())


#: Long runs even by one: test_scenario_chen2022.py sees to their published figures in eight steps.
IN_FEWER_STEPS = ("chen2022-dynamic-1", "chen2022-dynamic-2")


@pytest.mark.parametrize("key", [key for key, s in SCENARIOS.items() if s.published and key not in IN_FEWER_STEPS])
def test_every_published_figure_is_measured(key, monkeypatch):
    monkeypatch.setattr(ahmed_search, "STEPS", 1)  # names do not depend on it
    scenario = SCENARIOS[key]
    rows = os.path.commonprefix([name.rpartition("/")[0] for name in scenario.published])
    assert set(scenario.published) <= set(scenario.measure(1, 0, only=rows))
