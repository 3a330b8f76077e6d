"""track-fusion fuse with named axes: directions wrap, and numbers that look like them are told of."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from cli.runner import refusal, run, strict_json

from track_fusion.rules import RULES

COV = [[1.0, 0.0], [0.0, 0.00122]]
PAIR = [{"mean": [10.0, 3.12414], "cov": COV}, {"mean": [10.0, -3.12414], "cov": COV}]
PLAIN = [key for key, rule in RULES.own.items() if not rule.needed(rule.params())]


def fuse(rule: str = "covariance_intersection", **given: Any) -> tuple[Any, str]:
    """Return the answer, and what was said beside it."""
    result = run("fuse", "--rule", rule, stdin=json.dumps({"tracks": PAIR, **given}))
    assert result.exit_code == 0, result.stderr
    return strict_json(result.stdout), result.stderr


@pytest.mark.parametrize("rule", PLAIN)
def test_headings_at_the_seam_have_their_mean_there(rule: str) -> None:
    answer, said = fuse(rule, axes=["x", "yaw"])
    assert said == ""
    assert abs(answer["mean"][1]) >= 3.12413
    assert answer["info"]["beyond_half_circle"] is False


@pytest.mark.parametrize("given", [{"axes": ["x", "heading"]}, {"axes": ["x", "psi"], "angular": ["psi"]}])
def test_known_names_wrap_and_others_that_are_named(given: Any) -> None:
    answer, _ = fuse(**given)
    assert answer["mean"] == [pytest.approx(10.0), pytest.approx(-np.pi)]


def test_boxes_whose_front_is_unknown_have_the_mean_of_their_sides() -> None:
    tracks = [{"mean": [0.0, yaw], "cov": COV} for yaw in (1.0, 1.0 - np.pi)]
    answer, said = fuse(tracks=tracks, axes=["x", "yaw"], angular=["yaw:pi"])
    assert (answer["mean"], said) == ([0.0, pytest.approx(1.0)], "")
    assert answer["info"]["beyond_half_circle"] is False


def test_opposite_headings_are_flagged() -> None:
    tracks = [{"mean": [0.0, yaw], "cov": COV} for yaw in (0.0, 3.141592)]
    assert fuse(tracks=tracks, axes=["x", "yaw"])[0]["info"]["beyond_half_circle"] is True


def test_components_on_both_sides_of_the_seam_are_merged_there() -> None:
    halves = [{"weight": 0.5, "mean": [0.0, yaw], "cov": COV} for yaw in (3.1, -3.1)]
    answer, _ = fuse("naive", tracks=[{"components": halves}], axes=["x", "yaw"])
    assert abs(answer["mean"][1]) == pytest.approx(np.pi)
    assert answer["cov"][1][1] == pytest.approx(0.00122 + (np.pi - 3.1) ** 2)


def test_numbers_that_look_like_angles_are_told_of() -> None:
    answer, said = fuse()
    assert answer["mean"][1] == pytest.approx(0.0)  # as it was said: plain numbers
    assert said == (
        'Note: the numbers of axis 1 look like angles; name the axes by "axes" if they are, so that they wrap.\n'
    )


@pytest.mark.parametrize(
    "given",
    [
        {"axes": ["x", "y"]},  # named: they are none
        {"tracks": [{"mean": [0.0, 2.0], "cov": COV}, {"mean": [0.0, -2.0], "cov": COV}]},  # not near on the circle
        {"tracks": [{"mean": [0.0, 6.2], "cov": COV}, {"mean": [0.0, 6.0], "cov": COV}]},  # less than a half turn apart
        {"tracks": [{"mean": [0.0, 9.0], "cov": COV}, {"mean": [0.0, 9.0 - 2 * np.pi], "cov": COV}]},  # beyond a turn
        {"tracks": [{"mean": [x, 0.0], "cov": [[4.0, 0.0], [0.0, 1.0]]} for x in (3.1, -3.1)]},  # near as they stand
    ],
)  # fmt: skip
def test_other_numbers_are_not(given: Any) -> None:
    assert fuse(**given)[1] == ""


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"axes": ["x"]}, "axes: must be a list of 2 names, one an axis of tracks[0]; got 1"),
        ({"axes": ["x", 3]}, "axes[1]: must be a name; got 3"),
        ({"axes": ["x", "x"]}, 'axes: must be distinct names; got ["x", "x"]'),
        ({"angular": ["psi"]}, "axes: is missing; 'angular' names some of them"),
        ({"axes": ["x", "psi"], "angular": ["phi"]}, 'angular[0]: must be one of the axes x, psi; got "phi"'),
        ({"axes": ["x", "psi"], "angular": ["psi:2"]}, 'angular[0]: must be one of the axes x, psi; got "psi:2"'),
        ({"axes": ["x", "psi"], "angular": ["psi", "psi:pi"]}, 'angular[1]: names psi once more; got "psi:pi"'),
    ],
)
def test_wrong_names_are_refused(given: Any, line: str) -> None:
    assert refusal(run("fuse", "--rule", "naive", stdin=json.dumps({"tracks": PAIR, **given}))) == line
