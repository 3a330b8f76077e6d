"""Chen 2022 against the values of ERRATA.md, the filters' recursions written in scatters, and the draws' laws."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from track_fusion.filters.gaussian_student_t_mixture import GaussianStudentTMixture, MixtureNoiseParams
from track_fusion.linalg import Array
from track_fusion.models.noise import Noise
from track_fusion.params import ParameterError
from track_fusion.random_streams import stream
from track_fusion.rules import RULES, SourceTracks
from track_fusion.scenarios import SCENARIOS
from track_fusion.scenarios.chen2022 import dynamic, static
from track_fusion.scenarios.chen2022 import dynamic_1 as case_1
from track_fusion.scenarios.chen2022 import dynamic_2 as case_2
from track_fusion.scenarios.chen2022.dynamic import DCI, FCI, GP, KLA, MHDP_E, MHDP_I, QMMHD
from track_fusion.study.judgement import judged_claims
from track_fusion.study.rows import Outcomes
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scene import Tracking

CASES = {"I": case_1.TRACKING, "II": case_2.TRACKING}
#: The first steps, for comparisons of mechanics.
SHORT = {case: dataclasses.replace(tracking, steps=8) for case, tracking in CASES.items()}
#: A rule that needs more than the tracks.
SPLIT = RuleChoice.of("split_covariance_intersection")


def silent(share: float) -> None:
    pass


# ---- 5.1 ------------------------------------------------------------------------------------------------------------

#: ERRATA: Rao distances to the informative barycenter of MHDP with squared distances, and of FCI.
ERRATA_STATIC = {
    "t3": (0.0303, 0.0536),
    "t5": (0.0319, 0.0540),
    "t7": (0.0328, 0.0545),
    "gg065": (0.0236, 0.0321),
    "gg085": (0.0312, 0.0468),
    "gg1": (0.0363, 0.0573),
}


@pytest.mark.parametrize("name", ERRATA_STATIC)
def test_static_distances_are_those_of_the_errata(name: str) -> None:
    measured = static.SCENARIO.measure(1, 0)
    mhdp, fci = ERRATA_STATIC[name]
    for key in ("mhdp_explicit", "mhdp_iterative"):
        assert measured[f"given-{key}@{name}/rao_distance_1"].value == pytest.approx(mhdp, abs=1e-4)
    assert measured[f"given-fast_covariance_intersection@{name}/rao_distance_1"].value == pytest.approx(fci, abs=1e-4)
    assert static.SETTINGS[name].barycenter[0] == pytest.approx(2.91608, abs=5e-6)


@pytest.mark.parametrize("name", static.SETTINGS)
def test_unsquared_distances_give_one_sensors_estimate(name: str) -> None:
    """ERRATA: with the algorithm as printed the static example collapses onto one sensor."""
    fused = static.SETTINGS[name].fuse(static.UNSQUARED)
    assert fused[0] in static.MEANS


def test_static_claims() -> None:
    found = {c["claim"]: c["verdict"] for c in judged_claims(static.SCENARIO, static.SCENARIO.measure(1, 0))}
    printed = [verdict for claim, verdict in found.items() if "as printed" in claim]
    others = [verdict for claim, verdict in found.items() if "as printed" not in claim]
    assert printed == ["contradicts"] * 2
    assert others == ["agrees"] * 4


def test_every_intersection_lies_on_the_chord() -> None:
    """5.1: rules of the form (45) put the fused density on the segment between the two estimates."""
    for setting in static.SETTINGS.values():
        for choice in static.OTHERS:
            mean, scatter = setting.fuse(choice)
            assert scatter == pytest.approx(5.0 + (mean - 2.0), rel=1e-9)


def test_distance_to_the_geodesic_is_that_of_a_fine_grid() -> None:
    setting, fused = static.SETTINGS["t5"], np.array([3.1, 7.5])
    on_it = setting.geodesic(np.linspace(0.0, 1.0, 20_001))
    nearest = min(
        float(static.rao_distance_scalar(setting.family, np.asarray(m), np.asarray(s), *np.asarray(fused)))
        for m, s in zip(*on_it, strict=True)
    )
    assert setting.from_geodesic(fused) == pytest.approx(nearest, rel=1e-6)


def test_static_comparison_takes_any_rule_that_needs_only_tracks() -> None:
    choices = [RuleChoice(k, RULES[k].params()) for k in ("mhdp_explicit", "covariance_union", "mixture_average")]
    found = static.SCENARIO.compare(choices, range(3), 0, silent)
    assert len(found) == 18
    assert all(values.shape == (3,) and (values >= 0).all() for values in found.values())
    np.testing.assert_allclose(found["given-mhdp_explicit/rao_distance_gg065_1"], 0.0236, atol=1e-4)
    with pytest.raises(ParameterError, match="split_covariance_intersection"):
        static.SCENARIO.compare([RuleChoice.of("split_covariance_intersection")], [0], 0, silent)


# ---- 5.2: draws -----------------------------------------------------------------------------------------------------


def test_noise_is_the_mixture_of_the_paper() -> None:
    draws = Noise(0.5, 0.1, 200.0).draw(3, 0, "a", 200_000, 1)[:, 0]
    for limit in (0.5, 2.0, 10.0):
        share = 0.9 * stats.norm.sf(limit, scale=math.sqrt(0.5)) + 0.1 * stats.norm.sf(limit, scale=10.0)
        assert (np.abs(draws) > limit).mean() == pytest.approx(2 * share, abs=4 * math.sqrt(2 * share / 200_000))
    axes = Noise(1.0, 0.1, 1e8).draw(3, 0, "a", 500, 3)
    hit = np.abs(axes) > 50.0
    assert (hit.sum(1) % 3 == 0).mean() > 0.99  # all axes of a draw together


def test_noise_is_drawn_step_by_step_and_by_role() -> None:
    noise = Noise(1.0 / 3.0, 0.1, 200.0)
    long = noise.draw(1, 2, "sensor_1", 50, 2)
    np.testing.assert_array_equal(noise.draw(1, 2, "sensor_1", 20, 2), long[:20])
    for other in (noise.draw(1, 2, "sensor_2", 50, 2), noise.draw(1, 3, "sensor_1", 50, 2)):
        assert not np.isclose(other, long).any()
    # By itself what the filters are told: as before there was any other.
    np.testing.assert_array_equal(Noise().draw(1, 2, "a", 5, 2), stream(1, 2, "a").standard_normal((5, 2)))


@pytest.mark.parametrize("case", CASES)
def test_truth_and_measurements_have_the_papers_moments(case: str) -> None:
    """(66)-(74) with nominal values: x0 from N(x(0|0), P(0|0)); variances grow by .9 + .1 * 200, or 100."""
    tracking, runs = CASES[case], range(400)
    truth = tracking.truths(5, runs)
    for values, mean, variance in zip(truth[:, 0].T, (0.0, 5.0), (10.0, 25.0), strict=True):
        assert values.mean() == pytest.approx(mean, abs=4 * math.sqrt(variance / 400))
        assert values.var() == pytest.approx(variance, rel=0.3)
    push = truth[:, 1:, 1] - truth[:, :-1, 1]  # T w
    np.testing.assert_allclose(truth[:, 1:, 0] - truth[:, :-1, 0] - truth[:, :-1, 1], 0.5 * push, atol=1e-9)
    assert push.var() == pytest.approx(0.9 + 20.0, rel=0.05)
    for name, growth in (("stf", 20.9), ("gstm", 10.9)):
        met = dynamic.for_filter(tracking, name)
        seen = [met.measurements(states, 5, run) for states, run in zip(truth, runs, strict=True)]
        for key, axes, noise in (("sensor_1", [0], [[16]]), ("sensor_2", [1], [[16]]), ("sensor_3", [0, 1], R_3)):
            if key in tracking.sensors:
                error = np.concatenate([z[key] - states[1:, axes] for z, states in zip(seen, truth, strict=True)])
                np.testing.assert_allclose(error.T @ error / len(error), growth * np.array(noise), rtol=0.1)


R_3 = [[16, 4], [4, 6]]


def test_a_run_is_drawn_alone_as_among_others() -> None:
    tracking = CASES["II"]
    np.testing.assert_array_equal(tracking.truth(4, 7), tracking.truths(4, [2, 7])[1])
    np.testing.assert_array_equal(tracking.truth(4, 7, 30), tracking.truth(4, 7)[:31])
    short, long = (tracking.measurements(tracking.truth(4, 7, steps), 4, 7) for steps in (30, 100))
    for name, values in short.items():
        np.testing.assert_array_equal(values, long[name][:30])


# ---- 5.2: mechanics -------------------------------------------------------------------------------------------------


def scatters_fused(tracking: Tracking, choice: RuleChoice, seed: int, run: int) -> Array:
    """The Student-t recursion in the paper's terms, (T, 2): scatters, whose dof 4 or 5 is set back to 3."""
    f, gain = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    nominal = {"sensor_1": ([[1.0, 0.0]], [[16.0]]), "sensor_2": ([[0.0, 1.0]], [[16.0]]), "sensor_3": (np.eye(2), R_3)}
    seen = tracking.measurements(tracking.truth(seed, run), seed, run)
    x, scatter, found = np.array([0.0, 5.0]), np.diag([10.0, 25.0]), []
    for k in range(tracking.steps):
        x, scatter = f @ x, f @ scatter @ f.T + gain @ gain.T
        means, scatters = [], []
        for name, z in seen.items():
            h, r = (np.array(v, float) for v in nominal[name])
            innovation, spread = z[k] - h @ x, h @ scatter @ h.T + r
            inverse = np.linalg.inv(spread)
            k_gain, m = scatter @ h.T @ inverse, len(innovation)
            square = innovation @ inverse @ innovation
            posterior = (3 + square) / (3 + m) * (scatter - k_gain @ h @ scatter)
            new_dof = 3 + m
            means.append(x + k_gain @ innovation)
            scatters.append((3 - 2) * new_dof / (3 * (new_dof - 2)) * posterior)
        tracks = SourceTracks(np.array(means), 3.0 * np.array(scatters), np.full(len(means), 3.0))
        fused = RULES[choice.key](tracks, choice.params)
        x, scatter = fused.mean, fused.cov / 3.0
        found.append(x)
    return np.array(found)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("choice", dynamic.RULE_CHOICES, ids=lambda choice: choice.name)
def test_student_rows_equal_the_papers_recursion_in_scatters(case: str, choice: RuleChoice) -> None:
    fused = [f.mean[1] for f in dynamic.fusions(SHORT[case], "stf", choice, 6, [3, 8])]
    np.testing.assert_allclose(fused, scatters_fused(SHORT[case], choice, 6, 8), rtol=1e-6, atol=1e-6)


def test_mixture_filter_without_outliers_is_the_kalman_filter() -> None:
    """With the prior count of Student-t noises at nothing its posterior scatter is Kalman's of nominal Q, R and P."""
    trusting = GaussianStudentTMixture(MixtureNoiseParams(gaussian_count=1e9, student_count=1e-9), dynamic.DOF)
    mean, cov, sensor = np.array([[1.0, 2.0]]), np.array([[[9.0, 1.0], [1.0, 6.0]]]), dynamic.SENSOR_3
    found, found_cov = trusting.update(trusting.begin(mean, cov), np.array([[2.0, 1.0]]), sensor)[0].moments
    info = np.linalg.inv(cov[0] / 3.0) + np.linalg.inv(np.array(R_3))
    np.testing.assert_allclose(found_cov[0], 3.0 * np.linalg.inv(info), rtol=1e-6)
    wanted = np.linalg.solve(info, np.linalg.solve(cov[0] / 3.0, mean[0]) + np.linalg.solve(R_3, [2.0, 1.0]))
    np.testing.assert_allclose(found[0], wanted, rtol=1e-6)


@pytest.mark.parametrize("case", SHORT)
def test_pieces_equal_the_whole(case: str) -> None:
    table, short = dynamic.rows(dynamic.RULE_CHOICES), dataclasses.replace(CASES[case], steps=4)
    whole = dynamic.squared_errors(short, table, [0, 7, 1], 3, silent)
    for name, values in dynamic.squared_errors(short, table, [1], 3, silent).items():
        np.testing.assert_allclose(values[0], whole[name][2], rtol=1e-9, err_msg=name)
    scenario = SCENARIOS["chen2022-dynamic-1" if case == "I" else "chen2022-dynamic-2"]
    assert set(scenario.published) <= set(scenario.figures(whole))
    assert [len(chart.series) for chart in scenario.charts(whole)] == [7, 7]
    assert len(judged_claims(scenario, scenario.figures(whole))) == len(scenario.claims)


def test_only_the_rows_asked_for_are_run() -> None:
    seen: list[float] = []
    some = case_2.SCENARIO.simulate([1], 3, seen.append, "stf-covariance")
    assert list(some) == [f"stf-{DCI}", f"stf-{KLA}"]
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)
    assert [chart.series[0].label for chart in case_2.SCENARIO.charts(some)] == [KLA]


def test_comparison_is_the_root_of_the_time_averaged_square() -> None:
    choices, scenario = (dynamic.RULE_CHOICES[3], dynamic.RULE_CHOICES[5]), case_2.SCENARIO
    found = dynamic.scores(SHORT["II"], choices, [0, 4], 2, silent)
    outcomes = dynamic.squared_errors(SHORT["II"], dynamic.rows(choices), [0, 4], 2, silent)
    wanted = np.sqrt(outcomes[f"stf-{MHDP_E}"].mean(1))
    np.testing.assert_allclose(found[f"stf-{MHDP_E}/position_rmse_m"], wanted, rtol=1e-12)
    assert len(found) == 4
    with pytest.raises(ParameterError, match="split_covariance_intersection"):
        scenario.compare([SPLIT], [0], 0, silent)


# ---- 5.2: what holds ------------------------------------------------------------------------------------------------

RUNS, STEPS = 40, 60


@pytest.fixture(scope="module")
def errors() -> dict[str, Outcomes]:
    """Squared errors of the Student-t rows of Table 1 in both cases, in the first 60 of the 100 steps."""
    rows = {name: row for name, row in dynamic.rows(dynamic.RULE_CHOICES[:7]).items() if name.startswith("stf-")}
    cases = {case: dataclasses.replace(t, steps=STEPS) for case, t in CASES.items()}
    return {case: dynamic.squared_errors(t, rows, range(RUNS), 1, silent) for case, t in cases.items()}


def armses(errors: Outcomes) -> dict[str, float]:
    return {name.removeprefix("stf-"): float(np.sqrt(squares.mean(0)).mean()) for name, squares in errors.items()}


@pytest.mark.slow
def test_order_of_case_2(errors: dict[str, Outcomes]) -> None:
    """ERRATA: MHDP < QMMHD < {GP, FCI, KLA} < DCI with MHDP <= .8 KLA."""
    found = armses(errors["II"])
    assert max(found[MHDP_E], found[MHDP_I]) < found[QMMHD] < min(found[GP], found[FCI], found[KLA])
    assert max(found[GP], found[FCI], found[KLA]) < found[DCI]
    assert max(found[MHDP_E], found[MHDP_I]) <= 0.8 * found[KLA]


def test_excess_has_the_spread_of_paired_studies() -> None:
    """Errors that share most of their noise: the standard error is the spread over studies, not that of two rows."""
    rng, studies, runs = np.random.default_rng(0), 300, 100
    shared = rng.normal(size=(studies, runs, 4))
    noise = shared + 0.3 * rng.normal(size=(2, studies, runs, 4))
    found = [
        dynamic.figures({f"stf-{MHDP_E}": first**2, f"stf-{GP}": (1.2 * second) ** 2})
        for first, second in zip(*noise, strict=True)
    ]
    gaps = [figures[f"stf-{GP}/{dynamic.EXCESS}"] for figures in found]
    assert np.mean([gap.value for gap in gaps]) == pytest.approx(0.2 * math.sqrt(1.09), abs=0.01)
    spread = np.std([gap.value for gap in gaps])
    assert np.mean([gap.standard_error for gap in gaps]) == pytest.approx(spread, rel=0.15)
    assert spread < 0.6 * np.mean([figures[f"stf-{GP}/{dynamic.FIGURE}"].standard_error for figures in found])


@pytest.mark.slow
def test_claims_of_case_2_hold_with_the_student_t_filter(errors: dict[str, Outcomes]) -> None:
    """Heavy tails: 40 runs leave the lead over all five rules at once undecided, though it is there."""
    lead, *others = judged_claims(case_2.SCENARIO, dynamic.figures(errors["II"]))
    assert [claim["verdict"] for claim in others] == ["agrees"] * 2
    assert lead["verdict"] in ("agrees", "undecided")
    assert min(lead["evidence"].values()) > 0.0


def test_the_rule_behind_mhdp_is_the_one_of_the_printed_column() -> None:
    """Table 1: QMMHD in all columns but the mixture filter's of case II, where FCI has 5.36 and QMMHD 5.65."""
    next_ones = [c.needs[0] for case in (case_1, case_2) for c in case.SCENARIO.claims if "comes next" in c.text]
    figure = dynamic.FIGURE
    assert next_ones == [f"stf-{QMMHD}/{figure}", f"gstm-{QMMHD}/{figure}", f"stf-{QMMHD}/{figure}",
                         f"gstm-{FCI}/{figure}"]  # fmt: skip


@pytest.mark.slow
def test_advantage_of_mhdp_in_case_1_does_not_reproduce(errors: dict[str, Outcomes]) -> None:
    """ERRATA. In 40 runs QMMHD, said to come next, comes behind the three others."""
    lead, second, worst = judged_claims(case_1.SCENARIO, dynamic.figures(errors["I"]))
    assert "agrees" not in (lead["verdict"], second["verdict"])
    assert worst["verdict"] == "agrees"
    said, *rest = second["evidence"].values()
    assert said > max(rest)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_determinant_intersection_is_far_worse_and_the_two_mhdp_agree(errors: dict[str, Outcomes], case: str) -> None:
    """ERRATA: DCI > 2 x every other rule in both cases; |MHDP-E - MHDP-I| <= .02 m."""
    found = armses(errors[case])
    assert found.pop(DCI) > 2.0 * max(found.values())
    assert abs(found[MHDP_E] - found[MHDP_I]) <= 0.02
