"""Record topics to a rosbag2 directory, mcap or sqlite3, where `ros2 bag record` is not to be had."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rclpy.node import Node

from track_fusion.nodes.bag_player import message_class
from track_fusion.nodes.managed import Fault, qos

#: A recorder that falls behind by more messages of one topic than this loses some, and counts them.
QUEUE = 1000


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
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise Fault(
                "Recording needs the Python package rosbags: pip install rosbags. On a robot, use ros2 bag record."
            ) from None
        plugins = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
        if storage not in plugins:
            raise Fault(f"The storage must be one of {', '.join(plugins)}. Got {storage!r}.")
        if path.exists():
            raise Fault(f"{path} exists already; a bag is not overwritten.")
        self._node, self.counts = node, Counter[str]()
        self._early: deque[tuple[Any, bytes]] = deque()
        classes = {kind: message_class(kind) for kind in topics.values()}
        self._writer = Writer(path, version=9, storage_plugin=plugins[storage])
        self._writer.open()
        store = get_typestore(Stores.ROS2_JAZZY)
        for topic, kind in topics.items():
            connection = self._writer.add_connection(topic, kind, typestore=store)
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


def read_bag(path: Path, topics: tuple[str, ...]) -> dict[str, list[Any]]:
    """Read all messages of some topics, deserialised, in the order of the bag.

    Raises
    ------
    Fault    there is no such bag, or the package rosbags is missing
    """
    from rclpy.serialization import deserialize_message

    from track_fusion.nodes.bag_player import open_bag

    reader = open_bag(str(path))
    try:
        chosen = [c for c in reader.connections if c.topic in topics]
        found: dict[str, list[Any]] = {topic: [] for topic in topics}
        for connection, _, data in reader.messages(connections=chosen):
            found[connection.topic].append(deserialize_message(bytes(data), message_class(connection.msgtype)))
        return found
    finally:
        reader.close()
