"""Run the demo's scenario (Li et al., linear) in lockstep, with a rule of your choice.

    ros2 launch track_fusion demo.launch.py rule:=arithmetic_average

The other scenarios, and more arguments: scenario.launch.py.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Include scenario.launch.py with the demo's arguments."""
    scenario = PathJoinSubstitution([FindPackageShare("track_fusion"), "launch", "scenario.launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "rule",
                default_value="",
                description="Fusion rule, one that `track-fusion rules` lists; empty: as the parameter file says",
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(scenario),
                launch_arguments={
                    "scenario": "li2022-linear",
                    "rule": LaunchConfiguration("rule"),
                    "pace": "lockstep",
                }.items(),
            ),
        ]
    )
