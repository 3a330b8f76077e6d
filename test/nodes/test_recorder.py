"""Recording to a rosbag2 directory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from nodes.support import SECOND_NS, STEP_S, clock, stamp_ns, track_table
from rclpy.parameter import Parameter
from ros_helpers import Probe
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from track_fusion.bags.read import read_bag
from track_fusion.nodes.recorder import Recorder
from track_fusion.params import Fault

TYPE = "sensor_msgs/msg/PointCloud2"


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_messages_before_the_clock_begins_are_stamped_with_its_first_time(
    storage: str, ros_context: Any, tmp_path: Path
) -> None:
    """A time of 0 for them would make the bag last since 1970."""
    sim_time = Parameter("use_sim_time", Parameter.Type.BOOL, True)
    with Probe(ros_context, parameter_overrides=[sim_time]) as probe:
        recorder = Recorder(probe.node, tmp_path / "bag", {"/tracks": TYPE}, storage)
        out, ticker = probe.publisher("/tracks", PointCloud2), probe.publisher("/clock", Clock)
        sent = [track_table(k * SECOND_NS, [[k, 0.0, 0.0, 0.0]]) for k in (100, 101)]
        for k, msg in enumerate(sent):
            out.publish(msg)
            probe.wait_for(lambda n=k: recorder.counts["/tracks"] > n, STEP_S, "the message")  # type: ignore[misc]
            ticker.publish(clock(100 * SECOND_NS + 5))
            probe.wait_for(lambda: probe.node.get_clock().now().nanoseconds, STEP_S, "the clock")
        recorder.close()
    with Reader(tmp_path / "bag") as bag:
        assert [t for _, t, _ in bag.messages()] == [100 * SECOND_NS + 5] * 2
    again = read_bag(tmp_path / "bag", ("/tracks",))["/tracks"]
    assert [(stamp_ns(m), m.data.tobytes()) for m in again] == [(stamp_ns(m), m.data.tobytes()) for m in sent]


def test_a_bag_is_not_overwritten_and_the_storage_must_be_known(ros_context: Any, tmp_path: Path) -> None:
    with Probe(ros_context) as probe:
        with pytest.raises(Fault, match="exists already; a bag is not overwritten"):
            Recorder(probe.node, tmp_path, {"/tracks": TYPE})
        with pytest.raises(Fault, match="must be one of mcap, sqlite3. Got 'csv'"):
            Recorder(probe.node, tmp_path / "bag", {"/tracks": TYPE}, "csv")
        with pytest.raises(Fault, match="The type no_msgs/msg/None cannot be had"):
            Recorder(probe.node, tmp_path / "bag", {"/tracks": "no_msgs/msg/None"})
