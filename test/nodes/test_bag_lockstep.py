"""A bag in lockstep with a fusion centre: what the node publishes is what `bag fuse` writes."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags.support import GOLDEN, SENSORS, params_file
from nodes.support import START_S, STEP_S, Diagnostics, read
from ros_helpers import NodeProcess, Probe
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt64

from track_fusion.bags.fuse import FUSED, centre_of, fuse_bag
from track_fusion.bags.read import read_bag
from track_fusion.nodes.managed import qos

TOLERANCE = 1e-9


@pytest.mark.parametrize(
    ("oracle", "bag"), [("covariance_intersection", "tracks"), ("odometry", "odometry")], ids=["tables", "odometry"]
)
def test_a_bag_in_lockstep_gives_what_bag_fuse_gives(
    oracle: str, bag: str, ros_context: Any, ros_domain: int, tmp_path: Path
) -> None:
    """Parameters as on a robot: time limits that matter, and one source that is silent for two scans."""
    given = {"use_sim_time": True, "expected_subscribers": 1, "trigger": "any_source", "fusion_timeout_s": 0.05}
    params = params_file(tmp_path, oracle, **given, source_timeout_s=1.0, max_delay_s=10.0)
    out, tail_s = tmp_path / "out", 2.0
    outcome = fuse_bag(GOLDEN / bag, centre_of(params, print), out, tail_s=tail_s)
    wanted = read_bag(out, [FUSED])[FUSED]
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        tables, diagnostics = probe.listen(FUSED, PointCloud2, 1000), Diagnostics(probe)
        stack.enter_context(NodeProcess("fusion_centre", params_file=params))
        replay = {"bag": str(GOLDEN / bag), "pace": "lockstep", "bag_tail_s": tail_s, "deadline_s": START_S}
        remaps = {"~/processed": "/fusion_centre/processed"}
        player = stack.enter_context(NodeProcess("replay", params=replay, remaps=remaps))
        probe.wait_for(lambda: len(tables) >= len(wanted), START_S, "the fused tables")
        assert player.wait(STEP_S) == 0, player.output()
        counts = diagnostics.wait_for("fusion_centre", lambda v: v.get("steps") == str(outcome.steps), "its counts")
        assert f"Replayed {outcome.messages} messages" in player.output()
    assert len(tables) == len(wanted) > 50
    for table, of_bag in zip(tables, wanted, strict=True):
        got, want = read(table), read(of_bag)
        assert got.time_ns.tolist() == want.time_ns.tolist()
        assert got.track_id.tolist() == want.track_id.tolist()
        for name in ("mean", "cov", "existence", "status", "source"):
            a, b = getattr(got, name), getattr(want, name)
            np.testing.assert_allclose(a, b, rtol=0, atol=TOLERANCE * np.abs(b).max(initial=0.0))
    assert {k.removeprefix("rejected/"): int(v) for k, v in counts.items() if "rejected/" in k} == dict(
        outcome.rejected
    )


def test_the_count_is_told_to_who_comes_later(ros_context: Any, tmp_path: Path) -> None:
    """Messages that are turned away are counted, too; the parameter file is that of a node of another name."""
    params = tmp_path / "centre.yaml"
    params.write_text(json.dumps({"/**": {"ros__parameters": {"sensor_1.topic": "/one"}}}))
    with NodeProcess("fusion_centre", params_file=params) as _, Probe(ros_context) as probe:
        one = probe.publisher("/one", PointCloud2, deadline_s=START_S)
        other = probe.publisher(f"/fusion_centre/sources/{SENSORS[1]}/tracks", PointCloud2, deadline_s=START_S)
        for sender in (one, other, one):
            sender.publish(PointCloud2())
        diagnostics = Diagnostics(probe)
        diagnostics.wait_for_counts("fusion_centre", {"wrong_frame": 3})
        counts = probe.listen("/fusion_centre/processed", UInt64, qos(1, latched=True))
        probe.wait_for(lambda: counts and counts[-1].data == 3, STEP_S, "the count")
        one.publish(PointCloud2())
        probe.wait_for(lambda: counts[-1].data == 4, STEP_S, "the next count")
