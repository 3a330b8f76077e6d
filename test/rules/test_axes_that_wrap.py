"""Directions through every rule: what the contract cannot say in general, by examples and independent averages."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from track_fusion.angles import TURN, difference
from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.peers import by_rule
from track_fusion.rules import RULES, Mixture, Rule, SourceTracks
from track_fusion.rules.trials import Case

EVERY_RULE = pytest.mark.parametrize("rule", RULES.own.values(), ids=RULES.own)
#: A position and a yaw.
PERIODS = (np.inf, TURN)
COV = np.diag([1.0, 0.00122])


def tracks_of(rule: Rule, mean: Array, cov: Array = COV) -> SourceTracks:
    """Tracks (K, 2) of one covariance, with what the rule needs; the needs are made about the first yaw."""
    about = np.array([0.0, mean[0, 1]])
    flat = np.where(np.isfinite(PERIODS), difference(mean, about, PERIODS), mean)
    dof = np.full(len(mean), 5.0) if rule.family == "elliptical" else None
    plain = SourceTracks(flat, np.tile(cov, (len(mean), 1, 1)), dof)
    equipped = Case(rule, rule.example, {}, len(mean)).equipped(plain)
    extras = {
        name: dataclasses.replace(value, mean=value.mean + about) if isinstance(value, Mixture) else value
        for name, value in equipped.extras.items()
    }
    return dataclasses.replace(equipped, mean=mean, extras=extras, periods=PERIODS)


@EVERY_RULE
def test_two_headings_near_the_seam_have_their_mean_on_it(rule: Rule) -> None:
    fused = rule(tracks_of(rule, np.array([[10.0, 3.12414], [10.0, -3.12414]])))
    sampled = 0.05 if "ess" in fused.info else 1e-9  # standard deviations
    assert fused.mean[0] == pytest.approx(10.0, abs=sampled)
    assert abs(fused.mean[1]) == pytest.approx(np.pi, abs=0.01745 + 1e-6)  # a rule may choose one of the two
    if rule.guarantee == "conservative":
        assert abs(fused.mean[1]) == pytest.approx(np.pi, abs=1e-6)


@EVERY_RULE
def test_tracks_at_the_seam_give_what_they_give_at_zero_turned(rule: Rule) -> None:
    near, far = np.array([[10.0, -0.01], [10.5, 0.01]]), np.array([[10.0, np.pi - 0.01], [10.5, 0.01 - np.pi]])
    here, there = rule(tracks_of(rule, near)), rule(tracks_of(rule, far))
    np.testing.assert_allclose(difference(there.mean, here.mean, PERIODS) @ [[1, 0], [0, 0]], 0.0, atol=1e-9)
    assert abs(difference(there.mean, here.mean, PERIODS)[1]) == pytest.approx(np.pi, abs=1e-9)
    np.testing.assert_allclose(there.cov, here.cov, rtol=1e-9, atol=1e-12)


@EVERY_RULE
def test_tracks_without_a_mean_direction_are_fused_about_the_most_certain_and_flagged(rule: Rule) -> None:
    """At 0 (the most certain), 2 and -2 the spread is 4 > pi; turned by anything the result turns with them."""
    tracks = tracks_of(rule, np.array([[0.0, 2.0], [0.0, 0.0], [0.0, -2.0]]))
    sharper = np.array([1.0, 0.9, 1.0])[:, None, None] * tracks.cov
    needs = Case(rule, rule.example, {}, 3).equipped(dataclasses.replace(tracks, cov=sharper))
    fused = rule(needs)
    flat = rule(dataclasses.replace(needs, periods=()))  # as they stand they lie about the most certain already
    assert fused.info["beyond_half_circle"].all()
    np.testing.assert_allclose(difference(fused.mean, flat.mean, PERIODS), 0.0, atol=1e-9)
    np.testing.assert_allclose(fused.cov, flat.cov, rtol=1e-9)


def test_what_lies_within_a_half_circle_is_told_from_what_does_not() -> None:
    mean = np.zeros((3, 2, 2))
    mean[:, 1, 1] = [np.pi - 2e-6, np.pi - 0.5e-6, np.pi + 2e-6]
    fused = RULES["covariance_intersection"](SourceTracks(mean, np.tile(COV, (3, 2, 1, 1)), periods=PERIODS))
    assert fused.info["beyond_half_circle"].tolist() == [False, True, False]


def test_components_stay_with_their_track() -> None:
    """A heading that may be opposite, beside a sharp one at the seam: moments and mixture are of one piece."""
    weight = np.array([[0.9, 0.1], [1.0, 0.0]])
    mean = np.array([[[0.0, 3.0], [0.0, 3.0 + 2.5]], [[0.0, -3.1], [0.0, 0.0]]])
    tracks = SourceTracks.of(Mixture(weight, mean, np.tile(COV, (2, 2, 1, 1))), PERIODS)
    rule = RULES["mixture_average"]
    fused = rule(tracks, from_dict(rule.params, {"criterion": "given", "weights": (0.5, 0.5)}))
    assert fused.mixture is not None
    angle, share = fused.mixture.mean[:, 1], fused.mixture.weight
    # Unrolled by hand: 3, 5.5 of the first track, 2 pi - 3.1 of the second.
    unrolled = 0.45 * 3.0 + 0.05 * 5.5 + 0.5 * (TURN - 3.1)
    assert difference(fused.mean, [0.0, unrolled], PERIODS)[1] == pytest.approx(0.0, abs=1e-12)
    assert (np.abs(angle) <= np.pi).all()
    assert share.sum() == pytest.approx(1.0)


def test_tracks_in_utm_keep_their_digits() -> None:
    """Fused at a northing of 4e6 m the positions are those at the origin, to the last place."""
    rng = np.random.default_rng(3)
    mean = np.round(rng.normal(size=(50, 2, 2)), 6)
    cov = np.tile(1e-4 * COV, (50, 2, 1, 1))
    cov[:, 1, 0, 0] *= 2.0
    here = RULES["covariance_intersection"](SourceTracks(mean, cov, periods=PERIODS))
    there = RULES["covariance_intersection"](SourceTracks(mean + [4e6, 0.0], cov, periods=PERIODS))
    np.testing.assert_allclose(
        there.mean[..., 0] - 4e6, here.mean[..., 0], atol=2e-9
    )  # spacing of doubles at 4e6: 5e-10


def test_peers_fuse_directions() -> None:
    own, heard = (Mixture(np.ones(1), np.array([[10.0, a]]), COV[None]) for a in (3.12414, -3.12414))
    fused = by_rule(RULES["covariance_intersection"], periods=PERIODS)(own, heard, None, 0)
    assert abs(fused.mean[0, 1]) == pytest.approx(np.pi, abs=1e-6)


def test_without_axes_that_wrap_nothing_is_touched() -> None:
    """Infinite periods are no periods: the result is that of the function itself, bit for bit, without the flag."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(20, 3, 4, 6))
    tracks = SourceTracks(1e6 * rng.normal(size=(20, 3, 4)), root @ np.swapaxes(root, -1, -2), periods=(np.inf,) * 4)
    rule = RULES["covariance_intersection"]
    fused, plain = rule(tracks), rule.fuse(tracks, rule.params())
    np.testing.assert_array_equal(fused.mean, plain.mean)
    np.testing.assert_array_equal(fused.cov, plain.cov)
    assert "beyond_half_circle" not in fused.info
