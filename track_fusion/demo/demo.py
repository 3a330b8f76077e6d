"""The demonstration: a published scenario run by real nodes, recorded, judged and drawn."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import merged
from msg_adapters.odometry import odometry_from_msg
from msg_adapters.track_table import track_table_from_msg
from track_fusion.demo.bringup import Bringup, Nodes, bringups, local_environment, running, start_scenario
from track_fusion.metrics.accuracy import Estimate
from track_fusion.nodes.managed import Fault, qos
from track_fusion.nodes.recorder import Recorder, read_bag
from track_fusion.params import ParameterError, specs, unknown_name_error
from track_fusion.report.picture import Line, draw, draw_map
from track_fusion.rules import get_rule
from track_fusion.scenarios import SCENARIOS, RuleChoice, Scenario, get_scenario, judged_figures
from track_fusion.study.scene import Scene
from track_fusion.tracks import StateLayout, TrackBatch

#: How a scenario's rows name what the tracker nodes run.
ROWS = {
    "kalman": "kf",
    "extended": "ekf",
    "unscented": "ukf",
    "cubature": "ckf",
    "particle": "sir",
    "student_t": "stf",
    "pda": "pda",
}
#: Rules that a scenario which has them all is shown with; the last is recorded and drawn.
RULES = ("naive", "covariance_intersection", "arithmetic_average")
#: A run over ROS that takes longer than this has hung.
RUN_DEADLINE_S = 300.0
#: Library runs to compare with where they cost little.
FAST_RUNS = 1000
#: Domains that Linux's default range of ephemeral ports leaves free.
DOMAINS = 101
#: What a demonstration writes; only a folder with nothing else is cleared.
RESULTS = ("bag", "figures.json", "tracks.png", "nodes_*.log", "evaluation_*.json")
TRUTH = "/replay/truth"
FUSED = "/fusion_centre/tracks"
TABLE, ODOMETRY = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"
#: Of the sensors, and last of what is fused.
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:red")

Progress = Callable[[str, float], None]
Figures = dict[str, Estimate]


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

    @cached_property
    def scene(self) -> Scene:
        """What the nodes run."""
        return self.scenario.played()

    @cached_property
    def bringup(self) -> Bringup:
        """What the parameter file says."""
        return Bringup(self.name)

    @property
    def results(self) -> int:
        """Number of fusions."""
        return self.scene.steps // self.bringup.result_every

    @property
    def many_targets(self) -> bool:
        """Whether the scenario itself judges what the centre publishes."""
        return self.scenario.judge is not None

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
    Fault    a node failed or hung; the message names its log; or `out` holds something else than earlier results
    """
    _clear(demo.out)
    over_ros: dict[str, dict[str, float]] = {}
    for rule in demo.rules if demo.many_targets else (None, *demo.rules):
        over_ros[rule or "alone"] = _over_ros(demo, rule, progress)
    rows, label = [f"{demo.row}-{name}" for name in over_ros], f"library, {demo.library_runs} runs"
    result = _figures(demo, over_ros, *_library(demo, rows, lambda share: progress(label, share)))
    (demo.out / "figures.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    _picture(demo)
    return result


def _clear(out: Path) -> None:
    """Make an empty folder, of earlier results if there are any, and of nothing else."""
    if out.exists() and not out.is_dir():
        raise Fault(f"{out} is no folder.")
    foreign = [p.name for p in sorted(out.glob("*")) if not any(p.match(pattern) for pattern in RESULTS)]
    if foreign:
        raise Fault(f"{out} holds {foreign[0]}, which is no result of a demonstration: it would be deleted.")
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)


def _library(demo: Demo, rows: list[str], progress: Callable[[float], None]) -> tuple[Figures, Figures]:
    """Measure the rows that the scenario has, over the first run alone and over all; it may not know every rule.

    Rows of many targets share the tracks, the costly part, and are studied at once. Of one target, what all sensors
    together would give (IC) is measured for comparison.
    """
    wanted = [f"{demo.row}-"] if demo.many_targets else [*rows, f"{demo.row}-ic"]
    same: Figures = {}
    many: Figures = {}
    for done, only in enumerate(wanted):

        def part(share: float, done: int = done) -> None:
            progress((done + share) / len(wanted))

        try:
            outcomes = demo.scenario.simulate(range(demo.library_runs), demo.seed, part, only)
        except ParameterError:
            continue
        for found, runs in ((same, 1), (many, demo.library_runs)):
            found |= demo.scenario.figures({name: array[:runs] for name, array in outcomes.items()})
    progress(1.0)
    return same, many


def _over_ros(demo: Demo, rule: str | None, progress: Progress) -> dict[str, float]:
    """Run the scenario once by real processes; return its figures."""
    name = rule or "alone"
    judged, log = demo.out / f"evaluation_{name}.json", demo.out / f"nodes_{name}.log"
    domain = (os.getpid() + len(name)) % DOMAINS
    topics = _recorded(demo) if rule == demo.rules[-1] else {}
    with running(local_environment(domain), log) as nodes, _observer(domain) as (node, spin):
        recorder = Recorder(node, demo.out / "bag", topics) if topics else None
        seen, fused = _clock_counter(node), _listener(node) if demo.many_targets else []
        key = rule and rule.partition("@")[0]
        start_scenario(nodes, demo.name, key, _overrides(demo, rule, judged, topics))
        _wait(nodes, log, spin, lambda: progress(f"ROS, {name}", seen() / demo.scene.steps))
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline and (
            (demo.many_targets and len(fused) < demo.results)
            or (recorder is not None and min(recorder.counts[t] for t in topics) < demo.results)
        ):
            spin()
        if recorder is not None:
            recorder.close()
    progress(f"ROS, {name}", 1.0)
    result = json.loads(judged.read_text())
    judged.unlink()
    if result["times"] != demo.results or (result["missed"] and not demo.many_targets):
        raise Fault(
            f"{name}: {result['times']} of {demo.results} steps were judged, {result['missed']} missed; see {log}."
        )
    if demo.scenario.judge is None:
        return {k: v for k, v in result["all"].items() if "armse" in k}
    row = f"{demo.row}-{name}"
    figures = demo.scenario.figures(demo.scenario.judge(row, fused))
    return {name.removeprefix(f"{row}/"): e.value for name, e in figures.items()}


def _recorded(demo: Demo) -> dict[str, str]:
    """Topics of the bag and their types; of many targets all but the detections, which are very many."""
    topics = {TRUTH: ODOMETRY, **{f"/{s}/tracks": TABLE for s in demo.scene.sensors}, FUSED: TABLE}
    return topics | ({} if demo.many_targets else {f"/replay/{s}/detections": TABLE for s in demo.scene.sensors})


def _overrides(demo: Demo, rule: str | None, judged: Path, topics: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Parameters on top of the scenario's file; every output waits for all who read it, the recorder of topics, too."""
    file, sensors = demo.bringup.sections, list(demo.scene.sensors)
    readers = {name: file[name]["expected_subscribers"] + (f"/{name}/tracks" in topics) for name in sensors}
    overrides: dict[str, dict[str, Any]] = {
        "evaluator": {"output": str(judged)},
        "replay": {
            "seed": demo.seed,
            "expected_truth_subscribers": 1 + (TRUTH in topics),
            "expected_subscribers_each": 1 + (f"/replay/{sensors[0]}/detections" in topics),
        },
    }
    if rule is None:
        overrides[sensors[0]] = {"expected_subscribers": 2}  # replay and evaluator
        return overrides
    overrides |= {name: {"expected_subscribers": count} for name, count in readers.items()}
    of_fused = file["fusion_centre"]["expected_subscribers"] + (FUSED in topics) + demo.many_targets
    overrides["fusion_centre"] = {"expected_subscribers": of_fused} | _variant(demo, rule)
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


def _listener(node: Node) -> list[TrackBatch]:
    """Return the list that grows by each batch of fused tracks."""
    batches: list[TrackBatch] = []

    def on_tracks(msg: Any) -> None:
        fields = {name: value for name, value in vars(track_table_from_msg(msg)).items() if name != "axes"}
        batches.append(TrackBatch(layout=StateLayout(track_table_from_msg(msg).axes), **fields))

    node.create_subscription(PointCloud2, FUSED, on_tracks, qos(1000))
    return batches


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


def _figures(demo: Demo, over_ros: dict[str, dict[str, float]], same: Figures, many: Figures) -> dict[str, Any]:
    """Bring all into the form of `reproduce`: ros/ and library/ are the same one run, library/...@N-runs the study.

    The standard error of one run is the spread of a run in the study.
    """
    scenario = demo.scenario
    listed: list[dict[str, Any]] = []
    known = {name.rpartition("/")[2] for name in many}
    for rule, measured in over_ros.items():
        for quantity in [q for q in measured if q in known or not known]:
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
    layout, sensors = demo.scene.layout, list(demo.scene.sensors)
    axes, at = layout.axes, list(layout.position)
    topics = {**{s: f"/{s}/tracks" for s in sensors}, "fused": FUSED}
    messages = read_bag(demo.out / "bag", (TRUTH, *topics.values()))
    states = np.array([odometry_from_msg(m, axes).tracks.mean[0, 0, at] for m in messages[TRUTH]])
    lines = []
    for name, topic in topics.items():
        moments = [merged(track_table_from_msg(m), axes) for m in messages[topic]]
        mean = np.concatenate([m[:, at] for m, _ in moments])
        cov = np.concatenate([c[:, at][..., at] for _, c in moments])
        label = f"fused: {demo.rules[-1].replace('_', ' ')}" if name == "fused" else name.replace("_", " ")
        lines.append(Line(label, COLORS[list(topics).index(name) if name != "fused" else -1], mean, cov))
    truth = Line("truth", "black", states)
    what = "fused over ROS 2" if demo.many_targets else "fused over ROS 2 and fed back to the trackers"
    title = f"{demo.scenario.title}: {what} (one run)"
    if demo.many_targets:
        draw_map(demo.out / "tracks.png", title, [truth, *lines])
    else:
        draw(demo.out / "tracks.png", title, truth, lines)


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
