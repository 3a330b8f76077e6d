"""A centre on messages: how often it is asked changes nothing, and what it turns away is counted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from msg_adapters.arrays import MessageError
from msg_adapters.track_table import track_table_to_msg
from track_fusion.centre.centre import Published
from track_fusion.clock import ClockParams
from track_fusion.messages.centre import MessageCentre
from track_fusion.messages.counts import Counts
from track_fusion.messages.parameters import GivenParameters
from track_fusion.tracks import TrackBatch, planar_layout

SECOND, MS = 10**9, 10**6


def made(told: list[str] | None = None, **values: Any) -> MessageCentre:
    given = GivenParameters({"identity_namespace": "test"} | values, "fusion_centre")
    return MessageCentre(given, given.values, Counts((told if told is not None else []).append), given(ClockParams))


def table(stamp_ns: int, x: float, frame_id: str = "map") -> Any:
    layout = planar_layout()
    mean = np.array([[x, 0.0, 1.0, 0.0]])
    batch = TrackBatch.gaussian(layout, frame_id, mean, np.eye(4)[None], time_ns=stamp_ns, track_id=[1])
    return track_table_to_msg(batch, layout.axes, stamp_ns)


def arrivals(seed: int) -> list[tuple[int, int, Any]]:
    """Two sources at 10 and 4 Hz with jitter; one falls silent for a while, then both for 4 s."""
    rng, sent = np.random.default_rng(seed), []
    for source, period_s in ((0, 0.1), (1, 0.25)):
        for k in range(round(10.0 / period_s)):
            stamp_s = 1.0 + k * period_s
            if (source == 1 and 3.0 < stamp_s < 5.5) or 7.0 < stamp_s < 11.0:
                continue
            late_ns = int(rng.uniform(1, 60) * MS)
            stamp_ns = round(stamp_s * SECOND)
            sent.append((stamp_ns + late_ns, source, table(stamp_ns, stamp_s + 0.1 * rng.normal())))
    return sorted(sent, key=lambda item: item[0])


def driven(centre: MessageCentre, sent: list[tuple[int, int, Any]], every_ns: int | None) -> list[Published]:
    published, now_ns = [], sent[0][0]
    for arrival_ns, source, msg in sent:
        if every_ns:
            for between_ns in range(now_ns, arrival_ns, every_ns):
                published += centre.advance(between_ns)
        published += centre.take(source, msg, arrival_ns)
        now_ns = arrival_ns
    return [*published, *centre.advance(now_ns + 2 * SECOND)]


@pytest.mark.parametrize("trigger", ["any_source", "all_sources", "rate"])
def test_how_often_it_is_asked_changes_nothing(trigger: str) -> None:
    """Waits that time out, sources that fall silent, coasting: each step runs when it is due, whoever asks when."""
    values = {"trigger": trigger, "fusion_timeout_s": 0.15, "source_timeout_s": 0.6, "max_scan_age_s": 1.0}
    for seed in range(3):
        runs = [driven(made(**values), arrivals(seed), every_ns) for every_ns in (None, 3 * MS, 20 * MS)]
        assert len(runs[0]) > 60
        assert any(len(result.tracks) and result.tracks.is_coasted.all() for result in runs[0])
        for other in runs[1:]:
            assert [r.time_ns for r in other] == [r.time_ns for r in runs[0]]
            for a, b in zip(other, runs[0], strict=True):
                np.testing.assert_array_equal(a.tracks.mean, b.tracks.mean)
                np.testing.assert_array_equal(a.tracks.track_id, b.tracks.track_id)


def test_a_clock_that_jumps_far_is_not_caught_up_with() -> None:
    centre = made(trigger="rate", output_rate_hz=10.0, source_timeout_s=0.5)
    driven(centre, arrivals(0), None)
    assert len(list(centre.advance(10**6 * SECOND))) < 700


def test_what_is_turned_away_is_counted_and_told_once() -> None:
    told: list[str] = []
    centre = made(told)
    list(centre.take(0, table(SECOND, 0.0), SECOND))
    for _ in range(2):
        list(centre.take(0, table(SECOND, 0.0), SECOND))
    assert centre.counts.rejected == {"duplicate_scan": 2}
    assert told == ["Rejected (duplicate_scan): a scan of sensor_1 stamped 1.000 s"]
    with pytest.raises(MessageError) as error:
        list(centre.take(0, table(SECOND, 0.0, "odom"), SECOND))
    assert error.value.reason == "wrong_frame"
    assert centre.counts.counted["steps"] == 1


def test_a_source_that_strays_is_counted() -> None:
    centre = made(trigger="all_sources")
    for k in range(12):  # the second strays for three scans, and for good from the ninth
        for source, x in (0, 0.0), (1, 60.0 if k in (3, 4, 5) or k >= 9 else 0.0):
            now_ns = (k + 10) * SECOND // 10
            list(centre.take(source, table(now_ns, x), now_ns))
    counted = centre.counts.counted
    assert (counted["steps"], counted["held"], counted["released"], counted["merged"]) == (12, 6, 0, 0)
    assert len(centre.centre.tracks) == 1
