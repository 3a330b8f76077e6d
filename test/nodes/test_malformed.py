"""Malformed messages are counted by reason, stop nobody and leave the other tracks as they are; so does sheer load.

Each case sends what is bad, then (or in the same scan) what is good; the node must publish, to the last bit, what the
library makes of the good part alone. The counts on /diagnostics are compared once all cases have been sent.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from nodes.support import (
    AXES,
    IDENTITY,
    PATIENT,
    SECOND_NS,
    START_S,
    STEP_S,
    Diagnostics,
    clock,
    detections,
    positions,
    read,
    stamp_ns,
    track_table,
)
from ros_helpers import NodeProcess, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays
from msg_adapters.detection_table import detection_table_from_msg, detection_table_to_msg
from msg_adapters.header import stamp_from_ns
from msg_adapters.odometry import odometry_from_msg, odometry_to_msgs
from msg_adapters.track_table import track_table_to_msg
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import CentreConfig, IdentityParams, SourceConfig, TrackManagerParams
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.params import Params
from track_fusion.rules import RULES
from track_fusion.trackers.filters import FILTERS
from track_fusion.trackers.one_target import SensorTracker, SensorTrackerParams
from track_fusion.tracks import StateLayout, TrackBatch, planar_layout

FIRST_NS = 100 * SECOND_NS  # far enough from 0 that a stamp of 0 is stale, too: the reason must be the right one
PERIOD_NS = SECOND_NS // 10
MAX_FUTURE_S, MAX_DELAY_S = 0.5, 10.0
PARAMS = PATIENT | {"max_future_s": MAX_FUTURE_S, "max_delay_s": MAX_DELAY_S, "confirmation_threshold": [1, 1]}
MANAGER = TrackManagerParams(confirmation_threshold=(1, 1))
MOTION = NearlyConstantVelocity(planar_layout(), MotionParams())
SENSOR = LinearSensor.position(planar_layout(), 1.0)
GOOD = np.array([[0.0, 0.0, 1.0, 0.0], [50.0, 0.0, 0.0, 1.0], [0.0, 50.0, -1.0, 0.0]])
COVS = {"left": np.diag([1.0, 2.0, 0.5, 0.5]), "right": np.diag([2.0, 1.0, 0.25, 1.0])}
LOAD = 10_000


# ---- what is wrong with a message: functions that spoil a good one -----------------------------------------------


def with_bad_row(**fault: Any) -> Callable[[int], PointCloud2]:
    """A scan of the good tracks with a bad one amid them."""

    def make(at_ns: int) -> PointCloud2:
        arrays = read(track_table(at_ns, np.insert(GOOD, 1, [20.0, 20.0, 0.0, 0.0], 0), COVS["left"], [1, 9, 2, 3]))
        fields = {name: np.array(getattr(arrays, name)) for name in ("weight", "mean", "cov", "existence", "dof")}
        for name, value in fault.items():
            fields[name][1] = value
        return track_table_to_msg(dataclasses.replace(arrays, **fields), AXES, at_ns)

    return make


def with_repeated_id(at_ns: int) -> PointCloud2:
    arrays = read(track_table(at_ns, np.vstack([GOOD, [20.0, 20.0, 0.0, 0.0]]), COVS["left"]))
    return track_table_to_msg(dataclasses.replace(arrays, track_id=np.array([1, 2, 3, 1])), AXES, at_ns)


def spoilt(spoil: Callable[[Any], None], make: Callable[[int], Any]) -> Callable[[int], Any]:
    """A good message with one thing changed."""

    def changed(at_ns: int) -> Any:
        msg = make(at_ns)
        spoil(msg)
        return msg

    return changed


def shift(offset_ns: int) -> Callable[[Any], None]:
    def spoil(msg: Any) -> None:
        msg.header.stamp = stamp_from_ns(stamp_ns(msg) + offset_ns)

    return spoil


def zero_stamp(msg: Any) -> None:
    msg.header.stamp = stamp_from_ns(0)


def wrong_frame(msg: Any) -> None:
    msg.header.frame_id = "odom"


def no_frame(msg: Any) -> None:
    msg.header.frame_id = ""


def without_field(name: str) -> Callable[[Any], None]:
    def spoil(msg: Any) -> None:
        msg.fields = [f for f in msg.fields if f.name != name]

    return spoil


def twice_a_field(msg: Any) -> None:
    msg.fields = [*msg.fields, msg.fields[0]]


def short_data(msg: Any) -> None:
    msg.data = msg.data[:-8]


def wrong_row_step(msg: Any) -> None:
    msg.row_step += 8


def good_table(at_ns: int) -> PointCloud2:
    return track_table(at_ns, GOOD, COVS["left"])


def phd_table(at_ns: int) -> PointCloud2:
    return track_table_to_msg(dataclasses.replace(read(good_table(at_ns)), phd=True), AXES, at_ns)


NAN, HUGE = float("nan"), 1e200
INDEFINITE = np.diag([1.0, 1.0, 1.0, -1.0])
HEADER_CASES: list[tuple[str, Callable[[Any], None]]] = [
    ("wrong_frame", wrong_frame),
    ("wrong_frame", no_frame),
    ("zero_stamp", zero_stamp),
    ("future_stamp", shift(SECOND_NS)),
    ("future_stamp", shift(1_000_000 * SECOND_NS)),
]
CLOUD_CASES: list[tuple[str, Callable[[Any], None]]] = [
    *HEADER_CASES,
    ("wrong_data_length", short_data),
    ("wrong_data_length", wrong_row_step),
    ("bad_field", twice_a_field),
]
#: Reason, and the scan that holds the good tracks and a bad one.
ROW_CASES: list[tuple[str, Callable[[int], PointCloud2]]] = [
    ("not_finite", with_bad_row(mean=[20.0, NAN, 0.0, 0.0])),
    ("not_finite", with_bad_row(mean=float("inf"))),
    ("not_finite", with_bad_row(cov=NAN)),
    ("not_positive_definite", with_bad_row(cov=INDEFINITE)),
    ("not_positive_definite", with_bad_row(cov=np.zeros((4, 4)))),
    ("not_positive_definite", with_bad_row(cov=np.ones((4, 4)))),
    ("absurd_value", with_bad_row(mean=HUGE)),
    ("absurd_value", with_bad_row(cov=HUGE * np.eye(4))),
    ("bad_weight", with_bad_row(weight=0.5)),
    ("bad_existence", with_bad_row(existence=1.5)),
    ("bad_dof", with_bad_row(dof=1.0)),
    ("duplicate_track_id", with_repeated_id),
]
#: Reason, and a message that is bad as a whole.
TABLE_CASES: list[tuple[str, Callable[[int], PointCloud2]]] = [
    *((reason, spoilt(spoil, good_table)) for reason, spoil in CLOUD_CASES),
    ("missing_field", spoilt(without_field("weight"), good_table)),
    ("missing_field", spoilt(without_field("cov_x_vy"), good_table)),
    ("missing_axis", spoilt(without_field("x"), good_table)),
    ("phd_mixture", phd_table),
    ("missing_axis", spoilt(without_field("cov_vy_vy"), good_table)),
    ("out_of_order_scan", spoilt(shift(-2 * PERIOD_NS + 1), good_table)),
    ("duplicate_scan", spoilt(shift(-PERIOD_NS), good_table)),
    ("stale_scan", spoilt(shift(round(-(MAX_DELAY_S + 1) * SECOND_NS)), good_table)),
]


# ---- the nodes ---------------------------------------------------------------------------------------------------


class Bench:
    """The nodes under test, what they publish, and a clock that the test sets."""

    NODES = ("tables", "odometry", "tracker", "fed", "load")

    def __init__(self, probe: Probe) -> None:
        self.probe, self.diagnostics = probe, Diagnostics(probe)
        self.now_ns = FIRST_NS
        self.inputs = {
            "left": probe.publisher("/tables/sources/left/tracks", PointCloud2, deadline_s=START_S),
            "right": probe.publisher("/tables/sources/right/tracks", PointCloud2, deadline_s=START_S),
            "odometry": probe.publisher("/odometry/sources/sensor/tracks", Odometry, deadline_s=START_S),
            "detections": probe.publisher("/tracker/detections", PointCloud2, deadline_s=START_S),
            "fed": probe.publisher("/fed/detections", PointCloud2, deadline_s=START_S),
            "feedback": probe.publisher("/fed/feedback", PointCloud2, deadline_s=START_S),
        }
        self.outputs = {n: probe.listen(f"/{n}/tracks", PointCloud2) for n in (*self.NODES,)}
        self._clock = probe.publisher("/clock", Clock, readers=len(self.outputs), deadline_s=START_S)
        for name in self.outputs:
            self.diagnostics.wait_for(name, lambda v: v.get("active") == "True", f"{name} to be active")

    def tick(self, now_ns: int) -> None:
        """Set the clock; it is told again and again while an answer is awaited."""
        self.now_ns = now_ns
        self._clock.publish(clock(now_ns))

    def expect(self, node: str, count: int, what: str) -> PointCloud2:
        """Wait until a node has published so many messages; return the last."""
        got = self.outputs[node]

        def arrived() -> bool:
            self._clock.publish(clock(self.now_ns))
            return len(got) >= count

        self.probe.wait_for(arrived, STEP_S, f"message {count} of {node} after {what}")
        assert len(got) == count, what
        return got[-1]


@pytest.fixture(scope="module")
def bench(shared_domain: int, shared_probe: Probe) -> Iterator[Bench]:
    with ExitStack() as stack:

        def start(executable: str, node: str, **params: Any) -> NodeProcess:
            return stack.enter_context(NodeProcess(executable, node=node, params=params))

        centre = PARAMS | {"state_fusion": "covariance_intersection"}
        tracker = {"use_sim_time": True, "axes": list(AXES), "max_future_s": MAX_FUTURE_S}
        nodes = [
            start("fusion_centre", "tables", **centre, source_configurations=["left", "right"]),
            start("fusion_centre", "odometry", **centre, source_configurations=["sensor"], source_types=["odometry"]),
            start("fusion_centre", "load", **PARAMS, state_fusion="naive", deletion_threshold=[2, 2]),
            start("sensor_tracker", "tracker", **tracker),
            start("sensor_tracker", "fed", **tracker, feedback="replace", feedback_timeout_s=1000.0),
        ]
        yield Bench(shared_probe)
        assert [n.running for n in nodes] == [True] * len(nodes)


def reference(sources: int) -> FusionCentre:
    """The library's centre with the parameters of the nodes."""
    rule, names = RULES["covariance_intersection"], map(str, range(sources))
    sources, identity = tuple(map(SourceConfig, names)), IdentityParams(IDENTITY)
    config = CentreConfig(sources, MOTION, "map", rule, rule.params(), manager=MANAGER, identity=identity)
    return FusionCentre(config)


def library_batch(arrays: Any) -> TrackBatch:
    fields = {name: value for name, value in vars(arrays).items() if name != "axes"}
    return TrackBatch(layout=StateLayout(arrays.axes), **fields)


def table_bytes(batch: TrackBatch, at_ns: int) -> bytes:
    return track_table_to_msg(batch, AXES, at_ns).data.tobytes()


def check_counts(bench: Bench, node: str, reasons: list[str]) -> None:
    """Exactly these rejections are on /diagnostics, with a warning; the node runs and is active."""
    bench.diagnostics.wait_for_counts(node, Counter(reasons))
    status = bench.diagnostics.status(node)
    assert status.level == b"\x01"
    assert f"{len(reasons)} rejected" in status.message
    assert bench.diagnostics.values(node)["active"] == "True"


def test_a_centre_counts_bad_tables_and_fuses_the_rest(bench: Bench) -> None:
    centre = reference(2)
    cases = [(reason, bad, None) for reason, bad in TABLE_CASES] + [(reason, None, scan) for reason, scan in ROW_CASES]
    good = (None, None, good_table)
    sent = []
    for k, (reason, bad, scan) in enumerate([good, good, *cases, good]):
        at_ns = FIRST_NS + k * PERIOD_NS
        bench.tick(at_ns)
        if bad is not None:
            bench.inputs["left"].publish(bad(at_ns))
        bench.inputs["left"].publish((scan or good_table)(at_ns))
        right = track_table(at_ns, GOOD + 0.25, COVS["right"])
        bench.inputs["right"].publish(right)
        msg = bench.expect("tables", k + 1, f"case {k}, {reason}")
        scans = {i: library_batch(read(m)) for i, m in enumerate((good_table(at_ns), right))}
        expected, _ = centre.step(at_ns, scans)
        assert stamp_ns(msg) == at_ns
        assert msg.data.tobytes() == table_bytes(expected, at_ns), (k, reason)
        assert read(msg).source.tolist() == [3, 3, 3], (k, reason)
        sent += [reason] * (reason is not None)
    check_counts(bench, "tables", sent)


# ---- Odometry ----------------------------------------------------------------------------------------------------


def good_odometry(at_ns: int, track_id: int = 1) -> Odometry:
    batch = library_batch(read(track_table(at_ns, GOOD[track_id - 1], COVS["left"], [track_id])))
    (msg,) = odometry_to_msgs(batch, AXES)
    return msg


def entry(block: str, row: int, column: int, value: float) -> Callable[[Odometry], None]:
    def spoil(msg: Odometry) -> None:
        getattr(msg, block).covariance[row * 6 + column] = value

    return spoil


def zero_covariance(msg: Odometry) -> None:
    msg.pose.covariance[:] = 0.0


def no_child(msg: Odometry) -> None:
    msg.child_frame_id = ""


def no_orientation(msg: Odometry) -> None:
    msg.pose.pose.orientation.w = 0.0


def nan_speed(msg: Odometry) -> None:
    msg.twist.twist.linear.x = NAN


ODOMETRY_CASES: list[tuple[str, Callable[[Any], None]]] = [
    *HEADER_CASES,
    ("asymmetric_covariance", entry("pose", 0, 1, 0.5)),
    ("asymmetric_covariance", entry("twist", 1, 0, -0.1)),
    ("not_positive_definite", entry("pose", 0, 0, -1.0)),
    ("not_positive_definite", zero_covariance),
    ("not_finite", entry("twist", 0, 0, NAN)),
    ("not_finite", nan_speed),
    ("missing_child_frame", no_child),
    ("bad_orientation", no_orientation),
]


def test_a_centre_counts_bad_odometry_and_fuses_the_rest(bench: Bench) -> None:
    """Three targets, one message each; the bad one, of a fourth target, comes between them."""
    centre, base_ns = reference(1), bench.now_ns + SECOND_NS
    cases: list[tuple[str | None, Callable[[Any], None] | None]] = [(None, None), *ODOMETRY_CASES, (None, None)]
    for k, (_, spoil) in enumerate(cases):
        at_ns = base_ns + k * PERIOD_NS
        bench.tick(at_ns)
        messages = [good_odometry(at_ns, i) for i in (1, 2, 3)]
        bad = [] if spoil is None else [spoilt(spoil, good_odometry)(at_ns)]
        for msg in bad:
            msg.child_frame_id = msg.child_frame_id and "4"
        for msg in (*messages[:1], *bad, *messages[1:]):
            bench.inputs["odometry"].publish(msg)
        if k > 0:  # this scan has completed the one before
            msg = bench.expect("odometry", k, f"case {k - 1}")
            assert stamp_ns(msg) == at_ns - PERIOD_NS
            earlier = [odometry_from_msg(good_odometry(at_ns - PERIOD_NS, i), AXES).tracks for i in (1, 2, 3)]
            scan = TrackBatch.concatenate([library_batch(a) for a in earlier])
            expected, _ = centre.step(at_ns - PERIOD_NS, {0: scan})
            assert msg.data.tobytes() == table_bytes(expected, at_ns - PERIOD_NS), cases[k - 1]
    check_counts(bench, "odometry", [reason for reason, _ in cases if reason])
    assert int(bench.diagnostics.values("odometry")["cross_block_absent"]) >= 3 * len(cases)


# ---- a tracker's detections --------------------------------------------------------------------------------------


def test_a_tracker_counts_bad_detections_and_tracks_on(bench: Bench) -> None:
    kalman = FILTERS["kalman"].make(MOTION, SENSOR, Params())
    tracker = SensorTracker(MOTION, SENSOR, kalman, "map", SensorTrackerParams())
    base_ns, value = bench.now_ns + SECOND_NS, np.array([[3.0, 4.0]])
    rows: Mapping[str, Any] = {
        "not_finite": [[NAN, 0.0], [3.0, 4.0]],
        "absurd_value": [[3.0, 4.0], [1e300, 0.0]],
    }
    whole: list[tuple[str, Callable[[Any], None]]] = [
        *CLOUD_CASES,
        ("missing_field", without_field("x")),
        ("out_of_order_scan", shift(-2 * PERIOD_NS + 1)),
        ("duplicate_scan", shift(-PERIOD_NS)),
    ]
    cases: list[tuple[str, Callable[[Any], None] | None]] = [*whole, *((reason, None) for reason in rows)]
    for k, (reason, spoil) in enumerate([("", None), ("", None), *cases]):
        at_ns = base_ns + k * PERIOD_NS
        bench.tick(at_ns)
        if spoil is not None:
            bench.inputs["detections"].publish(spoilt(spoil, lambda t: detections(t, [[1e3, 1e3]]))(at_ns))
        bench.inputs["detections"].publish(detections(at_ns, rows.get(reason, value)))
        msg = bench.expect("tracker", k + 1, f"case {k}, {reason}")
        scan = detection_table_from_msg(detections(at_ns, value), ("x", "y"))
        assert msg.data.tobytes() == table_bytes(tracker.step(at_ns, scan.value, scan.cov), at_ns), (k, reason)
    check_counts(bench, "tracker", [reason for reason, _ in cases])


def test_a_tracker_counts_bad_feedback_and_waits_for_the_good(bench: Bench) -> None:
    """Neither bad feedback nor that of another time, an empty table included, stands for the one awaited."""
    kalman = FILTERS["kalman"].make(MOTION, SENSOR, Params())
    tracker = SensorTracker(MOTION, SENSOR, kalman, "map", SensorTrackerParams())
    at_ns, value = bench.now_ns + SECOND_NS, np.array([[3.0, 4.0]])
    bench.tick(at_ns)
    for k in range(2):
        bench.inputs["fed"].publish(detections(at_ns + k * PERIOD_NS, value + k))
    before = tracker.step(at_ns, value, None)
    assert bench.expect("fed", 1, "the first scan").data.tobytes() == table_bytes(before, at_ns)

    def feedback(stamp: int) -> PointCloud2:
        return track_table(stamp, [3.5, 4.5, 1.0, 0.0], COVS["right"])

    for _, spoil in CLOUD_CASES:
        bench.inputs["feedback"].publish(spoilt(spoil, feedback)(at_ns))
    for other in (feedback(at_ns - PERIOD_NS), track_table(at_ns - PERIOD_NS, [])):
        bench.inputs["feedback"].publish(other)
    bench.diagnostics.wait_for("fed", lambda v: v.get("feedback_of_another_time") == "2", "both to be counted")
    check_counts(bench, "fed", [reason for reason, _ in CLOUD_CASES])
    assert bench.diagnostics.values("fed")["waiting_scans"] == "1"
    bench.inputs["feedback"].publish(feedback(at_ns))
    assert tracker.feed_back(library_batch(read(feedback(at_ns))))
    after = tracker.step(at_ns + PERIOD_NS, value + 1, None)
    msg = bench.expect("fed", 2, "the feedback")
    assert msg.data.tobytes() == table_bytes(after, at_ns + PERIOD_NS)


# ---- load --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def load(bench: Bench) -> Callable[[Any, Any, str], PointCloud2]:
    """Send a scan of each source to the centre `load` and return what it publishes."""
    probe = bench.probe
    inputs = [probe.publisher(f"/load/sources/{s}/tracks", PointCloud2) for s in ("sensor_1", "sensor_2")]

    def send(first: Any, second: Any, what: str) -> PointCloud2:
        bench.tick(bench.now_ns + PERIOD_NS)
        count = len(bench.outputs["load"])
        for publisher, means in zip(inputs, (first, second), strict=True):
            publisher.publish(track_table(bench.now_ns, means))
        return bench.expect("load", count + 1, what)

    return send


def test_no_tracks_are_a_valid_scan_in_which_all_are_missed(load: Callable[..., PointCloud2]) -> None:
    assert load([], [], "two empty scans").width == 0
    assert read(load(GOOD, GOOD, "three tracks")).status.tolist() == [1, 1, 1]
    missed = read(load([], [], "the first miss"))
    assert (missed.status.tolist(), missed.source.tolist()) == ([3, 3, 3], [0, 0, 0])
    assert load([], [], "the second miss, which deletes").width == 0


def test_ten_thousand_tracks_of_each_source_are_fused(bench: Bench, load: Callable[..., PointCloud2]) -> None:
    side = round(LOAD**0.5)
    grid = np.stack(np.meshgrid(np.arange(side) * 20.0, np.arange(side) * 20.0), -1).reshape(LOAD, 2)
    first = np.hstack([grid, np.ones((LOAD, 2))])
    second = (first + [0.5, -0.5, 0.1, 0.0])[::-1]  # the other source lists them the other way round
    msg = load(first, second, f"{LOAD} tracks")
    arrays = read(msg)
    assert len(set(arrays.track_id.tolist())) == LOAD
    assert set(arrays.source.tolist()) == {3}
    np.testing.assert_allclose(positions(msg), first + [0.25, -0.25, 0.05, 0.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(arrays.cov[:, 0], np.broadcast_to(np.eye(4) / 2, (LOAD, 4, 4)), rtol=0, atol=1e-12)
    again = read(load(first + [0.1, 0.1, 0.0, 0.0], second, "the same tracks a step later"))
    assert again.track_id.tolist() == arrays.track_id.tolist()
    assert load(GOOD[:0], GOOD[:0], "a miss of all").width == LOAD
    assert bench.diagnostics.rejected("load") == {}


# ---- other trackers ----------------------------------------------------------------------------------------------


def test_trackers_of_other_sensors_and_filters_count_bad_detections_and_track_on(
    ros_context: Any, ros_domain: int
) -> None:
    """Each scan holds one good detection beside the bad ones: the track is the one of the good ones alone."""
    axes = ["x", "y", "vx", "vy", "turn_rate"]
    radar = {"sensor": "range_bearing", "range_sd": 1.0, "bearing_sd": 0.01, "subscribers_deadline_s": START_S}
    initial = {
        "initial_mean": [3.0, 4.0, 0.0, 0.0, 0.1], "initial_cov": [1.0, 1.0, 1.0, 1.0, 0.01],
        "initial_stamp_s": FIRST_NS / 1e9,
    }  # fmt: skip
    turning = {"axes": axes, "motion": "coordinated_turn", **initial}
    given = {"cubature": turning, "particle": turning | {"particles": 50}, "pda": {"axes": list(AXES)}}
    good = np.array([[5.0, 0.9]])
    bad = [[NAN, 0.0], [5.0, math.inf], [-5.0, 0.9], [1e300, 0.9]]
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        diagnostics, outputs = Diagnostics(probe), {}
        for name, params in given.items():
            clean = f"{name}_clean"
            for node in (name, clean):
                chosen = {"use_sim_time": True, "filter": name, "expected_subscribers": 1, "role": "a"} | radar | params
                if name != "particle":
                    del chosen["role"]
                stack.enter_context(NodeProcess("sensor_tracker", node=node, params=chosen))
                outputs[node] = probe.listen(f"/{node}/tracks", PointCloud2)
        inputs = {node: probe.publisher(f"/{node}/detections", PointCloud2, deadline_s=START_S) for node in outputs}
        ticker = probe.publisher("/clock", Clock, readers=len(outputs), deadline_s=START_S)
        for k in range(1, 6):
            stamp = FIRST_NS + k * PERIOD_NS
            for node, publisher in inputs.items():
                values = good if node.endswith("_clean") else np.concatenate([bad[:2], good, bad[2:]])
                scan = DetectionArrays(("range", "bearing"), "map", stamp, values, None)
                publisher.publish(detection_table_to_msg(scan))

            def answered(count: int = k, stamp: int = stamp) -> bool:
                ticker.publish(clock(stamp))
                return all(len(messages) >= count for messages in outputs.values())

            probe.wait_for(answered, STEP_S, f"scan {k}")
        for name in given:
            assert [m.data for m in outputs[name]] == [m.data for m in outputs[f"{name}_clean"]]
            diagnostics.wait_for_counts(name, {"absurd_value": 5, "negative_range": 5, "not_finite": 10})
        assert outputs["cubature"][-1].width == 1
        assert outputs["particle"][-1].width == 50


def test_a_tracker_tells_of_a_detection_that_starts_no_track_and_goes_on(ros_context: Any, ros_domain: int) -> None:
    """A target at the sensor itself: its bearing says nothing. The scan is answered all the same, by no tracks."""
    params = {"use_sim_time": True, "filter": "extended", "sensor": "range_bearing", "axes": list(AXES)}
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        diagnostics, output = Diagnostics(probe), probe.listen("/radar/tracks", PointCloud2)
        node = stack.enter_context(
            NodeProcess("sensor_tracker", node="radar", params=params | {"expected_subscribers": 1})
        )
        scans = probe.publisher("/radar/detections", PointCloud2, deadline_s=START_S)
        ticker = probe.publisher("/clock", Clock, deadline_s=START_S)
        for k, distance in enumerate((0.0, 50.0), start=1):
            stamp = FIRST_NS + k * PERIOD_NS
            scan = DetectionArrays(("range", "bearing"), "map", stamp, np.array([[distance, 0.5]]), None)
            scans.publish(detection_table_to_msg(scan))

            def answered(count: int = k, stamp: int = stamp) -> bool:
                ticker.publish(clock(stamp))
                return len(output) >= count

            probe.wait_for(answered, STEP_S, f"scan {k}")
        diagnostics.wait_for_counts("radar", {"cannot_start": 1})
        assert [m.width for m in output] == [0, 1]
        assert node.running
