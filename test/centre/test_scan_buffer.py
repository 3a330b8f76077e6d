"""When a step runs and what belongs to it: every policy, every reason, any order of arrival."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from track_fusion.centre import buffer as functions
from track_fusion.centre.buffer import ScanBuffer
from track_fusion.centre.config import CentreConfig, ScanBufferParams, SourceConfig
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

MS = 10**6
LAYOUT = planar_layout()


def scan(*ids):
    count = len(ids)
    return TrackBatch.gaussian(
        LAYOUT, "map", np.zeros((count, 4)), np.tile(np.eye(4), (count, 1, 1)), track_id=np.array(ids, np.int64)
    )


class Held:
    """Holds a buffer, a value, from call to call."""

    def __init__(self, assembles, params):
        sources = tuple(SourceConfig(str(k), assembles=a) for k, a in enumerate(assembles))
        motion, rule = NearlyConstantVelocity(LAYOUT, MotionParams()), RULES["naive"]
        self.config = CentreConfig(sources, motion, "map", rule, rule.params(), buffer=params)
        self.reset()

    def reset(self):
        self.value = ScanBuffer.empty(self.config)

    def add(self, source, scan, stamp_ns, now_ns):
        self.value, reason = functions.add(self.config, self.value, source, scan, stamp_ns, now_ns)
        return reason

    def pop(self, now_ns, living=False):
        self.value, step = functions.advance(self.config, self.value, now_ns, living)
        return step

    def silent_since(self, source, now_ns):
        return self.value.silence_s(source, now_ns)

    def all_silent(self, now_ns):
        return functions.all_silent(self.config, self.value, now_ns)


def buffer(sources=2, assembles=(), **params):
    return Held([k in assembles for k in range(sources)], ScanBufferParams(**params))


def add(buf, source, stamp_ms, now_ms, *ids):
    return buf.add(source, scan(*(ids or (source * 10_000 + stamp_ms,))), stamp_ms * MS, now_ms * MS)


def steps(buf, now_ms):
    """Everything that may run now: (time in ms, {source: track ids})."""
    found = []
    while (ready := buf.pop(now_ms * MS)) is not None:
        time_ns, scans, _ = ready
        found.append((time_ns // MS, {k: s.track_id.tolist() for k, s in scans.items()}))
    return found


def times(buf, now_ms):
    return [t for t, _ in steps(buf, now_ms)]


def test_waits_for_every_source_then_runs_at_the_stamp():
    buf = buffer()
    assert add(buf, 0, 100, 101) is None
    assert steps(buf, 101) == []
    add(buf, 1, 100, 105)
    assert steps(buf, 105) == [(100, {0: [100], 1: [10_100]})]
    assert steps(buf, 105) == []


def test_a_later_scan_of_a_source_also_ends_the_wait():
    buf = buffer()
    add(buf, 0, 100, 101)
    add(buf, 1, 130, 131)
    assert steps(buf, 131) == [(100, {0: [100]})]
    add(buf, 0, 130, 133)
    assert steps(buf, 133) == [(130, {0: [130], 1: [10_130]})]


def test_any_source_does_not_wait_but_takes_what_has_come():
    buf = buffer(trigger="any_source")
    add(buf, 0, 100, 101)
    assert times(buf, 101) == [100]
    add(buf, 1, 200, 201)
    add(buf, 0, 200, 201)
    assert steps(buf, 201) == [(200, {0: [200], 1: [10_200]})]


def test_a_scan_waits_no_longer_than_the_timeout():
    buf = buffer(fusion_timeout_s=0.05)
    add(buf, 0, 100, 110)
    assert times(buf, 159) == []
    assert times(buf, 160) == [100]


@pytest.mark.parametrize("first", [0, 1])
def test_of_scans_of_one_stamp_the_first_to_come_starts_the_wait(first):
    buf = buffer(3, fusion_timeout_s=0.05)
    add(buf, first, 100, 110)
    add(buf, 1 - first, 100, 150)
    assert times(buf, 159) == []
    assert times(buf, 160) == [100]


def test_a_late_scan_of_the_stamp_of_the_last_step_runs_another():
    buf = buffer(fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert steps(buf, 150) == [(100, {0: [100]})]
    add(buf, 1, 100, 160)
    assert steps(buf, 160) == [(100, {1: [10_100]})]


def test_a_silent_source_is_not_waited_for_until_it_speaks_again():
    buf = buffer(fusion_timeout_s=10.0, source_timeout_s=1.0)
    add(buf, 0, 100, 100)
    assert times(buf, 1099) == []
    add(buf, 0, 1100, 1100)
    assert times(buf, 1100) == [100, 1100]  # source 1 was never heard, for a second since the first scan of any
    add(buf, 1, 1100, 1150)
    assert times(buf, 1150) == [1100]
    add(buf, 0, 1200, 1200)
    assert times(buf, 1200) == []
    add(buf, 1, 1200, 1210)
    assert times(buf, 1210) == [1200]


def test_silence_is_told():
    buf = buffer(source_timeout_s=1.0)
    assert buf.silent_since(0, 5000 * MS) == -1.0
    assert not buf.all_silent(5000 * MS)
    add(buf, 0, 5000, 5000)
    add(buf, 0, 5400, 5400)
    assert buf.silent_since(0, 6000 * MS) == pytest.approx(0.6)
    assert buf.silent_since(1, 6000 * MS) == pytest.approx(1.0)
    assert not buf.all_silent(6000 * MS)
    assert buf.all_silent(6400 * MS)


def test_scans_are_turned_away_by_reason_and_leave_no_trace():
    buf = buffer(max_delay_s=0.5)
    add(buf, 0, 1000, 1000)
    assert add(buf, 0, 1000, 1001) == "duplicate_scan"
    assert add(buf, 0, 900, 1002) == "out_of_order_scan"
    assert add(buf, 1, 501, 1002) == "stale_scan"
    assert add(buf, 1, 502, 1002) is None
    assert steps(buf, 1002) == [(502, {1: [10_502]})]
    add(buf, 1, 1000, 1003)
    assert steps(buf, 1003) == [(1000, {0: [1000], 1: [11_000]})]


def test_a_scan_before_the_last_step_is_neglected():
    buf = buffer(out_of_sequence="neglect", fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 150) == [100]
    assert add(buf, 1, 90, 160) == "late_scan"
    assert steps(buf, 10_000) == []
    assert add(buf, 1, 100, 170) is None  # of the very time: not late


def test_or_kept_as_its_sources_newest_and_fused_at_the_time_of_the_last_step():
    buf = buffer(out_of_sequence="predict", fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 150) == [100]
    assert add(buf, 1, 90, 160) is None
    assert times(buf, 209) == []  # its source may still bring one of time 100
    assert steps(buf, 210) == [(100, {1: [10_090]})]
    assert add(buf, 1, 80, 211) == "out_of_order_scan"


def test_a_newer_scan_supersedes_a_late_one_of_its_source_and_is_counted():
    buf = buffer(fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 150) == [100]
    add(buf, 1, 90, 160)
    add(buf, 1, 95, 161)
    add(buf, 1, 100, 162)
    time_ns, scans, superseded = buf.pop(162 * MS)
    assert (time_ns, list(scans), scans[1].track_id.tolist()) == (100 * MS, [1], [10_100])
    assert superseded == {"superseded_scan": 2}


def test_the_time_of_steps_never_goes_back():
    buf = buffer(3, fusion_timeout_s=0.01)
    add(buf, 0, 100, 100)
    assert times(buf, 110) == [100]
    add(buf, 1, 50, 111)
    add(buf, 2, 70, 112)
    add(buf, 0, 120, 113)
    assert times(buf, 10_000) == [100, 120]


def test_pieces_of_one_stamp_make_one_scan_that_a_later_stamp_completes():
    buf = buffer(1, assembles=(0,))
    for i in (7, 8, 9):
        assert add(buf, 0, 100, 100, i) is None
        assert steps(buf, 100) == []
    assert add(buf, 0, 100, 100, 8) == "duplicate_track_id"
    add(buf, 0, 200, 200, 7)
    assert steps(buf, 200) == [(100, {0: [7, 8, 9]})]


@pytest.mark.parametrize("trigger", ["all_sources", "any_source"])
def test_pieces_wait_no_longer_than_the_timeout_and_come_too_late_after_it(trigger):
    buf = buffer(1, assembles=(0,), fusion_timeout_s=0.05, trigger=trigger)
    add(buf, 0, 100, 100, 7)
    add(buf, 0, 100, 130, 8)
    assert times(buf, 149) == []
    assert steps(buf, 150) == [(100, {0: [7, 8]})]
    assert add(buf, 0, 100, 151, 9) == "late_scan"


def test_pieces_that_were_fused_are_not_waited_for_again():
    buf = buffer(assembles=(1,), fusion_timeout_s=0.05)
    add(buf, 1, 100, 100, 5)
    assert times(buf, 150) == [100]
    add(buf, 0, 100, 151)
    assert steps(buf, 151) == [(100, {0: [100]})]


def test_the_step_of_a_whole_scan_waits_for_the_pieces_of_another_source():
    buf = buffer(2, assembles=(1,), trigger="any_source")
    add(buf, 1, 100, 100, 5)
    add(buf, 0, 100, 100)
    assert steps(buf, 100) == []
    add(buf, 1, 100, 101, 6)
    add(buf, 1, 110, 111, 5)
    assert steps(buf, 111) == [(100, {0: [100], 1: [5, 6]})]


def test_forgets_everything_when_the_clock_jumps_back():
    buf = buffer(assembles=(1,))
    add(buf, 0, 5000, 5000)
    buf.reset()
    assert buf.silent_since(0, 5000 * MS) == -1.0
    assert add(buf, 0, 100, 100) is None
    assert add(buf, 1, 100, 100, 1) is None
    assert steps(buf, 100) == []
    assert add(buf, 1, 200, 200, 1) is None
    assert steps(buf, 200)[0] == (100, {0: [100], 1: [1]})


def test_when_all_are_silent_a_step_without_scans_runs_while_tracks_live():
    buf = buffer(source_timeout_s=1.0)
    assert buf.pop(10_000 * MS, living=True) is None  # nothing was ever heard
    add(buf, 0, 5000, 5000)
    add(buf, 1, 5000, 5000)
    assert steps(buf, 5000) == [(5000, {0: [5000], 1: [15_000]})]
    for now, living, time in [(5999, True, None), (6000, False, None), (6010, True, 6010), (7009, True, None),
                              (7010, True, 7010)]:  # fmt: skip
        step = buf.pop(now * MS, living)
        assert step == (None if time is None else (time * MS, {}, {}))
    add(buf, 1, 7500, 7500)
    assert times(buf, 7600) == [7500]
    assert buf.pop(8499 * MS, living=True) is None
    assert buf.pop(8500 * MS, living=True) == (8500 * MS, {}, {})


@pytest.mark.parametrize("assembling", [False, True])
def test_no_function_changes_the_buffer_it_is_given(assembling):
    """Whatever was done with a buffer since, doing the same to it again gives the same."""
    buf, kept = buffer(2, assembles=(1,) if assembling else (), source_timeout_s=0.3, fusion_timeout_s=0.05), []

    def told(value):
        return (
            value.fused_ns,
            [(q.newest_ns, q.heard_ns, [(*w[:2], w.scan.track_id.tolist()) for w in q.waiting]) for q in value.queues],
        )

    for now, what in [(100, (0, 100, 7)), (100, (1, 100, 5)), (101, (1, 100, 6)), (102, (0, 100, 7)), (103, None),
                      (120, (1, 110, 5)), (130, (0, 110, 7)), (150, None), (200, None), (600, None)]:  # fmt: skip
        before = buf.value
        if what is None:
            action = partial(functions.advance, buf.config, before, now * MS, True)
        else:
            source, stamp, track_id = what
            action = partial(functions.add, buf.config, before, source, scan(track_id), stamp * MS, now * MS)
        buf.value, outcome = action()
        kept.append((before, told(before), action, told(buf.value), repr(outcome)))
    assert sum("scans={}" in outcome for *_, outcome in kept) == 1
    for before, content, action, after, outcome in kept:
        assert told(before) == content
        value, again = action()
        assert (told(value), repr(again)) == (after, outcome)


@st.composite
def arrivals(draw):
    """Stamps of one to four sources, each in order, and an order of arrival across them."""
    stamps = draw(st.lists(st.lists(st.integers(1, 12), unique=True, max_size=6).map(sorted), min_size=1, max_size=4))
    turns = draw(st.permutations([k for k, s in enumerate(stamps) for _ in s]))
    return stamps, turns


@given(arrivals(), st.booleans())
def test_any_order_of_arrival_across_sources_gives_the_same_steps(arrived, assembling):
    """Every stamp is a step, at once or when the sources fall silent, and holds all scans of its time."""
    stamps, turns = arrived
    buf = Held([assembling] * len(stamps), ScanBufferParams(source_timeout_s=5.0, fusion_timeout_s=5.0))
    queues, found = [list(s) for s in stamps], []
    for now, k in enumerate(turns):
        add(buf, k, queues[k].pop(0), 13 + now)
        found += steps(buf, 13 + now)
    found += steps(buf, 10_000)
    wanted = [(t, {k: [k * 10_000 + t] for k, s in enumerate(stamps) if t in s}) for t in sorted(set().union(*stamps))]
    assert found == wanted
