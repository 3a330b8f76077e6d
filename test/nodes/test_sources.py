"""What is declared of a source by parameters, and identities over the wire."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from nodes.support import PATIENT, SECOND_NS, START_S, STEP_S, Diagnostics, clock, read, stamp_ns, track_table
from ros_helpers import NodeProcess, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from msg_adapters.odometry import track_id_of

FIRST_NS = 100 * SECOND_NS
OFFSET_S = -18.0  # how far behind the clock of the source is: it is ahead
PARAMS: dict[str, Any] = PATIENT | {
    "source_configurations": ["left", "right"],
    "trigger": "any_source",
    "max_future_s": 2.0,
    "confirmation_threshold": [1, 1],
    "left.max_tracks_per_scan": 2,
    "right.can_initiate": False,
    "right.bias_sd": 3.0,
    "right.covariance_scale": 2.0,
    "right.time_offset_s": OFFSET_S,
    "right.is_self_reported": False,
}
#: Nothing is given: identities of its own.
OWN = PARAMS | {"identity_namespace": ""}


def test_sources_are_taken_as_declared_and_identities_go_out(ros_context: Any) -> None:
    with ExitStack() as stack:
        names = {"given": PARAMS, "own": OWN, "other": OWN}
        for name, params in names.items():
            inputs = {f"~/sources/{s}/tracks": f"/{s}/tracks" for s in ("left", "right")}
            stack.enter_context(NodeProcess("fusion_centre", node=name, params=params, remaps=inputs))
        probe = stack.enter_context(Probe(ros_context))
        fused = {name: probe.listen(f"/{name}/tracks", PointCloud2) for name in names}
        odometry = {name: probe.listen(f"/{name}/odometry", Odometry) for name in names}
        markers = {name: probe.listen(f"/{name}/markers", MarkerArray) for name in names}
        diagnostics = Diagnostics(probe)
        send = {
            s: probe.publisher(f"/{s}/tracks", PointCloud2, readers=3, deadline_s=START_S) for s in ("left", "right")
        }
        tick = probe.publisher("/clock", Clock, readers=3, deadline_s=START_S)
        for name in names:
            diagnostics.wait_for(name, lambda v: v.get("active") == "True", f"{name} to be active")

        def answered(now_ns: int) -> None:
            def all_there() -> bool:
                tick.publish(clock(now_ns))
                return all(got and stamp_ns(got[-1]) == now_ns for got in fused.values())

            probe.wait_for(all_there, STEP_S, f"the answer of {now_ns}")

        def published(source: str, at_ns: int, *means: list[float]) -> None:
            ahead_ns = round(OFFSET_S * SECOND_NS) if source == "right" else 0
            send[source].publish(track_table(at_ns - ahead_ns, means))

        tick.publish(clock(FIRST_NS))
        published("right", FIRST_NS, [0.0, 0.0, 0.0, 0.0])  # starts nothing, and is no stamp of the future
        answered(FIRST_NS)
        assert [m[-1].width for m in fused.values()] == [0] * 3
        assert {stamp_ns(m[-1]) for m in fused.values()} == {FIRST_NS}
        second_ns = FIRST_NS + SECOND_NS // 10
        published("left", second_ns, *([9.0 * k, 0.0, 0.0, 0.0] for k in range(3)))  # too many
        diagnostics_of = {name: {"too_many_tracks": 1} for name in names}
        for name, counts in diagnostics_of.items():
            diagnostics.wait_for_counts(name, counts)
        published("left", second_ns, [0.0, 0.0, 0.0, 0.0], [50.0, 0.0, 0.0, 0.0])
        answered(second_ns)
        third_ns = second_ns + SECOND_NS  # the scan of left is too old by then
        published("right", third_ns, [0.0, 0.0, 0.0, 0.0])
        answered(third_ns)

        for name, tables in fused.items():
            assert [stamp_ns(table) for table in tables] == [FIRST_NS, second_ns, third_ns]
            rows = read(tables[-1])
            assert rows.source.tolist() == [2, 0]
            np.testing.assert_allclose(np.diag(rows.cov[0, 0]), [11.0, 11.0, 2.0, 2.0])
            before = read(tables[-2])
            assert rows.uuid is not None
            assert before.uuid is not None
            assert rows.uuid.tolist() == before.uuid.tolist()
            assert {u[6] >> 4 for u in rows.uuid.tolist()} == {5}  # the version
            ids = set(rows.track_id.tolist())

            def all_there(name: str = name, ids: set[int] = ids) -> bool:
                own = {m.child_frame_id for m in odometry[name]}
                return own == set(map(str, ids)) and len(markers[name]) == 3

            probe.wait_for(all_there, STEP_S, f"all of {name}")
            assert {track_id_of(m.child_frame_id) for m in odometry[name]} == ids
            assert {m.id for m in markers[name][-1].markers[1:]} == ids
        given, own, other = (read(fused[name][-1]) for name in names)
        assert given.track_id.tolist() == [1, 2]
        uuids = {u.tobytes() for rows in (given, own, other) for u in rows.uuid}  # type: ignore[union-attr]
        assert len(uuids) == 6
        assert len({*own.track_id.tolist(), *other.track_id.tolist(), 1, 2}) == 6
        status = diagnostics.wait_for("given", lambda v: v.get("members") == "[0, 1]", "the last step")
        assert status["steps"] == "3"
