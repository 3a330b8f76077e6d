"""Playing a rosbag2 directory, sqlite3 or mcap, without rosbag2 itself."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from track_fusion.nodes.managed import Fault, ManagedNode, qos
from track_fusion.params import ParameterError, Params, param
from track_fusion.tracks import SECOND_NS

#: At most this much bag time passes between two /clock messages, wall time permitting.
CLOCK_PERIOD_S = 0.01


@dataclasses.dataclass(frozen=True)
class BagParams(Params):
    """How a bag is played."""

    remaps: tuple[str, ...] = param((), "topics under other names, each 'from:=to'", kind=str)
    topics: tuple[str, ...] = param((), "play these topics of the bag only; empty: all but /clock", kind=str)
    start_offset_s: float = param(0.0, "begin so far into the bag", unit="s", low=0.0)
    loop: bool = param(False, "begin again at the end, for ever")


def open_bag(path: str) -> Any:
    """Open a rosbag2 directory for reading.

    Raises
    ------
    Fault    there is no such bag, or the package rosbags is missing
    """
    try:
        from rosbags.rosbag2 import Reader
    except ImportError:
        raise Fault(
            "Playing a bag needs the Python package rosbags: pip install rosbags. On a robot, use ros2 bag play."
        ) from None
    try:
        reader = Reader(Path(path))
        reader.open()
    except Exception as error:
        raise Fault(f"The 'bag' parameter must be a rosbag2 directory. Got {path!r}: {error}") from None
    return reader


def message_class(name: str) -> Any:
    """Return the class of a type such as sensor_msgs/msg/PointCloud2.

    Raises
    ------
    Fault    its package is not installed
    """
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        raise Fault(
            f"The type {name} cannot be had: its package {package} is not installed here. Leave its topics out "
            "(of a bag: by bag_topics)."
        ) from None


class BagPlayer:
    """Publishes a bag's messages as they were serialised, and /clock beside them.

    Parameters
    ----------
    node : ManagedNode
    tell_time : callable    publishes /clock, ns
    path : str           rosbag2 directory
    params : BagParams
    rate : float         bag seconds a wall second
    """

    def __init__(
        self, node: ManagedNode, tell_time: Callable[[int], None], path: str, params: BagParams, rate: float
    ) -> None:
        self._node, self._tell_time, self._params, self._rate = node, tell_time, params, rate
        self._reader = open_bag(path)
        names = dict(self._split(r) for r in params.remaps)
        played = [
            c
            for c in self._reader.connections
            if c.topic in params.topics or (not params.topics and c.topic != "/clock")
        ]
        known = {c.topic for c in self._reader.connections}
        for topic in (*names, *params.topics):
            if topic not in known:
                raise Fault(f"The bag has no topic {topic}. It has {', '.join(sorted(known))}.")
        self._outputs = {
            c.id: node.create_publisher(message_class(c.msgtype), names.get(c.topic, c.topic), qos(100)) for c in played
        }
        self._played = played
        self.publishers = list(self._outputs.values())
        self._next: tuple[int, Any, bytes] | None = None

    @staticmethod
    def _split(remap: str) -> tuple[str, str]:
        source, arrow, target = remap.partition(":=")
        if not (source and arrow and target):
            raise ParameterError(f"The 'bag_remaps' parameter must hold 'from:=to'. Got {remap!r}.")
        return source, target

    def start(self, finish: Callable[[], None]) -> None:
        """Begin to play; `finish` is called after the last message."""
        self._finish = finish
        self._rewind()
        self._timer = self._node.create_timer(CLOCK_PERIOD_S, self._advance, clock=self._node._wall)

    def _rewind(self) -> None:
        start = self._reader.start_time + round(self._params.start_offset_s * SECOND_NS)
        self._messages: Iterator[Any] = self._reader.messages(connections=self._played, start=start)
        self._next = self._take()
        self._origin_ns, self._wall_start = start, time.monotonic()
        if self._next is None:
            raise Fault(f"The bag has no message after {self._params.start_offset_s:g} s.")

    def _take(self) -> tuple[int, Any, bytes] | None:
        for connection, stamp_ns, data in self._messages:
            return stamp_ns, self._outputs[connection.id], data
        return None

    def _advance(self) -> None:
        """Publish all that is due, each message after the clock of its time."""
        now_ns = self._origin_ns + round((time.monotonic() - self._wall_start) * self._rate * SECOND_NS)
        while self._next is not None and self._next[0] <= now_ns:
            stamp_ns, publisher, data = self._next
            self._tell_time(stamp_ns)
            publisher.publish(bytes(data))
            self._node.counted["messages"] += 1
            self._next = self._take()
        self._tell_time(now_ns)
        if self._next is None:
            if self._params.loop:
                self._rewind()
            else:
                self._timer.cancel()
                self._finish()
