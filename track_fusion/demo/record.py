"""Recording by command: find the topics' types, record until told to stop."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import rclpy
import rclpy.utilities
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from track_fusion.nodes.managed import Fault
from track_fusion.nodes.recorder import Recorder

#: How long to wait for a publisher that tells a topic's type.
DISCOVERY_S = 10.0


def record_until_told(out: Path, topics: Sequence[str], storage: str, sim_time: bool) -> dict[str, int]:
    """Record until SIGINT or SIGTERM; return how many messages of each topic there were.

    Parameters
    ----------
    out : Path                new directory of the bag
    topics : sequence of str  NAME, or NAME:TYPE
    storage : str             mcap or sqlite3
    sim_time : bool           stamp with /clock

    Raises
    ------
    Fault    a topic's type stays unknown, or recording is not possible
    """
    rclpy.init()
    node = Node("recorder", parameter_overrides=[Parameter("use_sim_time", Parameter.Type.BOOL, sim_time)])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    recorder = None
    try:
        recorder = Recorder(node, out, _types(node, executor, topics), storage)
        while rclpy.utilities.ok():
            executor.spin_once()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if recorder is not None:
            recorder.close()
        rclpy.utilities.try_shutdown()
    return dict(recorder.counts) if recorder else {}


def _types(node: Node, executor: SingleThreadedExecutor, topics: Sequence[str]) -> dict[str, str]:
    """Take each topic's type from its name or from its publisher."""
    wanted = dict(t.partition(":")[::2] for t in topics)
    deadline = time.monotonic() + DISCOVERY_S
    while unknown := [t for t, kind in wanted.items() if not kind]:
        known = dict(node.get_topic_names_and_types())
        wanted |= {t: known[t][0] for t in unknown if known.get(t)}
        if time.monotonic() > deadline:
            raise Fault(f"Nobody publishes {unknown[0]}; give its type: {unknown[0]}:sensor_msgs/msg/PointCloud2.")
        executor.spin_once(timeout_sec=0.05)
    return wanted
