"""Playing a rosbag2 directory, sqlite3 or mcap, without rosbag2 itself."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from track_fusion.bags.read import open_bag
from track_fusion.nodes.managed import ManagedNode, class_of, qos
from track_fusion.params import Fault, ParameterError, Params, param
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


class BagPlayer:
    """Publishes a bag's messages as they were serialised, each after the clock of its time.

    Parameters
    ----------
    node : ManagedNode
    tell_time : callable     publishes /clock, ns
    path : str               rosbag2 directory
    params : BagParams
    rate : float             bag seconds a wall second
    subscribers_each : int   how many to wait for on each topic

    Attributes
    ----------
    wanted, results, since_s    as of a ScenarioPlayer; of a bag no results are waited for

    Raises
    ------
    Fault             there is no such bag, or it has no such topic, or a package is missing
    ParameterError    a remapping is none
    """

    results = None

    def __init__(
        self, node: ManagedNode, tell_time: Callable[[int], None], path: str, params: BagParams, rate: float,
        subscribers_each: int,
    ) -> None:  # fmt: skip
        self._node, self._tell_time, self._params, self._rate = node, tell_time, params, rate
        self._reader = open_bag(Path(path))
        names = dict(_split(remap) for remap in params.remaps)
        known = {c.topic for c in self._reader.connections}
        for topic in (*names, *params.topics):
            if topic not in known:
                raise Fault(f"The bag has no topic {topic}. It has {', '.join(sorted(known))}.")
        wanted = set(params.topics) or known - {"/clock"}
        self._played = [c for c in self._reader.connections if c.topic in wanted]
        self._outputs = {
            c.id: node.create_publisher(class_of(c.msgtype), names.get(c.topic, c.topic), qos(100))
            for c in self._played
        }
        self.wanted = dict.fromkeys(self._outputs.values(), subscribers_each)
        self.since_s = time.monotonic()

    def start(self, finish: Callable[[str], None]) -> None:
        """Begin to play; after the last message `finish` is told how much that was."""
        self._finish = finish
        self._rewind()
        self._timer = self._node.every(CLOCK_PERIOD_S, self._advance)

    def awaited(self) -> str:
        """Say that nothing is waited for."""
        return ""

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
        now_ns = self._origin_ns + round((time.monotonic() - self._wall_start) * self._rate * SECOND_NS)
        while self._next is not None and self._next[1] <= now_ns:
            connection, stamp_ns, data = self._next
            self._tell_time(stamp_ns)
            self._outputs[connection.id].publish(bytes(data))
            self._node.counted["messages"] += 1
            self._next = next(self._messages, None)
        self._tell_time(now_ns)
        if self._next is None:
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
