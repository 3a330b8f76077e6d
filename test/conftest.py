"""Fixtures of every test: an own ROS domain and context each, so that no two tests or suites hear each other.

The environment is set before anything imports rclpy: field checks on (they are off by default, and let through what a
C++ node would not), discovery confined to this machine, and announced often enough to take well under half a second.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
# Domains up to 101 keep Fast DDS's ports below the range from which Linux hands out ephemeral ones; 0 is the users'.
DOMAINS = range(1, 102)

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(ROOT / "config" / "fastdds_fast_discovery.xml")
os.environ.setdefault("ROS_DOMAIN_ID", str(DOMAINS[-1]))  # for a test that forgets its fixture: not the users' domain

_next_domain = os.getpid() * 7  # suites that start one after the other begin in different places


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give the test a ROS_DOMAIN_ID that no other test on this machine uses while it runs; processes inherit it."""
    global _next_domain
    for _ in DOMAINS:
        domain = DOMAINS[_next_domain % len(DOMAINS)]
        _next_domain += 1
        # A lock on an open file ends with the process, however it ends.
        path = Path(tempfile.gettempdir()) / f"track_fusion_{os.getuid()}_domain_{domain}.lock"
        lock = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            continue
        try:
            monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
            yield domain
        finally:
            os.close(lock)
        return
    pytest.fail("Every ROS domain from 1 to 101 is in use by other tests on this machine.")


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
