"""Every parameter file of a scenario over real processes: each step and each figure of a run is the library's.

The fused posterior goes back to the trackers, which start the next step from it: from the second step on every number
depends on the feedback.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes.scenario_runs import RADAR_STEPS, RADARS, RUN, SEED, Case, run
from nodes.support import read, stamp_ns
from numpy.typing import NDArray

from track_fusion.demo.wiring import Bringup, bringups
from track_fusion.rules import RULES, get_rule
from track_fusion.scenarios import get_scenario
from track_fusion.scenarios.chen2022.dynamic import fusions
from track_fusion.scenarios.li2022 import linear as li2022_linear
from track_fusion.scenarios.li2022 import nonlinear as li2022_nonlinear
from track_fusion.scenarios.sharma import radar_runs as sharma_radar_runs
from track_fusion.study.one_target import Row, alone_row, drawn, fused_row, sir_filters
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.tracks import TrackBatch

TOLERANCE = 1e-9


def choice(name: str, rule: str) -> RuleChoice:
    return next(c for c in get_scenario(name).rules if c.name == rule)


def li2022() -> Iterator[Case]:
    linear, nonlinear, ckf = li2022_linear.TRACKING, li2022_nonlinear.TRACKING, li2022_nonlinear.CKF
    average, uniform = "arithmetic_average", {"covariance_intersection.criterion": "uniform"}
    sampled = RuleChoice("geometric_mean_sampling", RULES["geometric_mean_sampling"].params())
    yield Case("li2022-linear", sampled.key, "", fused_row(linear, li2022_linear.KF, sampled))
    joined = fused_row(linear, sir_filters(li2022_linear.SIR), choice("li2022-linear", average), join=True)
    yield Case("li2022-linear-sir", average, "sir-arithmetic_average", joined)
    for rule in ("naive", average):
        row = fused_row(nonlinear, ckf, choice("li2022-nonlinear", rule))
        yield Case("li2022-nonlinear", rule, f"ckf-{rule}", row)
    ci = choice("li2022-nonlinear", "covariance_intersection@uniform")
    yield Case("li2022-nonlinear", ci.key, f"ckf-{ci.name}", fused_row(nonlinear, ckf, ci), uniform)
    yield Case("li2022-nonlinear", None, "ckf-alone", alone_row(nonlinear, ckf, 1))
    sir = sir_filters(li2022_nonlinear.SIR)
    joined = fused_row(nonlinear, sir, choice("li2022-nonlinear", average), join=True)
    yield Case("li2022-nonlinear-sir", average, "sir-arithmetic_average", joined)
    yield Case("li2022-nonlinear-sir", ci.key, f"sir-{ci.name}", fused_row(nonlinear, sir, ci), uniform)
    yield Case("li2022-nonlinear-sir", None, "sir-alone", alone_row(nonlinear, sir, 1))


def chen2022() -> Iterator[Case]:
    """Any rule of each kind: elliptical, Gaussian, Gaussian with a parameter of its own."""
    chosen = {"chen2022-dynamic-1": ("mhdp_iterative", "covariance_intersection@uniform"),
              "chen2022-dynamic-2": ("mhdp_explicit", "geodesic_projection")}  # fmt: skip
    for name, rules in chosen.items():
        base = get_scenario(name).tracking
        assert base is not None
        for rule in rules:
            one = choice(name, rule)
            row = Row(lambda draws, base=base, one=one: fusions(base, "stf", one, draws.seed, draws.runs))  # type: ignore[misc]
            parameters = {"covariance_intersection.criterion": "uniform"} if one.variant else {}
            yield Case(name, one.key, f"stf-{one.name}", row, parameters)


CASES = [*li2022(), *chen2022()]
#: One of each family of densities; the others are slow by their number.
QUICK = {"li2022-nonlinear:arithmetic_average", "li2022-nonlinear-sir:alone", "chen2022-dynamic-1:mhdp_iterative"}


def test_every_parameter_file_is_run() -> None:
    tested_elsewhere = {"li2022-linear"}  # test_lockstep.py
    assert {c.name for c in CASES} | tested_elsewhere | {RADARS} == set(bringups())


@pytest.mark.parametrize(
    "case", [c if str(c) in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in CASES], ids=str
)
def test_the_nodes_give_the_numbers_of_the_library(
    case: Case, ros_context: Any, ros_domain: int, tmp_path: Path
) -> None:
    messages, judged = run(case, ros_context, ros_domain, tmp_path)
    scenario = get_scenario(Bringup(case.name).scenario)
    tracking = scenario.tracking
    assert tracking is not None
    step_ns, layout = round(tracking.dt_s * 1e9), tracking.layout
    assert [stamp_ns(m) for m in messages] == [k * step_ns for k in range(1, tracking.steps + 1)]
    draws = drawn(tracking, [RUN], SEED)
    expected = np.array([fused.mean[0] for fused in case.library.estimates(draws)])
    estimated = np.array([TrackBatch(layout=layout, **read(m).columns).moments[0][0] for m in messages])
    scale = np.abs(expected).max(0)
    np.testing.assert_allclose(estimated / scale, expected / scale, rtol=0, atol=TOLERANCE)
    assert (judged["times"], judged["missed"], judged["false"]) == (tracking.steps, 0, 0)
    compare_figures(case, judged["all"], estimated - draws.truth[0, 1:])


def compare_figures(case: Case, judged: dict[str, Any], error: NDArray[np.float64]) -> None:
    """Compare what the evaluator says with the figures of the scenario's own row, of this run alone."""
    scenario = get_scenario(Bringup(case.name).scenario)
    assert scenario.tracking is not None
    position = list(scenario.tracking.motion.layout.position)
    norm = np.linalg.norm(error[:, position], axis=1).mean()
    assert judged["position_armse_m"] == pytest.approx(norm, rel=TOLERANCE)
    if not case.row:
        assert get_rule(case.rule or "").optional == ("seed",)
        return
    outcomes = scenario.simulate([RUN], SEED, lambda share: None, case.row)
    own = {name.rpartition("/")[2]: e.value for name, e in scenario.figures(outcomes).items()
           if name.startswith(f"{case.row}/") and "_armse_" in name}  # fmt: skip
    assert own
    for quantity, value in own.items():
        assert judged[quantity] == pytest.approx(value, rel=TOLERANCE), quantity


@pytest.mark.slow
def test_radars_in_clutter_give_the_tracks_of_the_library(ros_context: Any, ros_domain: int, tmp_path: Path) -> None:
    """Every fusion depends on the one before: the centre fuses its own prediction, too."""
    pytest.importorskip("pymap3d")
    rule = "harmonic_mean"
    case = Case(RADARS, rule, "", Row(lambda draws: iter(())), steps=RADAR_STEPS)
    messages, judged = run(case, ros_context, ros_domain, tmp_path)
    own = sharma_radar_runs.centre(choice(RADARS, rule))
    fusions = sharma_radar_runs.local_tracks(SEED, RUN, lambda share: None)
    expected = [own.step(*fusion) for fusion in itertools.islice(fusions, len(messages))]
    assert len(messages) == RADAR_STEPS // sharma_radar_runs.FUSION_SCANS
    assert [stamp_ns(m) for m in messages] == [
        round(t * 1e9) for t in sharma_radar_runs.FUSION_TIMES_S[: len(messages)]
    ]
    assert len(expected[-1][0]) > 10
    for msg, (tracks, _) in zip(messages, expected, strict=True):
        table = read(msg)
        for field in ("track_id", "source", "status"):
            np.testing.assert_array_equal(getattr(table, field), getattr(tracks, field))
        for field in ("mean", "cov", "existence"):
            want = getattr(tracks, field)
            np.testing.assert_allclose(
                getattr(table, field), want, rtol=0, atol=TOLERANCE * np.abs(want).max(initial=1.0)
            )
    truth = sharma_radar_runs.scene().states(SEED, RUN)[:: sharma_radar_runs.FUSION_SCANS][1 : len(messages) + 1]
    of_step = [sharma_radar_runs.judged(tracks, states) for (tracks, _), states in zip(expected, truth, strict=True)]
    found_targets = sum(int(np.isfinite(step.nees).sum()) for step in of_step)
    assert (judged["times"], judged["all"]["samples"]) == (len(messages), found_targets)
    assert judged["missed"] == truth.shape[1] * len(messages) - found_targets
    assert judged["false"] == sum(int(step.false) for step in of_step)
    scores = np.concatenate([step.nees for step in of_step])
    assert judged["all"]["anees"] == pytest.approx(np.nanmean(scores) / 4, rel=TOLERANCE)
