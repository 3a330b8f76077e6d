"""What scenarios share: rules over runs, verdicts, the list."""

import dataclasses
import json
import math
import os

import numpy as np
import pytest
from scipy.stats import ttest_rel

from track_fusion.angles import TURN, difference, wrap
from track_fusion.linalg import transpose
from track_fusion.metrics.accuracy import Estimate, armse
from track_fusion.params import ParameterError
from track_fusion.rules import RULES, SourceTracks
from track_fusion.scenarios import SCENARIOS, get_scenario
from track_fusion.scenarios.ahmed import search as ahmed_search
from track_fusion.study.claim import Claim, ascending
from track_fusion.study.judgement import judged_claim, judged_figure, judged_figures
from track_fusion.study.rule_choice import RuleChoice, check_needs, fuse_runs, rule_by_rule
from track_fusion.study.scenario import Printed, Scenario

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
    judgement = judged_figure(scenario(published, runs), name, measured)
    return ": ".join(part for part in judgement if part)


def test_agrees_within_three_standard_deviations_of_the_difference():
    # Standard error .1 here, spread of a table of 100 runs .1: 3 sqrt(.02) = .4243.
    assert judge({"a/m": 1.42}, {"a/m": 1}) == "agrees"
    assert judge({"a/m": 0.58}, {"a/m": 1}) == "agrees"
    assert judge({"a/m": 1.43}, {"a/m": 1}) == "contradicts"
    # The paper's own table of 25 runs spreads by .2: 3 sqrt(.05) = .6708.
    assert judge({"a/m": 1.67}, {"a/m": 1}, runs=25) == "agrees"
    assert judge({"a/m": 1.68}, {"a/m": 1}, runs=25) == "contradicts"


def test_the_rounding_of_the_print_is_allowed_for():
    assert judge({"a/m": 1.044}, {"a/m": 1.0}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 1.051}, {"a/m": 1.0}, standard_error=0.0) == "contradicts"
    assert judge({"a/m": 1.51e-3}, {"a/m": 1.5e-3}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 1.56e-3}, {"a/m": 1.5e-3}, standard_error=0.0) == "contradicts"


def test_a_zero_at_the_end_of_the_print_is_a_digit():
    assert judge({"a/m": 10.74}, {"a/m": 10.7}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 10.704}, {"a/m": Printed("10.70")}, standard_error=0.0) == "agrees"
    assert judge({"a/m": 10.706}, {"a/m": Printed("10.70")}, standard_error=0.0) == "contradicts"
    assert json.dumps(Printed("10.70")) == "10.7"


def exactly(claim, *values):
    assert len(claim.needs) == len(values)
    return judged_claim(claim, [Estimate.exact(v) for v in values]).verdict


def test_kinds_of_claims_where_nothing_is_random():
    least = Claim.least("", "", "a/m", ["b/m", "c/m"])
    assert least.needs == ("a/m", "b/m", "c/m")
    assert exactly(least, 1.0, 4.0, 2.0) == "agrees"
    assert exactly(least, 2.0, 4.0, 2.0) == "contradicts"  # a tie is no order
    greatest = Claim.greatest("", "", "a/m", ["b/m", "c/m"])
    assert exactly(greatest, 4.0, 2.0, 1.0) == "agrees"
    assert exactly(greatest, 4.0, 1.0, 4.0 * (1.0 + 1e-15)) == "contradicts"
    assert exactly(Claim.greatest("", "", "a/m", ["b/m"], 2.0), 4.0, 1.9) == "agrees"
    assert exactly(Claim.greatest("", "", "a/m", ["b/m"], 2.0), 4.0, 2.0) == "contradicts"
    assert exactly(Claim.order("", "", "a/m", "b/m", "c/m"), 1.0, 2.0, 3.0) == "agrees"
    assert exactly(Claim.order("", "", "a/m", "b/m", "c/m"), 1.0, 3.0, 2.0) == "contradicts"
    assert exactly(Claim.above("", "", 1.0, "a/m", "b/m"), 1.1, 1.2) == "agrees"
    assert exactly(Claim.below("", "", 1.0, "a/m", "b/m"), 0.9, 1.2) == "contradicts"
    assert exactly(Claim.near("", "", 1.0, 0.1, "a/m"), 1.09) == exactly(Claim.near("", "", 1.0, 0.1, "a/m"), 0.91)
    assert exactly(Claim.near("", "", 1.0, 0.1, "a/m"), 0.89) == "contradicts"
    assert exactly(Claim.close("", "", 0.1, "a/m", "b/m", "c/m"), 10.0, 10.9, 9.1) == "agrees"
    assert exactly(Claim.close("", "", 0.1, "a/m", "b/m", "c/m"), 10.0, 10.9, 8.9) == "contradicts"
    each = Claim.each("", "", ["a/m", "b/m"], ["c/m", "d/m"], ascending)
    assert exactly(each, 1.0, 2.0, 1.5, 2.5) == "agrees"
    assert exactly(each, 1.0, 2.0, 1.5, 1.9) == "contradicts"


def test_figures_of_the_same_runs_are_compared_run_by_run():
    """Errors that share their noise: the difference is a tenth of it and clear; of other runs it could not be told."""
    rng = np.random.default_rng(1)
    noise = rng.normal(size=50)
    a, b = 10.0 + noise, 10.1 + noise + 0.02 * rng.normal(size=50)
    claim = Claim.order("", "", "a/m", "b/m")
    assert judged_claim(claim, [Estimate.mean(a), Estimate.mean(b)]).verdict == "agrees"
    assert judged_claim(claim, [Estimate.mean(b), Estimate.mean(a)]).verdict == "contradicts"
    assert judged_claim(claim, [Estimate.mean(a), Estimate.mean(b[::-1])]).verdict == "undecided"
    # Also of figures that are no averages: ratios, roots of averages, medians.
    for figure in (lambda v: Estimate.ratio(v, noise + 20.0), lambda v: armse(v[:, None] ** 2), Estimate.median):
        assert judged_claim(claim, [figure(a), figure(b)]).verdict == "agrees"
        assert judged_claim(claim, [figure(b), figure(a)]).verdict == "contradicts"


def test_the_margin_of_two_means_is_judged_as_their_differences_are():
    """The pseudo-values of a difference of means are the differences themselves."""
    rng = np.random.default_rng(2)
    verdicts = {1: "agrees", -1: "contradicts", 0: "undecided"}
    seen = set()
    for shift in np.linspace(-1.5, 1.5, 61):
        a, difference = rng.normal(size=40), rng.uniform(-1.7, 1.7, 20)
        difference = np.concatenate([difference, -difference]) + shift  # not skewed
        b = a + difference
        low, high = ttest_rel(b, a).confidence_interval(0.999)
        wanted = verdicts[int(low > 0.0) - int(high < 0.0)]
        assert judged_claim(Claim.order("", "", "a/m", "b/m"), [Estimate.mean(a), Estimate.mean(b)]).verdict == wanted
        seen.add(wanted)
    assert seen == set(verdicts.values())


def test_few_runs_and_unknown_errors_decide_nothing():
    claim = Claim.order("", "", "a/m", "b/m")
    for runs, wanted in ((9, "fewer than 10 runs"), (1, "a single run")):
        a = Estimate.mean(np.arange(float(runs)))
        assert judged_claim(claim, [a, Estimate.mean(100.0 + np.arange(runs))]) == ("undecided", wanted)
    told = [Estimate(1.0, 0.01, 50), Estimate(2.0, 0.01, 50)]
    assert judged_claim(claim, told) == ("undecided", "its error is not known")
    other = [Estimate.mean(np.arange(20.0)), Estimate.mean(100.0 + np.arange(30))]
    assert judged_claim(claim, other) == ("undecided", "figures of different runs")
    nowhere = Claim("", "", ("a/m",), lambda a: [np.log(-a)])
    assert judged_claim(nowhere, [Estimate.mean(np.arange(1.0, 20.0))]).verdict == "undecided"


def test_a_tie_in_every_run_is_no_order_but_allowed_by_some_slack():
    values = 10.0 + np.random.default_rng(3).normal(size=20)
    a = Estimate.mean(values)
    same = Estimate.mean(values * (1.0 + 1e-15))
    assert judged_claim(Claim.order("", "", "a/m", "b/m"), [a, same]) == ("contradicts", "a tie in every run")
    assert judged_claim(Claim.close("", "", 1e-9, "a/m", "b/m"), [a, same]).verdict == "agrees"


def test_what_ten_runs_all_say_may_still_fail_in_the_eleventh():
    """Ten of ten: the share is above .46 at 99.95 %."""
    always, never = Estimate.share(np.ones(10)), Estimate.share(np.zeros(10))
    assert always.value + always.unseen == pytest.approx(0.0005**0.1)
    assert judged_claim(Claim.above("", "", 0.45, "a/1"), [always]).verdict == "agrees"
    assert judged_claim(Claim.above("", "", 0.9, "a/1"), [always]).verdict == "undecided"
    assert judged_claim(Claim.above("", "", 0.9, "a/1"), [Estimate.share(np.ones(200))]).verdict == "agrees"
    assert judged_claim(Claim.below("", "", 0.1, "a/1"), [never]).verdict == "undecided"
    assert judged_claim(Claim.above("", "", 0.6, "a/1"), [never]).verdict == "contradicts"
    assert judged_claim(Claim.above("", "", 0.5, "a/1"), [never]).verdict == "undecided"


def test_what_no_result_could_contradict_is_marked_unless_it_is_contradicted():
    claim = Claim("", "", ("a/m",), lambda a: [a], by_construction="squares are positive")
    assert judged_claim(claim, [Estimate.exact(1.0)]) == ("by construction", "squares are positive")
    assert judged_claim(claim, [Estimate.exact(-1.0)]).verdict == "contradicts"  # a fault of the program


@pytest.mark.parametrize("gap", [0.0, 0.01, 0.05, 0.2])
def test_no_verdict_flips_with_the_seed(gap):
    """40 studies of each kind of error, tails as heavy as those of a filter that may lose its target."""
    kinds = {
        "normal": lambda rng, size: rng.normal(size=size),
        "squares": lambda rng, size: rng.chisquare(2, size) - 2.0,
        "heavy": lambda rng, size: rng.standard_t(3, size),
        "rare": lambda rng, size: np.where(rng.random(size) < 0.02, 30.0, -0.6),
    }
    claim = Claim.order("", "", "a/m", "b/m")
    for noise in kinds.values():
        small, large = [], []
        for seed in range(40):
            rng = np.random.default_rng([seed, 7])
            a, b = 10.0 + noise(rng, 500), 10.0 + gap + noise(rng, 500)
            for runs, verdicts in ((10, small), (500, large)):
                figures = [Estimate.mean(a[:runs]), Estimate.mean(b[:runs])]
                verdicts.append(judged_claim(claim, figures).verdict)
        assert not {"agrees", "contradicts"} <= {*small, *large}
        assert ("agrees", "contradicts") not in zip(small, large, strict=True)


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


def test_a_contradiction_says_where_it_stands_to_every_other_row_as_published():
    published = {"a/m": 1.0, "b/m": 2.0, "c/m": 0.5, "a/s": 7.0}
    assert judge({"a/m": 5.0, "b/m": 6.0, "c/m": 4.0, "a/s": 9.0}, published) == "contradicts: in the order published"
    assert judge({"a/m": 5.0, "b/m": 4.9, "c/m": 4.0}, published) == "contradicts"
    assert judge({"a/m": 5.0, "b/m": 6.0, "c/m": 5.1}, published) == "contradicts"


def test_rows_of_another_quantity_or_not_published_order_nothing():
    published = {"a/m": 1.0, "a/s": 7.0}
    assert judge({"a/m": 5.0, "a/s": 1.0}, published) == "contradicts"
    assert judge({"a/m": 5.0, "d/m": 9.0}, published) == "contradicts"
    assert (
        judge({"a/m": 5.0, "b/m": 9.0, "d/m": 1.0}, published | {"b/m": 2.0}) == "contradicts: in the order published"
    )


def test_ties():
    """A tie here where the paper has none is not its order; a tie of the paper orders nothing."""
    assert judge({"a/m": 5.0, "b/m": 5.0}, {"a/m": 1.0, "b/m": 2.0}) == "contradicts"
    assert judge({"a/m": 5.0, "b/m": 6.0}, {"a/m": 1.0, "b/m": 1.0}) == "contradicts"
    assert (
        judge({"a/m": 5.0, "b/m": 4.0, "c/m": 6.0}, {"a/m": 1.0, "b/m": 1.0, "c/m": 2.0})
        == "contradicts: in the order published"
    )


def test_not_given():
    assert judge({"a/m": 1.0}, {}) == "not given"
    assert judge({"a/m": 1.0}, {"a/m": 1.0}, standard_error=math.nan) == "undecided: a single run"


def test_a_figure_that_an_assumption_was_chosen_for_is_no_agreement():
    chosen = dataclasses.replace(scenario({"a/m": 1.0}), chosen=("a/m",))
    for value, wanted in ((1.0, "by construction"), (2.0, "contradicts")):
        assert judged_figure(chosen, "a/m", {"a/m": Estimate(value, 0.1, 100)}).verdict == wanted


def test_figures_are_ready_for_json():
    found = judged_figures(scenario({"a/m": 2.0}), {"a/m": Estimate(1.0, math.nan, 1), "b/m": Estimate(3.0, 0.5, 9)})
    assert found == [
        {
            "name": "a/m",
            "value": 1.0,
            "standard_error": None,
            "published": 2.0,
            "verdict": "undecided",
            "reason": "a single run",
        },
        {"name": "b/m", "value": 3.0, "standard_error": 0.5, "published": None, "verdict": "not given", "reason": ""},
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
