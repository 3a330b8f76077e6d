"""Sharma 5.2: figures of ERRATA.md, the sampled beside the exact ones, claims, pieces."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from track_fusion.params import ParameterError
from track_fusion.scenarios.sharma import gaussians as sharma_gaussians
from track_fusion.scenarios.sharma import mixtures as sharma_mixtures
from track_fusion.study.judgement import judged_claims
from track_fusion.study.rule_choice import RuleChoice

RUNS = 40
MODULES = {"gaussians": sharma_gaussians, "mixtures": sharma_mixtures}


@pytest.fixture(scope="module")
def outcomes():
    return {key: module.SCENARIO.simulate(range(RUNS), 3, lambda share: None) for key, module in MODULES.items()}


@pytest.fixture(scope="module")
def measured(outcomes):
    return {key: module.SCENARIO.figures(outcomes[key]) for key, module in MODULES.items()}


@pytest.mark.parametrize(
    ("row", "determinant"),
    [
        ("covariance_intersection", 1.583), ("harmonic_mean@grid", 1.093), ("inverse_covariance_intersection", 0.879),
        ("harmonic_mean", 0.759), ("ellipsoidal_intersection", 0.633), ("naive", 0.396),
    ],
)  # fmt: skip
def test_determinants_of_the_gaussians_by_the_errata(measured, row, determinant):
    found = measured["gaussians"][f"given-{row}/determinant_1"]
    assert found.value == pytest.approx(determinant, abs=6e-4)
    assert found.standard_error == 0.0


@pytest.mark.parametrize(
    ("row", "mean", "determinant"),
    [("harmonic_mean", (1.511, -0.790), 6.56), ("geometric_mean_sampling", (1.458, -0.709), 10.45)],
)
def test_moments_of_the_mixtures_by_the_errata(measured, row, mean, determinant):
    found = measured["mixtures"]
    for axis, value in zip("xy", mean, strict=True):
        assert found[f"given-{row}@grid/mean_{axis}_1"].value == pytest.approx(value, abs=6e-4)
    assert found[f"given-{row}@grid/determinant_1"].value == pytest.approx(determinant, abs=6e-3)


@pytest.mark.parametrize(
    ("key", "sampled", "exact"),
    [
        ("gaussians", "harmonic_mean@sampled", "harmonic_mean@grid"),
        ("gaussians", "geometric_mean_sampling", "covariance_intersection"),
        ("gaussians", "harmonic_mean@sampled_alpha_1_2", "harmonic_mean@grid_alpha_1_2"),
        ("gaussians", "harmonic_mean@sampled_alpha_1_5", "harmonic_mean@grid_alpha_1_5"),
        ("mixtures", "harmonic_mean@sampled", "harmonic_mean@grid"),
        ("mixtures", "geometric_mean_sampling", "geometric_mean_sampling@grid"),
    ],
)
def test_sampling_gives_the_exact_moments(measured, key, sampled, exact):
    for quantity in ("mean_x_1", "mean_y_1", "determinant_1"):
        found, wanted = (measured[key][f"given-{row}/{quantity}"] for row in (sampled, exact))
        assert 0 < found.standard_error < 0.02 * abs(wanted.value) + 0.01
        # Determinants of few thousand samples are low by about a thousandth.
        assert abs(found.value - wanted.value) < 4 * found.standard_error + 2e-3 * abs(wanted.value), quantity


def test_inflated_samples_against_a_sum_of_another_library():
    """The limit of (66) when samples of q, wider by alpha, are weighted as if q were not: f q_alpha / q."""
    alpha, axis = 1.5, np.linspace(-12.0, 14.0, 261)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    pairs = list(zip(sharma_gaussians.MEANS, sharma_gaussians.COVS, strict=True))
    a, b = (multivariate_normal(m, c).pdf(points) for m, c in pairs)
    wide = sum(multivariate_normal(m, alpha * c).pdf(points) for m, c in pairs)
    share = 2.0 * a * b / (a + b) * wide / (a + b)
    wanted = (
        np.average(points.reshape(-1, 2), 0, share.ravel()),
        np.cov(points.reshape(-1, 2).T, aweights=share.ravel()),
    )
    found = sharma_gaussians.PAIR.by_grid("harmonic", alpha).fuse(np.random.default_rng())
    np.testing.assert_allclose(found.mean, wanted[0], atol=1e-6)
    np.testing.assert_allclose(found.cov, wanted[1], rtol=1e-3)


def test_least_alpha_gives_the_determinant_of_the_geometric_mean(measured):
    alpha = measured["gaussians"][sharma_gaussians.LEAST_ALPHA].value
    assert 1.2 < alpha < 1.5
    assert sharma_gaussians.determinant(alpha) == pytest.approx(1.5828, abs=1e-4)


def test_claims_of_the_gaussians(measured):
    found = [c["verdict"] for c in judged_claims(sharma_gaussians.SCENARIO, measured["gaussians"])]
    assert found == ["agrees", "agrees", "agrees", "contradicts", "agrees"]


def test_claims_of_the_mixtures(measured):
    found = [c["verdict"] for c in judged_claims(sharma_mixtures.SCENARIO, measured["mixtures"])]
    assert found == ["agrees", "agrees"]


@pytest.mark.parametrize("key", MODULES)
def test_pieces_equal_the_whole_and_only_chooses_rows(outcomes, key):
    only = "given-harmonic_mean@sampled"
    part = MODULES[key].SCENARIO.simulate([5, 7], 3, lambda share: None, only)
    assert all(name.startswith(only) for name in part)
    for name, values in part.items():
        np.testing.assert_allclose(values, outcomes[key][name][[5, 7]], rtol=1e-9, err_msg=name)
    assert set(MODULES[key].SCENARIO.figures(part)) == {
        n for n in MODULES[key].SCENARIO.figures(outcomes[key]) if n.startswith(only)
    }
    assert MODULES[key].SCENARIO.charts(part)


def test_charts_of_the_gaussians_are_ellipses_of_two_sigma(outcomes):
    region = sharma_gaussians.charts(outcomes["gaussians"])[0]
    line = region.series[0]
    offset = np.stack([line.x, line.y], -1) - sharma_gaussians.MEANS[0]
    length = np.einsum("pi,ij,pj->p", offset, np.linalg.inv(sharma_gaussians.COVS[0]), offset)
    np.testing.assert_allclose(length, 4.0)
    assert len(region.series) == 8


def test_charts_of_the_mixtures_show_exact_and_sampled_densities(outcomes):
    _, *means = sharma_mixtures.SCENARIO.charts(outcomes["mixtures"])
    assert len(means) == 2
    for exact, drawn in (chart.contours for chart in means):
        assert exact.z.shape == (len(exact.y), len(exact.x))
        assert np.abs(exact.z - drawn.z).mean() < 0.03 < np.abs(exact.z).mean()


@pytest.mark.parametrize("key", MODULES)
def test_compare_gives_a_divergence_a_run(key):
    scenario, choices = MODULES[key].SCENARIO, MODULES[key].RULE_CHOICES
    found = scenario.compare(choices, [2, 3], 1, lambda share: None)
    assert set(found) == {f"given-{c.name}/kld_nats" for c in choices}
    assert all(v.shape == (2,) and (v > 0).all() for v in found.values())
    with pytest.raises(ParameterError, match="Got 'mixture_exact', which needs 'common' beside"):
        scenario.compare([RuleChoice.of("mixture_exact")], [0], 0, lambda share: None)
