"""Bags are read without ROS; what is none says so."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from track_fusion.bags.read import open_bag, read_bag
from track_fusion.params import Fault

pytest.importorskip("rosbags")

BAG = Path(__file__).parents[1] / "data" / "golden" / "tracks"
TOPICS = ("/sensor_1/tracks", "/sensor_2/tracks")


def test_messages_come_by_topic_in_order() -> None:
    messages = read_bag(BAG, TOPICS)
    assert list(messages) == list(TOPICS)
    for topic in TOPICS:
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages[topic]]
        assert len(stamps) > 50
        assert stamps == sorted(stamps)
    assert {m.header.frame_id for m in messages[TOPICS[0]]} == {"map"}


def test_a_topic_that_the_bag_lacks_has_no_messages() -> None:
    assert read_bag(BAG, ["/nowhere"]) == {"/nowhere": []}


def test_what_is_no_bag_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(Fault, match=f"must be a rosbag2 directory. Got '{tmp_path}'"):
        open_bag(tmp_path)


def test_without_rosbags_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(Fault, match="pip install rosbags"):
        open_bag(BAG)
