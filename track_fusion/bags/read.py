"""Reading rosbag2 directories, sqlite3 or mcap, without ROS."""

from __future__ import annotations

import functools
from collections.abc import Collection
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from track_fusion.params import Fault

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader


def open_bag(path: Path) -> Reader:
    """Open a rosbag2 directory for reading; the caller closes it.

    Raises
    ------
    Fault    there is no such bag, or the package rosbags is missing
    """
    try:
        from rosbags.rosbag2 import Reader
    except ImportError:
        raise Fault(
            "Reading a bag needs the Python package rosbags: pip install rosbags. On a robot, use ros2 bag play."
        ) from None
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # of rosbags, of its readers of metadata and storage: each has its own
        raise Fault(f"The 'bag' parameter must be a rosbag2 directory. Got '{path}': {error}") from None
    return reader


def read_bag(path: Path, topics: Collection[str]) -> dict[str, list[Any]]:
    """Read all messages of some topics, in the order of the bag; they have the fields of the ROS messages.

    Raises
    ------
    Fault    as open_bag
    """
    with closing(open_bag(path)) as reader:
        messages: dict[str, list[Any]] = {topic: [] for topic in topics}
        wanted = [connection for connection in reader.connections if connection.topic in messages]
        for connection, _, data in reader.messages(wanted) if wanted else ():  # to the package, none means all
            messages[connection.topic].append(deserialised(data, connection.msgtype))
        return messages


def deserialised(data: bytes | memoryview, kind: str) -> Any:
    """Return a message of a type of ROS 2 Jazzy, with the fields of that of ROS."""
    return type_store().deserialize_cdr(data, kind)


@functools.cache
def type_store() -> Any:
    """Return the types of ROS 2 Jazzy, and how they are serialised."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)
