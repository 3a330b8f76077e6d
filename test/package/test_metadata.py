"""package.xml, setup.py and CHANGELOG.rst agree, and colcon takes the package for what it is."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
NODES = {"sensor_tracker", "fusion_centre", "replay", "evaluator"}

pytestmark = pytest.mark.colcon


def test_package_xml_is_valid() -> None:
    package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg comes with colcon-ros")
    warnings: list[str] = []
    parsed = package.parse_package(str(ROOT), warnings=warnings)
    parsed.validate(warnings=warnings)
    assert warnings == []
    assert parsed.package_format == 3
    assert parsed.get_build_type() == "ament_python"
    assert parsed.licenses == ["Apache-2.0"]


def test_colcon_lists_an_ament_python_package(tmp_path: Path) -> None:
    pytest.importorskip("colcon_ros", reason="colcon-ros is not installed")
    command = [sys.executable, "-c", "from colcon_core.command import main; main()", "--log-base", str(tmp_path)]
    listed = subprocess.run(
        [*command, "list", "--base-paths", str(ROOT)], check=True, capture_output=True, text=True, timeout=60
    )
    name, _, kind = listed.stdout.rstrip("\n").split("\t")
    assert (name, kind) == ("track_fusion", "(ros.ament_python)")


def test_the_newest_release_in_the_changelog_is_this_version(setup_arguments: dict[str, Any]) -> None:
    """Above it stands at most what is not released, under the heading that catkin's tools know."""
    version = MANIFEST.findtext("version")
    headings = re.findall(r"^(\S+)(?: \(\d{4}-\d\d-\d\d\))?\n-+$", (ROOT / "CHANGELOG.rst").read_text(), re.MULTILINE)
    unreleased = headings[:1] == ["Forthcoming"]
    assert headings[unreleased] == version == setup_arguments["version"]


def test_the_licence_is_the_one_stated(setup_arguments: dict[str, Any]) -> None:
    text = (ROOT / "LICENSE").read_text()
    assert setup_arguments["license"] == "Apache-2.0"
    assert "Apache License" in text
    assert "Version 2.0, January 2004" in text


def test_only_numpy_and_scipy_are_needed_besides_ros(setup_arguments: dict[str, Any]) -> None:
    assert setup_arguments["install_requires"] == ["numpy>=1.26", "scipy>=1.11"]


def test_extra_test_names_pytest(setup_arguments: dict[str, Any]) -> None:
    # Without it `colcon test` runs unittest, finds nothing and is green.
    assert any(requirement.startswith("pytest") for requirement in setup_arguments["extras_require"]["test"])


def test_ros_imports_are_stated_in_package_xml() -> None:
    stated = {element.text for element in MANIFEST.findall("exec_depend")}
    optional = {"vision_msgs", "radar_msgs", "autoware_perception_msgs", "tf2_ros"}  # imported lazily
    sources = [
        path.read_text() for folder in ("track_fusion", "msg_adapters") for path in ROOT.glob(f"{folder}/**/*.py")
    ]
    pattern = re.compile(r"^\s*(?:from|import) (rclpy|tf2_ros|[a-z0-9_]+_(?:msgs|interfaces))\b", re.MULTILINE)
    used = {name for source in sources for name in pattern.findall(source)}
    assert "rclpy" in used
    assert used - optional <= stated


def test_the_entry_points_are_the_nodes_and_the_command(executables: dict[str, str]) -> None:
    nodes = {name: f"track_fusion.nodes.{name}:main" for name in NODES}
    assert executables == {**nodes, "track-fusion": "track_fusion.cli:main"}


@pytest.mark.parametrize("name", [*sorted(NODES), "track-fusion"])
def test_every_entry_point_can_be_called(name: str, executables: dict[str, str]) -> None:
    module, function = executables[name].split(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_marker_manifest_and_files_are_installed(setup_arguments: dict[str, Any]) -> None:
    installed = dict(setup_arguments["data_files"])
    assert installed["share/ament_index/resource_index/packages"] == ["resource/track_fusion"]
    assert installed["share/track_fusion"] == ["package.xml"]
    for folder in ("config", "launch"):
        there = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert {Path(name).name for name in installed[f"share/track_fusion/{folder}"]} == there
        assert there


def test_setup_cfg_puts_executables_where_ros_looks() -> None:
    text = (ROOT / "setup.cfg").read_text()
    assert "script_dir=$base/lib/track_fusion" in text
    assert "install_scripts=$base/lib/track_fusion" in text
