"""The filters in Li 2022's scenarios: the figures of ERRATA.md, by few runs, and independence of the batch."""

import dataclasses

import numpy as np
import pytest
from filters.plain import Plain

from track_fusion.filters.cubature import Cubature
from track_fusion.rules import RULES, SourceTracks
from track_fusion.scenarios.li2022 import linear as li2022_linear
from track_fusion.scenarios.li2022 import nonlinear as li2022_nonlinear
from track_fusion.study.one_target import drawn
from track_fusion.study.rule_choice import RuleChoice

RUNS = 100
#: sd of one 100-run table, position, from 500 runs of our own times sqrt(5).
CKF = {
    "ckf-alone": ((13.75, 0.33), (3.22, 0.06), (1.71, 0.03)),
    "ckf-ic": ((11.92, 0.26), (3.01, 0.05), (1.67, 0.03)),
    "ckf-arithmetic_average": ((12.48, 0.28), (3.14, 0.06), (1.67, 0.04)),
    "ckf-naive": ((238.0, 12.0), (15.3, 0.6), (3.5, 0.2)),
}


def study(module, rows, runs, seed):
    part = dataclasses.replace(module.STUDY, rows={n: module.STUDY.rows[n] for n in rows})
    return part.figures(part.simulate(range(runs), seed, lambda share: None))


@pytest.fixture(scope="module")
def nonlinear():
    return study(li2022_nonlinear, (*CKF, "ckf-covariance_union"), RUNS, 7)


@pytest.mark.parametrize("row", CKF)
def test_cubature_rows_of_table_2(nonlinear, row):
    for quantity, (wanted, sd) in zip(li2022_nonlinear.QUANTITIES, CKF[row], strict=True):
        found = nonlinear[f"{row}/{quantity.armse}"]
        assert abs(found.value - wanted) < 3.5 * sd
        assert found.standard_error == pytest.approx(sd, rel=0.8)


def test_fusion_weight_of_sensor_1_falls_as_published(nonlinear):
    """Fig. 11: .584 falling to .541; ERRATA: .5865 and .5455."""
    row = "ckf-arithmetic_average"
    assert nonlinear[f"{row}/sensor_1_weight_first_1"].value == pytest.approx(0.5865, abs=0.004)
    assert nonlinear[f"{row}/sensor_1_weight_last_1"].value == pytest.approx(0.5455, abs=0.004)


def test_covariance_union_of_table_2_is_a_valid_bound_and_worse_than_the_average(nonlinear):
    union, average = (nonlinear[f"ckf-{r}/position_armse_m"].value for r in ("covariance_union", "arithmetic_average"))
    assert average < union < 0.9 * li2022_nonlinear.TABLE_2["ckf-covariance_union"][0]
    credibility = {row: nonlinear[f"{row}/position_credibility_1"].value for row in CKF}
    assert credibility["ckf-naive"] < 0.01 < 0.9 < credibility["ckf-alone"] < 1.15
    assert credibility["ckf-arithmetic_average"] < nonlinear["ckf-covariance_union/position_credibility_1"].value


def test_the_union_of_least_determinant_keeps_the_turn_rate_in_bounds():
    """In this run the bound of least trace, in metres and radians at once, lets it grow to 10^4 deg/s."""
    part = dataclasses.replace(li2022_nonlinear.STUDY, rows={"u": li2022_nonlinear.STUDY.rows["sir-covariance_union"]})
    errors = part.simulate([219], 0, lambda share: None)["u/turn_rate_error_degps"]
    assert np.abs(errors).max() < 15.0


def test_particle_rows_of_table_1():
    names = (
        "sir-alone",
        "sir-ic",
        "sir-arithmetic_average",
        "sir-arithmetic_average@gaussian",
        "sir-alone@multinomial",
    )
    found = study(li2022_linear, names, 50, 1)
    value = {n: found[f"{n}/position_armse_m"] for n in names}
    assert abs(value["sir-arithmetic_average"].value - 19.48) < 3.5 * value["sir-arithmetic_average"].standard_error
    gaussian = value["sir-arithmetic_average@gaussian"]
    assert abs(gaussian.value - 18.85) < 3.5 * gaussian.standard_error
    assert gaussian.value < value["sir-arithmetic_average"].value < value["sir-alone"].value
    assert 20.0 < value["sir-alone"].value < value["sir-alone@multinomial"].value < 24.5


@pytest.mark.parametrize("module", [li2022_linear, li2022_nonlinear])
def test_rows_do_not_depend_on_the_batch(module):
    short = dataclasses.replace(module.TRACKING, steps=5)
    draws = drawn(short, range(3), 0)
    for name, row in module.STUDY.rows.items():
        together = [fused for _, fused in zip(range(5), row.estimates(draws), strict=False)]
        alone = row.estimates(draws.part(slice(1, 2)))
        for whole, one in zip(together, alone, strict=False):
            np.testing.assert_allclose(one.mean[0], whole.mean[1], rtol=1e-9, err_msg=name)
            np.testing.assert_allclose(one.cov[-1], whole.cov[-1 if len(whole.cov) == 1 else 1], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("module", [li2022_linear, li2022_nonlinear])
def test_rows_are_chosen_by_the_beginning_of_their_names(module):
    found = module.SCENARIO.measure(2, 0, only="sir-ic@")
    wanted = [quantity.armse for quantity in module.QUANTITIES]
    assert list(found) == [f"sir-ic@multinomial/{q}" for q in (*wanted, "position_claimed_m", "position_credibility_1")]
    with pytest.raises(ValueError, match="Unknown row 'sir-ci'. Did you mean 'sir-ic'"):
        module.SCENARIO.measure(2, 0, only="sir-ci")


def test_cubature_filters_under_rules_that_the_user_names():
    """The rule of the heavy-tailed families fuses Gaussian tracks, too; the figures are those of the loop by hand."""
    tracking, rule = li2022_nonlinear.TRACKING, RULES["mhdp_explicit"]
    choice = RuleChoice("mhdp_explicit", rule.params(), "mine")
    found = li2022_nonlinear.SCENARIO.compare([choice], [3], 1, lambda share: None)
    _, _, truth, seen = drawn(tracking, [3], 1)
    one = Plain(Cubature())
    mean, cov, squares, claimed = tracking.initial_mean, tracking.initial_cov, [], []
    for k in range(tracking.steps):
        mean, cov = one.predict(mean, cov, tracking.motion.over(tracking.dt_s))
        local = [one.update(mean, cov, z[0, k], s)[:2] for z, s in zip(seen, tracking.sensors.values(), strict=True)]
        fused = rule(SourceTracks(np.stack([m for m, _ in local]), np.stack([c for _, c in local])))
        mean, cov = fused.mean, fused.cov
        squares.append((mean - truth[0, k + 1]) ** 2)
        claimed.append(cov[[0, 1], [0, 1]].sum())
    position, velocity, turn = np.sqrt(
        np.mean(squares, 0) @ np.array([[1, 1, 0, 0, 0], [0, 0, 1, 1, 0], [0] * 4 + [1]]).T
    )
    names = ("position_rmse_m", "velocity_rmse_mps", "turn_rate_rmse_degps", "consistency_position_1")
    assert list(found) == [f"ckf-mhdp_explicit@mine/{q}" for q in names]
    *errors, consistency = found.values()
    np.testing.assert_allclose(np.concatenate(errors), [position, velocity, np.degrees(turn)], rtol=1e-6)
    assert consistency == pytest.approx(position**2 / np.mean(claimed), rel=1e-6)
