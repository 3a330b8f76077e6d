"""Bags read without ROS: the messages are those that ROS would deserialise, also to the adapters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import TrackArrays
from msg_adapters.odometry import odometry_from_msg, odometry_to_msgs
from msg_adapters.track_table import track_table_from_msg
from track_fusion.bags.read import read_bag
from track_fusion.tracks import TrackBatch, planar_layout

GOLDEN = Path(__file__).resolve().parents[1] / "data" / "golden" / "tracks"
TOPICS = ("/sensor_1/tracks", "/sensor_2/tracks")


def assert_same(one: TrackArrays, other: TrackArrays) -> None:
    assert (one.axes, one.frame_id, one.phd) == (other.axes, other.frame_id, other.phd)
    for name, value in one.columns.items():
        np.testing.assert_array_equal(value, other.columns[name], err_msg=name)


def test_the_adapters_read_tables_of_a_bag_as_those_of_ros() -> None:
    wanted: dict[str, list[TrackArrays]] = {topic: [] for topic in TOPICS}
    with Reader(GOLDEN) as bag:
        for connection, _, raw in bag.messages():
            if connection.topic in wanted:
                wanted[connection.topic].append(track_table_from_msg(deserialize_message(bytes(raw), PointCloud2)))
    messages = read_bag(GOLDEN, TOPICS)
    assert {topic: len(given) for topic, given in messages.items()} == {TOPICS[0]: 60, TOPICS[1]: 58}
    for topic, given in messages.items():
        for msg, arrays in zip(given, wanted[topic], strict=True):
            assert_same(track_table_from_msg(msg), arrays)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_odometry_too(storage: StoragePlugin, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    covs = np.eye(4) * rng.uniform(1, 2, (5, 1, 1))
    batch = TrackBatch.gaussian(planar_layout(), "map", rng.normal(size=(5, 4)), covs, time_ns=7, track_id=np.arange(5))
    sent = odometry_to_msgs(batch, batch.layout.axes)
    with Writer(tmp_path / "bag", version=9, storage_plugin=storage) as bag:
        connection = bag.add_connection("/o", "nav_msgs/msg/Odometry", typestore=get_typestore(Stores.ROS2_JAZZY))
        for k, msg in enumerate(sent):
            bag.write(connection, k, serialize_message(msg))
    for msg, again in zip(sent, read_bag(tmp_path / "bag", {"/o"})["/o"], strict=True):
        assert type(again) is not Odometry
        wanted, got = (odometry_from_msg(m, batch.layout.axes).tracks for m in (msg, again))
        assert_same(got, wanted)
