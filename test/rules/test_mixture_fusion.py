"""Rules mixture_exact and mixture_wep: the random study of Ahmed 5.1, limits, refusals, disjoint mixtures."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from densities.test_mixture import draw
from rules.test_mixture_averages import as_tracks

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture import Mixture, log_pdf, moments, sample
from track_fusion.densities.mixture_algebra import LogMixture, first_order, power, product
from track_fusion.densities.mixture_divergence import grid, kl_on_grid
from track_fusion.densities.mixture_sampling import Weighted, single_shot_em
from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import FusedTracks, SourceTracks, get_rule, mixture_common


def run(key: str, tracks: SourceTracks, **values: Any) -> FusedTracks:
    rule = get_rule(key)
    return rule(tracks, from_dict(rule.params, values))


# The random problems of Ahmed 5.1; about fifteen seconds of processor time.

PROBLEMS = 20
GRID = grid(np.full(2, -28.0), np.full(2, 28.0), 100)


def _random_mixture(rng: np.random.Generator, count: int, half: float) -> Mixture:
    """Weights uniform, means uniform within the square, covariances Wishart(10, .75 I), of mean 7.5 I."""
    weight, root = rng.random(count), rng.normal(size=(count, 2, 10)) * np.sqrt(0.75)
    return Mixture(weight / weight.sum(), rng.uniform(-half, half, (count, 2)), root @ np.swapaxes(root, 1, 2))


@dataclasses.dataclass
class Problem:
    tracks: SourceTracks
    first: Mixture
    second: Mixture
    log_exact: Array

    @classmethod
    def of(cls, seed: int) -> Problem:
        rng = np.random.default_rng(seed)
        first, second = _random_mixture(rng, 10, 14.0), _random_mixture(rng, 10, 14.0)
        common = _random_mixture(rng, 40, 20.0)
        both = Mixture(*(np.stack(arrays) for arrays in zip(vars(first).values(), vars(second).values(), strict=True)))
        logs = [log_pdf(m, GRID) for m in (first, second, common)]
        tracks = dataclasses.replace(as_tracks(both), extras={"common": common, "seed": 1})
        return cls(tracks, first, second, logs[0] + logs[1] - logs[2])

    def exact(self, **values: Any) -> float:
        fused = run("mixture_exact", self.tracks, max_components=0, **values)
        assert fused.mixture is not None
        return self.far(self.log_exact, fused.mixture)

    def far(self, log_truth: Array, fused: Mixture) -> float:
        return kl_on_grid(lambda x: log_truth, lambda x: log_pdf(fused, x), GRID)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [Problem.of(seed) for seed in range(PROBLEMS)]


def test_random_study_of_exact_fusion(problems: list[Problem]) -> None:
    def median(among: int = PROBLEMS, **values: Any) -> float:
        return float(np.median([p.exact(**values) for p in problems[:among]]))

    ingis = {"method": "dls", "proposal": "ingis", "default_variance": 5.0}
    dls = [median(**ingis, mixand_samples=s) for s in (10, 50, 200)]
    igs = [median(method="igs", samples=s) for s in (100, 500, 1000)]
    mmgd = median(method="mmgd")
    assert dls[2] <= 0.03
    assert igs[2] <= 0.06
    assert mmgd >= 10 * dls[2]
    assert dls == sorted(dls, reverse=True)  # more samples are always better
    assert igs == sorted(igs, reverse=True)
    assert median(mixand_samples=200) <= dls[2]  # heavy tails, the default
    assert dls[2] < median(method="laplace") < mmgd
    assert median(5, method="common_proposal", samples=2000, em_components=10) > 5 * dls[2]


def test_random_study_of_weighted_exponential_products(problems: list[Problem]) -> None:
    far: dict[str, list[float]] = {}
    for p in problems:
        base = {"criterion": "minimax_information_loss", "max_components": 0}
        omega = run("mixture_wep", p.tracks, **base, method="foci", samples=5000).weights
        assert omega is not None
        w = np.array(omega[0])
        log_truth = w * log_pdf(p.first, GRID) + (1 - w) * log_pdf(p.second, GRID)
        given = {"criterion": "given", "weights": tuple(omega), "max_components": 0}
        cases = {
            "dls": {"proposal": "ingis", "default_variance": 5.0, "mixand_samples": 200},
            "igs100": {"method": "igs", "samples": 100}, "igs1000": {"method": "igs", "samples": 1000},
            "foci": {"method": "foci"}, "naive": {"method": "naive_bayes"},
        }  # fmt: skip
        for name, values in cases.items():
            fused = run("mixture_wep", p.tracks, **given, **values).mixture
            assert fused is not None
            far.setdefault(name, []).append(p.far(log_truth, fused))
        far.setdefault("igs100 by foci", []).append(p.far(log_truth, _igs_by_first_order(p, w, 100)))
    median = {name: float(np.median(values)) for name, values in far.items()}
    assert median["dls"] <= 0.012
    assert median["igs1000"] <= 0.06
    assert median["foci"] >= 5 * median["igs1000"]
    # With the paper's proposal a hundred samples are worse than none. The rule's counts overlaps and does better.
    assert median["igs100 by foci"] > median["foci"]
    assert median["igs100"] < 0.9 * median["igs100 by foci"]
    assert median["dls"] < median["igs1000"] < median["naive"]


def _igs_by_first_order(p: Problem, omega: Array, count: int) -> Mixture:
    """Indirect global sampling from (14)-(17) at omega 1/2, as printed."""
    proposal = first_order(p.first, p.second, np.array(0.5))
    points = sample(proposal, np.random.default_rng(1), count).points
    weight = omega * log_pdf(p.first, points) + (1 - omega) * log_pdf(p.second, points) - log_pdf(proposal, points)
    return single_shot_em(Weighted(points, weight), product(LogMixture.of(p.first), LogMixture.of(p.second)))


def test_effective_samples_grow_from_ingis_to_heavy_tails(problems: list[Problem]) -> None:
    """Example 2 of Ahmed: the order of the mean share of effective samples is robust, that of divergences is not."""
    ess = [
        np.mean([run("mixture_exact", p.tracks, proposal=kind, mixand_samples=500).info["ess"] for p in problems[:6]])
        for kind in ("ingis", "lagis", "heavy_tail")
    ]
    assert ess[0] < ess[1]
    assert ess[0] < ess[2]


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
    monkeypatch.setattr(mixture_common, "POINTS", 1)
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
