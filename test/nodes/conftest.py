"""Fixtures of the node tests: a ROS domain and context for a whole module, whose tests share one set of processes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from ros_helpers import Probe, own_domain


@pytest.fixture(scope="module")
def shared_domain() -> Iterator[int]:
    """Give the module's shared processes a ROS_DOMAIN_ID of their own."""
    with own_domain(range(1, 102)) as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain


@pytest.fixture(scope="module")
def shared_probe(shared_domain: int) -> Iterator[Probe]:
    """Give the module's tests one node of their own."""
    import rclpy
    from rclpy.context import Context

    context = Context()
    rclpy.init(context=context, domain_id=shared_domain)
    try:
        with Probe(context) as probe:
            yield probe
    finally:
        context.try_shutdown()
