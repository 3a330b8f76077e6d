"""The rooms of the house and who may know whom; finds what breaks the rules. doc/architecture.md tells it to readers.

    .venv/bin/python tools/house.py

Reads imports, also those inside functions, as text; runs nothing of what it reads.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

#: Rooms by floor, from the top down: a module imports from its own room and from the floors below.
FLOORS: tuple[Mapping[str, str], ...] = (
    {"cli": "the command track-fusion, one command a file"},
    {"demo": "the wiring and the processes of a scenario's nodes, the demonstration"},
    {"nodes": "the ROS nodes: thin"},
    {
        "bags": "bags without ROS",
        "scenarios": "one published study a folder",
        "report": "pages and pictures",
    },
    {
        "messages": "messages at the door: parameters, screening, a centre on messages; without ROS",
        "study": "what a scenario is: runs, outcomes, figures, claims and verdicts",
    },
    {"centre": "the fusion centre: a value and pure steps"},
    {"peers": "decentralised fusion"},
    {"trackers": "detections in, tracks out"},
    {"rules": "one fusion rule a file"},
    {"weights": "ways to choose fusion weights"},
    {"filters": "one filter a file, all behind one interface"},
    {"densities": "Gaussians, mixtures, elliptical families"},
    {"models": "motion, sensors, noise"},
    {"metrics": "accuracy, consistency, evaluation, significance"},
    {"association": "gate, cost, assignment"},
    {"solvers": "numerics that know nothing of tracks"},
    {"ground": "modules outside any folder: data model, parameters, linear algebra, angles, random streams"},
)
#: The modules that stand on the ground, outside any folder, and the package itself.
GROUND = frozenset({"", "angles", "clock", "layouts", "linalg", "params", "plugins", "random_streams", "tracks"})
#: Only these rooms know ROS.
ROS_ROOMS = frozenset({"demo", "nodes"})
#: The adapters stand beside the house: these rooms use them, they know nothing of it.
ADAPTERS = "msg_adapters"
ADAPTER_USERS = frozenset({"bags", "demo", "messages", "nodes"})
#: What belongs to ROS beside message packages: by name, or by how the name begins.
ROS = frozenset({"ament_index_python", "diagnostic_updater", "launch", "launch_ros", "message_filters", "rclpy"})
ROS_PREFIXES = ("rosbag2_", "rosidl_", "tf2_")
#: What an installed package does not bring along.
NOT_INSTALLED = frozenset({"benchmark", "test", "tools"})


def faults(root: Path) -> list[str]:
    """Return what breaks the rules in a source tree, one line each: the arrow, and why it must not be."""
    paths = sorted(path for package in ("track_fusion", ADAPTERS) for path in (root / package).rglob("*.py"))
    modules = {_name(path, root): path for path in paths}
    arrows = {name: sorted(set(_arrows(path, root, name, modules))) for name, path in modules.items()}
    lines = [f"{name} is in no room" for name in modules if _ours(name) and _floor(name) is None]
    for name, targets in arrows.items():
        lines += [f"{name}:{line} -> {target}: {why}" for line, target in targets if (why := _fault(name, target))]
    return lines + [f"circle: {' -> '.join(circle)}" for circle in _circles(arrows)]


def room(name: str) -> str:
    """Return the room of a module of track_fusion."""
    first = (*name.split("."), "")[1]
    return "ground" if first in GROUND else first


def is_message_package(top: str) -> bool:
    """Tell whether a package holds messages or services of ROS."""
    return top.endswith(("_msgs", "_interfaces"))


def is_ros(top: str) -> bool:
    """Tell whether a package belongs to ROS."""
    return top in ROS or top.startswith(ROS_PREFIXES) or is_message_package(top)


def imported(path: Path, root: Path) -> Iterator[tuple[int, str]]:
    """Yield line and full name of everything a file imports: inside functions, relative, by `import_module`, too.

    Of a name that is put together as the program runs, only the constant beginning is known: it ends in a star.
    """
    package = path.relative_to(root).parent.parts
    for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(item, ast.Import):
            yield from ((item.lineno, alias.name) for alias in item.names)
        elif isinstance(item, ast.ImportFrom):
            base = list(package[: len(package) - item.level + 1]) if item.level else []
            base += [item.module] if item.module else []
            yield from ((item.lineno, ".".join([*base, alias.name])) for alias in item.names)
        elif isinstance(item, ast.Call) and item.args and _called(item) in {"import_module", "__import__"}:
            name = _spelt(item.args[0])
            level = len(name) - len(name.lstrip("."))
            anchor = _spelt(item.args[1]).split(".") if len(item.args) > 1 else list(package)
            yield item.lineno, ".".join([*anchor[: len(anchor) - level + 1], name[level:]] if level else [name])


def _called(call: ast.Call) -> str:
    """Return the last part of the name of what is called."""
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def _spelt(text: ast.expr) -> str:
    """Return a string; of one that is formatted or added, its beginning and a star."""
    if isinstance(text, ast.Constant):
        return str(text.value)
    first = text.values[0] if isinstance(text, ast.JoinedStr) and text.values else getattr(text, "left", None)
    return f"{_spelt(first).rstrip('*')}*" if first else "*"


def _name(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def _ours(name: str) -> bool:
    return name.split(".")[0] == "track_fusion"


def _floor(name: str) -> int | None:
    """Return the floor of a module, 0 at the ground."""
    return next((len(FLOORS) - 1 - k for k, rooms in enumerate(FLOORS) if room(name) in rooms), None)


def _arrows(path: Path, root: Path, own: str, modules: Mapping[str, Path]) -> Iterator[tuple[int, str]]:
    """Yield line and target of each import: the module of ours that it names, or is in."""
    for line, target in imported(path, root):
        parts = [] if target.endswith("*") else target.split(".")
        ways = (".".join(parts[:k]) for k in range(len(parts), 1, -1))
        module = next((way for way in ways if way in modules), target)
        if module not in {own, "*"}:
            yield line, module


def _fault(name: str, target: str) -> str | None:
    """Tell why a module must not import another, if so."""
    top = target.split(".")[0]
    if top in NOT_INSTALLED:
        return "is not installed with the package"
    if not _ours(name):
        allowed = top in {*sys.stdlib_module_names, "numpy", ADAPTERS} or is_message_package(top)
        return None if allowed else "an adapter imports messages and NumPy only"
    if is_ros(top):
        return None if room(name) in ROS_ROOMS else "the library imports ROS"
    if top == ADAPTERS:
        return None if room(name) in ADAPTER_USERS else f"only {', '.join(sorted(ADAPTER_USERS))} read messages"
    if not _ours(target) or room(target) == room(name):
        return None
    own, other = _floor(name), _floor(target)
    if target.endswith("*") and other is None:
        return "names no room"
    if own is None or other is None or other < own:
        return None
    return f"an arrow goes {'up' if other > own else 'across'}"


def _circles(arrows: Mapping[str, list[tuple[int, str]]]) -> Iterator[list[str]]:
    """Yield circles of modules, each once, from a walk in depth."""
    done: set[str] = set()

    def walk(name: str, way: list[str]) -> Iterator[list[str]]:
        if name in way:
            yield [*way[way.index(name) :], name]
        elif name not in done:
            for target in sorted({target for _, target in arrows.get(name, ())}):
                yield from walk(target, [*way, name])
            done.add(name)

    for name in arrows:
        yield from walk(name, [])


if __name__ == "__main__":
    lines = faults(ROOT)
    print("\n".join(lines) or "The house is in order.")
    sys.exit(bool(lines))
