"""A fusion centre over a bag: the node's, without ROS, at the times at which the bag's messages were received."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msg_adapters.arrays import MessageError
from msg_adapters.track_table import track_table_to_msg
from track_fusion.bags.read import deserialised, open_bag
from track_fusion.bags.write import add_topic, bag_class, copy_topic, create_bag, serialised
from track_fusion.centre.centre import Published
from track_fusion.clock import ClockParams
from track_fusion.messages.centre import MessageCentre
from track_fusion.messages.counts import Counts
from track_fusion.messages.parameters import GivenParameters, ManagedParams, parameters_of
from track_fusion.params import ParameterError
from track_fusion.tracks import SECOND_NS

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader, Writer

#: The node whose work is done here, and what it publishes.
NODE = "fusion_centre"
FUSED = f"/{NODE}/tracks"
TABLE = "sensor_msgs/msg/PointCloud2"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a bag.

    Attributes
    ----------
    messages : int       read of the sources' topics
    steps : int          fused tables written
    rejected, counted    by reason and by name, as the node's diagnostics report them
    ended : bool         False: told to stop before the end
    """

    messages: int
    steps: int
    rejected: Counter[str]
    counted: Counter[str]
    ended: bool


def centre_of(params: Path, tell: Callable[[str], object]) -> MessageCentre:
    """Make the centre that the node fusion_centre would be with a parameter file.

    Identities are those of the namespace "fusion_centre" unless the file names another one.

    Raises
    ------
    Fault             the file cannot be read
    ParameterError    a parameter is wrong or unknown, or the file has nothing for the node
    """
    # The same bag gives the same identities, in whatever run.
    given = GivenParameters({"identity_namespace": NODE} | parameters_of(params, f"/{NODE}"), NODE)
    given(ManagedParams)
    centre = MessageCentre(given, given.values, Counts(tell), given(ClockParams))
    given.refuse_unknown()
    return centre


def fuse_bag(
    bag: Path, centre: MessageCentre, out: Path, storage: str = "mcap", tail_s: float = 0.0,
    progress: Callable[[float], object] = lambda share: None, stopped: Callable[[], bool] = lambda: False,
) -> Outcome:  # fmt: skip
    """Fuse the tracks of a bag; write them on /fusion_centre/tracks into another one, beside all that is in the first.

    Parameters
    ----------
    bag : Path           rosbag2 directory; fused tracks that it holds already are left out
    centre : MessageCentre
    out : Path           directory of the new bag
    storage : str        of that: mcap or sqlite3
    tail_s : float       the clock runs on for so long after the last message, so that what waits is fused
    progress : callable  is told the share done, 0 to 1
    stopped : callable   tells between two messages whether to stop; the new bag is whole up to there

    Raises
    ------
    Fault             there is no such bag, the new one exists, or the package rosbags is missing
    ParameterError    the bag lacks a source's topic, or it is of another type
    """
    with closing(open_bag(bag)) as reader:
        by_topic = _sources(reader, centre)
        with closing(create_bag(out, storage)) as writer:
            run = _Run(reader, centre, writer, by_topic)
            ended = run.play(progress, stopped) and run.finish(tail_s)
    counts = centre.counts
    return Outcome(run.messages, run.steps, counts.rejected, counts.counted, ended)


def resolved(topic: str) -> str:
    """Return the full name of a topic of the node."""
    return f"/{NODE}{topic[1:]}" if topic.startswith("~") else f"/{topic.lstrip('/')}"


def _sources(reader: Reader, centre: MessageCentre) -> dict[str, list[int]]:
    """Tell which sources read each topic.

    Raises
    ------
    ParameterError    the bag lacks a topic, or it is of another type
    """
    kinds = {c.topic: c.msgtype for c in reader.connections}
    by_topic: dict[str, list[int]] = {}
    for k, source in enumerate(centre.sources):
        topic = resolved(source.topic)
        if topic not in kinds:
            fit = ", ".join(sorted(t for t, kind in kinds.items() if kind == source.kind.message)) or "none"
            raise ParameterError(
                f"The '{source.name}.topic' parameter must be a topic of the bag. Got '{topic}'. "
                f"Of the type {source.kind.message} the bag has {fit}."
            )
        if kinds[topic] != source.kind.message:
            raise ParameterError(
                f"The 'source_types' parameter says that {source.name} sends {source.kind.message}, "
                f"but {topic} is {kinds[topic]}."
            )
        by_topic.setdefault(topic, []).append(k)
    return by_topic


class _Run:
    """One way through a bag."""

    def __init__(self, reader: Reader, centre: MessageCentre, writer: Writer, by_topic: dict[str, list[int]]) -> None:
        self._reader, self._centre, self._writer, self._by_topic = reader, centre, writer, by_topic
        self._copies = {c.id: copy_topic(writer, c) for c in reader.connections if c.topic != FUSED}
        self._fused = add_topic(writer, FUSED, TABLE)
        self._axes = centre.centre.config.layout.axes
        self._now_ns = self.messages = self.steps = 0

    def play(self, progress: Callable[[float], object], stopped: Callable[[], bool]) -> bool:
        """Take all messages; tell whether that was all."""
        start_ns, length_ns = self._reader.start_time, max(self._reader.duration, 1)
        for connection, now_ns, data in self._reader.messages():
            if stopped():
                return False
            self._now_ns = now_ns
            if connection.id in self._copies:
                self._writer.write(self._copies[connection.id], self._now_ns, data)
            for source in self._by_topic.get(connection.topic, ()):
                self.messages += 1
                self._take(source, deserialised(data, connection.msgtype))
            progress((self._now_ns - start_ns) / length_ns)
        return True

    def finish(self, tail_s: float) -> bool:
        """Let the clock run on."""
        self._now_ns += round(tail_s * SECOND_NS)
        self._write(self._centre.advance(self._now_ns))
        return True

    def _take(self, source: int, msg: Any) -> None:
        try:
            self._write(self._centre.take(source, msg, self._now_ns))
        except MessageError as error:
            self._centre.counts.reject({error.reason: 1}, str(error))

    def _write(self, results: Iterable[Published]) -> None:
        for result in results:
            msg = track_table_to_msg(result.tracks, self._axes, result.time_ns, bag_class)
            self._writer.write(self._fused, self._now_ns, serialised(msg))
            self.steps += 1
