"""The types of messages that source tracks come in, by key. A type is imported when it is asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from msg_adapters.arrays import CrossBlock, RawReading, TrackArrays
from msg_adapters.classes import message_class


class Reading(NamedTuple):
    """The tracks of a message, and whether something was supplied that its type cannot carry."""

    tracks: TrackArrays
    supplied: bool = False


@dataclasses.dataclass(frozen=True)
class MessageType:
    """How tracks come in messages of one type, each with a std_msgs/Header `header`.

    Attributes
    ----------
    message : str        the type as ROS names it, such as "nav_msgs/msg/Odometry"
    read : callable      (message, axes wanted, what stands for a position-velocity block that is absent) -> Reading;
                         raises MessageError for what is malformed
    whole_scan : bool    a message holds all tracks of its stamp; else one track, and a later stamp ends the scan
    read_raw : callable  the same of many serialised messages at once, for what comes in pieces; None: they are decoded
                         one by one
    lacks : str          what a message cannot carry, under which readings that supply it are counted; empty: nothing
    """

    message: str
    read: Callable[[Any, Sequence[str], CrossBlock], Reading]
    whole_scan: bool = True
    lacks: str = ""
    read_raw: Callable[[Sequence[bytes], Sequence[str], CrossBlock], RawReading] | None = None

    def load(self) -> type:
        """Import the class of the messages; raise as message_class does."""
        return message_class(self.message)


def _read_table(msg: Any, axes: Sequence[str], cross_block: CrossBlock) -> Reading:
    from msg_adapters.track_table import track_table_from_msg

    return Reading(track_table_from_msg(msg))


def _read_odometry(msg: Any, axes: Sequence[str], cross_block: CrossBlock) -> Reading:
    from msg_adapters.odometry import odometry_from_msg

    return Reading(*odometry_from_msg(msg, axes, cross_block))


def _read_raw_odometry(messages: Sequence[bytes], axes: Sequence[str], cross_block: CrossBlock) -> RawReading:
    from msg_adapters.odometry_raw import odometry_from_raw

    return odometry_from_raw(messages, axes, cross_block)


#: Ours by key: what `source_types` may hold.
MESSAGE_TYPES: Mapping[str, MessageType] = {
    "track_table": MessageType("sensor_msgs/msg/PointCloud2", _read_table),
    "odometry": MessageType(
        "nav_msgs/msg/Odometry", _read_odometry, whole_scan=False, lacks="cross_block", read_raw=_read_raw_odometry
    ),
}
