"""Identities with default parameters: no ghosts, no change, in scenes of trackers whose errors persist."""

import numpy as np
import pytest

from benchmark import identity, scenes
from benchmark.identity import Score, centre_of, score, side_by_side, single_gate, table
from track_fusion.tracks import TrackBatch, planar_layout

SECOND = 10**9
BOTH_TRIGGERS = pytest.mark.parametrize("staggered", [False, True], ids=["all_sources", "any_source"])


def keeps(result: Score, targets: int) -> bool:
    return result.ids == targets and result.ghosts <= 0.01


@BOTH_TRIGGERS
@pytest.mark.parametrize("sd", [1.0, 2.0, 4.0, 8.0])
def test_consistent_trackers_make_no_ghosts(sd, staggered):
    made = side_by_side(np.random.default_rng(3), staggered, (1.0, sd), seconds=12.0)
    assert keeps(score(made), 20)


@BOTH_TRIGGERS
@pytest.mark.parametrize("share", [4, 16])
def test_a_covariance_told_too_small_makes_no_ghosts(share, staggered):
    made = side_by_side(np.random.default_rng(4), staggered, seconds=12.0, claim=1.0 / share)
    assert keeps(score(made), 20)
    assert not keeps(score(made, **single_gate(0.99)), 20)


@BOTH_TRIGGERS
@pytest.mark.parametrize("change", ["restart", "shuffled"])
def test_new_and_shuffled_ids_of_a_source_change_no_central_id(change, staggered):
    rng = np.random.default_rng(5)
    how = {"restart": 30} if change == "restart" else {"second": lambda told: scenes.shuffled(rng, told)}
    result = score(side_by_side(rng, staggered, seconds=12.0, **how))
    assert (result.ids, result.ghosts, result.switches) == (20, 0.0, 0)


@BOTH_TRIGGERS
@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("sds", [(1.0, 1.0), (0.3, 1.0)])
def test_crossing_targets_keep_their_ids(sds, swap, staggered):
    for seed in range(3):
        made = identity.crossed(np.random.default_rng(seed), staggered, 4.0, sds, swap)
        assert identity.is_right(score(made), 2)


#: The benchmark makes all draws.
DRAWS = 10


@pytest.mark.slow
@pytest.mark.parametrize("name", table())
def test_a_row_of_the_table_is_as_wanted(name):
    row = table()[name]
    results = [
        score(row.make(np.random.default_rng(draw), False), **row.params) for draw in range(min(row.draws, DRAWS))
    ]
    targets = int(results[0].living[0])
    if row.draws > 1:
        assert np.mean([identity.is_right(result, targets) for result in results]) >= 0.99
    else:
        assert results[0].ghosts <= 0.01


def one(x: float, variance: tuple[float, ...], time_ns: int, track_id: int = 0) -> TrackBatch:
    mean = np.array([[x, 0.0, 0.0, 0.0]])
    return TrackBatch.gaussian(
        planar_layout(), "map", mean, np.diag(variance)[None], time_ns=time_ns, track_id=np.array([track_id])
    )


def test_a_source_that_strays_for_a_while_makes_no_second_track():
    """FIELD pain 16."""
    centre, published = centre_of(), []
    for k in range(60):
        x, time_ns = (0.0 if k < 10 else 8.0 if k < 13 else 5.0), (k + 1) * SECOND // 10
        scans = {0: one(0.0, (0.1,) * 4, time_ns), 1: one(x, (4.0, 4.0, 1.0, 1.0), time_ns)}
        published.append(len(centre.step(time_ns, scans)[0]))
    assert max(published) == 1


def test_a_source_that_splits_a_target_gives_one_track():
    """FIELD pain 18: two at first, one as soon as they have stayed together for three steps."""
    centre = centre_of(merge_duplicates="also_within_a_source")
    variance = (1.0, 1.0, 0.1, 0.1)
    for k in range(30):
        time_ns = (k + 1) * SECOND // 10
        twice = TrackBatch.concatenate([one(0.0, variance, time_ns, 1), one(0.3, variance, time_ns, 2)])
        fused, info = centre.step(time_ns, {0: twice, 1: one(0.1, variance, time_ns)})
        assert len(info.merged) == (k == 2)
    assert len(fused) == 1
    assert len(centre.tracks) == 1


def test_patience_counts_updates_and_then_a_track_may_start():
    centre = centre_of(patience=3)
    for k in range(1, 10):
        time_ns = k * SECOND // 10
        scans = {0: one(0.0, (0.1,) * 4, time_ns), 1: one(0.0 if k < 4 else 100.0, (0.1,) * 4, time_ns)}
        _, info = centre.step(time_ns, scans)
        assert (info.held, info.released) == (int(4 <= k < 7), int(k == 7))
        assert len(centre.tracks) == 1 + (k >= 7)
