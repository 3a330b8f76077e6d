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

PACKAGE = "track_fusion"
FUSED = "/fusion_centre/tracks"
END_S = 1.0  # from the end of the replay to that of the rest: the last messages are still to be read
# Nodes that are no trackers.
OTHERS = ("fusion_centre", "evaluator", "replay")
# Launch arguments that override a parameter of the file: argument, node, parameter, type. The seed goes to trackers
# that draw random numbers, too.
OVERRIDES = (
    ("rule", "fusion_centre", "state_fusion", str),
    ("seed", "replay", "seed", int),
    ("seed", "fusion_centre", "seed", int),
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
    parameter_file = find_parameter_file(LaunchConfiguration("scenario").perform(context))
    names = yaml.safe_load(parameter_file.read_text())
    sensors = [name for name in names if name not in OTHERS]
    drawing = [s for s in sensors if names[s]["ros__parameters"].get("filter") == "particle"]
    overrides = (*OVERRIDES, *(("seed", sensor, "seed", int) for sensor in drawing))
    remappings = {
        "replay": [("~/fused", FUSED)],
        "fusion_centre": [(f"~/sources/{sensor}/tracks", f"/{sensor}/tracks") for sensor in sensors],
        "evaluator": [("~/truth", "/replay/truth"), ("~/tracks", FUSED)],
    }
    for sensor in sensors:
        remappings[sensor] = [("~/detections", f"/replay/{sensor}/detections"), ("~/feedback", FUSED)]
    over = TimerAction(period=END_S, actions=[Shutdown(reason="the replay is over")])
    # Replay comes last: by then the others are starting already.
    return [
        node(
            name,
            [str(parameter_file), *override_file(context, name, overrides)],
            remappings[name],
            **({"on_exit": [over]} if name == "replay" else {}),
        )
        for name in (*sensors, *OTHERS)
    ]


def node(name, parameters, remappings, **options):
    """Build one node; its executable is its name, but for the sensors' trackers."""
    return Node(
        package=PACKAGE,
        executable=name if name in OTHERS else "sensor_tracker",
        name=name,
        parameters=parameters,
        remappings=remappings,
        output="screen",
        **options,
    )


def override_file(context, name, overrides):
    """Write the launch arguments given for one node to a parameter file of its own.

    launch would do the same with a dictionary, but for all nodes ("/**"), and what the first file says of this node
    would win over that when it has a section for all nodes, too.
    """
    given = {}
    for argument, owner, parameter, kind in overrides:
        text = LaunchConfiguration(argument).perform(context)
        if owner == name and text:
            given[parameter] = kind(text)
    if not given:
        return []
    with NamedTemporaryFile("w", prefix=f"{name}_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump({name: {"ros__parameters": given}}, file)
    return [file.name]


def find_parameter_file(scenario):
    """Return the path of config/<scenario>.yaml; when there is none, say which there are."""
    folder = Path(get_package_share_directory(PACKAGE)) / "config"
    path = folder / f"{scenario}.yaml"
    if path.is_file():
        return path
    known = [other.stem for other in sorted(folder.glob("*.yaml")) if "replay" in yaml.safe_load(other.read_text())]
    raise RuntimeError(f"There is no scenario '{scenario}'. There are: {', '.join(known)}.")
