"""Directions over real processes: two trackers see x, y and yaw on either side of a seam, the centre fuses them."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import count
from time import monotonic
from typing import Any

import numpy as np
import pytest
from nodes.support import PATIENT, SECOND_NS, START_S, STEP_S, clock, read, stamp_ns
from ros_helpers import NodeProcess, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays
from msg_adapters.detection_table import detection_table_to_msg
from track_fusion.angles import HALF_TURN, TURN, difference

AXES = ["x", "y", "vx", "vy", "yaw"]
SEEN = ("x", "y", "yaw")
SENSORS = ("left", "right")
STEPS = 5
SCAN_S = 2.0  # after which the next scan is seen, though the last has not come through
SD = 0.05  # of the yaw: far less than from here to the seam
#: Parameters and remappings that a tracker and the centre have.
FRAME = {"use_sim_time": True, "max_future_s": 10.0, "axes": AXES, "expected_subscribers": 1}
TRACKER = FRAME | {"sensor": "linear", "sensor_axes": list(SEEN), "sensor_cov": [1.0, 1.0, SD**2]}
CENTRE = PATIENT | FRAME | {"source_configurations": list(SENSORS), "confirmation_threshold": [1, 1]}
TRACKS = {f"~/sources/{sensor}/tracks": f"/{sensor}/tracks" for sensor in SENSORS}


@pytest.mark.parametrize(
    ("angular", "yaws", "wanted", "period"),
    [
        (None, (np.pi - 0.1, 0.1 - np.pi), np.pi, TURN),
        (["yaw:pi"], (0.5 * np.pi - 0.1, 0.1 - 0.5 * np.pi), 0.5 * np.pi, HALF_TURN),
        (["yaw:pi"], (1.0, 1.0 - np.pi), 1.0, HALF_TURN),  # the same side of a box, taken for front and back
    ],
)
def test_yaws_on_either_side_of_a_seam_are_one_target(
    angular: list[str] | None, yaws: tuple[float, float], wanted: float, period: float, ros_context: Any
) -> None:
    named = {} if angular is None else {"angular": angular}
    with ExitStack() as stack:
        for sensor in SENSORS:
            stack.enter_context(NodeProcess("sensor_tracker", node=sensor, params=TRACKER | named))
        stack.enter_context(NodeProcess("fusion_centre", params=CENTRE | named, remaps=TRACKS))
        probe = stack.enter_context(Probe(ros_context))
        fused = probe.listen("/fusion_centre/tracks", PointCloud2)
        time = probe.publisher("/clock", Clock, readers=3, deadline_s=START_S)
        detections = [probe.publisher(f"/{s}/detections", PointCloud2, deadline_s=START_S) for s in SENSORS]
        at_s = count(1)

        def scanned() -> bool:
            """See one scan more: a reader may know of its writer later than the writer of it, and miss the first."""
            at_ns = next(at_s) * SECOND_NS
            time.publish(clock(at_ns))
            for publisher, yaw in zip(detections, yaws, strict=True):
                seen = DetectionArrays(SEEN, "map", at_ns, np.array([[5.0, 0.0, yaw]]), None)
                publisher.publish(detection_table_to_msg(seen))
            end = monotonic() + SCAN_S
            probe.wait_for(lambda: monotonic() > end or (fused and stamp_ns(fused[-1]) >= at_ns), STEP_S)
            return sum(read(msg).source.tolist() == [0b11] for msg in fused) >= STEPS

        probe.wait_for(scanned, START_S, f"{STEPS} steps of both sources")
    tables = [read(msg) for msg in fused]
    assert [table.track_id.tolist() for table in tables] == [[1]] * len(tables)
    tables = [table for table in tables if table.source.tolist() == [0b11]]
    yaw = np.array([table.mean[0, 0, AXES.index("yaw")] for table in tables])
    assert ((-0.5 * period <= yaw) & (yaw < 0.5 * period)).all()
    np.testing.assert_allclose(difference(yaw, wanted, period), 0.0, atol=1e-6)
