"""Who imports whom: the library without ROS, the nodes without extras, the adapters without the library, one way."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools.house import faults

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


def plant(root: Path, files: dict[str, str]) -> Path:
    """Write a small house."""
    for name, text in {"track_fusion/__init__.py": "", "msg_adapters/__init__.py": "", **files}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_the_house_is_in_order() -> None:
    assert len(list((ROOT / "track_fusion").rglob("*.py"))) > 100
    assert faults(ROOT) == []


@pytest.mark.parametrize(
    ("files", "fault"),
    [
        ({"track_fusion/rules/naive.py": "from track_fusion.centre import step", "track_fusion/centre/step.py": ""},
         "track_fusion.rules.naive:1 -> track_fusion.centre.step: an arrow goes up"),
        ({"track_fusion/linalg.py": "def f():\n    from . import cli", "track_fusion/cli/__init__.py": ""},
         "track_fusion.linalg:2 -> track_fusion.cli: an arrow goes up"),
        ({"track_fusion/scenarios/a.py": "import track_fusion.report.b", "track_fusion/report/b.py": ""},
         "track_fusion.scenarios.a:1 -> track_fusion.report.b: an arrow goes across"),
        ({"track_fusion/rules/a.py": "from track_fusion.rules import b", "track_fusion/rules/b.py": "from . import a"},
         "circle: track_fusion.rules.a -> track_fusion.rules.b -> track_fusion.rules.a"),
        ({"track_fusion/filters/kalman.py": "from nav_msgs.msg import Odometry"},
         "track_fusion.filters.kalman:1 -> nav_msgs.msg.Odometry: the library imports ROS"),
        ({"track_fusion/centre/step.py": "import rclpy"},
         "track_fusion.centre.step:1 -> rclpy: the library imports ROS"),
        ({"track_fusion/centre/step.py": "import msg_adapters.pose"},
         "track_fusion.centre.step:1 -> msg_adapters.pose: only bags, demo, nodes read messages"),
        ({"track_fusion/helpers.py": ""}, "track_fusion.helpers is in no room"),
        ({"track_fusion/attic/old.py": ""}, "track_fusion.attic.old is in no room"),
        ({"msg_adapters/pose.py": "import scipy"},
         "msg_adapters.pose:1 -> scipy: an adapter imports messages and NumPy only"),
        ({"msg_adapters/pose.py": "import track_fusion.tracks"},
         "msg_adapters.pose:1 -> track_fusion.tracks: an adapter imports messages and NumPy only"),
    ],
)  # fmt: skip
def test_what_breaks_the_rules_of_the_house_is_named(tmp_path: Path, files: dict[str, str], fault: str) -> None:
    assert faults(plant(tmp_path, files)) == [fault]


def test_what_keeps_them_is_not(tmp_path: Path) -> None:
    files = {
        "track_fusion/nodes/centre.py": "import rclpy, msg_adapters\nfrom track_fusion.centre import step",
        "track_fusion/centre/step.py": "import numpy\nfrom track_fusion.tracks import TrackBatch",
        "track_fusion/tracks.py": "from track_fusion.linalg import outer",
        "track_fusion/linalg.py": "",
        "msg_adapters/pose.py": "import numpy\nfrom nav_msgs.msg import Odometry",
    }
    assert faults(plant(tmp_path, files)) == []
