"""`track-fusion bag fuse`: the golden bags against their oracles, what is copied, what is refused, what ends it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags.support import GOLDEN, ROOT, SENSORS, expected, params_file
from cli.runner import refusal, run
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from msg_adapters.track_table import track_table_from_msg, track_table_to_msg
from track_fusion.bags.fuse import FUSED, TABLE, centre_of
from track_fusion.bags.read import deserialised, read_bag
from track_fusion.bags.write import add_topic, bag_class, serialised
from track_fusion.tracks import TrackBatch, planar_layout

TOLERANCE = 1e-9  # of the largest entry
SECOND = 10**9


def contents(bag: Path) -> list[tuple[str, int, bytes]]:
    with Reader(bag) as reader:
        return [(connection.topic, time_ns, bytes(data)) for connection, time_ns, data in reader.messages()]


def compare(bag: Path, oracle: str) -> None:
    """Compare the fused tables of a bag with the oracle's, step by step."""
    steps, messages = expected(oracle)["steps"], read_bag(bag, [FUSED])[FUSED]
    stamps = [m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in messages]
    assert stamps == [s["stamp_ns"] for s in steps]
    for step, msg in zip(steps, messages, strict=True):
        got, want = track_table_from_msg(msg), step["tracks"]
        for field in ("track_id", "source", "status"):
            assert getattr(got, field).tolist() == [t[field] for t in want]
        for k, track in enumerate(want):
            for value, of_oracle in ((got.mean[k, 0], track["mean"]), (got.cov[k, 0], track["cov"])):
                np.testing.assert_allclose(value, of_oracle, rtol=0, atol=TOLERANCE * np.abs(of_oracle).max())


@pytest.mark.parametrize(
    ("oracle", "storage"),
    [("naive", "mcap"), ("covariance_intersection", "sqlite3"), ("arithmetic_average", "mcap"), ("odometry", "mcap")],
)
def test_a_golden_bag_gives_what_its_oracle_expects_beside_all_it_holds(
    oracle: str, storage: str, tmp_path: Path
) -> None:
    bag, out = GOLDEN / ("odometry" if oracle == "odometry" else "tracks"), tmp_path / "out"
    words = ("--params", str(params_file(tmp_path, oracle)), "--out", str(out), "--storage", storage, "--tail", "1000")
    result = run("bag", "fuse", str(bag), *words)
    assert result.exit_code == 0, result.output
    compare(out, oracle)
    written = contents(out)
    assert [item for item in written if item[0] != FUSED] == contents(bag)
    assert [item[1] for item in written] == sorted(item[1] for item in written)
    assert {p.suffix for p in out.iterdir()} == {".yaml", {"mcap": ".mcap", "sqlite3": ".db3"}[storage]}


def test_a_bag_is_fused_again_from_its_copy(tmp_path: Path) -> None:
    """Fused tracks that the bag has already are not taken along."""
    params, first, second = params_file(tmp_path, "naive"), tmp_path / "first", tmp_path / "second"
    for bag, out in ((GOLDEN / "tracks", first), (first, second)):
        assert run("bag", "fuse", str(bag), "--params", str(params), "--out", str(out)).exit_code == 0
    assert contents(second) == contents(first)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"proces_noise": 1.0}, "Unknown parameter 'proces_noise'. Did you mean 'process_noise'?"),
        ({"sensor_1.topik": "/x"}, "Unknown parameter 'sensor_1.topik'. Did you mean 'sensor_1.topic'?"),
        ({"process_noise": -1.0}, "The 'process_noise' parameter must be a number >= 0. Got -1.0."),
        ({"harmonic_mean.weights": [0.5, 0.5]}, "belongs to 'harmonic_mean', but state_fusion is 'naive'"),
        ({"sensor_1.topic": "/radar"}, "The 'sensor_1.topic' parameter must be a topic of the bag. Got '/radar'. Of "),
        ({"source_types": ["odometry", "track_table"]}, "says that sensor_1 sends nav_msgs/msg/Odometry, but /sensor"),
    ],
)
def test_a_wrong_parameter_is_told_as_by_the_node(given: Mapping[str, Any], words: str, tmp_path: Path) -> None:
    params = params_file(tmp_path, "naive", **given)
    line = refusal(run("bag", "fuse", str(GOLDEN / "tracks"), "--params", str(params), "--out", str(tmp_path / "o")))
    assert words in line
    assert not (tmp_path / "o").exists()


def test_what_cannot_be_had_is_told(tmp_path: Path) -> None:
    params, bag = str(params_file(tmp_path, "naive")), str(GOLDEN / "tracks")
    other = tmp_path / "other.yaml"
    other.write_text("sensor_tracker:\n  ros__parameters: {}\n")
    for words, code, line in (
        ((str(tmp_path), "--params", params, "--out", str(tmp_path / "o")), 1, "must be a rosbag2 directory"),
        ((bag, "--params", params, "--out", str(tmp_path)), 1, "exists already; a bag is not overwritten."),
        ((bag, "--params", str(tmp_path / "no"), "--out", "o"), 1, "no cannot be read: No such file"),
        ((bag, "--params", str(other), "--out", "o"), 2, "no parameters for /fusion_centre. It has sensor_tracker."),
    ):
        result = run("bag", "fuse", *words)
        assert (result.exit_code, line in result.stderr) == (code, True), result.stderr


def long_bag(folder: Path, steps: int, sources: int = 2, tracks: int = 5) -> Path:
    """Make a bag of slowly moving tracks at 10 Hz."""
    rng, layout = np.random.default_rng(0), planar_layout()
    mean = np.concatenate([100.0 * rng.normal(size=(tracks, 2)), np.zeros((tracks, 2))], 1)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = [add_topic(bag, f"/sensor_{k + 1}/tracks", TABLE) for k in range(sources)]
        for step in range(1, steps + 1):
            for k, topic in enumerate(topics):
                seen = mean + rng.normal(size=mean.shape)
                stamp_ns = step * SECOND // 10
                batch = TrackBatch.gaussian(layout, "map", seen, np.tile(np.eye(4), (tracks, 1, 1)), time_ns=stamp_ns)
                msg = track_table_to_msg(batch, layout.axes, stamp_ns, bag_class)
                bag.write(topic, stamp_ns + k * 1000, serialised(msg))
    return folder


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_whole_bag(number: signal.Signals, tmp_path: Path) -> None:
    bag, out, steps = long_bag(tmp_path / "bag", 4000), tmp_path / "out", 4000
    command = ["bag", "fuse", str(bag), "--params", str(params_file(tmp_path, "naive")), "--out", str(out)]
    with subprocess.Popen(
        [sys.executable, "-m", "track_fusion.cli", *command], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        while process.poll() is None and not (out.is_dir() and any(p.stat().st_size > 50_000 for p in out.iterdir())):
            pass
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert b"Interrupted; what was fused by then is written." in said
    written = contents(out)
    copied = [item for item in written if item[0] != FUSED]
    assert copied == contents(bag)[: len(copied)]
    fused = len(written) - len(copied)
    assert 0 < fused < steps
    assert fused == len(copied) // 2


def test_bad_messages_are_counted_and_harm_nothing(tmp_path: Path) -> None:
    bag, layout = tmp_path / "bag", planar_layout()
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [add_topic(writer, f"/{s}/tracks", TABLE) for s in SENSORS]
        for step, frame in ((1, "map"), (2, "odom"), (3, "map")):
            batch = TrackBatch.gaussian(layout, frame, np.zeros((1, 4)), np.eye(4)[None], time_ns=step * SECOND)
            msg = track_table_to_msg(batch, layout.axes, step * SECOND, bag_class)
            for topic in topics:
                writer.write(topic, step * SECOND, serialised(msg))
    params = params_file(tmp_path, "naive")
    result = run("bag", "fuse", str(bag), "--params", str(params), "--out", str(tmp_path / "out"))
    assert result.exit_code == 0
    assert "6 messages, 2 fused tables" in result.stdout
    assert "       2  rejected: wrong_frame" in result.stdout
    assert result.stderr.count("Rejected (wrong_frame)") == 1


def test_no_ros_package_is_needed(tmp_path: Path) -> None:
    """Nor is any loaded where there is one."""
    out = tmp_path / "out"
    words = ["bag", "fuse", str(GOLDEN / "odometry"), "--params", str(params_file(tmp_path, "odometry")), "--out"]
    hidden = "sensor_msgs std_msgs nav_msgs geometry_msgs builtin_interfaces visualization_msgs rclpy"
    script = (
        f"import sys; sys.modules.update(dict.fromkeys({hidden!r}.split()))\n"
        f"from track_fusion.cli import main\nsys.argv[1:] = {[*words, str(out), '--tail', '1000']!r}\nmain()"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    compare(out, "odometry")


def test_a_message_written_without_ros_is_read_as_it_was() -> None:
    layout = planar_layout()
    batch = TrackBatch.gaussian(layout, "map", np.ones((3, 4)), np.tile(np.eye(4), (3, 1, 1)), time_ns=7)
    for tracks in (batch, TrackBatch.empty(layout, "map")):
        data = serialised(track_table_to_msg(tracks, layout.axes, 7, bag_class))
        back = track_table_from_msg(deserialised(data, TABLE))
        for name, value in back.columns.items():
            np.testing.assert_array_equal(value, getattr(tracks, name))


def test_the_first_robot_of_the_page_is_a_centre(tmp_path: Path) -> None:
    page = (ROOT / "doc" / "fusion-centre.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert len(block.splitlines()) == 10
    (tmp_path / "robot.yaml").write_text(block)
    centre = centre_of(tmp_path / "robot.yaml", print)
    assert [(s.name, s.topic, s.kind.whole_scan) for s in centre.sources] == [
        ("radar", "/radar/tracks", True), ("camera", "/camera/odometry", False),
    ]  # fmt: skip
    assert centre.centre.config.sources[1].settings.bias_sd == 0.3
