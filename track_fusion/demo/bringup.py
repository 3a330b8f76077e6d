"""Start a scenario's nodes as separate processes: what ros2 launch does on a robot, where launch is not to be had."""

from __future__ import annotations

import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from track_fusion.params import unknown_name_error

#: From SIGINT to the end of a node; they take a fraction of a second.
STOP_DEADLINE_S = 10.0
_PR_SET_PDEATHSIG = 1


def share_file(*parts: str) -> Path:
    """Find an installed or source-tree file such as config/li2022-linear.yaml.

    Raises
    ------
    FileNotFoundError    it is in neither place
    """
    roots = [Path(p) / "share" / "track_fusion" for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    roots += [Path(__file__).parents[2], Path(sys.prefix) / "share" / "track_fusion"]
    for root in roots:
        if (path := root.joinpath(*parts)).exists():
            return path
    raise FileNotFoundError(f"There is no {'/'.join(parts)} in {', '.join(map(str, roots))}.")


def local_environment(domain: int) -> dict[str, str]:
    """Environment in which nodes find each other fast, and nobody else finds them."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(share_file("config", "fastdds_fast_discovery.xml")),
    }


def ros_arguments(name: str, config: Path | None, params: Mapping[str, Any], remaps: Mapping[str, str]) -> list[str]:
    """Write what follows an executable on its command line."""
    words = ["--ros-args", "-r", f"__node:={name}"]
    words += ["--params-file", str(config)] if config else []
    for key, value in params.items():
        # With the node's name: a bare one would stand behind what the file says of this node.
        words += ["-p", f"{name}:{key}:={json.dumps(value)}"]
    for source, target in remaps.items():
        words += ["-r", f"{source}:={target}"]
    return words


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Nodes:
    """The processes of one run; :func:`running` ends them all."""

    def __init__(self, environment: Mapping[str, str], log: IO[str]) -> None:
        self._environment, self._log = dict(environment), log
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, executable: str, name: str, arguments: Sequence[str]) -> None:
        """Start a node of this package; it dies with this process."""
        self.start_module(f"track_fusion.nodes.{executable}", name, arguments)

    def start_module(self, module: str, name: str, arguments: Sequence[str]) -> None:
        """Start any module as a node; it dies with this process."""
        self.processes[name] = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            env=self._environment, stdin=subprocess.DEVNULL, stdout=self._log, stderr=subprocess.STDOUT,
            preexec_fn=_die_with_parent,
        )  # fmt: skip

    def failed(self) -> str | None:
        """Name of a node that ended with an error, if any."""
        return next((n for n, p in self.processes.items() if p.poll() not in (None, 0)), None)

    def stop(self) -> None:
        """Ask all to end, and kill what does not."""
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + STOP_DEADLINE_S
        for process in self.processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def running(environment: Mapping[str, str], log_path: Path) -> Iterator[Nodes]:
    """Give a set of nodes whose output goes to a file, and end them in any case."""
    with log_path.open("w") as log:
        nodes = Nodes(environment, log)
        try:
            yield nodes
        finally:
            nodes.stop()


_SCENARIO = re.compile(r"^replay:\n  ros__parameters:\n    scenario: (\S+)$", re.MULTILINE)
#: Nodes of a scenario that are no trackers.
OTHERS = ("replay", "fusion_centre", "evaluator")


class Bringup:
    """What a parameter file config/<name>.yaml describes: replay, trackers, fusion centre and evaluator of a scenario.

    Parameters
    ----------
    name : str    of the file: a scenario's key, or key and filter, as li2022-nonlinear-sir

    Raises
    ------
    ParameterError    there is none; the message lists those there are

    Attributes
    ----------
    path : Path
    scenario : str              key of the scenario
    trackers : tuple of str     names of the tracker nodes, those of the scenario's sensors
    filter : str                of the trackers
    result_every : int          the centre fuses at every so many steps
    sections : mapping          parameters of each node by name, as the file gives them
    """

    def __init__(self, name: str) -> None:
        import yaml  # type: ignore[import-untyped]  # comes with rclpy

        known = bringups()
        if name not in known:
            raise unknown_name_error(name, known, "parameter file of a scenario")
        self.path = share_file("config", f"{name}.yaml")
        content = yaml.safe_load(self.path.read_text())
        self.sections = {node: section["ros__parameters"] for node, section in content.items()}
        self.scenario = str(self.sections["replay"]["scenario"])
        self.trackers = tuple(node for node in self.sections if node not in OTHERS)
        self.filter = str(self.sections[self.trackers[0]].get("filter", "kalman"))
        self.result_every = int(self.sections["replay"].get("result_every", 1))

    def on_top(self, name: str, rule: str | None, random: Mapping[str, Any]) -> dict[str, Any]:
        """Parameters of a node on top of the file: the rule (None: none), and seed and run for all who draw."""
        from track_fusion.scenarios import get_scenario

        draws = name in ("replay", "fusion_centre") or self.sections[name].get("filter") == "particle"
        given = dict(random) if draws else {}
        if name == "replay":
            given["sensors"] = list(self.trackers_of(rule))
        elif name == "fusion_centre":
            given["state_fusion"] = rule
        elif name == "evaluator":
            given["steps"] = get_scenario(self.scenario).played().steps // self.result_every
        elif rule is None:
            given["feedback"] = "none"
        return given

    def trackers_of(self, rule: str | None) -> tuple[str, ...]:
        """Names of the trackers that run: all, or without fusion the first."""
        return self.trackers if rule else self.trackers[:1]


def bringups() -> dict[str, str]:
    """List the parameter files that describe a scenario: name -> key of the scenario. Needs no YAML reader."""
    files = sorted((path.stem, path) for path in share_file("config").glob("*.yaml"))
    found = {name: _SCENARIO.search(path.read_text()) for name, path in files}
    return {name: match[1] for name, match in found.items() if match}


def demos_of(scenario: str) -> list[str]:
    """Names of the parameter files with which a scenario runs over ROS."""
    return [name for name, key in bringups().items() if key == scenario]


def start_scenario(
    nodes: Nodes,
    name: str,
    rule: str | None,
    overrides: Mapping[str, Mapping[str, Any]],
    evaluator: bool = True,
) -> None:
    """Start replay, trackers, centre and evaluator of a scenario, wired as launch/scenario.launch.py does.

    Parameters
    ----------
    nodes : Nodes
    name : str                               of the parameter file, config/<name>.yaml
    rule : str or None                       fusion rule; None = no fusion: the first sensor's tracker alone
    overrides : {node: {parameter: value}}   on top of the file; seed and run of the replay go to all who draw
    evaluator : bool                         whether to start that one, too
    """
    bringup = Bringup(name)
    sensors = bringup.trackers_of(rule)
    fused = "/fusion_centre/tracks" if rule else f"/{sensors[0]}/tracks"
    random = {key: value for key, value in overrides.get("replay", {}).items() if key in ("seed", "run")}

    def start(executable: str, node: str, remaps: Mapping[str, str]) -> None:
        params = bringup.on_top(node, rule, random) | dict(overrides.get(node, {}))
        nodes.start(executable, node, ros_arguments(node, bringup.path, params, remaps))

    for sensor in sensors:
        start("sensor_tracker", sensor, {"~/detections": f"/replay/{sensor}/detections", "~/feedback": fused})
    if rule:
        start("fusion_centre", "fusion_centre", {f"~/sources/{s}/tracks": f"/{s}/tracks" for s in sensors})
    if evaluator:
        start("evaluator", "evaluator", {"~/truth": "/replay/truth", "~/tracks": fused})
    start("replay", "replay", {"~/fused": fused})
