"""tools/house.py: the house is in order, what breaks its rules is named, and the tests mirror its rooms."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.house import ADAPTERS, FLOORS, GROUND, faults, imported

ROOT = Path(__file__).resolve().parents[2]
#: Rooms without a folder of tests of their own, and where they are tested instead.
ELSEWHERE = {
    "demo": "its processes by test/nodes, its command by test/cli",
    "report": "its pages by test/cli, which makes them",
    "ground": "beside the folders, as its modules stand beside the rooms",
}
#: Folders of tests that are no room.
BESIDE = {
    "adapters": "msg_adapters",
    "data": "files that tests read",
    "oracles": "computations that share no code with what they judge",
    "package": "setup.py, package.xml, launch files, what is installed",
    "tools": "tools/",
}


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
         "track_fusion.centre.step:1 -> msg_adapters.pose: only bags, demo, messages, nodes read messages"),
        ({"track_fusion/helpers.py": ""}, "track_fusion.helpers is in no room"),
        ({"track_fusion/attic/old.py": ""}, "track_fusion.attic.old is in no room"),
        ({"msg_adapters/pose.py": "import scipy"},
         "msg_adapters.pose:1 -> scipy: an adapter imports messages and NumPy only"),
        ({"msg_adapters/pose.py": "import track_fusion.tracks"},
         "msg_adapters.pose:1 -> track_fusion.tracks: an adapter imports messages and NumPy only"),
        ({"msg_adapters/pose.py": "import tf2_ros"},
         "msg_adapters.pose:1 -> tf2_ros: an adapter imports messages and NumPy only"),
        ({"msg_adapters/a.py": "from . import b", "msg_adapters/b.py": "from msg_adapters.a import x"},
         "circle: msg_adapters.a -> msg_adapters.b -> msg_adapters.a"),
        ({"track_fusion/centre/a.py": "import rosbag2_py"},
         "track_fusion.centre.a:1 -> rosbag2_py: the library imports ROS"),
        ({"track_fusion/demo/a.py": "from tools.house import faults"},
         "track_fusion.demo.a:1 -> tools.house.faults: is not installed with the package"),
        ({"track_fusion/linalg.py": "import track_fusion.cli as c", "track_fusion/cli/__init__.py": ""},
         "track_fusion.linalg:1 -> track_fusion.cli: an arrow goes up"),
        ({"track_fusion/rules/a.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..nodes import b",
          "track_fusion/nodes/b.py": ""},
         "track_fusion.rules.a:3 -> track_fusion.nodes.b: an arrow goes up"),
        ({"track_fusion/rules/a.py": "import importlib\nimportlib.import_module('track_fusion.cli')",
          "track_fusion/cli/__init__.py": ""},
         "track_fusion.rules.a:2 -> track_fusion.cli: an arrow goes up"),
        ({"track_fusion/rules/a.py": "x = 1\n__import__(f'track_fusion.cli.{x}')"},
         "track_fusion.rules.a:2 -> track_fusion.cli.*: an arrow goes up"),
        ({"track_fusion/rules/a.py": "import importlib as i\ni.import_module('.app', 'track_fusion.cli')",
          "track_fusion/cli/app.py": ""},
         "track_fusion.rules.a:2 -> track_fusion.cli.app: an arrow goes up"),
        ({"track_fusion/rules/a.py": "import importlib as i\ni.import_module('track_fusion.' + room)"},
         "track_fusion.rules.a:2 -> track_fusion.*: names no room"),
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
        "track_fusion/cli/__init__.py": "from track_fusion.cli.app import main",
        "track_fusion/cli/app.py": "import importlib\nimportlib.import_module(f'track_fusion.cli.{name}')",
        "msg_adapters/pose.py": "import numpy\nfrom nav_msgs.msg import Odometry\nfrom . import header",
        "msg_adapters/header.py": "",
    }
    assert faults(plant(tmp_path, files)) == []


# ---- the tests ------------------------------------------------------------------------------------------------------


def test_every_room_has_its_folder_of_tests() -> None:
    rooms = {room for floor in FLOORS for room in floor if (ROOT / "track_fusion" / room).is_dir()}
    folders = {path.name for path in (ROOT / "test").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == (rooms - set(ELSEWHERE)) | set(BESIDE)
    for room in ("densities", "scenarios"):
        inner = [
            {path.name for path in (ROOT / side / room).iterdir() if path.is_dir() and path.name != "__pycache__"}
            for side in ("track_fusion", "test")
        ]
        assert inner[0] == inner[1]


def test_tests_beside_the_folders_are_of_the_ground() -> None:
    names = {path.stem.removeprefix("test_") for path in (ROOT / "test").glob("test_*.py")}
    assert names <= GROUND


def test_oracles_share_no_code_with_what_they_judge() -> None:
    for path in (ROOT / "test" / "oracles").glob("[!t]*.py"):
        tops = {target.split(".")[0] for _, target in imported(path, ROOT / "test")}
        assert not tops & {"track_fusion", ADAPTERS}, path.name


def test_what_tests_share_is_in_no_test() -> None:
    for path in (ROOT / "test").rglob("*.py"):
        modules = [part for _, target in imported(path, ROOT / "test") for part in target.split(".")[:-1]]
        assert not [part for part in modules if part.startswith("test_")], path.name
