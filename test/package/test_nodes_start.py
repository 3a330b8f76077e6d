"""Every node of the demo starts as its launch file says, becomes active, has the topics named, and ends cleanly.

`make test` runs this file a second time with TRACK_FUSION_NODE_PYTHON set to an environment that holds nothing but
rclpy, the message packages, NumPy and SciPy.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from package import launch_stand_in
from rcl_interfaces.srv import GetParameters
from rclpy.node import NodeNameNonExistentError
from ros_helpers import NodeProcess, Probe

ROOT = Path(__file__).resolve().parents[2]
PYTHON = os.environ.get("TRACK_FUSION_NODE_PYTHON", sys.executable)
NODES = ["replay", "sensor_1", "sensor_2", "fusion_centre", "evaluator"]
SCENARIO_DEADLINE_S = 60.0  # the scenario's steps in lockstep take about one second
STEPS = 100  # of li2022-linear


def nodes_of(folder: Path, launch: str, **arguments: str) -> dict[str, launch_stand_in.Described]:
    """Return the nodes of a launch file by name, in the order in which they are started."""
    with mock.patch.object(tempfile, "tempdir", str(folder)):  # where a launch file leaves parameter files
        nodes = launch_stand_in.load(ROOT / "launch" / f"{launch}.launch.py", ROOT, **arguments).nodes
    return {node.name: node for node in nodes}


def start(node: launch_stand_in.Described) -> NodeProcess:
    """Start a node as launch would."""
    command = ["-m", f"track_fusion.nodes.{node.executable}", *node.command_line()]
    return NodeProcess(node.executable, node=node.name, command=command, python=PYTHON)


def topics_of(probe: Probe, name: str) -> set[str]:
    """Return what a node publishes and subscribes to, as far as it has been discovered."""
    try:
        published = probe.node.get_publisher_names_and_types_by_node(name, "/")
        subscribed = probe.node.get_subscriber_names_and_types_by_node(name, "/")
    except NodeNameNonExistentError:
        return set()
    return {topic for topic, _ in (*published, *subscribed)}


@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_node_starts_has_its_topics_and_ends(name: str, number: int, ros_context: Any, tmp_path: Path) -> None:
    node = nodes_of(tmp_path, "demo")[name]
    with start(node) as process, Probe(ros_context) as probe:
        probe.wait_for_state(f"/{name}", "active")
        wanted = set(node.remappings.values())
        probe.wait_for(lambda: wanted <= topics_of(probe, name), 5.0, f"{wanted} among the topics of {name}")
        assert not {source.replace("~", f"/{name}") for source in node.remappings} & topics_of(probe, name)
        assert process.stop(number) == 0, process.output()
        if name == "fusion_centre":
            doing = (
                "Fusing x y vx vy in frame 'map' by covariance_intersection from /sensor_1/tracks, /sensor_2/tracks."
            )
            assert doing in process.output()


def test_launch_arguments_override_the_parameter_file(ros_context: Any, tmp_path: Path) -> None:
    node = nodes_of(tmp_path, "scenario", rule="naive")["fusion_centre"]
    with start(node), Probe(ros_context) as probe:
        request = GetParameters.Request(names=["state_fusion"])
        values = probe.call("/fusion_centre/get_parameters", GetParameters, request).values
        assert [value.string_value for value in values] == ["naive"]


@pytest.mark.slow
def test_the_demo_launch_runs_to_its_end(ros_domain: int, tmp_path: Path) -> None:
    with ExitStack() as stack:
        running = {name: stack.enter_context(start(node)) for name, node in nodes_of(tmp_path, "demo").items()}
        assert running["replay"].wait(SCENARIO_DEADLINE_S) == 0
        for name, process in running.items():
            assert process.stop() == 0, f"{name}: {process.output()}"
        printed = running["evaluator"].output()
        result = json.loads(printed[printed.index("{") :])  # a warning may come first
    assert (result["times"], result["missed"], result["false"]) == (STEPS, 0, 0)
