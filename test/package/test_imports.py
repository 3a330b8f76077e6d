"""The library imports without ROS, the nodes without extras."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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
    is_node = module.name.startswith(("track_fusion.nodes", "track_fusion.demo"))
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


@pytest.mark.colcon
def test_the_library_imports_without_ros() -> None:
    done = import_all(nodes=False, blocked={"rclpy", "tf2_ros", "launch"}, suffixes=("_msgs", "_interfaces"))
    assert {"track_fusion.tracks", "track_fusion.centre.centre", "track_fusion.cli"} <= done


@pytest.mark.colcon
def test_the_nodes_import_without_extras() -> None:
    done = import_all(nodes=True, blocked={"click", "rich", "matplotlib", "rosbags"})
    assert {f"track_fusion.nodes.{n}" for n in ("sensor_tracker", "fusion_centre", "replay", "evaluator")} <= done
