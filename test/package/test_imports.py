"""Who imports whom: the library without ROS, the nodes without extras, the adapters without the library, one way."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = sorted((ROOT / "track_fusion").rglob("*.py"))
ADAPTERS = sorted((ROOT / "msg_adapters").rglob("*.py"))

# A module imports from its own layer or those below. What stands in none of them is an application of the library.
LAYERS = (
    {"params", "linalg", "tracks", "optimise", "least_squares", "random_streams", "chi_square"},
    {"densities", "models"},
    {"rules", "filters", "association"},
    {"track_manager", "scan_buffer", "metrics"},
    {"fusion_centre", "peers"},
    {"scenarios", "report"},
    {"nodes"},
    {"cli"},
)
APPLICATION = 5

BLOCKED = """
import importlib, pkgutil, sys

class Block:
    def find_spec(self, name, path=None, target=None):
        root = name.split(".")[0]
        if root in {blocked!r} or root.endswith({suffixes!r}):
            raise ImportError(f"blocked: {{name}}", name=name)

sys.meta_path.insert(0, Block())
import track_fusion
for module in pkgutil.walk_packages(track_fusion.__path__, "track_fusion."):
    is_node = module.name.startswith("track_fusion.nodes")
    if is_node == {nodes!r} and not module.name.endswith("__main__"):
        importlib.import_module(module.name)
        print(module.name)
"""


def import_all(*, nodes: bool, blocked: set[str], suffixes: tuple[str, ...] = ()) -> set[str]:
    """Import every module (of nodes/, or all others) in a process in which some packages cannot be imported."""
    script = BLOCKED.format(nodes=nodes, blocked=blocked, suffixes=suffixes)
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and full name of everything a file imports, also inside functions; names relative to its package."""
    package = path.relative_to(ROOT).parent.parts
    for item in ast.walk(ast.parse(path.read_text())):
        if isinstance(item, ast.Import):
            yield from ((item.lineno, alias.name) for alias in item.names)
        elif isinstance(item, ast.ImportFrom):
            base = list(package[: len(package) - item.level + 1]) if item.level else []
            base += [item.module] if item.module else []
            yield from ((item.lineno, ".".join([*base, alias.name])) for alias in item.names)


def layer(name: str) -> int:
    """Return the layer of track_fusion.<name>."""
    return next((height for height, names in enumerate(LAYERS) if name in names), APPLICATION)


def is_ros(name: str) -> bool:
    root = name.split(".")[0]
    return root in {"rclpy", "tf2_ros", "ament_index_python"} or root.endswith(("_msgs", "_interfaces"))


@pytest.mark.colcon
def test_the_library_imports_without_ros() -> None:
    done = import_all(nodes=False, blocked={"rclpy", "tf2_ros", "launch"}, suffixes=("_msgs", "_interfaces"))
    assert {"track_fusion.tracks", "track_fusion.fusion_centre", "track_fusion.cli"} <= done


@pytest.mark.colcon
def test_the_nodes_import_without_extras() -> None:
    done = import_all(nodes=True, blocked={"click", "rich", "matplotlib", "rosbags"})
    assert {f"track_fusion.nodes.{n}" for n in ("sensor_tracker", "fusion_centre", "replay", "evaluator")} <= done


def test_only_nodes_name_ros() -> None:
    library = [path for path in LIBRARY if "nodes" not in path.relative_to(ROOT).parts]
    found = [f"{p.relative_to(ROOT)}:{line} {name}" for p in library for line, name in imported(p) if is_ros(name)]
    assert library
    assert found == []


def test_adapters_import_messages_and_numpy_only() -> None:
    allowed = set(sys.stdlib_module_names) | {"numpy", "msg_adapters"}
    found = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path in ADAPTERS
        for line, name in imported(path)
        if name.split(".")[0] not in allowed and not (is_ros(name) and not name.startswith("rclpy"))
    ]
    assert ADAPTERS
    assert found == []


def test_imports_point_one_way() -> None:
    upward = []
    for path in LIBRARY:
        own = layer(path.relative_to(ROOT / "track_fusion").parts[0].removesuffix(".py"))
        for line, name in imported(path):
            parts = name.split(".")
            is_init = path == ROOT / "track_fusion" / "__init__.py"
            if parts[0] == "track_fusion" and len(parts) > 1 and not is_init and layer(parts[1]) > own:
                upward.append(f"{path.relative_to(ROOT)}:{line} {name}")
    assert len(LIBRARY) > 1
    assert upward == []
