"""Writing rosbag2 directories, mcap or sqlite3, without ROS."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from track_fusion.bags.read import type_store
from track_fusion.params import Fault

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer


def create_bag(path: Path, storage: str) -> Writer:
    """Create a rosbag2 directory; the caller closes it, before which it is no bag.

    Parameters
    ----------
    path : Path    must not exist
    storage : str  mcap or sqlite3

    Raises
    ------
    Fault    the directory exists, there is no such storage, or the package rosbags is missing
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        raise Fault(
            "Writing a bag needs the Python package rosbags: pip install rosbags. On a robot, use ros2 bag record."
        ) from None
    plugins = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
    if storage not in plugins:
        raise Fault(f"The storage must be one of {', '.join(plugins)}. Got {storage!r}.")
    if path.exists():
        raise Fault(f"{path} exists already; a bag is not overwritten.")
    # Version 9 of the metadata is what ROS 2 Jazzy writes.
    writer = Writer(path, version=9, storage_plugin=plugins[storage])
    writer.open()
    return writer


def add_topic(writer: Writer, topic: str, kind: str) -> Connection:
    """Add a topic of a type of ROS 2 Jazzy, such as sensor_msgs/msg/PointCloud2."""
    return writer.add_connection(topic, kind, typestore=type_store())


def copy_topic(writer: Writer, of_other: Connection) -> Connection:
    """Add a topic of another bag, whatever its type: its definition comes along."""
    ext: Any = of_other.ext
    return writer.add_connection(
        of_other.topic,
        of_other.msgtype,
        msgdef=of_other.msgdef.data,
        rihs01=of_other.digest,
        serialization_format=ext.serialization_format,
        offered_qos_profiles=ext.offered_qos_profiles,
    )


def bag_class(kind: str) -> Any:
    """Return the class for a type of ROS 2 Jazzy: what makes a message where there is no ROS."""
    return type_store().types[kind]


def serialised(msg: Any) -> memoryview:
    """Serialise a message made of these classes; its arrays of bytes may be those of ROS."""
    for name, value in vars(msg).items():
        if isinstance(value, array):
            setattr(msg, name, np.frombuffer(value, np.uint8))
    return memoryview(type_store().serialize_cdr(msg, msg.__msgtype__))
