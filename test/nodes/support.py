"""What the node tests share: messages made and read, diagnostics, parameters of a centre that waits for all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from ros_helpers import Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays, TrackArrays
from msg_adapters.detection_table import detection_table_to_msg
from msg_adapters.header import stamp_from_ns, stamp_to_ns
from msg_adapters.track_table import track_table_from_msg, track_table_to_msg
from track_fusion.tracks import TrackBatch, planar_layout

SECOND_NS = 1_000_000_000
AXES = ("x", "y", "vx", "vy")
START_S = 60.0  # processes start slowly when the machine is busy
STEP_S = 60.0  # far above what anything awaited here takes, on a busy machine too

#: Identities of central tracks that are the same in every run.
IDENTITY = "test"

#: A centre in simulated time that runs a step only when all its sources are there: no wall clock in the result.
PATIENT = {
    "use_sim_time": True,
    "axes": list(AXES),
    "trigger": "all_sources",
    "fusion_timeout_s": 1000.0,
    "source_timeout_s": 10_000.0,
    "max_delay_s": 1000.0,
    "max_future_s": 10.0,
    "expected_subscribers": 1,
    "identity_namespace": IDENTITY,  # ids count from 1
}


def deep(*topics: str) -> dict[str, int]:
    """Parameters for queues that lose nothing however slow this machine is; like /sensor_1/tracks.subscription."""
    return {f"qos_overrides.{topic}.depth": 1000 for topic in topics}


def track_table(
    stamp_ns: int, means: Any, covs: Any = None, ids: Sequence[int] | None = None, frame_id: str = "map"
) -> PointCloud2:
    """Make a track table of confirmed Gaussian tracks; the covariance is the identity unless given."""
    means = np.asarray(means, float).reshape(-1, 4)
    covs = np.broadcast_to(np.eye(4) if covs is None else covs, (len(means), 4, 4))
    ids = list(range(1, len(means) + 1)) if ids is None else ids
    batch = TrackBatch.gaussian(planar_layout(), frame_id, means, covs, time_ns=stamp_ns, track_id=np.array(ids, int))
    return track_table_to_msg(batch, AXES, stamp_ns)


def detections(stamp_ns: int, values: Any, frame_id: str = "map") -> PointCloud2:
    """Make a detection table without covariance."""
    values = np.asarray(values, float).reshape(-1, 2)
    return detection_table_to_msg(DetectionArrays(("x", "y"), frame_id, stamp_ns, values, None))


def clock(stamp_ns: int) -> Clock:
    """Make a /clock message."""
    return Clock(clock=stamp_from_ns(stamp_ns))


def stamp_ns(msg: Any) -> int:
    """Return the stamp of a message."""
    return stamp_to_ns(msg.header.stamp)


def read(msg: PointCloud2) -> TrackArrays:
    """Read a track table."""
    return track_table_from_msg(msg)


def positions(msg: PointCloud2) -> NDArray[np.float64]:
    """Means of the tracks of a table, (N, 4)."""
    return read(msg).mean[:, 0]


class Diagnostics:
    """Follows /diagnostics: the newest status of each node."""

    def __init__(self, probe: Probe) -> None:
        self._probe = probe
        self._messages = probe.listen("/diagnostics", DiagnosticArray)

    def status(self, node: str) -> Any:
        """Return the newest status of a node, None before the first."""
        statuses = [s for m in self._messages for s in m.status if s.name == node]
        return statuses[-1] if statuses else None

    def values(self, node: str) -> dict[str, str]:
        """Return the newest keys and values of a node."""
        status = self.status(node)
        return {} if status is None else {v.key: v.value for v in status.values}

    def rejected(self, node: str) -> dict[str, int]:
        """Return the newest counts by reason."""
        return {k.removeprefix("rejected/"): int(v) for k, v in self.values(node).items() if k.startswith("rejected/")}

    def wait_for(self, node: str, condition: Callable[[dict[str, str]], object], what: str) -> dict[str, str]:
        """Wait until the values of a node meet a condition."""
        try:
            self._probe.wait_for(lambda: condition(self.values(node)), STEP_S, what)
        except TimeoutError as error:
            raise TimeoutError(f"{error} Last of {node}: {self.values(node)}") from None
        return self.values(node)

    def wait_for_counts(self, node: str, counts: Mapping[str, int]) -> None:
        """Wait until exactly these counts by reason are reported."""
        try:
            self._probe.wait_for(lambda: self.rejected(node) == dict(counts), STEP_S, f"the counts {dict(counts)}")
        except TimeoutError as error:
            raise TimeoutError(f"{error} Last of {node}: {self.rejected(node)}") from None
