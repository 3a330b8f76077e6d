"""The replay node by itself: the options of a bag and of a scenario, and what it says when it cannot start."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes.support import SECOND_NS, START_S, STEP_S, deep, positions, read, stamp_ns
from ros_helpers import NodeProcess, Probe
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.detection_table import detection_table_from_msg
from msg_adapters.header import stamp_to_ns
from track_fusion.scenarios import get_scenario

BAG = Path(__file__).resolve().parents[1] / "data" / "golden" / "tracks"
FIRST_NS, PERIOD_NS = 1000 * SECOND_NS, SECOND_NS // 10
STAMPS = {
    "/sensor_1/tracks": [FIRST_NS + k * PERIOD_NS for k in range(60)],
    "/sensor_2/tracks": [FIRST_NS + k * PERIOD_NS for k in range(60) if k not in (28, 29)],
}
RECEIVED_NS = (FIRST_NS + 10**6, FIRST_NS + 59 * PERIOD_NS + 5 * 10**6)  # of the first and the last message
#: Wall time that a loaded machine may add to a replay.
SLACK_S = 5.0


def start(stack: ExitStack, name: str, topics: dict[str, str], **params: Any) -> NodeProcess:
    """Start a replay of the golden bag whose topics get other names, on a clock of its own."""
    given = {"bag": str(BAG), "bag_remaps": [f"{old}:={new}" for old, new in topics.items()], **params}
    return stack.enter_context(NodeProcess("replay", node=name, params=given, remaps={"/clock": f"/{name}/clock"}))


def took_s(process: NodeProcess) -> float:
    return float(re.search(r"Replayed \d+ messages in ([0-9.]+) s", process.output())[1])  # type: ignore[index]


def raw_messages(topic: str) -> list[bytes]:
    with Reader(BAG) as bag:
        return [bytes(raw) for connection, _, raw in bag.messages() if connection.topic == topic]


@pytest.mark.colcon
def test_a_bag_is_played_under_other_names_from_an_offset_and_at_a_rate(ros_context: Any) -> None:
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        names = {n: {t: f"/{n}{t}" for t in STAMPS} for n in ("all", "slow", "late")}
        names["one"] = {"/sensor_1/tracks": "/one/moved"}
        got = {n: {t: probe.listen(new, PointCloud2, 1000) for t, new in names[n].items()} for n in names}
        clocks = probe.listen("/all/clock", Clock, 10_000)
        processes = {
            "all": start(stack, "all", names["all"], rate=20.0),
            "slow": start(stack, "slow", names["slow"], rate=4.0),
            "late": start(stack, "late", names["late"], rate=20.0, bag_start_offset_s=3.0),
            "one": start(stack, "one", names["one"], rate=20.0, bag_topics=["/sensor_1/tracks"]),
        }
        counts = {"all": 118, "slow": 118, "late": 60, "one": 60}
        for name, process in processes.items():
            probe.wait_for(lambda n=name: sum(map(len, got[n].values())) >= counts[n], START_S, f"all of {name}")  # type: ignore[misc]
            assert process.wait(STEP_S) == 0
        for name in ("all", "slow"):
            assert {t: [stamp_ns(m) for m in msgs] for t, msgs in got[name].items()} == STAMPS
        # 3 s after the first message of the bag come those of the scans at 1003.0 s and later.
        late = {t: [s for s in stamps if s >= FIRST_NS + 30 * PERIOD_NS] for t, stamps in STAMPS.items()}
        assert {t: [stamp_ns(m) for m in msgs] for t, msgs in got["late"].items()} == late
        assert [stamp_ns(m) for m in got["one"]["/sensor_1/tracks"]] == STAMPS["/sensor_1/tracks"]
        length_s = (RECEIVED_NS[1] - RECEIVED_NS[0]) / SECOND_NS
        for name, bag_s, rate in (("all", length_s, 20.0), ("slow", length_s, 4.0), ("late", length_s - 3.0, 20.0)):
            assert bag_s / rate - 0.01 <= took_s(processes[name]) <= bag_s / rate + SLACK_S, name
        probe.wait_for(lambda: stamp_to_ns(clocks[-1].clock) >= RECEIVED_NS[1], STEP_S, "the last of the clock")
        times = [stamp_to_ns(m.clock) for m in clocks]
        assert times == sorted(times)
        assert len(times) > len(STAMPS)


def test_the_bytes_of_a_bag_arrive_as_they_were_recorded(ros_context: Any) -> None:
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        got: list[bytes] = []
        probe.node.create_subscription(PointCloud2, "/raw", got.append, 1000, raw=True)
        process = start(stack, "raw", {"/sensor_1/tracks": "/raw"}, rate=50.0, bag_topics=["/sensor_1/tracks"])
        probe.wait_for(lambda: len(got) >= 60, START_S, "the bag")
        assert process.wait(STEP_S) == 0
        want = raw_messages("/sensor_1/tracks")
        assert [a[: len(b)] for a, b in zip(got, want, strict=True)] == want
        assert all(len(a) == -(-len(b) // 4) * 4 for a, b in zip(got, want, strict=True))  # DDS pads to 4 bytes


def test_a_bag_is_played_in_a_loop_until_told_to_end(ros_context: Any) -> None:
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        got = probe.listen("/loop/tracks", PointCloud2, 1000)
        clocks = probe.listen("/loop/clock", Clock, 10_000)
        only = {"/sensor_1/tracks": "/loop/tracks"}
        process = start(stack, "loop", only, rate=40.0, bag_loop=True, bag_topics=list(only), bag_start_offset_s=2.0)

        def rewinds() -> int:
            return int((np.diff([stamp_to_ns(m.clock) for m in clocks]) < 0).sum())

        probe.wait_for(lambda: len(got) >= 90 and rewinds() >= 2, START_S, "the bag to be played for the third time")
        assert process.stop() == 0
        assert [stamp_ns(m) for m in got[:80]] == STAMPS["/sensor_1/tracks"][20:] * 2


def test_a_scenario_publishes_what_the_library_draws(ros_context: Any) -> None:
    """Also beyond the scenario's own 100 steps; at pace realtime nobody has to answer."""
    seed, run, steps, rate = 11, 4, 120, 100.0
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        topics = ("sensor_1/detections", "sensor_2/detections", "truth")
        seen = {s: probe.listen(f"/replay/{s}/detections", PointCloud2, 1000) for s in ("sensor_1", "sensor_2")}
        true = probe.listen("/replay/truth", PointCloud2, 1000)
        params = {"pace": "realtime", "rate": rate, "seed": seed, "run": run, "steps": steps}
        params |= {"expected_truth_subscribers": 1, **deep(*(f"/replay/{t}.publisher" for t in topics))}
        process = stack.enter_context(NodeProcess("replay", params=params))
        probe.wait_for(lambda: min(map(len, (*seen.values(), true))) >= steps, START_S, "all steps")
        assert process.wait(STEP_S) == 0
        tracking = get_scenario("li2022-linear").tracking
        assert tracking is not None
        truth = tracking.truth(seed, run, steps)
        tables = [read(m) for m in true]
        assert [t.time_ns.tolist() for t in tables] == [[k * SECOND_NS] for k in range(1, steps + 1)]
        states = [positions(m)[0] for m in true]
        np.testing.assert_array_equal(states, truth[1:])
        for sensor, drawn in tracking.measurements(truth, seed, run).items():
            scans = [detection_table_from_msg(m, ("x", "y")) for m in seen[sensor]]
            assert [s.time_ns for s in scans] == [k * SECOND_NS for k in range(1, steps + 1)]
            np.testing.assert_array_equal([s.value[0] for s in scans], drawn)
            np.testing.assert_array_equal(scans[0].cov[0], tracking.sensors[sensor].noise)  # type: ignore[index]
        took = float(re.search(r"Replayed 120 steps in ([0-9.]+) s", process.output())[1])  # type: ignore[index]
        assert (steps - 2) / rate <= took <= steps / rate + SLACK_S


#: Parameters, exit code, words that the one line must hold.
REFUSED: list[tuple[dict[str, Any], int, str]] = [
    ({"bag": "/nowhere/bag"}, 1, "The 'bag' parameter must be a rosbag2 directory. Got '/nowhere/bag'"),
    ({"bag": str(BAG.parent)}, 1, "The 'bag' parameter must be a rosbag2 directory."),
    ({"bag_remaps": ["/sensor_9/tracks:=/x"]}, 1, "The bag has no topic /sensor_9/tracks. It has /sensor_1/tracks,"),
    ({"bag_topics": ["/clock"]}, 1, "The bag has no topic /clock."),
    ({"bag_remaps": ["/sensor_1/tracks"]}, 2, "The 'bag_remaps' parameter must hold 'from:=to'."),
    ({"bag_start_offset_s": 7.0, "expected_subscribers_each": 0}, 1, "The bag has no message after 7 s."),
    ({"bag_awaited": ["/x"], "pace": "lockstep"}, 1, "The bag has no topic /x. It has /sensor_1/tracks,"),
    (
        {"pace": "lockstep", "expected_subscribers_each": 0, "deadline_s": 0.5},
        1,
        "/processed has no publisher",
    ),
    ({"rate": 0.0}, 2, "The 'rate' parameter must be a number > 0. Got 0.0."),
    ({"deadline_s": 0.5}, 1, "/sensor_1/tracks has no subscriber; /sensor_2/tracks has no subscriber"),
]


def test_a_replay_that_cannot_start_says_why_on_one_line(ros_domain: int) -> None:
    with ExitStack() as stack:
        started = [
            stack.enter_context(NodeProcess("replay", params={"bag": str(BAG), **params})) for params, _, _ in REFUSED
        ]
        for process, (params, code, wanted) in zip(started, REFUSED, strict=True):
            assert process.wait(START_S) == code, (params, process.output())
            (line,) = process.output().strip().splitlines()
            assert wanted in line


def test_a_scenario_whose_package_is_missing_says_which_on_one_line(ros_domain: int) -> None:
    script = "import sys; sys.modules['pymap3d'] = None\nfrom track_fusion.nodes.replay import main\nmain()"
    command = ["-c", script, "--ros-args", "-p", "scenario:=sharma-radars"]
    with NodeProcess("replay", command=command) as process:
        assert process.wait(START_S) == 1
        (line,) = process.output().strip().splitlines()
        assert "pip install pymap3d" in line
