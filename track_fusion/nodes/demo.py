"""The demonstration: a published scenario run by real nodes, recorded, judged and drawn."""

from __future__ import annotations

import dataclasses
import json
import math
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

from msg_adapters.arrays import merged
from msg_adapters.odometry import odometry_from_msg
from msg_adapters.track_table import track_table_from_msg
from track_fusion.metrics.accuracy import Estimate
from track_fusion.nodes.bringup import Bringup, Nodes, bringups, local_environment, running, start_scenario
from track_fusion.nodes.managed import Fault, qos
from track_fusion.nodes.recorder import Recorder, read_bag
from track_fusion.params import ParameterError, specs, unknown_name_error
from track_fusion.report.picture import Line, draw
from track_fusion.rules import get_rule
from track_fusion.scenarios import SCENARIOS, RuleChoice, Scenario, Tracking, get_scenario, judged_figures

#: How a scenario's rows name what the tracker nodes run.
ROWS = {"kalman": "kf", "extended": "ekf", "unscented": "ukf", "cubature": "ckf", "particle": "sir", "student_t": "stf"}
#: Rules that a scenario which has them all is shown with; the last is recorded and drawn.
RULES = ("naive", "covariance_intersection", "arithmetic_average")
#: A run over ROS that takes longer than this has hung.
RUN_DEADLINE_S = 120.0
#: Library runs to compare with where they cost little.
FAST_RUNS = 1000
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
    name : str                   of the parameter file
    scenario : Scenario          the one of that file
    row : str                    beginning of its rows, as the scenario names the trackers' filter: kf
    rules : tuple of str         fusion rules, `key` or `key@variant`, besides the unfused first sensor; the last is
                                 recorded and drawn
    out : Path                   results; an earlier result there is replaced
    seed : int                   of the random streams, run 0
    library_runs : int           Monte Carlo runs of the library for comparison
    """

    name: str
    scenario: Scenario
    row: str
    rules: tuple[str, ...]
    out: Path
    seed: int = 0
    library_runs: int = 1000

    @property
    def tracking(self) -> Tracking:
        """What the nodes run."""
        assert self.scenario.tracking is not None
        return self.scenario.tracking

    def choice(self, rule: str) -> RuleChoice | None:
        """The scenario's own choice of parameters under this name."""
        return next((c for c in self.scenario.rules if c.name == rule), None)


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
    rows = [f"{demo.row}-{name}" for name in over_ros]
    same, label = _library(demo, rows, 1, lambda share: None), f"library, {demo.library_runs} runs"
    many = _library(demo, rows, demo.library_runs, lambda share: progress(label, share))
    result = _figures(demo, over_ros, same, many)
    (demo.out / "figures.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    _picture(demo)
    return result


def _library(demo: Demo, rows: list[str], runs: int, progress: Callable[[float], None]) -> dict[str, Estimate]:
    """Measure the rows that the scenario has; it may know nothing of a rule that the user has asked for."""
    found: dict[str, Estimate] = {}
    for done, row in enumerate(rows):

        def part(share: float, done: int = done) -> None:
            progress((done + share) / len(rows))

        try:
            measured = demo.scenario.study(runs, demo.seed, part, row)
        except ParameterError:
            continue
        found |= {name: estimate for name, estimate in measured.items() if name.startswith(f"{row}/")}
    progress(1.0)
    return found


def _over_ros(demo: Demo, rule: str | None, progress: Progress) -> dict[str, float]:
    """Run the scenario once by real processes; return the evaluator's figures."""
    name = rule or "alone"
    judged = demo.out / f"evaluation_{name}.json"
    log = demo.out / f"nodes_{name}.log"
    domain = (os.getpid() + len(name)) % DOMAINS
    recording = rule == demo.rules[-1]
    with running(local_environment(domain), log) as nodes, _observer(domain) as (node, spin):
        sensors = list(demo.tracking.sensors)
        topics = {TRUTH: ODOMETRY, **{f"/{s}/tracks": TABLE for s in sensors}, FUSED: TABLE}
        topics |= {f"/replay/{s}/detections": TABLE for s in sensors}
        recorder = Recorder(node, demo.out / "bag", topics) if recording else None
        seen = _clock_counter(node)
        key = rule and rule.partition("@")[0]
        start_scenario(nodes, demo.name, key, _overrides(demo, rule, sensors, judged, recording))
        steps = demo.tracking.steps
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
    overrides["fusion_centre"] = {"expected_subscribers": 2 + len(sensors) + extra} | _variant(demo, rule)
    return overrides


def _variant(demo: Demo, rule: str) -> dict[str, Any]:
    """Parameters in which a variant differs from the defaults; those of the scenario's own rules are in its file."""
    choice = demo.choice(rule)
    if choice is None or not choice.variant:
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
    scenario = demo.scenario
    listed: list[dict[str, Any]] = []
    for rule, measured in over_ros.items():
        for quantity in measured:
            name = f"{demo.row}-{rule}/{quantity}"
            spread = many[name].spread(1) if name in many else math.nan
            single = {"ros": measured[quantity]} | ({"library": same[name].value} if name in same else {})
            for path, value in single.items():
                (figure,) = judged_figures(scenario, {name: Estimate(value, spread, 1)})
                listed.append({**figure, "name": f"{path}/{name}"})
    for figure in judged_figures(scenario, many):
        name = figure["name"]
        row, _, quantity = name.rpartition("/")
        variant = f"{row},{demo.library_runs}-runs" if "@" in row else f"{row}@{demo.library_runs}-runs"
        listed.append({**figure, "name": f"library/{variant}/{quantity}"})
    return {
        "scenario": scenario.key,
        "parameter_file": demo.name,
        "runs": 1,
        "seed": demo.seed,
        "library_runs": demo.library_runs,
        "figures": listed,
    }


def _picture(demo: Demo) -> None:
    """Draw what the bag holds."""
    layout, sensors = demo.tracking.motion.layout, list(demo.tracking.sensors)
    axes, at = layout.axes, list(layout.position)
    topics = {**{s: f"/{s}/tracks" for s in sensors}, "fused": FUSED}
    messages = read_bag(demo.out / "bag", (TRUTH, *topics.values()))
    states = np.array([odometry_from_msg(m, axes).tracks.mean[0, 0, at] for m in messages[TRUTH]])
    lines = []
    for name, topic in topics.items():
        moments = [merged(track_table_from_msg(m), axes) for m in messages[topic]]
        mean = np.array([m[0, at] for m, _ in moments])
        cov = np.array([c[0][np.ix_(at, at)] for _, c in moments])
        label = f"fused: {demo.rules[-1].replace('_', ' ')}" if name == "fused" else name.replace("_", " ")
        lines.append(Line(label, COLORS.get(name, "tab:green"), mean, cov))
    title = f"{demo.scenario.title}: fused over ROS 2 and fed back to the trackers (one run)"
    draw(demo.out / "tracks.png", title, Line("truth", COLORS["truth"], states), lines)


def demo_of(name: str, out: Path, seed: int, library_runs: int | None, rules: tuple[str, ...] = ()) -> Demo:
    """Make the demonstration of a scenario; its rules are RULES, or the scenario's own, unless given.

    Parameters
    ----------
    name : str                    of a parameter file: a scenario's key, or key and filter
    library_runs : int or None    None: 1000 where the trackers are Kalman filters, which cost little, else what the
                                  scenario does by default

    Raises
    ------
    ParameterError    no such parameter file, or no such rule or variant
    Fault             the scenario does not run over ROS
    """
    if name in SCENARIOS and name not in bringups():
        raise Fault(f"The scenario {name} runs in the library only: track-fusion reproduce {name}.")
    bringup = Bringup(name)
    scenario, row = get_scenario(bringup.scenario), ROWS[bringup.filter]
    known = [c.name for c in scenario.rules]
    own = RULES if set(RULES) <= set(known) else tuple(c.name for c in scenario.rules if not c.variant)
    for rule in rules:
        if "@" in rule and rule not in known:
            raise unknown_name_error(rule, known, "rule of this scenario")
        get_rule(rule.partition("@")[0])
    runs = library_runs or (FAST_RUNS if row == "kf" else scenario.default_runs)
    return Demo(name, scenario, row, rules or own, out, seed, runs)
