"""Stand-ins for launch and launch_ros, of which no wheels exist: they record what a launch file describes.

Only what our launch files use is here, with the keyword arguments that the real classes take, so that a misspelt one
raises here as it would on a robot.
"""

from __future__ import annotations

import dataclasses
import runpy
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock


class Context:
    """What launch_description entities see while they are visited."""

    def __init__(self, configurations: Mapping[str, str]) -> None:
        self.launch_configurations = dict(configurations)


def perform(value: Any, context: Context) -> str:
    """Evaluate a substitution, a list of them, or plain text."""
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)):
        return "".join(perform(item, context) for item in value)
    return str(value.perform(context))


class LaunchConfiguration:
    def __init__(self, variable_name: str, *, default: str | None = None) -> None:
        self.name, self.default = variable_name, default

    def perform(self, context: Context) -> str:
        if self.name not in context.launch_configurations and self.default is None:
            raise KeyError(f"launch configuration '{self.name}' does not exist")
        return context.launch_configurations.get(self.name, self.default)


class PathJoinSubstitution:
    def __init__(self, substitutions: Iterable[Any]) -> None:
        self.parts = list(substitutions)

    def perform(self, context: Context) -> str:
        return str(Path(*[perform(part, context) for part in self.parts]))


@dataclasses.dataclass
class DeclareLaunchArgument:
    name: str
    _: dataclasses.KW_ONLY
    default_value: Any = None
    description: str | None = None
    choices: list[str] | None = None


@dataclasses.dataclass
class OpaqueFunction:
    _: dataclasses.KW_ONLY
    function: Callable[..., list[Any] | None]


@dataclasses.dataclass
class Shutdown:
    _: dataclasses.KW_ONLY
    reason: str = ""


@dataclasses.dataclass
class TimerAction:
    _: dataclasses.KW_ONLY
    period: float
    actions: list[Any]


@dataclasses.dataclass
class PythonLaunchDescriptionSource:
    launch_file_path: Any


@dataclasses.dataclass
class IncludeLaunchDescription:
    launch_description_source: PythonLaunchDescriptionSource
    _: dataclasses.KW_ONLY
    launch_arguments: Iterable[tuple[str, Any]] = ()


@dataclasses.dataclass
class Node:
    _: dataclasses.KW_ONLY
    package: str
    executable: str
    name: str
    namespace: str | None = None
    parameters: list[Any] = dataclasses.field(default_factory=list)
    remappings: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    output: str = "log"
    on_exit: list[Any] = dataclasses.field(default_factory=list)


class LaunchDescription:
    def __init__(self, initial_entities: Iterable[Any] = ()) -> None:
        self.entities = list(initial_entities)


@dataclasses.dataclass
class Described:
    """A node as the launch file describes it, with everything evaluated."""

    package: str
    executable: str
    name: str
    parameter_files: list[Path]
    remappings: dict[str, str]
    ends_launch: bool

    @classmethod
    def from_node(cls, node: Node, context: Context) -> Described:
        files = [Path(perform(item, context)) for item in node.parameters]
        after = [
            action for item in node.on_exit for action in (item.actions if isinstance(item, TimerAction) else [item])
        ]
        ends = any(isinstance(action, Shutdown) for action in after)
        return cls(node.package, node.executable, node.name, files, dict(node.remappings), ends)

    def command_line(self) -> list[str]:
        """What launch puts behind the executable."""
        words = ["--ros-args", "-r", f"__node:={self.name}"]
        for path in self.parameter_files:
            words += ["--params-file", str(path)]
        for source, target in self.remappings.items():
            words += ["-r", f"{source}:={target}"]
        return words


@dataclasses.dataclass
class Recorded:
    """Everything a launch file and the files it includes describe."""

    arguments: dict[str, DeclareLaunchArgument] = dataclasses.field(default_factory=dict)
    nodes: list[Described] = dataclasses.field(default_factory=list)


def load(path: Path, share: Path, **arguments: str) -> Recorded:
    """Run a launch file with launch arguments; `share` stands for the package's share directory."""
    recorded = Recorded()
    with mock.patch.dict(sys.modules, stand_in_modules(share)):
        visit_file(path, Context(arguments), set(arguments), recorded)
    return recorded


def visit_file(path: Path, context: Context, given: set[str], recorded: Recorded) -> None:
    """Visit all entities of a launch file; every argument given must be declared in it."""
    description = runpy.run_path(str(path))["generate_launch_description"]()
    declared = {e.name for e in description.entities if isinstance(e, DeclareLaunchArgument)}
    assert given <= declared, f"{path.name} declares no argument {given - declared}"
    for entity in description.entities:
        visit(entity, context, recorded)


def visit(entity: Any, context: Context, recorded: Recorded) -> None:
    """Do what launch does with one entity, but record nodes instead of starting them."""
    if isinstance(entity, DeclareLaunchArgument):
        recorded.arguments.setdefault(entity.name, entity)
        if entity.name not in context.launch_configurations:
            assert entity.default_value is not None, f"the launch argument {entity.name} is required"
            context.launch_configurations[entity.name] = perform(entity.default_value, context)
        value = context.launch_configurations[entity.name]
        assert entity.choices is None or value in entity.choices, f"{entity.name} must be one of {entity.choices}"
    elif isinstance(entity, OpaqueFunction):
        for made in entity.function(context) or []:
            visit(made, context, recorded)
    elif isinstance(entity, IncludeLaunchDescription):
        arguments = {name: perform(value, context) for name, value in entity.launch_arguments}
        context.launch_configurations.update(arguments)
        path = Path(perform(entity.launch_description_source.launch_file_path, context))
        visit_file(path, context, set(arguments), recorded)
    elif isinstance(entity, Node):
        recorded.nodes.append(Described.from_node(entity, context))
    else:
        raise AssertionError(f"the stand-in does not know {entity!r}")


def stand_in_modules(share: Path) -> dict[str, types.ModuleType]:
    """Return modules by the names under which launch files import them."""

    def get_package_share_directory(package_name: str) -> str:
        assert package_name == "track_fusion"
        return str(share)

    class FindPackageShare:
        def __init__(self, package: str) -> None:
            self.package = package

        def perform(self, context: Context) -> str:
            return get_package_share_directory(self.package)

    contents: dict[str, tuple[Any, ...]] = {
        "launch": (LaunchDescription,),
        "launch.actions": (DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, Shutdown, TimerAction),
        "launch.launch_description_sources": (PythonLaunchDescriptionSource,),
        "launch.substitutions": (LaunchConfiguration, PathJoinSubstitution),
        "launch_ros": (),
        "launch_ros.actions": (Node,),
        "launch_ros.substitutions": (FindPackageShare,),
        "ament_index_python": (),
        "ament_index_python.packages": (get_package_share_directory,),
    }
    modules = {}
    for name, members in contents.items():
        modules[name] = types.ModuleType(name)
        for member in members:
            setattr(modules[name], member.__name__, member)
    return modules
