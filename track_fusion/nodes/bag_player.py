"""Playing a rosbag2 directory, sqlite3 or mcap, without rosbag2 itself."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from std_msgs.msg import UInt64

from track_fusion.bags.read import open_bag
from track_fusion.nodes.managed import ManagedNode, class_of, qos
from track_fusion.params import Fault, ParameterError, Params, param
from track_fusion.tracks import SECOND_NS

#: A count is for who comes later, too.
COUNTS = qos(10, latched=True)
#: At most this much bag time passes between two /clock messages, wall time permitting.
CLOCK_PERIOD_S = 0.01


@dataclasses.dataclass(frozen=True)
class BagParams(Params):
    """How a bag is played."""

    remaps: tuple[str, ...] = param((), "topics under other names, each 'from:=to'", kind=str)
    topics: tuple[str, ...] = param((), "play these topics of the bag only; empty: all but /clock", kind=str)
    start_offset_s: float = param(0.0, "begin so far into the bag", unit="s", low=0.0)
    loop: bool = param(False, "begin again at the end, for ever")
    tail_s: float = param(
        0.0, "let the clock run on for so long after the last message, so that what waits is fused", unit="s", low=0.0
    )
    awaited: tuple[str, ...] = param(
        (),
        "at pace lockstep, topics of the bag, by their names in it, whose messages ~/processed counts; empty: all that "
        "are played",
        kind=str,
    )


class BagPlayer:
    """Publishes a bag's messages as they were serialised, each after the clock of its time.

    Parameters
    ----------
    node : ManagedNode
    tell_time : callable     publishes /clock, ns
    path : str               rosbag2 directory
    params : BagParams
    rate : float or None     bag seconds a wall second; None: a message when the one before is counted on ~/processed
    subscribers_each : int   how many to wait for on each topic

    Attributes
    ----------
    wanted, results, since_s    as of a ScenarioPlayer; the results are the counts

    Raises
    ------
    Fault             there is no such bag, or it has no such topic, or a package is missing
    ParameterError    a remapping is none
    """

    def __init__(
        self, node: ManagedNode, tell_time: Callable[[int], None], path: str, params: BagParams, rate: float | None,
        subscribers_each: int,
    ) -> None:  # fmt: skip
        self._node, self._tell_time, self._params, self._rate = node, tell_time, params, rate
        self._reader = open_bag(Path(path))
        names = dict(_split(remap) for remap in params.remaps)
        known = {c.topic for c in self._reader.connections}
        for topic in (*names, *params.topics, *params.awaited):
            if topic not in known:
                raise Fault(f"The bag has no topic {topic}. It has {', '.join(sorted(known))}.")
        wanted = set(params.topics) or known - {"/clock"}
        self._played = [c for c in self._reader.connections if c.topic in wanted]
        self._outputs = {
            c.id: node.create_publisher(class_of(c.msgtype), names.get(c.topic, c.topic), qos(100))
            for c in self._played
        }
        self.wanted = dict.fromkeys(self._outputs.values(), subscribers_each)
        self._awaited = {c.id for c in self._played if c.topic in (params.awaited or wanted)}
        self._begun = False
        self._next: Any = None
        self._sent_ns, self._count, self._goal = 0, -1, -1
        self.results = None if rate else node.create_subscription(UInt64, "~/processed", self._on_count, COUNTS)
        self.since_s = time.monotonic()

    def start(self, finish: Callable[[str], None]) -> None:
        """Begin to play; after the last message `finish` is told how much that was."""
        self._finish = finish
        self._rewind()
        if self._rate:
            self._timer = self._node.every(CLOCK_PERIOD_S, self._advance)
            return
        self._begun = True
        if self._count >= 0:
            self._goal = self._count
            self._go_on()

    def awaited(self) -> str:
        """Say which count is waited for; empty: none."""
        if self.results is None:
            return ""
        if not self._node.counted["processed"] and self._sent_ns:
            self._tell_time(self._sent_ns)  # a participant may have met our clock after our first message
        return f"no count of message {self._node.counted['messages']} on {self.results.topic_name}."

    def _on_count(self, msg: Any) -> None:
        """Take a count; the first one tells where it begins."""
        self._count = msg.data
        if not self._begun:
            return
        if self._goal < 0:
            self._goal = self._count
            self._go_on()
        elif self._count >= self._goal and self._sent_ns:
            self._node.counted["processed"] += 1
            self._go_on()

    def _go_on(self) -> None:
        """Publish up to the next message that is counted; finish after the last."""
        while self._next is not None:
            connection = self._send()
            self.since_s = time.monotonic()
            if connection.id in self._awaited:
                self._goal += 1
                return
        if self._params.loop:
            self._rewind()
            self._go_on()
        elif self._begun:
            self._begun = False
            self._tell_time(self._sent_ns + round(self._params.tail_s * SECOND_NS))
            self._finish(f"{self._node.counted['messages']} messages")

    def _send(self) -> Any:
        """Publish the next message after the clock of its time; return its connection."""
        connection, self._sent_ns, data = self._next
        self._tell_time(self._sent_ns)
        self._outputs[connection.id].publish(bytes(data))
        self._node.counted["messages"] += 1
        self._next = next(self._messages, None)
        return connection

    def _rewind(self) -> None:
        start = self._reader.start_time + round(self._params.start_offset_s * SECOND_NS)
        # Of no connection the reader would give all messages.
        self._messages: Iterator[Any] = iter(self._reader.messages(self._played, start) if self._played else ())
        self._next = next(self._messages, None)
        self._origin_ns, self._wall_start = start, time.monotonic()
        if self._next is None:
            raise Fault(f"The bag has no message after {self._params.start_offset_s:g} s.")

    def _advance(self) -> None:
        """Publish all that is due, each message after the clock of its time."""
        now_ns = self._origin_ns + round((time.monotonic() - self._wall_start) * (self._rate or 1.0) * SECOND_NS)
        while self._next is not None and self._next[1] <= now_ns:
            self._send()
        self._tell_time(now_ns)
        if self._next is None and now_ns >= self._sent_ns + round(self._params.tail_s * SECOND_NS):
            if self._params.loop:
                self._rewind()
            else:
                self._timer.cancel()
                self._finish(f"{self._node.counted['messages']} messages")


def _split(remap: str) -> tuple[str, str]:
    source, arrow, target = remap.partition(":=")
    if not (source and arrow and target):
        raise ParameterError(f"The 'bag_remaps' parameter must hold 'from:=to'. Got {remap!r}.")
    return source, target
