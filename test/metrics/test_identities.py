"""Identity measures against plain loops over their definitions, cases computed by hand, and bounded memory."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from oracles import tracking_scores

from track_fusion.association.assignment import distances
from track_fusion.metrics.identities import Identities, Scene, identities_of

Points = Mapping[int, Sequence[float]]
CUTOFF_M = 10.0


def scene(truth: Points, seen: Points) -> Scene:
    ids = [np.array(list(points), np.int64) for points in (truth, seen)]
    at = [np.array(list(points.values()), float).reshape(-1, 2) for points in (truth, seen)]
    return Scene(ids[0], ids[1], distances(*at))


def figures(scenes: Sequence[tuple[Points, Points]]) -> dict[str, Any]:
    return dict(identities_of([scene(*each) for each in scenes], CUTOFF_M).figures())


def crowd(seed: int, steps: int = 12) -> list[tuple[Points, Points]]:
    """Four targets that walk about in each other's reach; tracks that miss, swap, end and are born, and false ones."""
    rng = np.random.default_rng(seed)
    at, name, scenes = 8.0 * rng.normal(size=(4, 2)), {t: t + 10 for t in range(4)}, []
    for _ in range(steps):
        at = at + 3.0 * rng.normal(size=at.shape)
        if rng.random() < 0.3:
            a, b = rng.choice(4, 2, replace=False)
            name[a], name[b] = name[b], name[a]
        if rng.random() < 0.3:
            name[int(rng.integers(4))] = int(rng.integers(20, 23))
        truth = {t: tuple(at[t]) for t in range(4) if rng.random() < 0.9}
        seen: dict[int, Any] = {
            name[t]: tuple(at[t] + 2.0 * rng.normal(size=2)) for t in range(4) if rng.random() < 0.85
        }
        if rng.random() < 0.3:
            seen[30] = tuple(8.0 * rng.normal(size=2))
        scenes.append((truth, seen))
    return scenes


@pytest.mark.parametrize("seed", range(12))
def test_all_are_what_their_definitions_say(seed: int) -> None:
    scenes = crowd(seed)
    got = figures(scenes)
    wanted = tracking_scores.clear(scenes, CUTOFF_M) | tracking_scores.hota(scenes, CUTOFF_M)
    wanted["idf1"] = tracking_scores.idf1(scenes, CUTOFF_M)
    assert {name: got[name] for name in wanted} == pytest.approx(wanted, rel=1e-12)


def test_perfect_tracks_score_one() -> None:
    got = figures([({1: (k, 0), 2: (k, 50)}, {7: (k, 0), 8: (k, 50)}) for k in range(5)])
    assert (got["id_switches"], got["motp_m"]) == (0, 0.0)
    assert [got[name] for name in ("completeness", "mota", "idf1", "hota", "deta", "assa")] == [1.0] * 6


def test_one_switch_halfway_by_hand() -> None:
    """One target for 10 times, track 1 for 5, then track 2: both exactly on it."""
    got = figures([({1: (0, 0)}, {1 + (k >= 5): (0, 0)}) for k in range(10)])
    assert got["id_switches"] == 1
    assert got["mota"] == pytest.approx(1 - 1 / 10)
    assert got["idf1"] == pytest.approx(2 * 5 / (10 + 10))
    assert got["assa"] == pytest.approx(2 * (5 * 5 / (10 + 5 - 5)) / 10)  # each pair: 5 times, of 10 of either
    assert got["hota"] == pytest.approx(np.sqrt(1.0 * 0.5))


def test_misses_and_false_tracks_by_hand() -> None:
    """4 times a target and its track 4 m off; at two of these, only the target; once a false track beside."""
    far = {9: (100, 0)}
    got = figures([({1: (0, 0)}, {5: (4, 0)}), ({1: (0, 0)}, {}), ({1: (0, 0)}, {}), ({1: (0, 0)}, {5: (4, 0)} | far)])
    assert (got["completeness"], got["motp_m"]) == (0.5, 4.0)
    assert got["mota"] == pytest.approx(1 - (2 + 1 + 0) / 4)
    assert got["idf1"] == pytest.approx(2 * 2 / (4 + 3))
    # A similarity of .6 counts at 12 of the 19 levels.
    assert got["deta"] == pytest.approx(12 / 19 * 2 / (4 + 3 - 2))
    assert got["assa"] == pytest.approx(12 / 19 * 2 / (4 + 2 - 2))


def test_a_pair_stays_while_it_may() -> None:
    """Another track comes nearer: no switch until the first is out of reach."""
    got = figures([({1: (0, 0)}, {1: (3.0 * k, 0), 2: (0, 1)}) for k in range(5)])
    assert got["id_switches"] == 1


def test_a_gap_hides_no_switch() -> None:
    got = figures([({1: (0, 0)}, {1: (0, 0)}), ({1: (0, 0)}, {}), ({1: (0, 0)}, {2: (0, 0)})])
    assert got["id_switches"] == 1


def test_nothing_to_measure_is_none() -> None:
    got = figures([({}, {})])
    assert {got[name] for name in ("mota", "motp_m", "idf1", "hota", "deta", "assa", "completeness")} == {None}


def test_a_running_sum_says_the_same_where_no_pair_is_in_doubt() -> None:
    rng, running = np.random.default_rng(0), Identities(CUTOFF_M)
    home, scenes = np.array([[100.0 * k, 0.0] for k in range(6)]), []
    for k in range(40):
        truth = {t: tuple(home[t]) for t in range(6) if rng.random() < 0.9}
        seen = {10 + t + 6 * (k > 20): tuple(home[t] + rng.normal(size=2)) for t in range(6) if rng.random() < 0.9}
        scenes.append((truth, seen))
        running.add(scene(truth, seen))
    assert running.figures() == pytest.approx(figures(scenes), rel=1e-12)


def test_a_running_sum_is_near_the_definition_in_a_crowd() -> None:
    """The pairs of HOTA know the past only; all else is the same to the last digit."""
    for seed in range(12):
        scenes, running = crowd(seed, 60), Identities(CUTOFF_M)
        for each in scenes:
            running.add(scene(*each))
        got, wanted = dict(running.figures()), figures(scenes)
        for name in ("hota", "deta", "assa"):
            assert got.pop(name) == pytest.approx(wanted.pop(name), abs=0.03)
        assert got == wanted


def test_memory_is_flat_and_what_is_settled_counts() -> None:
    """Two targets with their tracks, new ones every 5 times: those settled are as good as those held."""
    running, sizes = Identities(CUTOFF_M), []
    for k in range(9000):
        ids = 2 * (k // 5) + np.arange(2)
        running.add(Scene(ids, ids + 7, np.where(np.eye(2) > 0, 0.0, 50.0)))
        if k in (6750, 8999):
            sizes.append(len(pickle.dumps(running)))
    assert sizes[1] <= 1.02 * sizes[0]
    got = running.figures()
    assert got["settled_targets"] == 2600
    assert [got[name] for name in ("completeness", "mota", "idf1", "hota", "assa")] == pytest.approx([1.0] * 5)


def test_one_target_with_ever_new_tracks_needs_no_more_memory() -> None:
    running, sizes = Identities(CUTOFF_M), []
    for k in range(12_000):
        running.add(Scene(np.array([1]), np.array([k]), np.zeros((1, 1))))
        if k % 100 == 99:
            sizes.append(len(pickle.dumps(running)))
    assert max(sizes[80:]) <= 1.02 * max(sizes[40:80])
    assert running.figures()["id_switches"] == 11_999
