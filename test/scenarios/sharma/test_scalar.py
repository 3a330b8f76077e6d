"""Sharma 6.1: weights of scalars, against the closed form of (77) in ERRATA.md and a loop of one run."""

import numpy as np
import pytest

from track_fusion.params import ParameterError
from track_fusion.random_streams import stream
from track_fusion.scenarios.sharma import scalar as sharma_scalar
from track_fusion.scenarios.sharma.scalar import RULE_CHOICES, SCENARIO, SETTINGS, STEPS, figures, simulate
from track_fusion.study.judgement import judged_claims
from track_fusion.study.rule_choice import RuleChoice

RUNS = 200


@pytest.fixture(scope="module")
def outcomes():
    return simulate(range(RUNS), 1, lambda share: None)


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda s: s.name)
def test_one_run_looped_by_the_closed_form(outcomes, setting):
    """omega = clip(1/2 + (P2 - P1) / (2 d^2), 0, 1); then (31)."""
    run = 17
    normals = stream(1, run, "noise").standard_normal((STEPS + 1, 2))
    truth, estimate, claimed = 0.0, None, 1.0
    for k, (first, second) in enumerate(normals):
        truth += np.sqrt(setting.ratio) * first
        z = truth + setting.correlation * first + np.sqrt(1 - setting.correlation**2) * second
        if estimate is None:
            estimate = z
            continue
        prior, claimed = estimate, claimed + setting.ratio
        d2 = (prior - z) ** 2
        omega = np.clip(0.5 + (1.0 - claimed) / (2.0 * d2), 0.0, 1.0)
        spread = (1.0 - omega) * claimed + omega + omega * (1.0 - omega) * d2
        fused = 1.0 / (1.0 / claimed + 1.0 - 1.0 / spread)
        estimate = fused * (prior / claimed + z - ((1.0 - omega) * prior + omega * z) / spread)
        claimed = fused
        row = f"kf-harmonic_mean@{setting.name}"
        assert outcomes[f"{row}/weight"][run, k - 1] == pytest.approx(omega, abs=1e-6)
        square = (estimate - truth) ** 2
        assert outcomes[f"{row}/square"][run, k - 1] == pytest.approx(square, rel=1e-5, abs=1e-9)
        assert outcomes[f"{row}/nees"][run, k - 1] == pytest.approx(square / claimed, rel=1e-5, abs=1e-9)


def test_the_measurement_alone_has_variance_one(outcomes):
    for setting in SETTINGS:
        assert outcomes[f"kf-alone@{setting.name}/square"].mean() == pytest.approx(1.0, abs=0.05)


def test_weights_of_figure_3(outcomes):
    found = figures(outcomes)
    for setting in SETTINGS:
        assert found[f"kf-covariance_intersection@{setting.name}/weight_1"].value == 0.0
        assert found[f"kf-inverse_covariance_intersection@{setting.name}/weight_1"].value == 1.0
    assert found["kf-harmonic_mean@q1_rho0_5/weight_1"].value == pytest.approx(0.20, abs=0.01)


def test_consistency_of_the_errata(outcomes):
    """Scalar NEES 1.09 with (77) at variance ratio 10 and rho .9; 1.16 at omega .5 and rho .99."""
    found = figures(outcomes)
    for row, wanted in (("ratio10_rho0_9", 1.09), ("half_ratio10_rho0_99", 1.16)):
        nees = found[f"given-harmonic_mean@{row}/nees_1"]
        assert abs(nees.value - wanted) < 3 * nees.standard_error + 0.005
        assert nees.standard_error < 0.015


def test_claims(outcomes):
    found = [c["verdict"] for c in judged_claims(SCENARIO, figures(outcomes))]
    assert found == ["agrees"] * 5 + ["contradicts"] * 4


def test_pieces_equal_the_whole_and_only_chooses_rows(outcomes):
    for only in ("kf-harmonic_mean@q1", "given-"):
        part = simulate([3, 40], 1, lambda share: None, only)
        assert part
        for name, values in part.items():
            assert name.startswith(only)
            np.testing.assert_allclose(values, outcomes[name][[3, 40]], rtol=1e-9, err_msg=name)
        assert set(figures(part)) == {n for n in figures(outcomes) if n.startswith(only)}
        assert SCENARIO.charts(part)


def test_charts_show_the_weights_over_the_steps(outcomes):
    *weights, bars = SCENARIO.charts(outcomes)
    assert [len(c.series) for c in weights] == [5, 5, 5]
    for chart in weights:
        lines = {s.label: s.y for s in chart.series}
        assert (lines["Covariance intersection"] == 0.0).all()
        assert (lines["Inverse covariance intersection"] == 1.0).all()
        assert all(len(s.x) == STEPS for s in chart.series)
    assert len(bars.ticks) == len(bars.series[0].x) == len(SETTINGS) + 2


def test_compare_takes_any_rule_and_refuses_what_needs_more(outcomes):
    choices = (RuleChoice.of("naive"), RULE_CHOICES[-1])
    found = SCENARIO.compare(choices, range(RUNS), 1, lambda share: None)
    assert len(found) == 2 * 2 * len(SETTINGS)  # errors and their consistency
    consistency = found["kf-harmonic_mean/consistency_q1_rho0_1"]
    np.testing.assert_allclose(consistency, outcomes["kf-harmonic_mean@q1_rho0/nees"].mean(1))
    name = SETTINGS[4].name
    np.testing.assert_allclose(
        found[f"kf-harmonic_mean/rmse_{name}_1"] ** 2, outcomes[f"kf-harmonic_mean@{name}/square"].mean(1)
    )
    # Independent noises: the prior and the measurement are independent, naive fusion is the Kalman filter.
    steady = SETTINGS[4].ratio * (np.sqrt(1.25) - 0.5)  # P of a random walk with q = r = 1
    assert (found[f"kf-naive/rmse_{name}_1"] ** 2).mean() == pytest.approx(steady, rel=0.05)
    with pytest.raises(ParameterError, match="Got 'mixture_exact', which needs 'common' beside"):
        SCENARIO.compare([RuleChoice.of("mixture_exact")], [0], 0, lambda share: None)


def test_compare_draws_for_each_run_by_itself(monkeypatch):
    """A rule that samples: runs in a piece of their own give what they give among others."""
    monkeypatch.setattr(sharma_scalar, "SETTINGS", SETTINGS[:1])
    choice = RuleChoice.of("harmonic_mean", method="sampling", samples=10)
    whole = SCENARIO.compare([choice], [2, 3], 4, lambda share: None)
    part = SCENARIO.compare([choice], [3], 4, lambda share: None)
    for name, values in part.items():
        np.testing.assert_allclose(values, whole[name][1:], rtol=1e-9)
