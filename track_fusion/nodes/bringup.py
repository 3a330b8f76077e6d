"""Start a scenario's nodes as separate processes: what ros2 launch does on a robot, where launch is not to be had."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

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


def start_scenario(
    nodes: Nodes,
    scenario: str,
    rule: str | None,
    overrides: Mapping[str, Mapping[str, Any]],
    evaluator: bool = True,
) -> None:
    """Start replay, trackers, centre and evaluator of a scenario, wired as launch/scenario.launch.py does.

    Parameters
    ----------
    nodes : Nodes
    scenario : str                           its parameter file is config/<scenario>.yaml
    rule : str or None                       fusion rule; None = no fusion: the first sensor's tracker alone
    overrides : {node: {parameter: value}}   on top of the file
    evaluator : bool                         whether to start that one, too
    """
    from track_fusion.scenarios import get_scenario

    tracking = get_scenario(scenario).tracking
    assert tracking is not None
    config = share_file("config", f"{scenario}.yaml")
    sensors = list(tracking.sensors) if rule else list(tracking.sensors)[:1]
    fused = "/fusion_centre/tracks" if rule else f"/{sensors[0]}/tracks"

    def start(executable: str, name: str, params: Mapping[str, Any], remaps: Mapping[str, str]) -> None:
        nodes.start(executable, name, ros_arguments(name, config, {**params, **overrides.get(name, {})}, remaps))

    for sensor in sensors:
        params = {} if rule else {"feedback": "none"}
        start("sensor_tracker", sensor, params, {"~/detections": f"/replay/{sensor}/detections", "~/feedback": fused})
    if rule:
        sources = {f"~/sources/{s}/tracks": f"/{s}/tracks" for s in sensors}
        start("fusion_centre", "fusion_centre", {"state_fusion": rule}, sources)
    if evaluator:
        start("evaluator", "evaluator", {"steps": tracking.steps}, {"~/truth": "/replay/truth", "~/tracks": fused})
    start("replay", "replay", {"sensors": sensors}, {"~/fused": fused})
