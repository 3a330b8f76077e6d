"""The evaluator by itself: a truth that is not whole, or of another type, and the end of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from nodes.support import AXES, SECOND_NS, START_S, STEP_S, Diagnostics, track_table
from ros_helpers import NodeProcess, Probe
from sensor_msgs.msg import PointCloud2

from msg_adapters.odometry import odometry_to_msgs
from track_fusion.tracks import TrackBatch, planar_layout


def test_lost_truth_is_reported_and_the_end_of_the_run_ends_the_evaluator(ros_context: Any, tmp_path: Path) -> None:
    """Of 20 samples of two targets Odometry lacks 3, and the eleventh time never comes."""
    output = tmp_path / "result.json"
    params = {"truth_type": "odometry", "steps": 11, "output": str(output)}
    with NodeProcess("evaluator", params=params) as process, Probe(ros_context) as probe:
        truth = probe.publisher("/evaluator/truth", Odometry, deadline_s=START_S)
        tracks = probe.publisher("/evaluator/tracks", PointCloud2, deadline_s=START_S)
        diagnostics = Diagnostics(probe)
        for k in range(10):
            at_ns, states = (1 + k) * SECOND_NS, np.array([[10.0 * k, 500.0 * i, 10.0, 0.0] for i in (0, 1)])
            batch = TrackBatch.gaussian(
                planar_layout(), "map", states, np.tile(1e-12 * np.eye(4), (2, 1, 1)), time_ns=at_ns, track_id=[1, 2]
            )
            for msg in odometry_to_msgs(batch, AXES)[: 1 if k in (3, 5, 9) else 2]:
                truth.publish(msg)
            tracks.publish(track_table(at_ns, states + 0.5))
        diagnostics.wait_for("evaluator", lambda v: v.get("times") == "10" and v.get("unjudged") == "2", "the count")
        assert "2 samples could not be judged" in diagnostics.status("evaluator").message
        assert process.running
        probe.node.destroy_publisher(truth)
        assert process.wait(STEP_S) == 0
        assert "10 of 11 times were judged; 3 samples could not be." in process.output()
    result = json.loads(output.read_text())
    assert (result["all"]["samples"], result["unjudged"], result["missed"], result["false"]) == (17, 3, 0, 0)
    assert result["all"]["verdict"] == "underconfident"


def test_a_truth_of_another_type_is_named(ros_context: Any) -> None:
    with NodeProcess("evaluator") as process, Probe(ros_context) as probe:
        probe.node.create_publisher(Odometry, "/evaluator/truth", 10)
        diagnostics = Diagnostics(probe)
        text = "~/truth is published as nav_msgs/msg/Odometry, but truth_type is 'track_table'"
        probe.wait_for(lambda: text in getattr(diagnostics.status("evaluator"), "message", ""), START_S, "a warning")
        assert f"{text}: none of it is read." in process.output()
