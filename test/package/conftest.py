"""What the tests of the package share: setup.py's arguments, read without building anything."""

from __future__ import annotations

import runpy
import sys
import types
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def setup_arguments() -> dict[str, Any]:
    """Return what setup.py passes to setuptools.setup."""
    given: dict[str, Any] = {}
    setuptools = types.ModuleType("setuptools")
    setuptools.setup = given.update  # type: ignore[attr-defined]
    setuptools.find_packages = lambda **_: []  # type: ignore[attr-defined]
    with mock.patch.dict(sys.modules, {"setuptools": setuptools}), pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        runpy.run_path(str(ROOT / "setup.py"))
    return given


@pytest.fixture(scope="session")
def executables(setup_arguments: dict[str, Any]) -> dict[str, str]:
    """Return the console scripts: name -> "module:function"."""
    pairs = (script.split("=") for script in setup_arguments["entry_points"]["console_scripts"])
    return {name.strip(): target.strip() for name, target in pairs}
