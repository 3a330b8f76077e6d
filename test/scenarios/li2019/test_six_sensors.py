"""Li 2019, Fig. 8: trials against their law, masses against plain sums and grids, lost targets against ERRATA."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from track_fusion.params import ParameterError
from track_fusion.random_streams import stream
from track_fusion.scenarios.li2019.common import exact_geometric, intensity, scalar_mixture
from track_fusion.scenarios.li2019.six_sensors import (
    AA,
    AVERAGE,
    EXACT,
    GA,
    SCENARIO,
    TARGETS,
    X,
    by_rule,
    least_mass,
    of_mixtures,
    on_grid,
    scan,
    trials,
)
from track_fusion.study.judgement import judged_claims
from track_fusion.study.rule_choice import RuleChoice


@pytest.fixture(scope="module")
def outcomes():
    return SCENARIO.simulate(range(60), 1, lambda share: None, "")


@pytest.fixture(scope="module")
def measured(outcomes):
    return SCENARIO.figures(outcomes)


@pytest.fixture(scope="module")
def some():
    return trials(range(8), 5)


def _lists(parts, run):
    """Return the components (weight, place) of each sensor in one trial, padding dropped."""
    return [
        [(w, m) for w, m in zip(weights, means[:, 0], strict=True) if w > 0]
        for weights, means in zip(parts.weight[run], parts.mean[run], strict=True)
    ]


def test_losses_are_those_of_the_errata(measured):
    """Per trial the arithmetic average loses less than .2 of 5 targets, the approximate geometric more than 1."""
    average, geometric = measured[f"{AA}/lost_targets_1"], measured[f"{GA}/lost_targets_1"]
    assert average.value + 2 * average.standard_error < 0.2
    assert geometric.value - 5 * geometric.standard_error > 1.0


def test_a_trial_is_drawn_by_its_law():
    drawn = [scan(stream(0, run, "test")) for run in range(3000)]
    seen = np.stack([s for s, _ in drawn])
    np.testing.assert_allclose(seen.mean(0), 0.9, atol=0.02)
    alarms = np.array([len(places) - s.sum() for s, places in drawn])
    assert alarms.mean() == pytest.approx(1.0, abs=0.06)
    assert alarms.var() == pytest.approx(1.0, abs=0.1)
    where = np.concatenate([places[s.sum() :] for s, places in drawn])
    assert where.min() >= 0
    assert where.max() <= 200
    assert where.mean() == pytest.approx(100.0, abs=4)
    errors = np.concatenate([places[: s.sum()] - TARGETS[s] for s, places in drawn])
    assert errors.std() == pytest.approx(2.0, rel=0.03)


def test_a_sensor_that_sees_nothing_looks_again():
    class Blind:
        """First no detection and no false alarm, then one detection."""

        looks = 0

        def random(self, size):
            self.looks += 1
            return np.where(np.arange(size) == 2, 1.0 - 0.5 * (self.looks > 1), 1.0)

        def standard_normal(self, size):
            return np.zeros(size)

        def poisson(self, rate):
            return 0

        def uniform(self, low, high, size):
            return np.empty(size)

    rng = Blind()
    seen, places = scan(rng)
    assert rng.looks == 2
    assert seen.tolist() == [False, False, True, False, False]
    assert places.tolist() == [70.0]


def test_masses_of_the_arithmetic_average_component_by_component(some):
    parts, _ = some
    found = by_rule(AVERAGE, 4)(parts)
    near_any = np.abs(X[:, None] - TARGETS).min(-1) < 15
    for run in range(8):
        near, intensity = np.zeros(5), np.zeros(len(X))
        for components in _lists(parts, run)[:4]:
            for weight, place in components:
                one = norm(place, 5.0)
                near += weight / 4 * (one.cdf(TARGETS + 8) - one.cdf(TARGETS - 8))
                intensity += weight / 4 * one.pdf(X)
        np.testing.assert_allclose(found.near[run], near, rtol=1e-9)
        assert found.far[run] == pytest.approx(intensity[~near_any].sum() * 0.5, abs=2e-3)


def test_masses_of_the_geometric_averages_point_by_point(some):
    """The product over sensors of sums of sixth roots of components, (49), and the sixth root of the product."""
    parts, _ = some
    rule = by_rule(RuleChoice.of("mixture_hybrid", max_components=20))(parts)
    exact = exact_geometric(parts, X)
    for run in range(8):
        approximate, product, number = np.ones(len(X)), np.ones(len(X)), 0.0
        for components in _lists(parts, run):
            total = sum(w for w, _ in components)
            densities = [w / total * norm(place, 5.0).pdf(X) for w, place in components]
            approximate *= sum(d ** (1 / 6) for d in densities)
            product *= sum(densities) ** (1 / 6)
            number += total / 6
        wanted = on_grid(number * approximate[None] / (approximate.sum() * 0.5))
        np.testing.assert_allclose(rule.near[run], wanted.near[0], atol=0.01)
        assert rule.far[run] == pytest.approx(wanted.far[0], abs=0.01)
        np.testing.assert_allclose(rule.between[run], wanted.between[0], atol=1e-3)
        np.testing.assert_allclose(exact[run], number * product / (product.sum() * 0.5), rtol=1e-6, atol=1e-12)


def test_half_the_mass_of_a_target_that_all_see():
    """Mean weight .75 of the mass within 8 of a Gaussian of variance 25 + 4: near enough to the median."""
    share = 2 * norm.cdf(8 / np.sqrt(29)) - 1
    assert least_mass() == pytest.approx(0.5 * 0.75 * share, rel=0.08)
    parts, seen = trials(range(3), 0, certain=True)
    assert seen.all()
    assert ((parts.weight > 0).sum(-1) >= 5).all()


def test_two_targets_are_mixed_when_half_way_is_higher():
    one, two = (scalar_mixture(np.ones((1, 2)), np.array([m]), np.full((1, 2), 25.0)) for m in ([28, 33], [20, 40]))
    assert of_mixtures(one).mixed.tolist() == [True]
    assert of_mixtures(two).mixed.tolist() == [False]
    assert on_grid(intensity(one, X)).mixed.tolist() == [True]


def test_claims(measured):
    judged = judged_claims(SCENARIO, measured)
    assert len(judged) == len(SCENARIO.claims)
    others = {c["claim"][:34]: c["verdict"] for c in judged if c["verdict"] != "agrees"}
    # That none of sixty trials mixes two targets leaves room for one in nine.
    assert others == {
        "A target that one sensor misses is": "contradicts", "It mixes the targets at 20 and 40 ": "undecided",
        "The more sensors, the more targets": "undecided",
    }  # fmt: skip
    assert measured[f"{EXACT}/lost_targets_1"].value < measured[f"{GA}/lost_targets_1"].value
    assert measured[f"{EXACT}/lost_missed_by_0_share_1"].value < 0.05  # only the approximation loses what all see
    shares = [measured[f"{GA}/lost_missed_by_{k}_share_1"].value for k in range(3)]
    assert shares == sorted(shares)


def test_pieces_equal_the_whole(outcomes):
    for only in (AA, EXACT, f"{GA}@sensors3"):
        pieces = [SCENARIO.simulate(part, 1, lambda share: None, only) for part in ([0], [1, 2], [3, 4, 5])]
        for name in pieces[0]:
            np.testing.assert_allclose(np.concatenate([p[name] for p in pieces]), outcomes[name][:6], rtol=1e-9)
    few = SCENARIO.figures(SCENARIO.simulate([0], 1, lambda share: None, AA))
    assert f"{AA}/lost_targets_1" in few
    assert np.isnan(few[f"{AA}/lost_targets_1"].standard_error)


def test_any_rules_are_compared(outcomes):
    rules = [*SCENARIO.rules, RuleChoice.of("naive")]
    found = SCENARIO.compare(rules, range(4), 1, lambda share: None)
    for row in (AA, GA):
        np.testing.assert_array_equal(found[f"{row}/lost_targets_1"], outcomes[f"{row}/lost"][:4].sum(-1))
        np.testing.assert_allclose(found[f"{row}/far_mass_1"], outcomes[f"{row}/far"][:4], rtol=1e-9)
    assert (found["given-naive/lost_targets_1"] >= 3).all()  # one Gaussian cannot cover them all
    needy = RuleChoice.of("split_covariance_intersection")
    with pytest.raises(ParameterError, match="which needs '.*' beside the tracks"):
        SCENARIO.compare([needy], [0], 1, lambda share: None)


def test_charts(outcomes):
    panels = SCENARIO.charts(outcomes)
    assert [chart.title.partition(":")[0] for chart in panels] == [
        "Fig. 8", "Lost targets of five", "Lost by place of the target",
    ]  # fmt: skip
    assert [line.x.tolist() for line in panels[1].series] == [[2, 3, 4, 5, 6], [2, 3, 4, 5, 6], [6]]
    assert len(SCENARIO.charts({k: v for k, v in outcomes.items() if k.startswith(f"{GA}@sensors3")})) == 1
