"""Averages of mixtures: Fig. 7 of Li 2019, one component, weights of 0 and 1, reduction, PHDs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from densities.mixture.examples import draw
from rules.mixtures import as_tracks

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.rules import SourceTracks, get_rule

KEYS = ("mixture_average", "mixture_geometric", "mixture_hybrid")


def _figure_7() -> SourceTracks:
    """The two PHDs of Li 2019, 5.2; the second padded with a component of weight 0."""
    weight = np.array([[0.7, 0.6, 0.5], [0.9, 0.8, 0.0]])
    mean = np.array([[10.0, 50.0, 90.0], [11.0, 52.0, 0.0]])[..., None]
    return as_tracks(Mixture(weight, mean, np.array([[100.0, 100.0, 200.0], [100.0, 120.0, 1.0]])[..., None, None]))


def test_hybrid_components_of_figure_7() -> None:
    fused = get_rule("mixture_hybrid")(_figure_7())
    assert fused.mixture is not None
    got = np.column_stack([fused.mixture.weight, fused.mixture.mean[:, 0], fused.mixture.cov[:, 0, 0]])
    got = got[got[:, 0] > 0]
    wanted = [(0.7315, 10.5, 100), (0.0928, 29.09, 109.09), (0.1013, 30.5, 100),
              (0.6351, 50.91, 109.09), (0.0033, 37.33, 133.33), (0.1859, 66.25, 150)]  # fmt: skip
    np.testing.assert_allclose(got[np.argsort(got[:, 0])], sorted(wanted), rtol=2e-4, atol=6e-5)
    assert fused.mixture.weight.sum() == pytest.approx(1.75)


def test_average_and_geometric_components_of_figure_7() -> None:
    average = get_rule("mixture_average")(_figure_7()).mixture
    assert average is not None
    np.testing.assert_allclose(average.weight, [0.35, 0.3, 0.25, 0.45, 0.4, 0.0])
    hybrid, geometric = (get_rule(k)(_figure_7()).mixture for k in ("mixture_hybrid", "mixture_geometric"))
    assert hybrid is not None
    assert geometric is not None
    np.testing.assert_allclose(hybrid.weight, 1.75 * geometric.weight)


def test_one_component_gives_the_gaussian_rule() -> None:
    rng = np.random.default_rng(0)
    tracks = as_tracks(draw(rng, 5, 3, count=1))
    given = {"criterion": "given", "weights": (0.5, 0.2, 0.3)}
    for key, gaussian in (
        ("mixture_average", "arithmetic_average"),
        ("mixture_geometric", "covariance_intersection"),
        ("mixture_hybrid", "covariance_intersection"),
    ):
        ours, other = get_rule(key), get_rule(gaussian)
        got, wanted = ours(tracks, ours.params(**given)), other(tracks, other.params(**given))
        np.testing.assert_allclose(got.mean, wanted.mean, rtol=1e-9)
        np.testing.assert_allclose(got.cov, wanted.cov, rtol=1e-9)


@pytest.mark.parametrize("key", KEYS)
def test_weight_one_gives_the_source_back(key: str) -> None:
    rule, tracks = get_rule(key), as_tracks(draw(np.random.default_rng(1), 3))
    fused = rule(tracks, rule.params(criterion="given", weights=(0.0, 1.0, 0.0)))  # type: ignore[call-arg]
    np.testing.assert_allclose(fused.mean, tracks.mean[1], rtol=1e-12)
    np.testing.assert_allclose(fused.cov, tracks.cov[1], rtol=1e-12)


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("reduction", ["runnalls", "salmond", "cap"])
def test_reduction_keeps_what_it_promises(key: str, reduction: str) -> None:
    rule, tracks = get_rule(key), as_tracks(draw(np.random.default_rng(2), 6, 2, count=4))
    whole = rule(tracks)
    fused = rule(tracks, rule.params(max_components=3, reduction=reduction))  # type: ignore[call-arg]
    assert fused.mixture is not None
    assert whole.mixture is not None
    assert fused.mixture.count == 3
    np.testing.assert_allclose(fused.mixture.weight.sum(-1), whole.mixture.weight.sum(-1))
    if reduction != "cap":
        np.testing.assert_allclose(fused.mean, whole.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(fused.cov, whole.cov, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("key", ["mixture_geometric", "mixture_hybrid"])
def test_disjoint_mixtures_meet_halfway(key: str) -> None:
    """A thousand standard deviations apart, products of components underflow but for their logarithms."""
    part = Mixture(np.full((2, 2), 0.5), np.array([[[0.0], [1.0]], [[1e3], [1e3 + 2]]]), np.ones((2, 2, 1, 1)))
    fused = get_rule(key)(as_tracks(part))
    assert fused.mean[0] == pytest.approx(500.5, abs=1e-6)  # the two nearest components
    assert fused.cov[0, 0] == pytest.approx(1.0, abs=1e-6)


def test_particles_and_empty_mixtures_are_refused() -> None:
    tracks = as_tracks(draw(np.random.default_rng(3), 2))
    assert tracks.mixture is not None
    points = dataclasses.replace(tracks, mixture=dataclasses.replace(tracks.mixture, cov=np.zeros((2, 3, 2, 2))))
    with pytest.raises(ValueError, match="this rule does not take particles"):
        get_rule("mixture_average")(points)
    none = dataclasses.replace(tracks, mixture=dataclasses.replace(tracks.mixture, weight=np.zeros((2, 3))))
    with pytest.raises(ValueError, match="must not all be 0"):
        get_rule("mixture_geometric")(none)
