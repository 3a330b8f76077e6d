"""Fixtures of every test: an own ROS domain and context each, so that no two tests or suites hear each other.

The environment is set before anything imports rclpy: field checks on (they are off by default, and let through what a
C++ node would not), discovery confined to this machine, and announced often enough to take well under half a second.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from ros_helpers import own_domain

ROOT = Path(__file__).resolve().parent.parent
# Domains up to 101 keep Fast DDS's ports below the range from which Linux hands out ephemeral ones; 0 is the users'.
DOMAINS = range(1, 102)
# What is tested in these folders no version of NumPy or SciPy changes: texts, processes, packaging.
ONCE = frozenset({"bags", "cli", "nodes", "package", "tools"})

# How long an example takes tells of the machine's other work only.
hypothesis.settings.register_profile("unhurried", deadline=None)
hypothesis.settings.load_profile("unhurried")

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(ROOT / "config" / "fastdds_fast_discovery.xml")
os.environ.setdefault("ROS_DOMAIN_ID", str(DOMAINS[-1]))  # for a test that forgets its fixture: not the users' domain


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that `make test` need not repeat with other versions."""
    for item in items:
        if item.path.relative_to(ROOT / "test").parts[0] in ONCE:
            item.add_marker(pytest.mark.once)


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give the test a ROS_DOMAIN_ID that no other test on this machine uses while it runs; processes inherit it."""
    with own_domain(DOMAINS) as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain


@pytest.fixture
def ros_context(ros_domain: int) -> Iterator[Any]:
    """Give the test an rclpy Context of its own, in its own domain."""
    import rclpy
    from rclpy.context import Context

    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    try:
        yield context
    finally:
        context.try_shutdown()


@pytest.fixture(scope="session")
def project_root() -> Path:
    """Return the root of the source tree."""
    return ROOT
