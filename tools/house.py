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
    {"demo": "bring-up of processes, the demonstration, recording"},
    {"nodes": "the ROS nodes: thin"},
    {
        "bags": "bags without ROS",
        "scenarios": "one published study a folder",
        "report": "pages and pictures",
    },
    {"study": "what a scenario is: runs, samples, figures, claims and verdicts"},
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
    {"ground": "data model, parameters, linear algebra, angles, random streams"},
)
#: The modules that stand on the ground, outside any folder, and the package itself.
GROUND = frozenset({"", "angles", "layouts", "linalg", "params", "plugins", "random_streams", "tracks"})
#: Only these rooms know ROS.
ROS_ROOMS = frozenset({"demo", "nodes"})
#: The adapters stand beside the house: it may use them, they know nothing of it.
ADAPTERS = "msg_adapters"
ADAPTER_USERS = frozenset({"bags", "demo", "nodes"})


def faults(root: Path) -> list[str]:
    """Return what breaks the rules in a source tree, one line each: the arrow, and why it must not be."""
    modules = {_name(path, root): path for path in sorted((root / "track_fusion").rglob("*.py"))}
    arrows = {name: sorted(set(_arrows(path, name, modules))) for name, path in modules.items()}
    lines = [f"{name} is in no room" for name in modules if _floor(name) is None]
    for name, targets in arrows.items():
        lines += [fault for line, target in targets if (fault := _fault(name, target, line))]
    lines += [f"circle: {' -> '.join(circle)}" for circle in _circles(arrows)]
    for path in sorted((root / ADAPTERS).rglob("*.py")):
        name = _name(path, root)
        allowed = {*sys.stdlib_module_names, "numpy", ADAPTERS}
        for line, target in imported(path, root):
            top = target.split(".")[0]
            if top not in allowed and (not is_ros(target) or top == "rclpy"):
                lines.append(f"{name}:{line} -> {target}: an adapter imports messages and NumPy only")
    return lines


def room(name: str) -> str:
    """Return the room of a module of track_fusion."""
    first = (*name.split("."), "")[1]
    return "ground" if first in GROUND else first


def is_ros(name: str) -> bool:
    """Tell whether a module belongs to ROS."""
    top = name.split(".")[0]
    return top in {"rclpy", "tf2_ros", "ament_index_python"} or top.endswith(("_msgs", "_interfaces"))


def imported(path: Path, root: Path) -> Iterator[tuple[int, str]]:
    """Yield line and full name of everything a file imports, also inside functions; of relative imports, too."""
    package = path.relative_to(root).parent.parts
    for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(item, ast.Import):
            yield from ((item.lineno, alias.name) for alias in item.names)
        elif isinstance(item, ast.ImportFrom):
            base = list(package[: len(package) - item.level + 1]) if item.level else []
            base += [item.module] if item.module else []
            yield from ((item.lineno, ".".join([*base, alias.name])) for alias in item.names)


def _name(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def _floor(name: str) -> int | None:
    """Return the floor of a module, 0 at the ground."""
    return next((len(FLOORS) - 1 - k for k, rooms in enumerate(FLOORS) if room(name) in rooms), None)


def _arrows(path: Path, own: str, modules: Mapping[str, Path]) -> Iterator[tuple[int, str]]:
    """Yield line and target of each import: the module it names where it is ours."""
    for line, target in imported(path, path.parents[own.count(".") + (path.name == "__init__.py")]):
        if target.split(".")[0] == "track_fusion":
            while target not in modules and "." in target:
                target = target.rpartition(".")[0]
        if target != own:
            yield line, target


def _fault(name: str, target: str, line: int) -> str | None:
    arrow = f"{name}:{line} -> {target}"
    if is_ros(target):
        return None if room(name) in ROS_ROOMS else f"{arrow}: the library imports ROS"
    if target.split(".")[0] == ADAPTERS:
        users = ", ".join(sorted(ADAPTER_USERS))
        return None if room(name) in ADAPTER_USERS else f"{arrow}: only {users} read messages"
    if target.split(".")[0] != "track_fusion" or room(target) == room(name):
        return None
    own, other = _floor(name), _floor(target)
    if own is None or other is None or other < own:
        return None
    return f"{arrow}: an arrow goes {'up' if other > own else 'across'}"


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
    found = faults(ROOT)
    print("\n".join(found) or "The house is in order.")
    sys.exit(bool(found))
