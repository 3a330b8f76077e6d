"""When a step runs and what belongs to it: every policy, every reason, any order of arrival."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from track_fusion.centre import buffer as functions
from track_fusion.centre.buffer import ScanBuffer
from track_fusion.centre.config import CentreConfig, FusionCentreParams, ScanBufferParams, SourceConfig
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

    def __init__(self, assembles, params, max_scan_age_s=100.0):
        sources = tuple(SourceConfig(str(k), assembles=a) for k, a in enumerate(assembles))
        motion, rule = NearlyConstantVelocity(LAYOUT, MotionParams()), RULES["naive"]
        fusion = FusionCentreParams(max_scan_age_s=max_scan_age_s)
        self.config = CentreConfig(sources, motion, "map", rule, rule.params(), fusion, buffer=params)
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


def buffer(sources=2, assembles=(), max_scan_age_s=100.0, **params):
    """A buffer that waits for all sources, unless told otherwise."""
    params = {"trigger": "all_sources"} | params
    return Held([k in assembles for k in range(sources)], ScanBufferParams(**params), max_scan_age_s)


def add(buf, source, stamp_ms, now_ms, *ids):
    return buf.add(source, scan(*(ids or (source * 10_000 + stamp_ms,))), stamp_ms * MS, now_ms * MS)


def steps(buf, now_ms):
    """Everything that may run now: (time in ms, {source: track ids})."""
    found = []
    while (ready := buf.pop(now_ms * MS)) is not None:
        time_ns, scans = ready[:2]
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


def test_any_source_is_the_default():
    assert ScanBufferParams().trigger == "any_source"


def two_of_one_period(**params):
    """Two sources that have been heard at 100, 200 and 300 ms, all of it fused."""
    buf = buffer(2, **({"trigger": "any_source"} | params))
    for stamp in (100, 200, 300):
        add(buf, 0, stamp, stamp)
        add(buf, 1, stamp, stamp)
        steps(buf, stamp + 5)
    return buf


def test_any_source_gathers_for_a_short_while_what_is_due():
    buf = two_of_one_period()
    add(buf, 0, 400, 401)
    assert times(buf, 401) == times(buf, 404) == []
    assert functions.wake_ns(buf.config, buf.value, 401 * MS) == 405 * MS
    assert steps(buf, 405) == [(400, {0: [400]})]
    add(buf, 0, 500, 501)
    assert times(buf, 501) == []
    add(buf, 1, 500, 503)
    assert steps(buf, 503) == [(500, {0: [500], 1: [10_500]})]


def test_a_source_that_is_not_due_is_not_waited_for():
    buf = two_of_one_period()
    add(buf, 0, 350, 351)
    assert times(buf, 351) == [350]
    add(buf, 0, 1400, 1400)  # the other one is silent by now
    assert times(buf, 1400) == [1400]


def test_the_period_of_a_source_bears_lost_scans_and_jumps():
    buf = buffer(1, trigger="any_source")
    assert functions.period_ns(buf.value.queues[0].stamps) == 0
    for stamp in (100, 200, 300, 500, 600, 9000, 700):
        add(buf, 0, stamp, stamp if stamp < 9000 else 600)
    assert functions.period_ns(buf.value.queues[0].stamps) == 100 * MS


def test_scans_of_a_stamp_that_was_published_are_taken_up_by_the_next_step():
    buf = buffer(2, trigger="any_source", fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 100) == [100]
    assert add(buf, 1, 100, 102) is None
    assert times(buf, 102) == []
    add(buf, 0, 133, 134)
    assert steps(buf, 134) == [(133, {0: [133], 1: [10_100]})]


def test_when_no_next_step_comes_they_make_one_of_the_least_advance():
    buf = buffer(2, trigger="any_source", fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 100) == [100]
    add(buf, 1, 100, 102)
    assert times(buf, 151) == []
    assert functions.wake_ns(buf.config, buf.value, 151 * MS) == 152 * MS
    step = buf.pop(152 * MS)
    assert (step.time_ns, list(step.scans), step.kept_out) == (100 * MS + 1, [1], {})


def test_steps_closer_together_than_the_rate_allows_are_joined():
    buf = buffer(2, trigger="any_source", max_output_rate_hz=10.0)
    add(buf, 0, 100, 110)
    add(buf, 1, 100, 110)
    assert times(buf, 115) == [100]
    for stamp in (133, 166):
        add(buf, 1, stamp, stamp + 10)
        assert times(buf, stamp + 10) == []
    add(buf, 0, 200, 210)
    add(buf, 1, 200, 210)
    step = buf.pop(214 * MS)
    assert (step.time_ns // MS, sorted(step.scans), step.kept_out) == (200, [0, 1], {"superseded_scan": 2})


def test_a_joined_step_comes_in_time_when_no_later_scan_does():
    buf = buffer(1, trigger="any_source", max_output_rate_hz=10.0)
    add(buf, 0, 100, 110)
    assert times(buf, 110) == [100]
    add(buf, 0, 150, 160)
    assert times(buf, 209) == []
    assert functions.wake_ns(buf.config, buf.value, 209 * MS) == 210 * MS
    assert times(buf, 210) == [150]


def test_at_a_rate_steps_bear_the_stamps_of_its_ticks_scans_or_not():
    buf = buffer(2, trigger="rate", output_rate_hz=10.0)
    assert buf.pop(1000 * MS, living=True) is None  # nothing was ever heard
    add(buf, 0, 1030, 1040)
    assert functions.wake_ns(buf.config, buf.value, 1040 * MS) == 1100 * MS
    add(buf, 1, 1040, 1050)
    add(buf, 0, 1080, 1090)
    add(buf, 0, 1101, 1102)
    step = buf.pop(1103 * MS)
    assert (step.time_ns, step.kept_out) == (1100 * MS, {"superseded_scan": 1})
    assert {k: s.track_id.tolist() for k, s in step.scans.items()} == {0: [1080], 1: [11_040]}
    assert steps(buf, 1199) == []
    assert steps(buf, 1200) == [(1200, {0: [1101]})]
    assert steps(buf, 1500) == [(1500, {})]  # of ticks that were missed the last alone


def test_published_at_the_time_of_the_clock():
    buf = buffer(1, trigger="any_source", publish_at="now")
    add(buf, 0, 100, 130)
    add(buf, 0, 110, 130)
    assert [buf.pop(130 * MS).publish_ns for _ in range(2)] == [130 * MS, 130 * MS + 1]
    add(buf, 0, 180, 150)  # a little ahead of the clock
    assert buf.pop(150 * MS).publish_ns == 180 * MS


def test_a_scan_far_ahead_of_the_clock_waits_for_its_time_and_stops_nobody():
    for trigger in ("any_source", "all_sources"):
        buf = buffer(2, trigger=trigger, fusion_timeout_s=0.05, max_scan_age_s=99.0)
        got = []
        add(buf, 1, 16_000, 1000)
        for now in range(1000, 15_900, 100):
            add(buf, 0, now, now)
            if now < 14_000:
                assert add(buf, 1, now, now + 10) is None
            got += steps(buf, now + 20)
        kept = [scans.get(1) for time, scans in got if time < 14_000]
        assert kept == [[10_000 + now] for now in range(1000, 14_000, 100)]
        assert [time for time, _ in got] == list(range(1000, 15_900, 100))
        assert functions.wake_ns(buf.config, buf.value, 15_899 * MS) == 15_900 * MS  # at the tolerance
        assert times(buf, 15_950) == [16_000]


def test_a_source_whose_scans_are_all_turned_away_is_not_live():
    buf = buffer(2, source_timeout_s=1.0)
    for now in range(5000, 6000, 100):
        add(buf, 0, now, now)
        assert add(buf, 1, now - 11_000, now) == "stale_scan"
        steps(buf, now)
    add(buf, 0, 6000, 6000)
    assert add(buf, 1, 6000 - 11_000, 6000) == "stale_scan"
    assert times(buf, 6000) == [5900, 6000]
    assert buf.silent_since(1, 6000 * MS) == pytest.approx(1.0)


def test_a_scan_that_is_too_old_to_take_part_is_counted_and_is_no_update():
    buf = buffer(2, trigger="any_source", max_scan_age_s=0.5)
    add(buf, 0, 1000, 1000)
    assert times(buf, 1000) == [1000]
    add(buf, 1, 650, 1100)
    add(buf, 0, 1200, 1200)
    step = buf.pop(1200 * MS)
    assert (step.time_ns, list(step.scans), step.kept_out) == (1200 * MS, [0], {"aged_scan": 1})


def test_late_scans_are_handed_out_for_retrodiction():
    buf = buffer(2, trigger="any_source")
    object.__setattr__(buf.config.buffer, "out_of_sequence", "retrodict")
    for stamp in (100, 200):
        add(buf, 0, stamp, stamp)
        assert times(buf, stamp) == [stamp]
    assert add(buf, 1, 150, 201) is None
    assert add(buf, 1, 120, 202) is None
    assert add(buf, 0, 170, 203) is None  # between two that were fused
    assert add(buf, 0, 200, 203) == "duplicate_scan"
    assert times(buf, 203) == []
    add(buf, 0, 300, 300)
    step = buf.pop(304 * MS)
    assert (step.time_ns, list(step.scans), step.kept_out) == (300 * MS, [0], {})
    assert [(k, s.track_id.tolist(), t // MS) for k, s, t in step.late] == [
        (0, [170], 170), (1, [10_120], 120), (1, [10_150], 150)
    ]  # fmt: skip


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


def test_a_silent_source_is_not_waited_for_until_it_speaks_again():
    buf = buffer(fusion_timeout_s=10.0, source_timeout_s=1.0)
    add(buf, 0, 100, 100)
    assert times(buf, 1099) == []
    add(buf, 0, 1100, 1100)
    assert times(buf, 1100) == [100, 1100]  # source 1 was never heard, for a second since the first scan of any
    add(buf, 1, 1100, 1150)
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
    assert add(buf, 1, 501, 1002) == "stale_scan"
    assert add(buf, 1, 502, 1002) is None
    assert steps(buf, 1002) == [(502, {1: [10_502]})]
    add(buf, 1, 1000, 1003)
    assert steps(buf, 1003) == [(1000, {0: [1000], 1: [11_000]})]
    assert add(buf, 0, 1000, 1004) == "duplicate_scan"
    assert add(buf, 0, 900, 1004) == "out_of_order_scan"


def test_a_scan_that_comes_before_its_step_has_run_is_sorted_in():
    buf = buffer()
    add(buf, 0, 1000, 1000)
    assert add(buf, 0, 900, 1001) is None
    assert add(buf, 0, 900, 1001) == "duplicate_scan"
    assert add(buf, 0, 950, 1002) is None
    add(buf, 1, 1000, 1003)
    assert steps(buf, 1003) == [(900, {0: [900]}), (950, {0: [950]}), (1000, {0: [1000], 1: [11_000]})]


def test_a_scan_before_the_last_step_is_neglected():
    buf = buffer(out_of_sequence="neglect", fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 150) == [100]
    assert add(buf, 1, 90, 160) == "late_scan"
    assert steps(buf, 10_000) == []
    assert add(buf, 1, 100, 170) is None  # of the very time: not late


def test_or_kept_as_its_sources_newest_for_the_next_step():
    buf = buffer(out_of_sequence="predict", fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 150) == [100]
    assert add(buf, 1, 90, 160) is None
    assert buf.pop(209 * MS) is None
    step = buf.pop(210 * MS)
    assert (step.time_ns, step.scans[1].track_id.tolist()) == (100 * MS + 1, [10_090])
    assert add(buf, 1, 80, 211) == "out_of_order_scan"


def test_a_newer_scan_supersedes_a_late_one_of_its_source_and_is_counted():
    buf = buffer(fusion_timeout_s=0.05)
    add(buf, 0, 100, 100)
    assert times(buf, 150) == [100]
    for stamp in (90, 95, 100):
        add(buf, 1, stamp, 160)
    add(buf, 0, 110, 161)
    add(buf, 1, 120, 162)
    step = buf.pop(162 * MS)
    assert (step.time_ns, sorted(step.scans), step.scans[1].track_id.tolist()) == (110 * MS, [0, 1], [10_100])
    assert step.kept_out == {"superseded_scan": 2}


@given(st.data())
def test_the_times_of_steps_strictly_increase(data):
    """Whatever comes, in whatever order, by whatever trigger, and whenever one looks."""
    trigger = data.draw(st.sampled_from(["any_source", "all_sources", "rate"]))
    publish_at = data.draw(st.sampled_from(["stamp", "now"]))
    rate = data.draw(st.sampled_from([0.0, 30.0]))
    buf = buffer(3, trigger=trigger, publish_at=publish_at, max_output_rate_hz=rate, source_timeout_s=0.3,
                 assembles=(2,))  # fmt: skip
    now, shown, fused = 1000, [], []
    for _ in range(data.draw(st.integers(1, 30))):
        now += data.draw(st.integers(0, 200))
        source, stamp = data.draw(st.integers(0, 2)), now + data.draw(st.integers(-400, 150))
        add(buf, source, stamp, now, data.draw(st.integers(0, 3)))
        while (step := buf.pop(now * MS, living=True)) is not None:
            fused.append(step.time_ns)
            shown.append(step.publish_ns)
    assert fused == sorted(set(fused))
    assert shown == sorted(set(shown))
    assert shown == fused if publish_at == "stamp" else all(a >= b for a, b in zip(shown, fused, strict=True))


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
    buf = buffer(1, assembles=(0,), fusion_timeout_s=0.05, assembly_window_s=0.05, trigger=trigger)
    add(buf, 0, 100, 100, 7)
    add(buf, 0, 100, 130, 8)
    assert times(buf, 149) == []
    assert steps(buf, 150) == [(100, {0: [7, 8]})]
    assert add(buf, 0, 100, 151, 9) == "late_scan"


def test_a_scan_in_pieces_is_complete_when_all_tracks_of_the_last_one_have_come():
    buf = buffer(1, assembles=(0,), trigger="any_source", assembly_window_s=0.01)
    for k in (5, 6):
        add(buf, 0, 100, 100 + k, k)
    assert times(buf, 115) == []
    assert functions.wake_ns(buf.config, buf.value, 115 * MS) == 116 * MS
    assert steps(buf, 116) == [(100, {0: [5, 6]})]  # of the first it is not known
    add(buf, 0, 200, 200, 6)
    assert times(buf, 200) == []
    add(buf, 0, 200, 201, 5)
    assert steps(buf, 201) == [(200, {0: [6, 5]})]
    add(buf, 0, 300, 300, 5)
    assert times(buf, 309) == []
    assert steps(buf, 310) == [(300, {0: [5]})]  # one of them is gone
    add(buf, 0, 400, 400, 5)
    assert steps(buf, 400) == [(400, {0: [5]})]


def test_a_newborn_that_comes_after_its_scan_is_waited_for_in_the_next():
    buf = buffer(1, assembles=(0,), trigger="any_source")
    add(buf, 0, 100, 100, 5)
    assert times(buf, 110) == [100]
    add(buf, 0, 200, 200, 5)
    assert times(buf, 200) == [200]
    assert add(buf, 0, 200, 201, 6) == "late_scan"
    add(buf, 0, 300, 300, 5)
    assert times(buf, 300) == []
    add(buf, 0, 300, 301, 6)
    assert steps(buf, 301) == [(300, {0: [5, 6]})]


def test_several_pieces_may_come_at_once_and_those_that_are_there_are_turned_away():
    buf = buffer(1, assembles=(0,), trigger="any_source")
    add(buf, 0, 100, 100, 5, 6)
    assert add(buf, 0, 100, 100, 6, 7) == "duplicate_track_id"
    assert steps(buf, 110) == [(100, {0: [5, 6, 7]})]


def test_pieces_that_were_fused_are_not_waited_for_again():
    buf = buffer(assembles=(1,), fusion_timeout_s=0.05)
    add(buf, 1, 100, 100, 5)
    assert times(buf, 150) == [100]
    add(buf, 0, 100, 151)
    assert steps(buf, 151) == []
    assert steps(buf, 201) == [(100, {0: [100]})]


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
        assert step == (None if time is None else (time * MS, {}, {}, time * MS, ()))
    add(buf, 1, 7500, 7500)
    assert times(buf, 7600) == [7500]
    assert buf.pop(8499 * MS, living=True) is None
    assert buf.pop(8500 * MS, living=True) == (8500 * MS, {}, {}, 8500 * MS, ())


@pytest.mark.parametrize("assembling", [False, True])
def test_no_function_changes_the_buffer_it_is_given(assembling):
    """Whatever was done with a buffer since, doing the same to it again gives the same."""
    buf, kept = buffer(2, assembles=(1,) if assembling else (), source_timeout_s=0.3, fusion_timeout_s=0.05), []

    def told(value):
        return (
            value.fused_ns,
            [
                (q.stamps, q.taken_ns, q.heard_ns, q.ids, [(*w[:3], w.scan.track_id.tolist()) for w in q.waiting])
                for q in value.queues
            ],
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
    patient = ScanBufferParams(trigger="all_sources", source_timeout_s=5.0, fusion_timeout_s=5.0)
    buf = Held([assembling] * len(stamps), patient)
    queues, found = [list(s) for s in stamps], []
    for now, k in enumerate(turns):
        add(buf, k, queues[k].pop(0), 13 + now)
        found += steps(buf, 13 + now)
    found += steps(buf, 10_000)
    wanted = [(t, {k: [k * 10_000 + t] for k, s in enumerate(stamps) if t in s}) for t in sorted(set().union(*stamps))]
    assert found == wanted
