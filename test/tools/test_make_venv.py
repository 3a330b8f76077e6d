"""tools/make_venv.py: a missing prerequisite gets one clear line, and a sourced ROS is recognised."""

from __future__ import annotations

import ast
import importlib.util
import platform
import sys
from collections import namedtuple
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "tools" / "make_venv.py"
VersionInfo = namedtuple("VersionInfo", "major minor micro releaselevel serial")


@pytest.fixture
def make_venv(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load the script, on a machine that looks like x86-64 Linux with no ROS sourced."""
    spec = importlib.util.spec_from_file_location("make_venv", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    return module


def pretend_python(monkeypatch: pytest.MonkeyPatch, major: int, minor: int) -> None:
    monkeypatch.setattr(sys, "version_info", VersionInfo(major, minor, 1, "final", 0))
    monkeypatch.setattr(platform, "python_version", lambda: f"{major}.{minor}.1")


def refusal(make_venv: ModuleType, sourced: list[str]) -> str:
    with pytest.raises(make_venv.Refusal) as caught:
        make_venv.check_machine(sourced)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_script_parses_on_an_old_python() -> None:
    assert ast.parse(SCRIPT.read_text(), feature_version=(3, 6))


@pytest.mark.parametrize("minor", [11, 12, 13])
def test_supported_pythons_are_accepted(make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch, minor: int) -> None:
    pretend_python(monkeypatch, 3, minor)
    assert make_venv.check_machine([]) is None


@pytest.mark.parametrize("minor", [6, 10, 14])
def test_another_python_is_refused(make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch, minor: int) -> None:
    pretend_python(monkeypatch, 3, minor)
    assert f"Python 3.11 to 3.13 is needed; this is 3.{minor}.1: " in refusal(make_venv, [])


def test_a_python_at_hand_that_would_do_is_named(
    make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pretend_python(monkeypatch, 3, 10)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert refusal(make_venv, []).endswith("install one (with venv) and set PYTHON=.")
    program = tmp_path / "python3.12"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert refusal(make_venv, []).endswith("run make again with PYTHON=python3.12.")


def test_with_a_sourced_ros_a_newer_python_is_its_business(
    make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_python(monkeypatch, 3, 14)
    assert make_venv.check_machine(["/opt/ros/jazzy"]) is None


def test_another_processor_needs_a_sourced_ros(make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert "no ROS 2 wheels for Linux aarch64: install ros-jazzy-ros-base with apt" in refusal(make_venv, [])
    assert make_venv.check_machine(["/opt/ros/jazzy"]) is None


def test_another_distribution_is_refused(make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DISTRO", "humble")
    assert refusal(make_venv, ["/opt/ros/humble"]).startswith("ROS 2 humble is sourced, but track_fusion needs jazzy")
    assert make_venv.check_machine([]) is None  # the variable alone, without a prefix, is no sourced ROS


def test_a_missing_venv_module_is_named(make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ensurepip", None)
    wanted = f"sudo apt install python{sys.version_info.major}.{sys.version_info.minor}-venv"
    assert wanted in refusal(make_venv, [])


def test_our_own_environments_are_no_sourced_ros(
    make_venv: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{ROOT / '.venv'}:{ROOT / '.venv-floor'}")
    assert make_venv.sourced_prefixes() == []
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}:{ROOT / '.venv'}")
    assert make_venv.sourced_prefixes() == [str(tmp_path)]


def test_an_environment_of_another_kind_or_version_is_made_anew(make_venv: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "pip").touch()
    config = tmp_path / "pyvenv.cfg"
    config.write_text(f"include-system-site-packages = false\nversion = {platform.python_version()}\n")
    assert make_venv.fits(str(tmp_path), [])
    assert not make_venv.fits(str(tmp_path), ["/opt/ros/jazzy"])
    config.write_text("include-system-site-packages = false\nversion = 3.9.1\n")
    assert not make_venv.fits(str(tmp_path), [])
