"""Ahmed 5.4 against ERRATA; truth, sensors and the fusion of modes against formulas of their own; pieces."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.filters.gaussian_sum_modes import MixtureModes
from track_fusion.params import ParameterError
from track_fusion.rules import RULES
from track_fusion.scenarios.ahmed import maneuver, platforms
from track_fusion.study.judgement import judged_claims
from track_fusion.study.rule_choice import RuleChoice

STEPS = 125


@pytest.fixture(scope="module")
def outcomes():
    return maneuver.simulate(range(2), 0, lambda share: None, steps=STEPS)


@pytest.mark.slow
def test_errors_right_after_the_fusions_are_those_of_the_errata(outcomes):
    """ERRATA, Example 4: IGS median <= 30 m; log10 ratio FOCI / IGS >= .7 at platform 2; centralised <= IGS."""
    found = maneuver.figures(outcomes)
    assert found["gsf-mixture_wep/median_position_error_m"].value <= 30.0
    assert found["gsf-mixture_wep@foci/log10_error_ratio_to_igs_p2_1"].value >= 0.7
    centre, igs = (found[f"{row}/median_position_error_m"].value for row in (maneuver.CENTRE, maneuver.BY_IGS))
    assert centre <= igs
    order, *_ = judged_claims(maneuver.SCENARIO, found)
    in_order = list(order["evidence"].values())
    assert in_order == sorted(set(in_order))
    assert order["verdict"] == "undecided"  # two runs prove nothing


@pytest.mark.slow
def test_figures_are_what_they_say(outcomes):
    found = maneuver.figures(outcomes)
    error = outcomes["gsf-mixture_wep error"]
    at = [59, 119]
    by_run = [
        np.median([np.hypot(error[r, p, k, 0], error[r, p, k, 2]) for p in range(3) for k in at]) for r in range(2)
    ]
    assert found["gsf-mixture_wep/median_position_error_m"].value == pytest.approx(np.mean(by_run))
    ratio = [
        np.log10(np.hypot(*outcomes["gsf-mixture_wep@foci error"][r, 1, k, ::2]) / np.hypot(*error[r, 1, k, ::2]))
        for r in range(2)
        for k in at
    ]
    assert found["gsf-mixture_wep@foci/log10_error_ratio_to_igs_p2_1"].value == pytest.approx(np.mean(ratio))


@pytest.mark.slow
def test_until_they_talk_the_platforms_are_the_independent_ones(outcomes):
    for row in (maneuver.BY_IGS, maneuver.BY_FOCI):
        np.testing.assert_array_equal(outcomes[f"{row} error"][:, :, :59], outcomes["gsf-alone error"][:, :, :59])
        assert (outcomes[f"{row} error"][:, :, 59] != outcomes["gsf-alone error"][:, :, 59]).all()
        # What they held just before they talked for the first time is what independent ones hold.
        np.testing.assert_array_equal(outcomes[f"{row} before"][:, :, 0], outcomes["gsf-alone variance"][:, :, 59])


def test_the_truth_turns_by_the_chain_and_is_disturbed_by_its_process_noise():
    states = platforms.truths(range(40), 5, 300)
    heading = np.unwrap(np.arctan2(states[..., 3], states[..., 1]), axis=1)
    turned = np.diff(heading, axis=1)
    mode = np.abs(turned[..., None] - np.array(platforms.TURN_RATES)).argmin(-1)
    stays = (mode[:, 1:] == mode[:, :-1]).mean()
    assert stays == pytest.approx(0.85, abs=0.02)
    assert np.bincount(mode.ravel()) / mode.size == pytest.approx(0.2, abs=0.05)
    speed = np.hypot(states[..., 1], states[..., 3])
    # White acceleration of 2 m^2/s^3 on each axis: the speed takes steps of variance 2 m^2/s^2.
    assert np.diff(speed, axis=1).var() == pytest.approx(2.0, rel=0.1)


def test_platforms_see_range_and_range_rate_with_the_papers_noise():
    runs = range(3)
    states = platforms.truths(runs, 1)
    seen = platforms.measurements(states, runs, 1)
    for name, (x, y) in platforms.PLATFORMS.items():
        gap = states[:, 1:, [0, 2]] - [x, y]
        distance = np.sqrt((gap**2).sum(-1))
        rate = (gap * states[:, 1:, [1, 3]]).sum(-1) / distance
        noise = seen[name] - np.stack([distance, rate], -1)
        np.testing.assert_allclose(noise.reshape(-1, 2).var(0), [400.0, 1.0], rtol=0.12)
        assert np.abs(noise.mean((0, 1)) / [20.0, 1.0]).max() < 4 / np.sqrt(noise[..., 0].size)


def test_modes_are_fused_with_the_integral_of_each_product():
    """(74)-(76) for one Gaussian a mode, omega from (11) by SciPy, all integrals in closed form."""
    rng = np.random.default_rng(4)

    def modes(shift):
        root = rng.standard_normal((platforms.MODES, 4, 6))
        mean = shift + rng.standard_normal((platforms.MODES, 4))
        cov = root @ np.swapaxes(root, -1, -2)
        probability = rng.dirichlet(np.ones(platforms.MODES))
        return MixtureModes(probability, Mixture(np.ones((platforms.MODES, 1)), mean[:, None], cov[:, None]))

    own, heard = modes(0.0), modes(1.0)
    fused = platforms.fuse_modes(maneuver.RULE_CHOICES[0], 0)(own, heard, None, 0)
    log_eta = []
    for m in range(platforms.MODES):
        (a, p), (b, q) = ((d.mixture.mean[m, 0], d.mixture.cov[m, 0]) for d in (own, heard))

        def log_integral(w, a=a, p=p, b=b, q=q):
            i, j = w * np.linalg.inv(p), (1 - w) * np.linalg.inv(q)
            spread = np.linalg.inv(np.linalg.inv(i) + np.linalg.inv(j))
            dets = w * np.linalg.slogdet(p)[1] + (1 - w) * np.linalg.slogdet(q)[1] + np.linalg.slogdet(i + j)[1]
            return -0.5 * (dets + (a - b) @ spread @ (a - b))

        naive = np.linalg.inv(np.linalg.inv(p) + np.linalg.inv(q))
        centre = naive @ (np.linalg.solve(p, a) + np.linalg.solve(q, b))

        def expected_log(mean, cov, naive=naive, centre=centre):
            gap = centre - mean
            inside = np.trace(np.linalg.solve(cov, naive)) + gap @ np.linalg.solve(cov, gap)
            return -0.5 * (np.linalg.slogdet(cov)[1] + inside)

        kappa = expected_log(b, q) - expected_log(a, p)

        def objective(w, kappa=kappa, log_integral=log_integral):
            return w * kappa + log_integral(w)

        w = minimize_scalar(objective, bounds=(1e-9, 1 - 1e-9), method="bounded", options={"xatol": 1e-12}).x
        log_eta.append(log_integral(w))
        info = w * np.linalg.inv(p) + (1 - w) * np.linalg.inv(q)
        np.testing.assert_allclose(fused.mixture.cov[m, 0], np.linalg.inv(info), rtol=1e-3)
    expected = own.probability * np.exp(log_eta)
    np.testing.assert_allclose(fused.probability, expected / expected.sum(), rtol=1e-4)


def test_pieces_equal_the_whole_and_progress_goes_up(monkeypatch):
    for module in (maneuver, platforms):  # two fusions in a few steps
        monkeypatch.setattr(module, "SCHEDULE", dataclasses.replace(platforms.SCHEDULE, period=5))
    shares = []
    whole = maneuver.simulate([3, 8], 2, shares.append, "gsf-mixture_wep", steps=11)
    assert whole["gsf-mixture_wep before"].shape == (2, 3, 2, 4)
    for row in (maneuver.BY_IGS, maneuver.BY_FOCI):
        assert (whole[f"{row} before"] != whole[f"{row} variance"][:, :, 4::5]).all()
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    part = maneuver.simulate([8], 2, lambda share: None, "gsf-mixture_wep", steps=11)
    for name, values in part.items():
        np.testing.assert_allclose(values[0], whole[name][1], rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_charts_and_figures_cope_with_parts(outcomes):
    assert len(maneuver.charts(outcomes)) == 1 + 4 + 2
    centre = {name: values for name, values in outcomes.items() if name.startswith(("truth", maneuver.CENTRE))}
    assert set(maneuver.figures(centre)) == {f"gsf-ic/{q}" for q in (
        "median_position_error_m", "median_velocity_error_mps", "median_position_error_all_steps_m",
        "median_velocity_error_all_steps_mps", "share_inside_2_sigma_1")}  # fmt: skip
    assert len(maneuver.charts(centre)) == 7
    foci = {name: values for name, values in outcomes.items() if name.startswith(("truth", maneuver.BY_FOCI))}
    assert f"{maneuver.BY_FOCI}/share_of_fusions_that_shrink_2_sigma_1" in maneuver.figures(foci)
    one = maneuver.figures({name: values[:1] for name, values in outcomes.items()})
    assert all(np.isfinite(estimate.value) for estimate in one.values())


def test_compare_takes_any_rule_for_two_tracks(monkeypatch):
    monkeypatch.setattr(maneuver, "STEPS", 60)
    rules = [RuleChoice(key, RULES[key].params()) for key in ("covariance_intersection", "naive")]
    found = maneuver.SCENARIO.compare(rules, [0], 0, lambda share: None)
    assert {name: values.shape for name, values in found.items()} == {
        "gsf-covariance_intersection/median_position_error_m": (1,),
        "gsf-naive/median_position_error_m": (1,),
    }
    with pytest.raises(ParameterError, match="Got 'mixture_exact', which needs 'common' beside the tracks"):
        maneuver.SCENARIO.compare(
            [RuleChoice("mixture_exact", RULES["mixture_exact"].params())], [0], 0, lambda share: None
        )
