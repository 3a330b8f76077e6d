"""A fusion centre on messages: what its node and a bag have in common, without ROS."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from msg_adapters.arrays import CrossBlock, MessageError, TrackArrays
from msg_adapters.header import check_header, make_header
from msg_adapters.types import MESSAGE_TYPES, MessageType
from track_fusion.centre.centre import FusionCentre, Published
from track_fusion.centre.config import (
    MAX_SOURCES,
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    ScanBufferParams,
    SourceConfig,
    SourceSettings,
    StateFusionParams,
    TrackManagerParams,
)
from track_fusion.clock import ClockParams
from track_fusion.messages.counts import Counts
from track_fusion.messages.parameters import Declare, refuse_of_others
from track_fusion.messages.screening import FrameParams, screened_tracks
from track_fusion.models.choices import MOTIONS, MotionChoice, make
from track_fusion.params import ParameterError, Params, param
from track_fusion.plugins import Registry
from track_fusion.random_streams import RandomParams
from track_fusion.rules import RULES
from track_fusion.tracks import SECOND_NS

#: Message types of sources by key, those of other packages included.
SOURCE_TYPES: Registry[MessageType] = Registry("track_fusion.adapters", "source type", MessageType, MESSAGE_TYPES)

#: When the clock has gone on by more than this since it was told last, it has jumped, and nothing is made up for.
CATCH_UP_NS = 60 * SECOND_NS


@dataclasses.dataclass(frozen=True)
class SourceParams(Params):
    """Where source tracks come from."""

    source_configurations: tuple[str, ...] = param(
        ("sensor_1", "sensor_2"), "name of each source; parameters of its own begin with it"
    )
    source_types: tuple[str, ...] = param(
        (),
        "message type of each source: track_table (the full posterior) or odometry (one message a track); "
        "empty: all track_table",
        choices=SOURCE_TYPES,
        kind=str,
    )
    cross_block: str = param(
        "block_diagonal",
        "what stands for the position-velocity block that Odometry lacks: block_diagonal (none), or "
        "conservative (covers every possible one)",
        choices=("block_diagonal", "conservative"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.source_configurations
        if not 1 <= len(names) <= MAX_SOURCES or len(set(names)) < len(names) or not all(names):
            raise ParameterError(
                f"The 'source_configurations' parameter must hold 1 to {MAX_SOURCES} distinct names. Got {list(names)}."
            )
        if taken := sorted(set(names) & set(RULES)):
            raise ParameterError(
                f"The 'source_configurations' parameter must not hold names of fusion rules, whose parameters begin "
                f"with them. Got {', '.join(taken)}."
            )
        if self.source_types and len(self.source_types) != len(names):
            raise ParameterError(
                f"The 'source_types' parameter must hold one type a source, {len(names)}. "
                f"Got {list(self.source_types)}."
            )

    @property
    def kinds(self) -> list[MessageType]:
        """Message type of each source."""
        return [SOURCE_TYPES[key] for key in self.source_types or ("track_table",) * len(self.source_configurations)]


@dataclasses.dataclass(frozen=True)
class OneSourceParams(Params):
    """A source, by its name."""

    topic: str = param("", "where its tracks are read; empty: ~/sources/<name>/tracks")


@dataclasses.dataclass(frozen=True)
class Source:
    """One source: its name, its topic (~ is the node's name), the type of its messages."""

    name: str
    topic: str
    kind: MessageType


class MessageCentre:
    """A fusion centre that takes messages, whoever carries them, and counts what it turns away.

    Parameters
    ----------
    declare : Declare            gives its parameters
    given : iterable of str      names of all parameters that were given
    counts : Counts
    clock : ClockParams

    Raises
    ------
    ParameterError    a parameter is wrong, or belongs to a rule that is not the one chosen

    Attributes
    ----------
    frame : FrameParams
    sources : list of Source
    centre : FusionCentre
    counts : Counts
    """

    def __init__(self, declare: Declare, given: Iterable[str], counts: Counts, clock: ClockParams) -> None:
        self.frame, self.counts = declare(FrameParams), counts
        params = declare(SourceParams)
        self._cross_block: CrossBlock = "conservative" if params.cross_block == "conservative" else "block_diagonal"
        names = params.source_configurations
        topics = [declare(OneSourceParams, f"{name}.").topic or f"~/sources/{name}/tracks" for name in names]
        self.sources = [Source(*of_source) for of_source in zip(names, topics, params.kinds, strict=True)]
        key = declare(MotionChoice).motion
        motion = make(MOTIONS, key, declare(MOTIONS[key].params), self.frame.layout)
        rule = RULES[declare(StateFusionParams).state_fusion]
        refuse_of_others(given, RULES, "state_fusion", rule.key)
        sources = tuple(
            SourceConfig(s.name, assembles=not s.kind.whole_scan, settings=declare(SourceSettings, f"{s.name}."))
            for s in self.sources
        )
        self.centre = FusionCentre(
            CentreConfig(
                sources, motion, self.frame.frame_id, rule, declare(rule.params, f"{rule.key}."),
                declare(FusionCentreParams), declare(TrackManagerParams), declare(ScanBufferParams),
                declare(RandomParams), declare(IdentityParams), clock,
            )
        )  # fmt: skip
        self._told_ns = 0

    def take(self, source: int, msg: Any, now_ns: int) -> Iterator[Published]:
        """Take a message of a source, and run the steps that are due: first those of the time before it.

        Raises
        ------
        MessageError    it cannot be read; nothing was taken
        """
        yield from self.advance(now_ns)
        kind = self.sources[source].kind
        stamp_ns = self._stamp_of(source, msg.header, now_ns)
        arrays, supplied = kind.read(msg, self.centre.config.layout.axes, self._cross_block)
        if kind.lacks:
            self.counts.counted[f"{kind.lacks}_absent"] += supplied
        self._receive(source, arrays, stamp_ns, now_ns)
        yield from self.advance(now_ns)

    def take_raw(self, source: int, messages: Sequence[bytes], now_ns: int) -> Iterator[Published]:
        """Take serialised messages of a source whose type is read so, as `take` does one after the other.

        What cannot be read is counted and harms no other.
        """
        yield from self.advance(now_ns)
        kind = self.sources[source].kind
        if kind.read_raw is None:
            raise ValueError(f"Messages of the type {kind.message} must be decoded. Got bytes.")
        reading = kind.read_raw(messages, self.centre.config.layout.axes, self._cross_block)
        self.counts.counted[f"{kind.lacks}_absent"] += reading.supplied
        for error in reading.errors:
            self.counts.reject({error.reason: 1}, str(error))
        for scan in reading.scans:
            try:
                header = make_header(scan.stamp_ns, scan.frame_id)
                self._receive(source, scan.tracks, self._stamp_of(source, header, now_ns), now_ns)
            except MessageError as error:
                self.counts.reject({error.reason: len(scan.tracks.track_id)}, str(error))
        yield from self.advance(now_ns)

    def _stamp_of(self, source: int, header: Any, now_ns: int) -> int:
        """Return the stamp of a header that passes, by the source's clock."""
        now_ns -= self.centre.config.sources[source].settings.time_offset_ns
        return check_header(header, frame_id=self.frame.frame_id, now_ns=now_ns, max_future_ns=self.frame.max_future_ns)

    def _receive(self, source: int, arrays: TrackArrays, stamp_ns: int, now_ns: int) -> None:
        scan = screened_tracks(self.counts, arrays, self.centre.config.layout)
        if reason := self.centre.receive(source, scan, stamp_ns, now_ns):
            self.counts.reject({reason: 1}, f"a scan of {self.sources[source].name} stamped {stamp_ns / 1e9:.3f} s")

    def advance(self, now_ns: int) -> Iterator[Published]:
        """Run the steps that are due by now, one whenever the next result is asked for; count what happened.

        Each runs at the moment at which it became due, so that how often one asks changes nothing.
        """
        for moment_ns in self._moments(now_ns):
            yield from self._advance(moment_ns)

    def _moments(self, now_ns: int) -> Iterator[int]:
        """Yield when time alone may have made a step due since it was told last, and now."""
        last_ns = max(min(self._told_ns, now_ns), now_ns - CATCH_UP_NS)
        self._told_ns = now_ns
        while (wake_ns := self.centre.wake_ns(last_ns)) is not None and wake_ns < now_ns:
            yield wake_ns
            last_ns = wake_ns
        yield now_ns

    def _advance(self, now_ns: int) -> Iterator[Published]:
        counted = self.counts.counted
        for result in self.centre.advance(now_ns):
            self.counts.reject(result.kept_out, "a newer scan of the source came before its fusion, or it was too old")
            info = result.info
            counted["steps"] += 1
            for name in ("unconverged", "unsound", "beyond_half_circle", "held", "released"):
                counted[name] += getattr(info, name)
            counted["deleted"] += len(info.changes.deleted)
            counted["dropped_tentative"] += len(info.changes.dropped)
            counted["merged"] += len(info.merged)
            counted["late_beyond_share"] += result.beyond_share
            if result.rewound:
                counted["rewinds"] += result.rewound.repeated > 0
                counted["repeated_steps"] += result.rewound.repeated
                counted["vanished"] += len(result.rewound.vanished)
            yield result
