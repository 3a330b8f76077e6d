"""Recording topics to a rosbag2 directory, mcap or sqlite3, where `ros2 bag record` is not to be had."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
import rclpy.utilities
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from track_fusion.bags.write import add_topic, create_bag
from track_fusion.nodes.managed import class_of, qos
from track_fusion.params import Fault

#: A recorder that falls behind by more messages of one topic than this loses some, and counts them.
QUEUE = 1000
#: How long to wait for a publisher that tells a topic's type.
DISCOVERY_S = 10.0


class Recorder:
    """Writes every message of some topics, as serialised, with the node's time of its arrival.

    What comes before simulated time has begun is written with the first time there is.

    Parameters
    ----------
    node : Node                          whose executor does the work
    path : Path                          the bag's directory; it must not exist
    topics : {topic: type}               types such as sensor_msgs/msg/PointCloud2
    storage : "mcap" or "sqlite3"

    Raises
    ------
    Fault    the package rosbags is missing, the directory exists, or a message package is missing
    """

    def __init__(self, node: Node, path: Path, topics: Mapping[str, str], storage: str = "mcap") -> None:
        self._node, self.counts = node, Counter[str]()
        self._early: deque[tuple[Any, bytes]] = deque()
        classes = {kind: class_of(kind) for kind in topics.values()}
        self._writer = create_bag(path, storage)
        for topic, kind in topics.items():
            connection = add_topic(self._writer, topic, kind)
            node.create_subscription(classes[kind], topic, self._write(connection), qos(QUEUE), raw=True)

    def _write(self, connection: Any) -> Callable[[Any], None]:
        def write(data: Any) -> None:
            self._early.append((connection, bytes(data)))
            self.counts[connection.topic] += 1
            if now_ns := self._node.get_clock().now().nanoseconds:
                self._flush(now_ns)

        return write

    def _flush(self, now_ns: int) -> None:
        while self._early:
            connection, data = self._early.popleft()
            self._writer.write(connection, now_ns, data)

    def close(self) -> None:
        """Finish the bag."""
        self._flush(self._node.get_clock().now().nanoseconds)
        self._writer.close()


def record_until_told(out: Path, topics: Sequence[str], storage: str, sim_time: bool) -> dict[str, int]:
    """Record in a process of its own until SIGINT or SIGTERM; return how many messages of each topic there were.

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
