"""Li 2022, linear, against the converged values of its errata; runs do not depend on each other."""

import dataclasses
import math

import numpy as np
import pytest
from oracles.kalman import predict, update
from scipy.linalg import solve_discrete_are

from track_fusion.params import ParameterError
from track_fusion.rules import RULES, SourceTracks
from track_fusion.scenarios.li2022.linear import KALMAN_ROWS, RULE_CHOICES, SCENARIO, STUDY, TRACKING
from track_fusion.study.judgement import judged_claims, judged_figures
from track_fusion.study.one_target_study import TRUTH
from track_fusion.study.rule_choice import RuleChoice

RUNS = 1000
#: Converged values (position m, velocity m/s) and the spread of one 100-run table, by an independent implementation.
ERRATA = {
    "kf-alone": ((20.01, 0.15), (10.84, 0.08)),
    "kf-ic": ((18.26, 0.13), (10.50, 0.07)),
    "kf-naive": ((38.26, 0.55), (13.14, 0.15)),
    "kf-arithmetic_average": ((18.61, 0.14), (10.88, 0.09)),
    "kf-covariance_intersection@uniform": ((18.57, 0.14), (10.72, 0.09)),
}
#: Covariance union about either mean, position; the spread of one 100-run table is our own.
ERRATA_UNION = {"kf-covariance_union": (19.45, 0.11), "kf-covariance_union@optimal_mean": (22.4, 0.14)}
UNION_RUNS = 120
#: The reference values are rounded to 0.01; their own Monte Carlo error is not stated, taken as that of 1000 runs.
REFERENCE_RUNS, ROUNDING = 1000, 0.005


#: Rows by Kalman filters, that without a closed form aside; the particle filters' rows: test_filter_scenarios.
KALMAN = {name: row for name, row in KALMAN_ROWS.items() if not name.endswith("@optimal_mean")}


def sampled(rows, runs, seed, progress=lambda share: None):
    return dataclasses.replace(STUDY, rows=rows).simulate(runs, seed, progress)


@pytest.fixture(scope="module")
def measured():
    return STUDY.figures(sampled({n: r for n, r in KALMAN.items() if "union" not in n}, range(RUNS), 20))


@pytest.fixture(scope="module")
def unions():
    return STUDY.figures(sampled(KALMAN_ROWS, range(UNION_RUNS), 21))


@pytest.mark.parametrize("row", ERRATA)
def test_linear_scenario_lies_inside_the_intervals_of_the_errata(measured, row):
    for quantity, (value, sd100) in zip(("position_armse_m", "velocity_armse_mps"), ERRATA[row], strict=True):
        found = measured[f"{row}/{quantity}"]
        error = sd100 * math.sqrt(100 / RUNS + 100 / REFERENCE_RUNS)
        assert abs(found.value - value) <= 3 * error + ROUNDING, (row, quantity, found)
        assert found.standard_error == pytest.approx(sd100 * math.sqrt(100 / RUNS), rel=0.35)


def test_intersection_by_trace_always_takes_sensor_1_alone(measured):
    """Another error of the paper: see ERRATA.md. The claimed 18.85 needs a fixed weight."""
    for quantity in ("position_armse_m", "velocity_armse_mps"):
        alone, ci = (measured[f"{row}/{quantity}"].value for row in ("kf-alone", "kf-covariance_intersection"))
        assert ci == pytest.approx(alone, rel=1e-9)


def test_what_reproduces_and_what_does_not(measured):
    found = {f["name"]: f["verdict"] for f in judged_figures(SCENARIO, measured)}
    for row in ("kf-alone", "kf-ic", "kf-arithmetic_average"):
        assert found[f"{row}/position_armse_m"] == found[f"{row}/velocity_armse_mps"] == "agrees"
    assert found["kf-naive/velocity_armse_mps"] == "agrees"
    assert found["kf-covariance_intersection/position_armse_m"] == "contradicts"
    assert found["kf-covariance_intersection@uniform/position_armse_m"] == "not given"


def test_covariance_union_lies_where_the_errata_have_it_and_not_where_the_table_has_it(unions):
    for row, (value, sd100) in ERRATA_UNION.items():
        found = unions[f"{row}/position_armse_m"]
        error = sd100 * math.sqrt(100 / UNION_RUNS + 100 / REFERENCE_RUNS)
        assert abs(found.value - value) <= 3 * error + 0.05, (row, found)  # 22.4 is given to .1
        assert found.value > unions["kf-arithmetic_average/position_armse_m"].value
    verdicts = {f["name"]: f["verdict"] for f in judged_figures(SCENARIO, unions)}
    assert verdicts["kf-covariance_union/position_armse_m"] == "contradicts"


def test_eq_8_as_printed_happens_to_be_the_bound_here(unions):
    """One side always covers the other: the printed rows are not those of another way to order covariances."""
    for quantity in ("position_armse_m", "position_claimed_m"):
        bound, printed = (unions[f"kf-covariance_union{v}/{quantity}"].value for v in ("", "@max_trace"))
        assert printed == pytest.approx(bound, rel=1e-6)


def test_weight_on_sensor_1(measured):
    """ERRATA: .5745 on the average; covariance intersection by the trace always 1."""
    average = measured["kf-arithmetic_average/sensor_1_weight_1"]
    assert average.value == pytest.approx(0.5745, abs=5e-4)
    assert measured["kf-covariance_intersection/sensor_1_weight_1"].value == 1.0
    assert 0.0 < measured["kf-arithmetic_average/sensor_1_weight_sd_1"].value < 0.02


def test_filters_claim_what_the_riccati_equation_says():
    transition, noise = TRACKING.motion.matrices(TRACKING.dt_s)
    one = TRACKING.sensors["sensor_1"]
    predicted = solve_discrete_are(transition.T, one.matrix.T, noise, one.noise)
    gain = predicted @ one.matrix.T @ np.linalg.inv(one.matrix @ predicted @ one.matrix.T + one.noise)
    wanted = np.trace((predicted - gain @ one.matrix @ predicted)[:2, :2])
    found = sampled({"kf-alone": KALMAN_ROWS["kf-alone"]}, range(2), 0)["kf-alone/claimed_position_m2"]
    np.testing.assert_allclose(found[:, -1], wanted, rtol=1e-9)


def test_credibility(measured, unions):
    """Filters without fusion are credible; naive fusion is not, by far; the others claim too much, union most."""
    for row in ("kf-alone", "kf-ic"):
        found = measured[f"{row}/position_credibility_1"]
        assert 0.0 < found.value - 1.0 < 0.03  # the truth starts at the very mean: the first steps claim too much
    assert measured["kf-naive/position_credibility_1"].value < 0.1
    uniform = measured["kf-covariance_intersection@uniform/position_credibility_1"].value
    average = measured["kf-arithmetic_average/position_credibility_1"].value
    assert 1.5 < uniform < average < unions["kf-covariance_union@optimal_mean/position_credibility_1"].value
    assert unions["kf-covariance_union/position_credibility_1"].value > 1.5 * average


def test_claims_come_out_as_the_errata_have_it(measured, unions):
    judged = {c["claim"]: c["verdict"] for m in (unions, measured) for c in judged_claims(SCENARIO, m)}
    assert len(judged) == 19  # the particle filter's are not measured here
    # What is within 6 % by .02 and velocities that differ by 1 %: a thousand runs tell, a hundred would not.
    assert not [claim for claim, verdict in judged.items() if verdict == "undecided"]
    wrong = {claim for claim, verdict in judged.items() if verdict == "contradicts"}
    assert wrong == {
        "KF: average and intersection are similar (within 6 %)",
        "KF: the intersection is close to IC (within 6 %)",
        "KF with covariance union about the arithmetic average is worse than every row but naive fusion",
    }


def test_runs_do_not_depend_on_how_they_are_cut_into_batches():
    whole = sampled(KALMAN, range(6), 3)
    for part in ([0, 1], [2], [3, 4, 5]):
        alone = sampled(KALMAN, part, 3)
        for name, values in alone.items():
            np.testing.assert_allclose(values, whole[name][part], rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("choice", RULE_CHOICES, ids=lambda choice: choice.name)
def test_the_study_equals_filters_and_rule_looped_over_one_run(choice):
    run, seed = 4, 5
    truth = TRACKING.truth(seed, run)
    drawn = TRACKING.measurements(truth, seed, run)
    name = f"kf-{choice.name}"
    found = sampled({name: KALMAN_ROWS[name]}, [7, run], seed)
    np.testing.assert_array_equal(found[TRUTH][1], truth[:, :2])
    mean, cov = TRACKING.initial_mean, TRACKING.initial_cov
    transition, noise = TRACKING.motion.matrices(TRACKING.dt_s)
    for k in range(TRACKING.steps):
        mean, cov = predict(mean, cov, transition, noise)
        local = [update(mean, cov, drawn[name][k], s.matrix, s.noise)[:2] for name, s in TRACKING.sensors.items()]
        tracks = SourceTracks(np.stack([m for m, _ in local]), np.stack([c for _, c in local]))
        fused = RULES[choice.key].fuse(tracks, choice.params)
        mean, cov = fused.mean, fused.cov
        errors = [found[f"{name}/{q}"][1, k] for q in ("position_error_m", "velocity_error_mps")]
        np.testing.assert_allclose(np.concatenate(errors), mean - truth[k + 1], rtol=1e-7, atol=1e-6)
        assert found[f"{name}/claimed_position_m2"][1, k] == pytest.approx(cov[0, 0] + cov[1, 1], rel=1e-8)
        if f"{name}/sensor_1_weight_1" in found:
            assert found[f"{name}/sensor_1_weight_1"][1, k] == pytest.approx(fused.weights[0], abs=1e-7)


def test_progress_goes_to_the_end():
    seen = []
    SCENARIO.measure(2, 0, seen.append, "sir-")
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)


def test_truth_starts_at_the_initial_mean_and_moves_by_the_model():
    truth = TRACKING.truths(1, range(300))
    np.testing.assert_array_equal(truth[:, 0], np.tile(TRACKING.initial_mean, (300, 1)))
    transition, noise = TRACKING.motion.matrices(1.0)
    steps = (truth[:, 1:] - truth[:, :-1] @ transition.T).reshape(-1, 4)
    np.testing.assert_allclose(steps.T @ steps / len(steps), noise, rtol=0.05, atol=0.05)
    drawn = np.stack([TRACKING.measurements(truth[r], 1, r)["sensor_2"] for r in range(300)])
    assert (drawn - truth[:, 1:, :2]).std() == pytest.approx(40.0, rel=0.02)


def test_charts_show_every_quantity_of_every_filter():
    outcomes = sampled({n: r for n, r in KALMAN.items() if n != "kf-naive"}, range(3), 1)
    charts = STUDY.charts(outcomes)
    assert [c.title.partition(":")[2].strip() for c in charts[:3]] == [
        "course of one trial", "position RMSE", "velocity RMSE",
    ]  # fmt: skip
    assert len(charts) == 5
    assert all(len(c.series) <= 8 for c in charts)
    course = {s.label: s for s in charts[0].series}
    assert set(course) == {"truth", "alone", "ic", "arithmetic_average", "covariance_intersection", "covariance_union"}
    np.testing.assert_array_equal([course["truth"].x, course["truth"].y], outcomes[TRUTH][0].T)
    position = {s.label: s.y for s in charts[1].series}
    wanted = np.sqrt((outcomes["kf-ic/position_error_m"] ** 2).sum(-1).mean(0))
    np.testing.assert_allclose(position["ic"], wanted, rtol=1e-12)
    assert charts[3].log_y
    (weight,) = charts[4].series
    kept = outcomes["kf-arithmetic_average/sensor_1_weight_1"]
    np.testing.assert_allclose([weight.y, weight.error], [kept.mean(0), kept.std(0)])


# ---- rules that the user names ---------------------------------------------------------------------------------------


def test_compared_rules_are_the_rows_of_the_table():
    found = SCENARIO.compare(RULE_CHOICES[:2], range(4), 3, lambda share: None)
    rows = sampled({n: KALMAN[n] for n in ("kf-naive", "kf-arithmetic_average")}, range(4), 3)
    assert list(found)[:2] == ["kf-naive/position_rmse_m", "kf-naive/velocity_rmse_mps"]
    for rule in ("naive", "arithmetic_average"):
        squares = (rows[f"kf-{rule}/position_error_m"] ** 2).sum(-1)
        np.testing.assert_allclose(found[f"kf-{rule}/position_rmse_m"], np.sqrt(squares.mean(1)), rtol=1e-12)


@pytest.mark.parametrize("key", RULES)
def test_any_rule_that_needs_tracks_only_is_compared(key):
    rule = RULES[key]
    choice = RuleChoice(key, rule.params())
    if rule.needed(choice.params):
        with pytest.raises(ParameterError, match=f"Got '{key}', which needs '{rule.needed(choice.params)[0]}'"):
            SCENARIO.compare([choice], range(2), 0, lambda share: None)
        return
    both = SCENARIO.compare([choice], [5, 1], 0, lambda share: None)
    alone = SCENARIO.compare([choice], [1], 0, lambda share: None)
    assert list(both) == [f"kf-{key}/{q}" for q in ("position_rmse_m", "velocity_rmse_mps", "consistency_position_1")]
    for name, values in both.items():
        if "rmse" in name:
            assert 5.0 < values.min() < values.max() < 100.0
        assert values[1] == pytest.approx(alone[name][0], rel=1e-9)
