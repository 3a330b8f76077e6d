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

from track_fusion.demo.wiring import Bringup, Overrides, share_file

#: From SIGINT to the end of a node; they take a fraction of a second.
STOP_DEADLINE_S = 10.0
_PR_SET_PDEATHSIG = 1


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


def start_scenario(nodes: Nodes, name: str, rule: str | None, overrides: Overrides, evaluator: bool = True) -> None:
    """Start replay, trackers, centre and evaluator of a scenario.

    Parameters
    ----------
    nodes : Nodes
    name : str               of the parameter file, config/<name>.yaml
    rule : str or None       fusion rule; None = no fusion: the first sensor's tracker alone
    overrides : Overrides    on top of the file; seed and run of the replay go to all who draw
    evaluator : bool         whether to start that one, too
    """
    from track_fusion.scenarios import get_scenario

    bringup = Bringup(name)
    steps = get_scenario(bringup.scenario).played().steps // bringup.result_every
    given: Overrides = {"fusion_centre": {"state_fusion": rule}, "evaluator": {"steps": steps}}
    params = {node: {**given.get(node, {}), **overrides.get(node, {})} for node in {**given, **overrides}}
    for spec in bringup.nodes(params, rule is not None, evaluator):
        nodes.start(spec.executable, spec.name, ros_arguments(spec.name, spec.parameter_file, spec.params, spec.remaps))
