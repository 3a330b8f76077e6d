"""HMD-S and GMD-S of Sharma: the examples of section 5 against a grid, limits, inflation, balance of the proposal."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from densities.mixture.examples import draw
from rules.mixtures import as_tracks

from track_fusion.densities.harmonic import HarmonicMean
from track_fusion.densities.mixture.mean_density import log_mean_density, sample_mean_density
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.on_grid import grid, moments_on_grid
from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import FusedTracks, SourceTracks, get_rule

A, B = np.array([[2.5, -1.0], [-1.0, 1.2]]), np.array([[0.8, -0.5], [-0.5, 4.0]])
#: (75)-(76), and the mixtures after them, the second p^1 being p^2.
GAUSSIANS = SourceTracks(np.array([[0.5, 1.0], [2.0, 1.0]]), np.stack([A, B]))
MIXTURES = as_tracks(Mixture(
    np.array([[0.3, 0.7], [0.4, 0.6]]),
    np.array([[[-0.5, 3.0], [2.0, 0.3]], [[-1.5, 1.0], [3.0, -4.0]]]),
    np.stack([np.stack([A, B])] * 2),
))  # fmt: skip
GRID = grid(np.full(2, -14.0), np.full(2, 14.0), 280)
SAMPLES = 20000
HALF = {"criterion": "given", "weights": (0.5, 0.5), "samples": SAMPLES}


def run(key: str, tracks: SourceTracks, **values: Any) -> FusedTracks:
    rule = get_rule(key)
    extra = {"method": "sampling"} if key == "harmonic_mean" else {}
    return rule(tracks, from_dict(rule.params, {**extra, **values}))


def _on_grid(tracks: SourceTracks, kind: str, omega: float = 0.5) -> tuple[Array, Array]:
    part = tracks.mixture or Mixture(np.ones((2, 1)), tracks.mean[:, None], tracks.cov[:, None])
    logs = log_pdf(part, GRID[None])
    log_mean = log_mean_density(logs, np.array([omega, 1.0 - omega]), kind)  # type: ignore[arg-type]
    return moments_on_grid(log_mean, GRID)


@pytest.mark.parametrize(
    ("key", "kind", "tracks", "mean", "det"),
    [
        ("harmonic_mean", "harmonic", GAUSSIANS, None, 1.093),
        ("geometric_mean_sampling", "geometric", GAUSSIANS, None, 1.583),
        ("harmonic_mean", "harmonic", MIXTURES, (1.511, -0.790), 6.56),
        ("geometric_mean_sampling", "geometric", MIXTURES, (1.458, -0.709), 10.45),
    ],
)
def test_examples_of_section_5(
    key: str, kind: str, tracks: SourceTracks, mean: tuple[float, float] | None, det: float
) -> None:
    wanted_mean, wanted_cov = _on_grid(tracks, kind)
    assert np.linalg.det(wanted_cov) == pytest.approx(det, rel=1e-3)
    if mean is not None:
        np.testing.assert_allclose(wanted_mean, mean, atol=1e-3)
    fused = run(key, tracks, **HALF)
    error = 4.0 / np.sqrt(float(fused.info["ess"]) * SAMPLES)  # four standard errors of a mean
    sigma = np.sqrt(np.diag(wanted_cov))
    assert (np.abs(fused.mean - wanted_mean) <= error * sigma).all()
    np.testing.assert_allclose(fused.cov / np.outer(sigma, sigma), wanted_cov / np.outer(sigma, sigma), atol=2 * error)
    assert (fused.mixture is None) == (tracks.mixture is None)


def test_the_gaussian_method_claims_less_than_the_density_itself() -> None:
    """Example (75)-(76): HMD-GA .759, exact 1.093."""
    rule = get_rule("harmonic_mean")
    claimed = rule(GAUSSIANS, from_dict(rule.params, {"criterion": "given", "weights": (0.5, 0.5)})).cov
    assert np.linalg.det(claimed) == pytest.approx(0.759, abs=1e-3)


def test_components_of_a_fused_mixture_share_its_density() -> None:
    fused = run("harmonic_mean", MIXTURES, **HALF)
    assert fused.mixture is not None
    assert fused.mixture.count == 4
    assert fused.mixture.weight.sum() == pytest.approx(1.0)
    logs = log_pdf(MIXTURES.mixture, GRID[None])  # type: ignore[arg-type]
    truth = np.exp(log_mean_density(logs, np.array([0.5, 0.5]), "harmonic"))
    got = np.exp(log_pdf(fused.mixture, GRID))
    truth, got = truth / truth.sum(), got / got.sum()
    assert 0.5 * np.abs(truth - got).sum() < 0.1  # total variation


def test_many_samples_of_gaussians_give_covariance_intersection() -> None:
    part = draw(np.random.default_rng(0), 4, 3, count=1, spread=0.5)
    tracks = SourceTracks(part.mean[..., 0, :], part.cov[..., 0, :, :])
    given = {"criterion": "given", "weights": (0.5, 0.2, 0.3)}
    got, wanted = (
        run("geometric_mean_sampling", tracks, **given, samples=40000),
        run("covariance_intersection", tracks, **given),
    )
    sigma = np.sqrt(np.diagonal(wanted.cov, axis1=-2, axis2=-1))
    error = 4.0 / np.sqrt(got.info["ess"] * 40000)
    assert (np.abs(got.mean - wanted.mean) / sigma <= error[:, None]).all()
    unit = sigma[:, :, None] * sigma[:, None, :]
    assert (np.abs(got.cov - wanted.cov) / unit <= 2 * error[:, None, None]).all()


def test_inflation_widens_beyond_the_geometric_mean() -> None:
    """Sharma, Fig. 1b: small alpha suffice."""
    dets = [np.linalg.det(run("harmonic_mean", GAUSSIANS, **HALF, inflation=a).cov) for a in (1.0, 1.2, 1.5)]
    assert dets == sorted(dets)
    assert dets[2] > 1.583


@pytest.mark.parametrize("key", ["harmonic_mean", "geometric_mean_sampling"])
def test_weight_one_gives_the_source_back(key: str) -> None:
    for tracks in (GAUSSIANS, MIXTURES):
        fused = run(key, tracks, criterion="given", weights=(0.0, 1.0))
        np.testing.assert_allclose(fused.mean, tracks.mean[1], rtol=1e-12)
        np.testing.assert_allclose(fused.cov, tracks.cov[1], rtol=1e-12)


def test_balanced_proposal_has_less_error_than_samples_of_one_source() -> None:
    part = Mixture(np.ones((2, 1)), GAUSSIANS.mean[:, None], GAUSSIANS.cov[:, None])
    wanted = _on_grid(GAUSSIANS, "harmonic")[0]
    half = np.array([0.5, 0.5])
    balanced, single = [], []
    for seed in range(200):
        balanced.append(sample_mean_density(part, half, "harmonic", np.random.default_rng(seed), 200).moments()[0])
        x = np.random.default_rng(seed).multivariate_normal(*(a[0] for a in (GAUSSIANS.mean, GAUSSIANS.cov)), 200)
        logs = log_pdf(part, x[None])
        weight = np.exp(log_mean_density(logs, half, "harmonic") - logs[0])
        single.append(weight @ x / weight.sum())
    errors = [np.linalg.norm(np.array(e) - wanted, axis=1).mean() for e in (balanced, single)]
    assert errors[0] < 0.8 * errors[1]


def test_effective_samples_vanish_where_tracks_are_far_apart() -> None:
    far = dataclasses.replace(GAUSSIANS, mean=GAUSSIANS.mean + np.array([[0.0, 0.0], [15.0, 0.0]]))
    near, lost = (run("geometric_mean_sampling", t).info for t in (GAUSSIANS, far))
    assert lost["ess"] < 0.1 * near["ess"]
    assert lost["log_eta"] < near["log_eta"] - 5.0


def test_the_harmonic_mean_says_when_it_draws() -> None:
    rule = get_rule("harmonic_mean")
    assert not rule.uses("seed", rule.params())
    assert rule.uses("seed", from_dict(rule.params, {"method": "sampling"}))
    sampler = get_rule("geometric_mean_sampling")
    assert sampler.uses("seed", sampler.params())
    assert not sampler.uses("common", sampler.params())


# Three sources at once.

THREE = {"criterion": "given", "weights": (0.5, 0.2, 0.3), "samples": SAMPLES}
TRIPLE = SourceTracks(
    np.array([[0.5, 1.0], [2.0, 1.0], [-0.5, 0.0]]), np.stack([A, B, np.array([[1.5, 0.5], [0.5, 1.0]])])
)


def _three_mixtures() -> SourceTracks:
    assert MIXTURES.mixture is not None
    third = draw(np.random.default_rng(3), 1, count=2)
    parts = (np.concatenate(pair) for pair in zip(vars(MIXTURES.mixture).values(), vars(third).values(), strict=True))
    return as_tracks(Mixture(*parts))


@pytest.mark.parametrize("kind", ["gaussians", "mixtures"])
def test_the_harmonic_mean_of_three_is_the_density_itself(kind: str) -> None:
    """1 / sum of w_i / p_i on a grid; folded, it is another."""
    tracks = TRIPLE if kind == "gaussians" else _three_mixtures()
    part = tracks.mixture or Mixture(np.ones((3, 1)), tracks.mean[:, None], tracks.cov[:, None])
    log_mean = log_mean_density(log_pdf(part, GRID[None]), np.array(THREE["weights"]), "harmonic")
    wanted_mean, wanted_cov = moments_on_grid(log_mean, GRID)
    sigma = np.sqrt(np.diag(wanted_cov))

    def apart(fused: FusedTracks) -> tuple[float, float]:
        unit = np.outer(sigma, sigma)
        return float(np.abs((fused.mean - wanted_mean) / sigma).max()), float(
            np.abs((fused.cov - wanted_cov) / unit).max()
        )

    joint, folded = run("harmonic_mean", tracks, **THREE), run("harmonic_mean", tracks, **THREE, combine="fold")
    error = 4.0 / np.sqrt(float(joint.info["ess"]) * SAMPLES)
    assert apart(joint)[0] <= error
    assert apart(joint)[1] <= 2 * error
    assert max(apart(folded)) > 2 * error
    assert joint.info["converged"]


@pytest.mark.parametrize("criterion", ["det", "trace", "given"])
def test_one_gaussian_for_the_denominator_of_three(criterion: str) -> None:
    """The closed form is that of densities/harmonic.py; the weights that are told are those of the mean, omega."""
    rule, given = get_rule("harmonic_mean"), THREE["weights"] if criterion == "given" else ()
    fused = rule(TRIPLE, from_dict(rule.params, {"criterion": criterion, "weights": given}))
    harmonic = HarmonicMean.of(TRIPLE.mean[None], TRIPLE.cov[None])
    assert fused.weights is not None
    assert fused.weights.sum() == pytest.approx(1.0)
    mean, cov = harmonic.at(harmonic.shares(fused.weights[None]))
    np.testing.assert_allclose(fused.mean, mean[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fused.cov, cov[0], rtol=1e-9)
    if criterion == "given":
        np.testing.assert_allclose(fused.weights, given, rtol=1e-12)


def test_for_two_joint_and_fold_are_the_same() -> None:
    for values in ({}, {"criterion": "trace"}, {"method": "sampling", "samples": 500}):
        rule = get_rule("harmonic_mean")
        joint, fold = (rule(GAUSSIANS, from_dict(rule.params, {**values, "combine": c})) for c in ("joint", "fold"))
        np.testing.assert_array_equal(joint.mean, fold.mean)
        np.testing.assert_array_equal(joint.cov, fold.cov)


# Samples that tell nothing.


@pytest.mark.parametrize("apart", [8.0, 1e4])
@pytest.mark.parametrize("places", [(0.0, 1.0), (0.0, 1.0, 6.0)])
def test_where_next_to_no_sample_counts_the_closed_form_takes_their_place(
    apart: float, places: tuple[float, ...]
) -> None:
    """Unit tracks so far apart: 28 of 5000 samples counted, or one, which claimed a variance of 1e-106."""
    count = len(places)
    tracks = SourceTracks(apart * np.array(places)[:, None] * [1.0, 0.0], np.tile(np.eye(2), (count, 1, 1)))
    closed = {"geometric_mean_sampling": "geometric_average", "harmonic_mean": "harmonic_mean"}
    for key in closed if apart > 8.0 else ["geometric_mean_sampling"]:
        fused, wanted = run(key, tracks), get_rule(closed[key])(tracks)
        assert fused.info["ess"] <= 0.01
        assert not fused.info["converged"]
        np.testing.assert_allclose(fused.mean, wanted.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(fused.cov, wanted.cov, rtol=1e-9, atol=1e-12)
        if apart > 8.0:
            np.testing.assert_allclose(run(key, tracks, inflation=2.0).cov, 2.0 * wanted.cov, rtol=1e-9, atol=1e-12)


def test_mixtures_fall_back_on_powers_of_components_and_on_moments() -> None:
    assert MIXTURES.mixture is not None
    far = dataclasses.replace(MIXTURES.mixture, mean=MIXTURES.mixture.mean + np.array([[[0.0, 0.0]], [[1e3, 0.0]]]))
    tracks = as_tracks(far)
    got = run("geometric_mean_sampling", tracks)
    wanted = get_rule("mixture_geometric")(tracks)
    assert not got.info["converged"]
    np.testing.assert_allclose(got.cov, wanted.cov, rtol=1e-9)
    assert got.mixture is not None
    assert got.mixture.count == 4
    got = run("harmonic_mean", tracks)
    rule = get_rule("harmonic_mean")
    wanted = rule(SourceTracks(tracks.mean, tracks.cov))
    assert not got.info["converged"]
    np.testing.assert_allclose(got.cov, wanted.cov, rtol=1e-9)


def test_in_a_batch_only_those_that_fail_are_replaced() -> None:
    far = GAUSSIANS.mean + np.array([[0.0, 0.0], [500.0, 0.0]])
    both = SourceTracks(np.stack([GAUSSIANS.mean, far]), np.stack([GAUSSIANS.cov] * 2))
    for key in ("geometric_mean_sampling", "harmonic_mean"):
        fused = run(key, both)
        np.testing.assert_array_equal(fused.info["converged"], [True, False])
        np.testing.assert_allclose(fused.cov[0], run(key, GAUSSIANS).cov, rtol=1e-12)
        np.testing.assert_array_equal(fused.info["ess"] > 0.01, [True, False])
