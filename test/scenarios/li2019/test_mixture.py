"""Li 2019, Fig. 7: components of ERRATA, intensities by scipy's densities, divergences that theorems bound."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import norm

from track_fusion.scenarios.li2019.common import exact_geometric, intensity
from track_fusion.scenarios.li2019.mixture import AA, EXACT, GA, PARTS, SCENARIO, X, fused_mixture
from track_fusion.study.judgement import judged_claims
from track_fusion.study.rule_choice import RuleChoice

#: Weight, mean and variance of the hybrid average's components.
ERRATA = [
    (0.7315, 10.5, 100.0), (0.0928, 29.09, 109.09), (0.1013, 30.5, 100.0), (0.0033, 37.33, 133.33),
    (0.6351, 50.91, 109.09), (0.1859, 66.25, 150.0),
]  # fmt: skip
GM_1 = [(0.7, 10.0, 100.0), (0.6, 50.0, 100.0), (0.5, 90.0, 200.0)]
GM_2 = [(0.9, 11.0, 100.0), (0.8, 52.0, 120.0)]


@pytest.fixture(scope="module")
def measured():
    return SCENARIO.measure(1, 0)


def _sum(parts, power=1.0):
    return sum((w * norm(m, np.sqrt(v)).pdf(X)) ** power for w, m, v in parts)


def _normal_sum(parts, power=1.0):
    total = sum(w for w, _, _ in parts)
    return _sum([(w / total, m, v) for w, m, v in parts], power)


def test_components_are_those_of_the_errata(measured):
    found = [[measured[f"{GA}/component{k}_{q}_1"].value for q in ("weight", "mean", "variance")] for k in range(1, 7)]
    np.testing.assert_allclose(found, ERRATA, rtol=2e-4, atol=6e-5)
    assert measured[f"{GA}/expected_targets_1"].value == pytest.approx(1.75)
    found = [[measured[f"{AA}/component{k}_{q}_1"].value for q in ("weight", "mean", "variance")] for k in range(1, 6)]
    np.testing.assert_allclose(found, sorted([(w / 2, m, v) for w, m, v in GM_1 + GM_2], key=lambda c: c[1]))
    assert f"{GA}/component7_weight_1" not in measured


def test_intensities_point_by_point():
    """The union of the components; the product of their square roots, (49); the root of the product of the sums."""
    average, hybrid = (intensity(fused_mixture(choice), X) for choice in SCENARIO.rules)
    np.testing.assert_allclose(average, 0.5 * (_sum(GM_1) + _sum(GM_2)), rtol=1e-9, atol=1e-15)
    approximate = _normal_sum(GM_1, 0.5) * _normal_sum(GM_2, 0.5)
    exact = np.sqrt(_normal_sum(GM_1) * _normal_sum(GM_2))
    for found, wanted in ((hybrid, approximate), (exact_geometric(PARTS, X), exact)):
        np.testing.assert_allclose(found, 1.75 * wanted / trapezoid(wanted, X), rtol=1e-6, atol=1e-12)


def test_shapes(measured):
    assert measured[f"{AA}/peaks_1"].value == 3
    assert measured[f"{GA}/peaks_1"].value == measured[f"{EXACT}/peaks_1"].value == 2
    tail = 0.5 * sum(
        w * (norm(m, np.sqrt(v)).cdf(10.5 - np.sqrt(800)) + norm(m, np.sqrt(v)).sf(90 + np.sqrt(800)))
        for w, m, v in GM_1 + GM_2
    )
    assert measured[f"{AA}/tail_mass_1"].value == pytest.approx(tail, rel=0.01)
    isolated = 0.5 * (_sum(GM_1) + _sum(GM_2))[np.abs(X - 90).argmin()]
    assert measured[f"{AA}/isolated_1"].value == pytest.approx(isolated)


def test_claims_of_the_paper_that_do_not_hold(measured):
    """The approximate average has the lower peak at target 1; without the approximation it has the higher."""
    judged = judged_claims(SCENARIO, measured)
    assert len(judged) == len(SCENARIO.claims)
    false = [c["claim"] for c in judged if c["verdict"] == "contradicts"]
    assert false == ["The geometric average has the higher peak at target 1."]


def test_averages_have_the_least_divergences():
    """The arithmetic average of densities is nearest seen from the sources, at equal weights among all densities."""
    pooled = RuleChoice.of("geometric_average")
    found = SCENARIO.compare([*SCENARIO.rules, pooled], range(2), 0, lambda share: None)
    assert all(values.shape == (2,) for values in found.values())
    of_sources = {name: v[0] for name, v in found.items() if "of_sources" in name}
    assert min(of_sources, key=of_sources.__getitem__).startswith("given-mixture_average")
    first, second = _normal_sum(GM_1), _normal_sum(GM_2)
    fused = (1.8 * first + 1.7 * second) / 3.5
    step = X[1] - X[0]
    kld = [step * (f * np.log(f / fused))[f > 1e-200].sum() for f in (first, second)]
    assert of_sources["given-mixture_average/kld_of_sources_nats"] == pytest.approx(np.mean(kld), rel=1e-6)
    # Of a Gaussian from another only by what was fused: the sources' moments do.
    assert found["given-geometric_average/kld_from_sources_nats"][0] > 0.1


def test_rows_can_be_chosen():
    seen = []
    found = SCENARIO.simulate(range(2), 0, seen.append, EXACT)
    assert {name.partition("/")[0] for name in found} == {EXACT}
    assert seen[-1] == 1.0
    (chart,) = SCENARIO.charts(found)
    assert [line.label for line in chart.series] == ["GM 1", "GM 2", "geometric, exact"]
    panels = SCENARIO.charts(SCENARIO.simulate([0], 0, lambda share: None, ""))
    assert [len(panel.series) for panel in panels] == [5, 6]
