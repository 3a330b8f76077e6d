"""One run of a demonstration by real processes, seen from a node in this one."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import PointCloud2

from msg_adapters.track_table import track_table_from_msg
from track_fusion.demo.bringup import Nodes, local_environment, running, start_scenario
from track_fusion.demo.plan import Demo
from track_fusion.demo.wiring import FUSED, TRUTH
from track_fusion.nodes.managed import qos
from track_fusion.nodes.recorder import Recorder
from track_fusion.params import Fault, specs
from track_fusion.tracks import StateLayout, TrackBatch

#: A run that takes longer than this has hung.
RUN_DEADLINE_S = 300.0
#: From the end of the nodes to that of their last messages.
LAST_MESSAGES_S = 5.0
#: Domains that Linux's default range of ephemeral ports leaves free.
DOMAINS = 101
TABLE = "sensor_msgs/msg/PointCloud2"

Progress = Callable[[str, float], None]


def over_ros(demo: Demo, rule: str | None, progress: Progress) -> dict[str, float]:
    """Run the scenario once by real processes, with a rule or (None) without fusion; return its figures.

    Raises
    ------
    Fault    a node failed or hung, or steps are missing; the message names the nodes' log
    """
    name = rule or "alone"
    judged, log = demo.out / f"evaluation_{name}.json", demo.out / f"nodes_{name}.log"
    fused = _run(demo, rule, judged, log, lambda share: progress(f"ROS, {name}", share))
    result = json.loads(judged.read_text())
    judged.unlink()
    if result["times"] != demo.results or result["unjudged"] or (result["missed"] and not demo.many_targets):
        raise Fault(
            f"{name}: {result['times']} of {demo.results} steps were judged, {result['unjudged']} samples could not "
            f"be, {result['missed']} were missed; see {log}."
        )
    if demo.scenario.judge is None:
        return {k: v for k, v in result["all"].items() if "armse" in k}
    row = f"{demo.row}-{name}"
    figures = demo.scenario.figures(demo.scenario.judge(row, fused))
    return {figure.removeprefix(f"{row}/"): e.value for figure, e in figures.items()}


def _run(demo: Demo, rule: str | None, judged: Path, log: Path, progress: Callable[[float], None]) -> list[TrackBatch]:
    """Run to the end, recording the last rule; return the fused tracks where the scenario judges them itself."""
    domain = (os.getpid() + len(rule or "alone")) % DOMAINS
    topics = _recorded(demo) if rule == demo.rules[-1] else {}
    ticks: list[Any] = []
    tables: list[Any] = []
    with running(local_environment(domain), log) as nodes, _observer(domain) as (node, spin):
        recorder = Recorder(node, demo.out / "bag", topics) if topics else None
        node.create_subscription(ClockMessage, "/clock", ticks.append, qos(1000))
        if demo.many_targets:
            node.create_subscription(PointCloud2, FUSED, tables.append, qos(1000))
        key = rule and rule.partition("@")[0]
        start_scenario(nodes, demo.name, key, _overrides(demo, rule, judged, topics))
        _wait(nodes, log, spin, lambda: progress(len(ticks) / demo.scene.steps))
        deadline = time.monotonic() + LAST_MESSAGES_S
        while time.monotonic() < deadline and (
            (demo.many_targets and len(tables) < demo.results)
            or (recorder is not None and min(recorder.counts[t] for t in topics) < demo.results)
        ):
            spin()
        if recorder is not None:
            recorder.close()
    progress(1.0)
    scans = map(track_table_from_msg, tables)
    return [TrackBatch(layout=StateLayout(scan.axes), **scan.columns) for scan in scans]


def _recorded(demo: Demo) -> dict[str, str]:
    """Topics of the bag and their types; of many targets all but the detections, which are very many."""
    topics = {TRUTH: TABLE, **{f"/{s}/tracks": TABLE for s in demo.scene.sensors}, FUSED: TABLE}
    return topics | ({} if demo.many_targets else {f"/replay/{s}/detections": TABLE for s in demo.scene.sensors})


def _overrides(demo: Demo, rule: str | None, judged: Path, topics: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Parameters on top of the scenario's file; every output waits for all who read it, the recorder of topics, too."""
    file, sensors = demo.bringup.sections, list(demo.scene.sensors)
    replay = {
        "seed": demo.seed,
        "expected_truth_subscribers": 1 + (TRUTH in topics),
        "expected_subscribers_each": 1 + (f"/replay/{sensors[0]}/detections" in topics),
    }
    overrides: dict[str, dict[str, Any]] = {"evaluator": {"output": str(judged)}, "replay": replay}
    if rule is None:
        return {**overrides, sensors[0]: {"expected_subscribers": 2}}  # replay and evaluator
    for name in (*sensors, "fusion_centre"):
        readers = file[name]["expected_subscribers"] + (f"/{name}/tracks" in topics)
        overrides[name] = {"expected_subscribers": readers}
    overrides["fusion_centre"]["expected_subscribers"] += demo.many_targets
    overrides["fusion_centre"] |= _variant(demo, rule)
    return overrides


def _variant(demo: Demo, rule: str) -> dict[str, Any]:
    """Parameters in which a variant differs from the defaults; those of the scenario's own rules are in its file."""
    choice = next((c for c in demo.scenario.rules if c.name == rule and c.variant), None)
    if choice is None:
        return {}
    values = {name: (getattr(choice.params, name), default) for name, (_, default) in specs(choice.params).items()}
    given = {f"{choice.key}.{name}": value for name, (value, default) in values.items() if value != default}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in given.items()}


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
