"""A centre that retrodicts, as a process: a source that is always late counts as if it were not."""

import numpy as np
from nodes.support import IDENTITY, PATIENT, SECOND_NS, START_S, STEP_S, Diagnostics, clock, read, stamp_ns, track_table
from ros_helpers import NodeProcess, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt64

from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.nodes.managed import qos
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

STEPS, LAG = 12, 3
TENTH_NS = SECOND_NS // 10
COVS = {"a": np.diag([1.0, 2.0, 1.0, 1.0]), "b": np.diag([2.0, 1.0, 1.0, 2.0])}


def means(source, k):
    """Two targets that move, seen a little apart by the two sources."""
    off = 0.3 if source == "b" else 0.0
    return [[0.1 * k + off, 0.0, 1.0, 0.0], [100.0, 0.2 * k - off, 0.0, 2.0]]


def in_order():
    """The centre's plain steps, all scans in time up to the last that the late source had sent before the last step."""
    rule, motion = RULES["covariance_intersection"], NearlyConstantVelocity(planar_layout(), MotionParams())
    manager, params = TrackManagerParams(confirmation_threshold=(1, 1)), FusionCentreParams(memory=True)
    sources = SourceConfig("a"), SourceConfig("b")
    own = CentreConfig(sources, motion, "map", rule, rule.params(), params, manager, identity=IdentityParams(IDENTITY))
    state = CentreState.initial(own)
    for k in range(1, STEPS + 1):
        time_ns, scans = (100 + k) * TENTH_NS, {}
        for s, source in enumerate("ab" if k < STEPS - LAG else "a"):
            covs = np.tile(COVS[source], (2, 1, 1))
            scans[s] = TrackBatch.gaussian(planar_layout(), "map", means(source, k), covs, time_ns=time_ns)
        state, published, _ = step(own, state, time_ns, scans)
    return published


def test_the_last_output_is_that_of_all_scans_in_time_and_identifiers_stay(ros_context, ros_domain):
    params = PATIENT | {
        "source_configurations": ["a", "b"], "confirmation_threshold": [1, 1], "trigger": "any_source", "memory": True,
        "out_of_sequence": "retrodict", "gather_window_s": 0.0, "max_rewind_share": 1.0,
    }  # fmt: skip
    with NodeProcess("fusion_centre", params=params) as centre, Probe(ros_context) as probe:
        fused, diagnostics = probe.listen("/fusion_centre/tracks", PointCloud2), Diagnostics(probe)
        counts = probe.listen("/fusion_centre/processed", UInt64, qos(1, latched=True))
        ticker = probe.publisher("/clock", Clock, deadline_s=START_S)
        topics = {s: f"/fusion_centre/sources/{s}/tracks" for s in "ab"}
        sources = {s: probe.publisher(t, PointCloud2, deadline_s=START_S) for s, t in topics.items()}

        def send(source, k, now_ns):
            """Publish a scan and wait until the centre has taken it in."""
            sent = counts[-1].data if counts else 0
            sources[source].publish(track_table((100 + k) * TENTH_NS, means(source, k), COVS[source]))

            def taken():
                ticker.publish(clock(now_ns))
                return counts and counts[-1].data == sent + 1

            probe.wait_for(taken, STEP_S, f"scan {k} of {source}")

        for k in range(1, STEPS + 1):
            send("a", k, (100 + k) * TENTH_NS)
            if k > LAG:  # it waits for the next step
                send("b", k - LAG, (100 + k) * TENTH_NS)
        probe.wait_for(lambda: len(fused) == STEPS, STEP_S, "the last step")
        diagnostics.wait_for("fusion_centre", lambda v: int(v.get("rewinds", 0)) == STEPS - LAG - 1, "all rewinds")
        values = diagnostics.values("fusion_centre")
        assert int(values["repeated_steps"]) == (LAG + 1) * (STEPS - LAG - 1)
        assert diagnostics.rejected("fusion_centre") == {}
        assert centre.stop() == 0
    assert [stamp_ns(msg) for msg in fused] == [(100 + k) * TENTH_NS for k in range(1, STEPS + 1)]
    assert [read(msg).track_id.tolist() for msg in fused] == [[1, 2]] * STEPS
    last, wanted = read(fused[-1]), in_order()
    np.testing.assert_allclose(last.mean, wanted.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(last.cov, wanted.cov, rtol=1e-9, atol=1e-12)
