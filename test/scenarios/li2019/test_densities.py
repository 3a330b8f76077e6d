"""Li 2019, densities: against densities on a grid, samples and ERRATA; claims true and false."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from track_fusion.params import ParameterError
from track_fusion.rules.covariance_intersection import CovarianceIntersectionParams
from track_fusion.scenarios.li2019.densities import AA, GA, PAIRS, SCENARIO, THETA, WEIGHT
from track_fusion.study.judgement import judged_claims, judged_figures
from track_fusion.study.rule_choice import RuleChoice


@pytest.fixture(scope="module")
def measured():
    return SCENARIO.measure(1, 0)


def test_variances_at_equal_weights_are_those_of_the_errata(measured):
    for name, aa, ga in (("fig5", 175.0, 133.33), ("fig6", 325.0, 266.67)):
        assert measured[f"{AA}@{name}/variance_1"].value == pytest.approx(aa)
        assert measured[f"{GA}@{name}/variance_1"].value == pytest.approx(ga, abs=0.005)


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("weight", [0.2, 0.5, 0.9])
def test_errors_against_quadrature_of_the_densities(name, weight):
    pair = PAIRS[name]
    first, second = (norm(m, np.sqrt(v)).pdf for m, v in zip(pair.means, pair.variances, strict=True))
    densities = {
        AA: lambda x: weight * first(x) + (1 - weight) * second(x),
        GA: lambda x: first(x) ** weight * second(x) ** (1 - weight),
    }
    for average, density in densities.items():
        mass = quad(density, -150, 250, epsabs=1e-10)[0]
        for theta in (40.0, 72.0):
            error = quad(lambda x, t=theta, f=density: (x - t) ** 2 * f(x), -150, 250, epsabs=1e-8)[0] / mass
            found = pair.errors(average, np.array([weight]), np.array([theta]))
            assert found[0, 0] == pytest.approx(error, rel=1e-6)


def test_extremes_are_those_of_a_plain_loop(measured):
    """(32)-(35) and (41) for scalars, spelt out."""
    for name, pair in PAIRS.items():
        (m1, m2), (v1, v2) = pair.means, pair.variances
        crossed, greater, from_theta = 0, 0, None
        for theta in THETA:
            signs = set()
            for w in WEIGHT:
                aa = w * (v1 + (m1 - theta) ** 2) + (1 - w) * (v2 + (m2 - theta) ** 2)
                variance = v1 * v2 / (w * v2 + (1 - w) * v1)
                ga = variance + (variance * (w * m1 / v1 + (1 - w) * m2 / v2) - theta) ** 2
                signs.add(aa > ga)
                greater += aa > ga
            crossed += len(signs) == 2
            if False in signs and from_theta is None:
                from_theta = theta
        assert measured[f"{AA}@{name}/greater_mse_share_1"].value == pytest.approx(greater / THETA.size / WEIGHT.size)
        assert measured[f"{AA}@{name}/crossed_theta_share_1"].value == pytest.approx(crossed / THETA.size)
        found = measured.get(f"{AA}@{name}/less_mse_from_theta_1")
        assert found is None if from_theta is None else found.value == pytest.approx(from_theta)


def test_means_of_appendix_b(measured):
    root = np.sqrt(2.0)
    exact = {
        f"{GA}@appendix": 3 * root / 5,
        f"{AA}@appendix": 2 * root / 3,
        "given-alone@appendix_uniform": 2 * root / 3,
        "given-alone@appendix_rising": 2 * root / 3,
        "given-alone@appendix_uniform_to_1": 0.5,
    }
    for row, value in exact.items():
        assert measured[f"{row}/mean_1"].value == pytest.approx(value, rel=1e-12)
    verdicts = {f["name"]: f["verdict"] for f in judged_figures(SCENARIO, measured)}
    assert all(verdicts[name] == "agrees" for name in SCENARIO.published)


def test_claims_of_the_paper_that_do_not_hold(measured):
    judged = judged_claims(SCENARIO, measured)
    assert len(judged) == len(SCENARIO.claims)
    false = [(c["source"], c["claim"]) for c in judged if c["verdict"] == "contradicts"]
    assert [source for source, _ in false] == ["Remark 8", "Appendix B"]
    assert "at all weights" in false[0][1]
    assert "(0, 1]" in false[1][1]


def test_rules_are_compared_by_their_error():
    naive_weights = CovarianceIntersectionParams(criterion="given", weights=(0.5, 0.5))
    rules = [*SCENARIO.rules, RuleChoice("covariance_intersection", naive_weights)]
    found = SCENARIO.compare(rules, range(2), 0, lambda share: None)
    assert set(found) == {f"given-{c.name}/{f}_rms_error_1" for c in rules for f in PAIRS}
    np.testing.assert_allclose(
        found["given-covariance_intersection/fig5_rms_error_1"], found["given-geometric_average/fig5_rms_error_1"]
    )
    points = np.concatenate(
        [norm(m, np.sqrt(v)).ppf((np.arange(4000) + 0.5) / 4000) for m, v in ((50, 100), (60, 200))]
    )
    square = ((points[:, None] - THETA) ** 2).mean()
    assert found["given-arithmetic_average/fig5_rms_error_1"][0] == pytest.approx(np.sqrt(square), rel=1e-3)
    needy = RuleChoice.of("split_covariance_intersection")
    with pytest.raises(ParameterError, match="which needs '.*' beside the tracks"):
        SCENARIO.compare([needy], [0], 0, lambda share: None)


def test_rows_can_be_chosen_and_progress_goes_to_the_end():
    seen = []
    found = SCENARIO.simulate(range(3), 0, seen.append, f"{GA}@fig5")
    assert {name.partition("/")[0] for name in found} == {f"{GA}@fig5"}
    assert all(values.shape == (3,) for values in found.values())
    assert seen[-1] == 1.0
    (variance, error) = SCENARIO.charts(found)
    assert [line.label for line in variance.series] == ["geometric", "density 1", "density 2"]
    assert error.contours[0].z.shape == (error.contours[0].y.size, error.contours[0].x.size)


def test_charts():
    panels = SCENARIO.charts(SCENARIO.simulate([0], 0, lambda share: None, ""))
    assert [chart.title.partition(":")[0] for chart in panels] == ["Fig. 5"] * 3 + ["Fig. 6"] * 3 + ["Appendix B"]
    excess = panels[2].contours[0].z
    assert excess.min() < 0 < excess.max()  # the averages cross over
    assert panels[5].contours[0].z.min() >= 0
