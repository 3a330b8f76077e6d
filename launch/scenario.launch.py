"""Run a published scenario: replay, one tracker a sensor, the fusion centre and the evaluator.

    ros2 launch track_fusion scenario.launch.py scenario:=li2022-nonlinear rule:=covariance_intersection

All parameters come from config/<scenario>.yaml; an argument that is given overrides the file. The launch ends when the
replay node does.
"""

from pathlib import Path
from tempfile import NamedTemporaryFile

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown, TimerAction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from track_fusion.demo.wiring import Bringup, bringups

PACKAGE = "track_fusion"
END_S = 1.0  # from the end of the replay to that of the rest: the last messages are still to be read
# Launch arguments that override a parameter of the file: argument, node, parameter, type.
OVERRIDES = (
    ("rule", "fusion_centre", "state_fusion", str),
    ("seed", "replay", "seed", int),
    ("pace", "replay", "pace", str),
    ("rate", "replay", "rate", float),
)


def generate_launch_description():
    """Declare the arguments; which nodes there are depends on the scenario's file."""
    unset = "empty: as the scenario's parameter file says"
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "scenario", default_value="li2022-linear", description="Scenario, that is a file of config/ (no .yaml)"
            ),
            DeclareLaunchArgument(
                "rule", default_value="", description=f"Fusion rule, one that `track-fusion rules` lists; {unset}"
            ),
            DeclareLaunchArgument("seed", default_value="", description=f"Seed of the random streams; {unset}"),
            DeclareLaunchArgument(
                "pace",
                default_value="",
                choices=["", "lockstep", "realtime"],
                description=f"Each step when the last is fused, or by the clock; {unset}",
            ),
            DeclareLaunchArgument(
                "rate", default_value="", description=f"Scenario seconds a second at pace realtime; {unset}"
            ),
            OpaqueFunction(function=scenario_nodes),
        ]
    )


def scenario_nodes(context):
    """Build the nodes that the scenario's parameter file names."""
    scenario, folder = LaunchConfiguration("scenario").perform(context), Path(get_package_share_directory(PACKAGE))
    known = bringups(folder / "config")
    if scenario not in known:
        raise RuntimeError(f"There is no scenario '{scenario}'. There are: {', '.join(known)}.")
    given = {}
    for argument, owner, parameter, kind in OVERRIDES:
        if text := LaunchConfiguration(argument).perform(context):
            given.setdefault(owner, {})[parameter] = kind(text)
    return [node(spec) for spec in Bringup(scenario, folder / "config").nodes(given)]


def node(spec):
    """Build one node; the launch ends with the replay."""
    over = TimerAction(period=END_S, actions=[Shutdown(reason="the replay is over")])
    return Node(
        package=PACKAGE,
        executable=spec.executable,
        name=spec.name,
        parameters=[str(spec.parameter_file), *override_file(spec)],
        remappings=list(spec.remaps.items()),
        output="screen",
        **({"on_exit": [over]} if spec.name == "replay" else {}),
    )


def override_file(spec):
    """Write what stands on top of the parameter file to a file of its own.

    launch would do the same with a dictionary, but for all nodes ("/**"), and what the first file says of this node
    would win over that when it has a section for all nodes, too.
    """
    if not spec.params:
        return []
    with NamedTemporaryFile("w", prefix=f"{spec.name}_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump({spec.name: {"ros__parameters": dict(spec.params)}}, file)
    return [file.name]
