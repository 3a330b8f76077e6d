"""Rules mixture_exact and mixture_wep: random problems of Ahmed 5.1, limits, refusals, disjoint mixtures."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from densities.mixture.examples import draw
from densities.mixture.integrals import Problem as Integral
from densities.mixture.integrals import problems as problems_with_integral
from densities.mixture.integrals import taken, verdict
from rules.mixtures import as_tracks

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture.algebra import LogMixture, first_order, power, product
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, moments, sample
from track_fusion.densities.mixture.sampling import Weighted, single_shot_em
from track_fusion.densities.on_grid import kl_on_grid
from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import FusedTracks, SourceTracks, get_rule, mixture_exact
from track_fusion.rules.shared import sampling
from track_fusion.scenarios.ahmed.mixtures import Problem, log_fused
from track_fusion.scenarios.ahmed.random import study_problem


def run(key: str, tracks: SourceTracks, **values: Any) -> FusedTracks:
    rule = get_rule(key)
    return rule(tracks, from_dict(rule.params, values))


# The random problems of Ahmed 5.1. The study itself: test/scenarios/ahmed/test_mixtures.py.


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [study_problem(0, run) for run in range(6)]


def _median(problems: list[Problem], **values: Any) -> float:
    """Median divergence of the exactly fused density from what the rule gives."""
    far = []
    for p in problems:
        fused = run("mixture_exact", p.tracks(np.random.default_rng(1)), max_components=0, **values)
        far.append(kl_on_grid(p.log_exact(), log_fused(fused)))
    return float(np.median(far))


def test_the_default_method_is_the_most_accurate(problems: list[Problem]) -> None:
    best = _median(problems, mixand_samples=200)
    assert best <= 0.03
    assert best <= _median(problems, mixand_samples=200, proposal="ingis", default_variance=5.0)
    laplace = _median(problems, method="laplace")
    assert best < laplace < _median(problems, method="mmgd")
    assert _median(problems, method="common_proposal", samples=2000, em_components=10) > 5 * best


def test_printed_proposal_of_algorithm_1_needs_more_samples(problems: list[Problem]) -> None:
    """Also callable by itself: what the parameter says is what the algorithms give."""
    p, rng = problems[0], np.random.default_rng(5)
    printed = {"criterion": "given", "weights": (0.4, 0.6), "omega_proposal": "first_order", "max_components": 0}
    got = run("mixture_wep", p.tracks(rng), method="igs", samples=300, **printed)
    drawn = first_order(p.first, p.second, np.array(0.5))
    seed = np.random.default_rng(5).integers(1 << 63, size=1)[0]
    points = sample(drawn, np.random.default_rng(seed), 300).points
    weight = 0.4 * log_pdf(p.first, points) + 0.6 * log_pdf(p.second, points) - log_pdf(drawn, points)
    naive = product(LogMixture.of(p.first), LogMixture.of(p.second))
    mean, cov = moments(single_shot_em(Weighted(points, weight), naive))
    np.testing.assert_allclose(got.mean, mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got.cov, cov, rtol=1e-9, atol=1e-9)
    ours = run("mixture_wep", p.tracks(rng), method="igs", samples=300, **(printed | {"omega_proposal": "overlap"}))
    assert ours.info["ess"] > 1.3 * got.info["ess"]


# Limits.


def _gaussians(rng: np.random.Generator, *lead: int, count: int = 2) -> SourceTracks:
    part = draw(rng, *lead, count, count=1, n=3)
    return SourceTracks(part.mean[..., 0, :], part.cov[..., 0, :, :])


@pytest.mark.parametrize("criterion", ["chernoff", "minimax_information_loss"])
@pytest.mark.parametrize("method", ["dls", "igs", "is_wem", "foci"])
def test_one_component_of_a_product_is_the_geometric_average(criterion: str, method: str) -> None:
    tracks = _gaussians(np.random.default_rng(0), 5)
    got = run("mixture_wep", tracks, criterion=criterion, method=method)
    wanted = run("geometric_average", tracks, criterion=criterion)
    np.testing.assert_allclose(got.mean, wanted.mean, rtol=1e-9)
    np.testing.assert_allclose(got.cov, wanted.cov, rtol=1e-9)
    np.testing.assert_allclose(got.weights, wanted.weights, atol=1e-9)


def test_single_components_at_given_weights_are_covariance_intersection_of_all_sources() -> None:
    tracks = _gaussians(np.random.default_rng(1), 5, count=4)
    given = {"criterion": "given", "weights": (0.1, 0.0, 0.6, 0.3)}
    got, wanted = (run(key, tracks, **given) for key in ("mixture_wep", "covariance_intersection"))
    np.testing.assert_allclose(got.mean, wanted.mean, rtol=1e-9)
    np.testing.assert_allclose(got.cov, wanted.cov, rtol=1e-9)
    np.testing.assert_allclose(got.weights, wanted.weights, atol=1e-12)


@pytest.mark.parametrize("method", ["dls", "igs", "mmgd", "laplace"])
def test_one_component_of_the_exact_rule_subtracts_information(method: str) -> None:
    tracks = _gaussians(np.random.default_rng(2), 5, count=3)
    cov = 2.0 * tracks.cov.sum(-3)
    mean = tracks.mean.mean(-2)
    common = Mixture(np.ones((5, 1)), mean[:, None], cov[:, None])
    got = run("mixture_exact", dataclasses.replace(tracks, extras={"common": common}), method=method)
    info = np.linalg.inv(tracks.cov)
    wanted = np.linalg.inv(info.sum(1) - 2.0 * np.linalg.inv(cov))
    pull = np.einsum("bkij,bkj->bi", info, tracks.mean) - 2.0 * np.linalg.solve(cov, mean[..., None])[..., 0]
    np.testing.assert_allclose(got.cov, wanted, rtol=1e-9)
    np.testing.assert_allclose(got.mean, (wanted @ pull[..., None])[..., 0], rtol=1e-8, atol=1e-9)


def test_common_information_of_each_step() -> None:
    """A chain: the second step divides by what the third source shares with the fusion of the first two."""
    tracks = _gaussians(np.random.default_rng(3), count=3)
    commons = [Mixture(np.ones(1), np.zeros((1, 3)), c * np.eye(3)[None]) for c in (40.0, 90.0)]
    got = run("mixture_exact", dataclasses.replace(tracks, extras={"common": commons}))
    wanted = np.linalg.inv(np.linalg.inv(tracks.cov).sum(0) - np.eye(3) / 40.0 - np.eye(3) / 90.0)
    np.testing.assert_allclose(got.cov, wanted, rtol=1e-9)


def test_a_source_that_equals_the_common_information_adds_nothing() -> None:
    tracks = as_tracks(draw(np.random.default_rng(4), 4, 2, count=3))
    assert tracks.mixture is not None
    for silent in (0, 1):
        part = tracks.mixture
        common = Mixture(part.weight[:, silent], part.mean[:, silent], part.cov[:, silent])
        fused = run("mixture_exact", dataclasses.replace(tracks, extras={"common": common}))
        np.testing.assert_allclose(fused.mean, tracks.mean[:, 1 - silent], rtol=1e-12)
        np.testing.assert_allclose(fused.cov, tracks.cov[:, 1 - silent], rtol=1e-12)


@pytest.mark.parametrize("method", ["dls", "igs", "is_wem", "foci", "pcci"])
def test_weight_one_and_equal_mixtures_come_back(method: str) -> None:
    part = draw(np.random.default_rng(5), 3, 2, count=3)
    tracks = as_tracks(part)
    fused = run("mixture_wep", tracks, method=method, criterion="given", weights=(0.0, 1.0))
    if method != "pcci":  # has exponents of its own
        np.testing.assert_allclose(fused.mean, tracks.mean[:, 1], rtol=1e-12)
        np.testing.assert_allclose(fused.cov, tracks.cov[:, 1], rtol=1e-12)
    twice = as_tracks(Mixture(*(np.repeat(a[:, :1], 4, 1) for a in vars(part).values())))
    fused = run("mixture_wep", twice, method=method)
    np.testing.assert_allclose(fused.mean, tracks.mean[:, 0], rtol=1e-12)
    np.testing.assert_allclose(fused.cov, tracks.cov[:, 0], rtol=1e-12)


def test_products_of_powers_meet_between_disjoint_mixtures() -> None:
    part = Mixture(np.full((2, 2), 0.5), np.array([[[0.0], [1.0]], [[1e3], [1e3 + 2]]]), np.ones((2, 2, 1, 1)))
    for method in ("dls", "igs"):
        fused = run("mixture_wep", as_tracks(part), method=method, criterion="given", weights=(0.5, 0.5))
        assert fused.mean[0] == pytest.approx(500.5, abs=0.3)
        assert fused.cov[0, 0] == pytest.approx(1.0, rel=0.2)
        assert fused.info["log_eta"] < -1e5


# Refusals.


def _split(factor: float) -> SourceTracks:
    """Two sources and common information of two components, of which the product is sharper only by the factor."""
    part = Mixture(np.full((2, 2), 0.5), np.array([[[0.0], [3.0]], [[1.0], [4.0]]]), np.full((2, 2, 1, 1), 2.0))
    common = Mixture(np.full(2, 0.5), np.array([[0.0], [2.0]]), np.full((2, 1, 1), factor))
    return dataclasses.replace(as_tracks(part), extras={"common": common})


@pytest.mark.parametrize("method", ["dls", "igs", "laplace"])
def test_quotients_without_integral_are_refused(method: str) -> None:
    run("mixture_exact", _split(1.5), method=method)
    with pytest.raises(ValueError, match=r"has no integral for 4 of 4 pairs of components"):
        run("mixture_exact", _split(0.9), method=method)
    with pytest.raises(ValueError, match=r"has no integral for 4 of 4"):  # none is left
        run("mixture_exact", _split(1.0), method=method, not_integrable="skip")


def test_pairs_without_integral_can_be_skipped() -> None:
    part = Mixture(np.full((2, 2), 0.5), np.array([[[0.0], [3.0]]] * 2), np.array([[2.0, 50.0]] * 2)[..., None, None])
    common = Mixture(np.ones(1), np.zeros((1, 1)), np.full((1, 1, 1), 5.0))
    tracks = dataclasses.replace(as_tracks(part), extras={"common": common})
    for method in ("dls", "igs", "mmgd", "laplace"):
        with pytest.raises(ValueError, match="has no integral for 1 of 4"):
            run("mixture_exact", tracks, method=method)
        fused = run("mixture_exact", tracks, method=method, not_integrable="skip")
        assert fused.info["skipped"] == 1
        assert np.isfinite(fused.mean).all()
        assert fused.mixture is not None
        assert fused.mixture.weight.sum() == pytest.approx(1.0)


def _two_equal_sources(problem: Integral) -> SourceTracks:
    """Two sources whose product is the Gaussian of the problem."""
    n = len(problem.cov)
    part = Mixture(np.ones((2, 1)), np.zeros((2, 1, n)), np.stack([2.0 * problem.cov] * 2)[:, None])
    return dataclasses.replace(as_tracks(part), extras={"common": problem.common})


@pytest.mark.parametrize("method", ["dls", "igs", "laplace", "common_proposal"])
def test_a_pair_that_nothing_proves_is_taken_by_its_samples(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    undecided = [p for p in problems_with_integral(1e-2, 0.15) if not verdict(p.cov, p.common).proved[0]]
    sampled = [p for p in undecided if all(taken(p, seed) for seed in range(5))][:3]
    assert len(sampled) == 3
    for problem in sampled:
        fused = run("mixture_exact", _two_equal_sources(problem), method=method)
        assert fused.info["undecided"] == 1
        assert fused.info["least_difference"] == pytest.approx(problem.difference, rel=1e-3)
    plain = run("mixture_exact", _split(1.5), method=method)
    assert (plain.info["undecided"], plain.info["least_difference"]) == (0, 1.0)
    monkeypatch.setattr(mixture_exact, "EFFECTIVE", 1.0)
    with pytest.raises(
        ValueError, match="of 1 it is neither proved nor refuted, and no more than 100% of samples count"
    ):
        run("mixture_exact", _two_equal_sources(sampled[0]), method=method)


@pytest.mark.parametrize("method", ["dls", "igs", "laplace", "common_proposal"])
def test_a_pair_without_integral_is_refused_with_the_direction(method: str) -> None:
    for problem in problems_with_integral(-0.05, -1e-3)[:20]:
        with pytest.raises(ValueError, match=r"has no integral for 1 of 1 pairs.*, as along \(-?[0-9.e-]+, .*\)\."):
            run("mixture_exact", _two_equal_sources(problem), method=method)


def test_common_information_that_does_not_fit_is_refused() -> None:
    tracks = _split(5.0)
    good = tracks.extras["common"]

    def fail(common: Any, **values: Any) -> str:
        with pytest.raises(ValueError) as caught:
            run("mixture_exact", dataclasses.replace(tracks, extras={"common": common}), **values)
        return str(caught.value)

    assert fail(3.0) == "The extra 'common' must be a Mixture, or a sequence of 1. Got float."
    assert fail([good, good]) == "The extra 'common' must be a Mixture, or a sequence of 1. Got list."
    assert "must have weights that are non-negative" in fail(dataclasses.replace(good, weight=np.zeros(2)))
    assert "positive definite" in fail(dataclasses.replace(good, cov=-good.cov))
    assert "must be finite" in fail(dataclasses.replace(good, mean=np.full((2, 1), np.nan)))
    assert "must have a mean (..., T, 1)" in fail(dataclasses.replace(good, mean=np.zeros((2, 2))))


# Diagnostics and seeds.


@pytest.mark.parametrize("key", ["mixture_exact", "mixture_wep", "geometric_mean_sampling"])
def test_the_seed_decides(key: str) -> None:
    rng = np.random.default_rng(6)
    tracks = dataclasses.replace(as_tracks(draw(rng, 2)), extras={"common": draw(rng, count=2)})
    wide = tracks.extras["common"]
    common = dataclasses.replace(wide, cov=wide.cov + 50 * np.eye(2))

    def fused(**seed: Any) -> Array:
        return get_rule(key)(dataclasses.replace(tracks, extras={"common": common, **seed})).mean

    np.testing.assert_array_equal(fused(), fused(seed=0))
    np.testing.assert_array_equal(fused(seed=5), fused(seed=np.random.default_rng(5)))
    assert np.abs(fused(seed=0) - fused(seed=1)).max() > 1e-6


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("mixture_exact", {}),
        ("mixture_wep", {}),
        ("geometric_mean_sampling", {}),
        ("harmonic_mean", {"method": "sampling"}),
    ],
)
def test_large_batches_are_cut_into_pieces_that_draw_the_same_numbers(
    key: str, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(10)
    part = draw(rng, 2, 3, 3)
    common = Mixture(part.weight[:, :, 0], part.mean[:, :, 0], part.cov[:, :, 0] + 60 * np.eye(2))
    tracks = dataclasses.replace(as_tracks(part), extras={"common": common})
    whole = run(key, tracks, **values)
    monkeypatch.setattr(sampling, "POINTS", 1)
    generator = np.random.default_rng(0)
    cut = run(key, dataclasses.replace(tracks, extras={"common": common, "seed": generator}), **values)
    np.testing.assert_allclose(cut.mean, whole.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cut.cov, whole.cov, rtol=1e-9, atol=1e-9)
    for name in ("converged", "ess", "log_eta"):
        np.testing.assert_allclose(cut.info.get(name, 0), whole.info.get(name, 0), rtol=1e-8, atol=1e-8)
    assert cut.mixture is not None
    assert cut.mixture.weight.shape[:2] == (2, 3)
    assert generator.random() != np.random.default_rng(0).random()  # a generator moves on


@pytest.mark.parametrize("reduction", ["runnalls", "salmond", "cap"])
def test_reduction_before_during_and_after(reduction: str) -> None:
    tracks = as_tracks(draw(np.random.default_rng(7), 3, 2, count=5))
    whole = run("mixture_wep", tracks, max_components=0)
    assert whole.mixture is not None
    assert whole.mixture.count <= 25
    after = run("mixture_wep", tracks, max_components=4, reduction=reduction)
    assert after.mixture is not None
    assert after.mixture.count == 4
    before = run("mixture_wep", tracks, max_source_components=2, reduction=reduction)
    assert before.mixture is not None
    assert before.mixture.count <= 4
    during = run("mixture_wep", tracks, prune_nats=1.0)
    assert (during.info["pruned"] >= whole.info["pruned"]).all()
    if reduction != "cap":
        np.testing.assert_allclose(after.mean, whole.mean, rtol=1e-9, atol=1e-9)


def test_power_approximation_is_above_the_true_power() -> None:
    """Why the proposal of Algorithm 1 is safe: (a + b)^w <= a^w + b^w."""
    mixture = draw(np.random.default_rng(8), count=4)
    raised = power(LogMixture.of(mixture), 0.4)
    points = 5.0 * np.random.default_rng(9).normal(size=(500, 2))
    above = log_pdf(Mixture(np.exp(raised.log_weight), raised.mean, raised.cov), points)
    assert (above >= 0.4 * log_pdf(mixture, points) - 1e-12).all()
    assert normalised(raised.log_weight).sum() == pytest.approx(1.0)
    assert moments(Mixture(normalised(raised.log_weight), raised.mean, raised.cov))[0].shape == (2,)
