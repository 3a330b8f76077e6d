"""Bags are read without ROS: the golden ones hold what their oracle wrote; what is no bag is named."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from track_fusion.bags.read import open_bag, read_bag
from track_fusion.params import Fault

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "test" / "data" / "golden"
SENSORS = ("/sensor_1/tracks", "/sensor_2/tracks")


def test_messages_come_by_topic_in_the_order_of_the_bag() -> None:
    messages = read_bag(GOLDEN / "tracks", SENSORS)
    assert {topic: len(of_topic) for topic, of_topic in messages.items()} == dict(zip(SENSORS, (60, 58), strict=True))
    for of_topic in messages.values():
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in of_topic]
        assert np.diff(stamps).min() > 0
        assert stamps[0] == 1000 * 10**9
        assert all(m.width * m.point_step == len(m.data) for m in of_topic)


def test_a_topic_that_is_not_there_has_no_messages_and_others_are_left_out() -> None:
    assert read_bag(GOLDEN / "tracks", ["/nowhere"]) == {"/nowhere": []}
    assert read_bag(GOLDEN / "tracks", []) == {}


def test_what_is_no_bag_is_named(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(Fault, match=f"The 'bag' parameter must be a rosbag2 directory. Got '{path}'"):
            open_bag(path)


def test_neither_ros_nor_rosbags_is_needed_to_load_the_module() -> None:
    script = (
        "import sys; sys.modules.update(rclpy=None, rosbags=None)\n"
        "from track_fusion.bags.read import read_bag\n"
        "try: read_bag('anywhere', [])\n"
        "except Exception as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout == (
        "Reading a bag needs the Python package rosbags: pip install rosbags. On a robot, use ros2 bag play.\n"
    )
