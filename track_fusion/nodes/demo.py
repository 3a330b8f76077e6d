"""The demonstration: a published scenario run by real nodes, recorded, judged and drawn."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage

from msg_adapters.odometry import odometry_from_msg
from msg_adapters.track_table import track_table_from_msg
from track_fusion.metrics.accuracy import Estimate
from track_fusion.nodes.bringup import Nodes, local_environment, running, start_scenario
from track_fusion.nodes.managed import Fault, qos
from track_fusion.nodes.recorder import Recorder, read_bag
from track_fusion.report.picture import Line, draw
from track_fusion.scenarios import Scenario, get_scenario, judged_figures

#: What the tracker nodes run: the rows of a scenario that start with this.
NODE_FILTER = "kf-"
#: A run over ROS that takes longer than this has hung.
RUN_DEADLINE_S = 60.0
#: Domains that Linux's default range of ephemeral ports leaves free.
DOMAINS = 101
TRUTH = "/replay/truth"
FUSED = "/fusion_centre/tracks"
TABLE, ODOMETRY = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"
COLORS = {"truth": "black", "sensor_1": "tab:blue", "sensor_2": "tab:orange", "fused": "tab:red"}

Progress = Callable[[str, float], None]


@dataclasses.dataclass(frozen=True)
class Demo:
    """What a demonstration runs.

    Attributes
    ----------
    scenario : Scenario          one that runs over ROS
    rules : tuple of str         fusion rules besides the unfused first sensor; the last is recorded and drawn
    out : Path                   results; an earlier result there is replaced
    seed : int                   of the random streams, run 0
    library_runs : int           Monte Carlo runs of the library for comparison
    """

    scenario: Scenario
    rules: tuple[str, ...]
    out: Path
    seed: int = 0
    library_runs: int = 1000


def run_demo(demo: Demo, progress: Progress) -> dict[str, Any]:
    """Run all, write bag, figures.json and picture; return what figures.json holds.

    Parameters
    ----------
    demo : Demo
    progress : callable    (what is being done, done share of it)

    Raises
    ------
    Fault    a node failed or hung; the message names its log
    """
    if demo.out.exists():
        shutil.rmtree(demo.out)
    demo.out.mkdir(parents=True)
    over_ros: dict[str, dict[str, float]] = {}
    for rule in (None, *demo.rules):
        over_ros[rule or "alone"] = _over_ros(demo, rule, progress)
    scenario = demo.scenario
    label = f"library, {demo.library_runs} runs"
    same = scenario.study(1, demo.seed, lambda share: None, NODE_FILTER)
    many = scenario.study(demo.library_runs, demo.seed, lambda share: progress(label, share), NODE_FILTER)
    result = _figures(demo, over_ros, same, many)
    (demo.out / "figures.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    _picture(demo)
    return result


def _over_ros(demo: Demo, rule: str | None, progress: Progress) -> dict[str, float]:
    """Run the scenario once by real processes; return the evaluator's figures."""
    name = rule or "alone"
    judged = demo.out / f"evaluation_{name}.json"
    log = demo.out / f"nodes_{name}.log"
    domain = (os.getpid() + len(name)) % DOMAINS
    recording = rule == demo.rules[-1]
    with running(local_environment(domain), log) as nodes, _observer(domain) as (node, spin):
        sensors = list(demo.scenario.tracking.sensors) if demo.scenario.tracking else []
        topics = {TRUTH: ODOMETRY, **{f"/{s}/tracks": TABLE for s in sensors}, FUSED: TABLE}
        topics |= {f"/replay/{s}/detections": TABLE for s in sensors}
        recorder = Recorder(node, demo.out / "bag", topics) if recording else None
        seen = _clock_counter(node)
        start_scenario(nodes, demo.scenario.key, rule, _overrides(demo, rule, sensors, judged, recording))
        steps = demo.scenario.tracking.steps if demo.scenario.tracking else 1
        _wait(nodes, log, spin, lambda: progress(f"ROS, {name}", seen() / steps))
        if recorder is not None:
            deadline = time.monotonic() + 5.0
            while min(recorder.counts[t] for t in topics) < steps and time.monotonic() < deadline:
                spin()
            recorder.close()
    progress(f"ROS, {name}", 1.0)
    result = json.loads(judged.read_text())
    judged.unlink()
    if result["times"] != steps or result["missed"]:
        raise Fault(f"{name}: {result['times']} of {steps} steps were judged, {result['missed']} missed; see {log}.")
    return {k: v for k, v in result["all"].items() if "armse" in k}


def _overrides(
    demo: Demo, rule: str | None, sensors: list[str], judged: Path, recording: bool
) -> dict[str, dict[str, Any]]:
    """Parameters on top of the scenario's file; every output waits for all who read it."""
    extra = int(recording)
    overrides: dict[str, dict[str, Any]] = {
        "evaluator": {"output": str(judged)},
        "replay": {"seed": demo.seed, "expected_truth_subscribers": 1 + extra, "expected_subscribers_each": 1 + extra},
    }
    if rule is None:
        overrides[sensors[0]] = {"expected_subscribers": 2}  # replay and evaluator
        return overrides
    overrides |= {s: {"expected_subscribers": 1 + extra} for s in sensors}
    overrides["fusion_centre"] = {"expected_subscribers": 2 + len(sensors) + extra}
    return overrides


@contextmanager
def _observer(domain: int) -> Iterator[tuple[Node, Callable[[], None]]]:
    """Give a node in this process and the function that lets it work."""
    context = Context()
    context.init(args=[], domain_id=domain)
    executor = SingleThreadedExecutor(context=context)
    try:
        use_sim_time = Parameter("use_sim_time", Parameter.Type.BOOL, True)
        node = Node("observer", context=context, use_global_arguments=False, parameter_overrides=[use_sim_time])
        executor.add_node(node)
        yield node, lambda: executor.spin_once(timeout_sec=0.05)
    finally:
        executor.shutdown()
        context.try_shutdown()


def _clock_counter(node: Node) -> Callable[[], int]:
    count = 0

    def on_clock(msg: Any) -> None:
        nonlocal count
        count += 1

    node.create_subscription(ClockMessage, "/clock", on_clock, qos(1000))
    return lambda: count


def _wait(nodes: Nodes, log: Path, spin: Callable[[], None], report: Callable[[], None]) -> None:
    """Let the run come to its end, or say which node failed."""
    deadline = time.monotonic() + RUN_DEADLINE_S
    ending = [nodes.processes[name] for name in ("replay", "evaluator")]
    while any(p.poll() is None for p in ending):
        if failed := nodes.failed():
            last = (log.read_text().strip().splitlines() or ["(it said nothing)"])[-1]
            raise Fault(f"The node {failed} failed: {last} (all output: {log})")
        if time.monotonic() > deadline:
            raise Fault(f"The run did not end within {RUN_DEADLINE_S:g} s; see {log}.")
        spin()
        report()


def _figures(
    demo: Demo, over_ros: dict[str, dict[str, float]], same: dict[str, Estimate], many: dict[str, Estimate]
) -> dict[str, Any]:
    """Bring all into the form of `reproduce`: ros/ and library/ are the same one run, library/...@N-runs the study.

    The standard error of one run is the spread of a run in the study.
    """
    scenario, rows = demo.scenario, [NODE_FILTER + name for name in over_ros]
    listed: list[dict[str, Any]] = []
    for row, measured in zip(rows, over_ros.values(), strict=True):
        for quantity in measured:
            name = f"{row}/{quantity}"
            for path, value in (("ros", measured[quantity]), ("library", same[name].value)):
                single = Estimate(value, many[name].spread(1), 1)
                (figure,) = judged_figures(scenario, {name: single})
                listed.append({**figure, "name": f"{path}/{name}"})
    for figure in judged_figures(scenario, many):
        name = figure["name"]
        row, _, quantity = name.rpartition("/")
        variant = f"{row},{demo.library_runs}-runs" if "@" in row else f"{row}@{demo.library_runs}-runs"
        listed.append({**figure, "name": f"library/{variant}/{quantity}"})
    return {
        "scenario": scenario.key,
        "runs": 1,
        "seed": demo.seed,
        "library_runs": demo.library_runs,
        "figures": listed,
    }


def _picture(demo: Demo) -> None:
    """Draw what the bag holds."""
    tracking = demo.scenario.tracking
    assert tracking is not None
    axes, sensors = tracking.motion.layout.axes, list(tracking.sensors)
    topics = {**{s: f"/{s}/tracks" for s in sensors}, "fused": FUSED}
    messages = read_bag(demo.out / "bag", (TRUTH, *topics.values()))
    states = np.array([odometry_from_msg(m, axes).tracks.mean[0, 0] for m in messages[TRUTH]])
    lines = []
    for name, topic in topics.items():
        tables = [track_table_from_msg(m) for m in messages[topic]]
        mean, cov = np.array([t.mean[0, 0, :2] for t in tables]), np.array([t.cov[0, 0, :2, :2] for t in tables])
        label = f"fused: {demo.rules[-1].replace('_', ' ')}" if name == "fused" else name.replace("_", " ")
        lines.append(Line(label, COLORS.get(name, "tab:green"), mean, cov))
    title = f"{demo.scenario.title}: fused over ROS 2 and fed back to both trackers (one run)"
    draw(demo.out / "tracks.png", title, Line("truth", COLORS["truth"], states[:, :2]), lines)


def demo_of(key: str, out: Path, seed: int, library_runs: int, rules: tuple[str, ...] = ()) -> Demo:
    """Make the demonstration of a scenario; its rules are the scenario's own unless given.

    Raises
    ------
    ParameterError    no such scenario
    Fault             the scenario does not run over ROS
    """
    scenario = get_scenario(key)
    if scenario.tracking is None:
        raise Fault(f"The scenario {key} runs in the library only: track-fusion reproduce {key}.")
    paper = tuple(dict.fromkeys(c.key for c in scenario.rules if not c.variant))
    return Demo(scenario, rules or paper, out, seed, library_runs)
