"""From a sensor's track message to the fused message, through a real centre, and the memory of each node."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from benchmark.measure import Result
from msg_adapters.track_table import track_table_to_msg
from track_fusion.demo.bringup import local_environment, ros_arguments, running
from track_fusion.nodes.managed import qos
from track_fusion.tracks import TrackBatch, planar_layout

SIZES = (10, 100, 1000)
LOAD = 10_000
SCANS = 300
LOAD_SCANS = 5
DEADLINE_S = 60.0
PERIOD_NS = 100_000_000
#: Resident memory of a node may grow to this.
MEMORY_MB = 250.0


class Sensors:
    """Two sources and a listener in this process, a real centre in its own."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        self.context.init(args=[], domain_id=domain)
        self.node = Node("benchmark", context=self.context, use_global_arguments=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.outputs = [self.node.create_publisher(PointCloud2, f"/sensor_{k}/tracks", qos(10)) for k in (1, 2)]
        self.arrived: float | None = None
        self.node.create_subscription(PointCloud2, "/fusion_centre/tracks", self._on_fused, qos(10))
        self.time_ns = PERIOD_NS

    def _on_fused(self, msg: PointCloud2) -> None:
        self.arrived = time.perf_counter()
        self.size = msg.width

    def wait(self, condition) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            if time.monotonic() > deadline:
                raise RuntimeError("The centre did not answer.")
            self.executor.spin_once(timeout_sec=0.05)

    def scan(self, truth: np.ndarray, rng: np.random.Generator) -> float:
        """Publish one scan of each source; seconds from the second one to the fused message."""
        self.time_ns += PERIOD_NS
        layout, stamp = planar_layout(), time.time_ns()
        messages = []
        for _ in self.outputs:
            batch = TrackBatch.gaussian(
                layout,
                "map",
                truth + rng.normal(size=truth.shape),
                np.broadcast_to(np.eye(4), (len(truth), 4, 4)),
                time_ns=stamp,
            )
            messages.append(track_table_to_msg(batch, layout.axes, stamp))
        self.arrived = None
        self.outputs[0].publish(messages[0])
        began = time.perf_counter()
        self.outputs[1].publish(messages[1])
        self.wait(lambda: self.arrived is not None)
        return self.arrived - began


def resident_mb(pid: int) -> float:
    """Resident memory of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS")


def run() -> Iterator[Result]:
    domain = os.getpid() % 100
    environment = local_environment(domain)
    os.environ.update({k: environment[k] for k in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")})
    params = {
        "process_noise": 1.0,
        "confirmation_threshold": [1, 1],
        "trigger": "all_sources",
        "fusion_timeout_s": 10.0,
        "source_timeout_s": 60.0,
    }
    remaps = {f"~/sources/sensor_{k}/tracks": f"/sensor_{k}/tracks" for k in (1, 2)}
    rng = np.random.default_rng(0)
    sensors = Sensors(domain)
    with tempfile.TemporaryDirectory() as folder, running(environment, Path(folder) / "log") as nodes:
        nodes.start("fusion_centre", "fusion_centre", ros_arguments("fusion_centre", None, params, remaps))
        for other in ("sensor_tracker", "evaluator", "replay"):
            arguments = ros_arguments(other, None, {"deadline_s": 600.0} if other == "replay" else {}, {})
            nodes.start(other, other, arguments)
        sensors.wait(lambda: all(o.get_subscription_count() for o in sensors.outputs))
        sensors.wait(lambda: sensors.node.count_publishers("/fusion_centre/tracks"))
        for name, process in nodes.processes.items():
            yield Result(f"memory of {name} at rest", figure=f"{resident_mb(process.pid):.0f} MB")
        for size in SIZES:
            truth = rng.uniform(0, 100 * np.sqrt(size), size=(size, 4)) * [1, 1, 0, 0]
            took = np.array([sensors.scan(truth, rng) for _ in range(SCANS)])[SCANS // 10 :]
            p50, p99 = np.percentile(took, [50, 99])
            yield Result(
                f"sensor message to fused message, {size} tracks",
                p50,
                figure=f"p50 {1e3 * p50:.1f} ms, p99 {1e3 * p99:.1f} ms",
            )
        truth = rng.uniform(0, 100 * np.sqrt(LOAD), size=(LOAD, 4)) * [1, 1, 0, 0]
        for _ in range(LOAD_SCANS):
            sensors.scan(truth, rng)
        memory = resident_mb(nodes.processes["fusion_centre"].pid)
        yield Result(
            f"memory of fusion_centre at {LOAD} tracks",
            None,
            f"{MEMORY_MB:.0f} MB",
            memory / MEMORY_MB,
            at_most=1.0,
            figure=f"{memory:.0f} MB",
        )
    sensors.context.try_shutdown()
