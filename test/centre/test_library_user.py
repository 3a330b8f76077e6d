"""A library user, who feeds scans and times, gets what the node publishes: waiting, coasting, superseded scans."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    ScanBufferParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

LAYOUT = planar_layout()
MS, SECOND = 10**6, 10**9
MAX_COAST_S, LOOK_NS = 3.0, 20 * MS


def fusion_centre(**buffer):
    """A centre that waits for all sources, unless told otherwise."""
    buffer = {"trigger": "all_sources"} | buffer
    rule, motion = RULES["covariance_intersection"], NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=5.0))
    manager = TrackManagerParams(confirmation_threshold=(1, 1), max_coast_s=MAX_COAST_S)
    sources, params = (SourceConfig("a"), SourceConfig("b")), FusionCentreParams(max_scan_age_s=0.3)
    waits, identity = ScanBufferParams(**buffer), IdentityParams("test")
    config = CentreConfig(sources, motion, "map", rule, rule.params(), params, manager, waits, identity=identity)
    return FusionCentre(config)


def scan(time_ns, x=0.0):
    mean = np.array([[x, 0.0, 1.0, 0.0]])
    return TrackBatch.gaussian(LAYOUT, "map", mean, np.eye(4)[None], time_ns=time_ns)


def test_when_all_sources_are_silent_the_tracks_coast_and_are_deleted():
    """As through the node, which looks at the time every 20 ms."""
    own, published = fusion_centre(source_timeout_s=0.5), []
    for now_ns in range(SECOND, 10 * SECOND, LOOK_NS):
        if now_ns <= 2 * SECOND and now_ns % (100 * MS) == 0:
            for source in (0, 1):
                assert own.receive(source, scan(now_ns, now_ns / SECOND), now_ns, now_ns) is None
        published += own.advance(now_ns)
    fused, tail = published[:11], published[10:]
    assert [p.time_ns for p in fused] == list(range(SECOND, 2 * SECOND + 1, 100 * MS))
    assert [p.tracks.source.tolist() for p in fused] == [[3]] * 11
    assert [p.time_ns - 2 * SECOND for p in tail] == list(range(0, round(MAX_COAST_S * SECOND) + SECOND, SECOND // 2))
    assert [p.tracks.status.tolist() for p in tail] == [[1], *[[3]] * (len(tail) - 2), []]
    assert all(np.diff([np.linalg.det(p.tracks.cov[0, 0]) for p in tail[:-1]]) > 0)
    np.testing.assert_allclose([p.tracks.mean[0, 0, 0] for p in tail[:-1]], [p.time_ns / SECOND for p in tail[:-1]])
    assert tail[-1].info.changes.deleted.tolist() == [1]
    assert len(own.tracks) == 0  # and nothing more is published


def test_silence_of_a_source_is_told_and_not_waited_for():
    own = fusion_centre(source_timeout_s=0.5, fusion_timeout_s=0.2)
    assert own.buffer.silence_s(0, SECOND) == -1.0
    own.receive(0, scan(SECOND), SECOND, SECOND)
    assert [p.time_ns for p in own.advance(SECOND)] == []
    assert [p.time_ns for p in own.advance(SECOND + 200 * MS)] == [SECOND]
    assert own.buffer.silence_s(1, SECOND + 300 * MS) == pytest.approx(0.3)
    own.receive(0, scan(SECOND + 600 * MS), SECOND + 600 * MS, SECOND + 600 * MS)
    assert [p.time_ns for p in own.advance(SECOND + 600 * MS)] == [SECOND + 600 * MS]


def test_scans_that_are_turned_away_and_superseded_are_told():
    own = fusion_centre(fusion_timeout_s=0.05)
    assert own.receive(0, scan(100 * MS), 100 * MS, 100 * MS) is None
    assert own.receive(0, scan(100 * MS), 100 * MS, 101 * MS) == "duplicate_scan"
    assert [p.kept_out for p in own.advance(150 * MS)] == [{}]
    for stamp in (90, 95, 100):
        assert own.receive(1, scan(stamp * MS), stamp * MS, 160 * MS) is None
    (result,) = own.advance(210 * MS)
    assert (result.time_ns, result.kept_out) == (100 * MS + 1, {"superseded_scan": 2})


def test_a_step_of_ones_own_counts_for_the_buffer():
    own = fusion_centre(trigger="any_source")
    own.step(SECOND, {0: scan(SECOND)})
    own.receive(1, scan(900 * MS), 900 * MS, SECOND)
    assert list(own.advance(SECOND)) == []
    assert own.wake_ns(SECOND + 50 * MS) == SECOND + 100 * MS
    (result,) = own.advance(SECOND + 100 * MS)
    assert (result.time_ns, result.tracks.source.tolist()) == (SECOND + 1, [3])


def test_a_second_centre_behind_the_first_loses_nothing():
    """Two sources of 10 and 30 Hz, each late by its own delay, the slow one sometimes by more than a period."""
    first, second, arrivals = fusion_centre(trigger="any_source"), fusion_centre(trigger="any_source"), []
    for k in range(90):
        stamp = SECOND + k * SECOND // 30
        arrivals.append((stamp + 3 * MS, 1, stamp))
        if k % 3 == 0:
            arrivals.append((stamp + (45 if k % 2 else 2) * MS, 0, stamp))
    published, taken = [], []
    for now, source, stamp in sorted(arrivals):
        assert first.receive(source, scan(stamp), stamp, now) is None
        for result in first.advance(now):
            published.append(result)
            assert second.receive(0, result.tracks, result.time_ns, now) is None
            taken += second.advance(now)
    published += first.advance(5 * SECOND)
    assert len(published) > 85
    assert [p.time_ns for p in taken] == [p.time_ns for p in published[: len(taken)]]
    assert all(not p.kept_out for p in taken)
    assert all(np.diff([p.time_ns for p in published]) > 0)


def test_what_is_published_at_the_time_of_the_clock_is_predicted_to_it():
    own, at_stamp = fusion_centre(trigger="any_source", publish_at="now"), fusion_centre(trigger="any_source")
    for centre in (own, at_stamp):
        centre.receive(0, scan(SECOND, 7.0), SECOND, SECOND + 50 * MS)
    (now,), (then,) = own.advance(SECOND + 50 * MS), at_stamp.advance(SECOND + 50 * MS)
    assert (now.time_ns, then.time_ns) == (SECOND + 50 * MS, SECOND)
    assert now.tracks.time_ns.tolist() == [SECOND + 50 * MS]
    np.testing.assert_allclose(now.tracks.mean[0, 0], [7.05, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(now.tracks.cov[0, 0, 0, 0], 1 + 0.05**2 + 5.0 * 0.05**3 / 3)
    np.testing.assert_array_equal(own.tracks.mean, at_stamp.tracks.mean)  # the state stays at its own time


def test_a_small_backward_step_of_the_clock_is_ridden_out():
    own, published = fusion_centre(trigger="any_source"), []
    for k in range(40):
        now = SECOND + k * 10 * MS - (25 * MS if k >= 20 else 0)
        assert own.receive(k % 2, scan(now), now, now) in (None, "duplicate_scan", "out_of_order_scan")
        published += own.advance(now)
    assert own.resets == 0
    assert {i for p in published for i in p.tracks.track_id.tolist()} == {1}
    assert published[-1].time_ns == SECOND + 365 * MS


def test_a_large_one_starts_anew_and_identifiers_go_on_counting():
    own = fusion_centre(trigger="any_source")
    for now, resets, ids in [(5 * SECOND, 0, [1]), (5 * SECOND - 101 * MS, 1, [2]), (SECOND, 2, [3])]:
        assert own.receive(0, scan(now), now, now) is None
        (result,) = own.advance(now)
        assert (own.resets, result.tracks.track_id.tolist(), result.time_ns) == (resets, ids, now)
    own.reset()
    assert (own.resets, own.state.central.identities.births, own.buffer.silence_s(0, SECOND)) == (2, 4, -1.0)


def test_a_result_is_made_when_it_is_asked_for():
    own = fusion_centre(trigger="any_source")
    for k in (1, 2):
        own.receive(0, scan(k * SECOND), k * SECOND, 2 * SECOND)
    results = own.advance(2 * SECOND)
    assert next(results).time_ns == own.state.time_ns == SECOND
    assert next(results).time_ns == own.state.time_ns == 2 * SECOND
    with pytest.raises(StopIteration):
        next(results)


def test_what_was_kept_can_be_set_again():
    own, kept, results = fusion_centre(trigger="any_source"), [], []
    for k in range(1, 6):
        kept.append((own.history, own.buffer))
        own.receive(k % 2, scan(k * SECOND, k), k * SECOND, k * SECOND)
        results += own.advance(k * SECOND)
    own.history, own.buffer = kept[2]
    for k in range(3, 6):
        own.receive(k % 2, scan(k * SECOND, k), k * SECOND, k * SECOND)
        (again,) = own.advance(k * SECOND)
        np.testing.assert_array_equal(again.tracks.mean, results[k - 1].tracks.mean)
        np.testing.assert_array_equal(again.tracks.cov, results[k - 1].tracks.cov)


def test_the_example_of_the_page_runs():
    page = (Path(__file__).parents[2] / "doc" / "fusion-centre.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(code, {})
    lines = out.getvalue().splitlines()
    assert lines[0] == "0.0 [] [] []"  # tentative
    assert [line.split()[0] for line in lines[18:]] == ["1.8", "1.9", "2.9", "3.9", "4.9"]
    assert lines[19] == "1.9 [1] [1.9] [False]"
    assert lines[20] == "2.9 [1] [2.9] [ True]"  # it coasts
    assert len(lines) == 23


def test_the_page_names_every_module_of_the_room():
    root = Path(__file__).parents[2]
    page = (root / "doc" / "fusion-centre.md").read_text(encoding="utf-8")
    modules = {path.name for path in (root / "track_fusion" / "centre").iterdir() if path.suffix == ".py"}
    named = set(re.findall(r"`(\w+\.py)`", page))
    assert modules - named <= {"__init__.py", "centre.py"}
    assert named <= modules
