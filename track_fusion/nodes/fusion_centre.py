"""Fusion-centre node: source tracks in, fused tracks out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from msg_adapters.arrays import CrossBlock
from msg_adapters.header import check_header
from msg_adapters.markers import markers_to_msg
from msg_adapters.odometry import odometry_to_msgs
from msg_adapters.track_table import track_table_to_msg
from msg_adapters.types import MESSAGE_TYPES, MessageType
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    MAX_SOURCES,
    CentreConfig,
    FusionCentreParams,
    ScanBufferParams,
    SourceConfig,
    StateFusionParams,
    TrackManagerParams,
)
from track_fusion.centre.publish import StepInfo
from track_fusion.models.choices import MOTIONS, MotionChoice
from track_fusion.nodes.managed import ManagedNode
from track_fusion.nodes.process import end, run
from track_fusion.nodes.ros_params import chosen, declare, refuse_of_others
from track_fusion.nodes.screening import FrameParams, screened_tracks
from track_fusion.params import ParameterError, Params, param
from track_fusion.plugins import Registry
from track_fusion.random_streams import RandomParams
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch

#: Message types of sources by key, those of other packages included.
SOURCE_TYPES: Registry[MessageType] = Registry("track_fusion.adapters", "source type", MessageType, MESSAGE_TYPES)
#: How often waiting scans and silent sources are looked at, in ROS time.
LOOK_PERIOD_S = 0.02


@dataclasses.dataclass(frozen=True)
class SourceParams(Params):
    """Where source tracks come from."""

    source_configurations: tuple[str, ...] = param(
        ("sensor_1", "sensor_2"), "name of each source; its tracks are read from ~/sources/<name>/tracks"
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
        if self.source_types and len(self.source_types) != len(names):
            raise ParameterError(
                f"The 'source_types' parameter must hold one type a source, {len(names)}. "
                f"Got {list(self.source_types)}."
            )

    @property
    def kinds(self) -> list[MessageType]:
        """Message type of each source."""
        return [SOURCE_TYPES[key] for key in self.source_types or ("track_table",) * len(self.source_configurations)]


class FusionCentreNode(ManagedNode):
    """Carries messages and the time to a :class:`track_fusion.centre.centre.FusionCentre`."""

    def declare_parameters_(self) -> None:
        """Declare parameters and build the centre."""
        self.frame, self.sources = declare(self, FrameParams), declare(self, SourceParams)
        self.kinds = self.sources.kinds
        motion = chosen(self, MOTIONS, declare(self, MotionChoice).motion, self.frame.layout)
        rule = RULES[declare(self, StateFusionParams).state_fusion]
        refuse_of_others(self, RULES, "state_fusion", rule.key)
        rule_params = declare(self, rule.params, f"{rule.key}.")
        names = zip(self.sources.source_configurations, self.kinds, strict=True)
        sources = tuple(SourceConfig(name, assembles=not kind.whole_scan) for name, kind in names)
        self.centre = FusionCentre(
            CentreConfig(
                sources, motion, self.frame.frame_id, rule, rule_params, declare(self, FusionCentreParams),
                declare(self, TrackManagerParams), declare(self, ScanBufferParams), declare(self, RandomParams),
                self.clock,
            )
        )  # fmt: skip
        self._latency_s = 0.0
        self._last: StepInfo | None = None

    def connect(self) -> None:
        """Create the topics."""
        self._tracks = self.publisher(PointCloud2, "~/tracks", expected=self.managed.expected_subscribers)
        self._odometry = self.publisher(Odometry, "~/odometry")
        self._markers = self.publisher(MarkerArray, "~/markers")
        for k, (name, kind) in enumerate(zip(self.sources.source_configurations, self.kinds, strict=True)):
            try:
                message = kind.load()
            except ImportError as error:
                raise ParameterError(f"The 'source_types' parameter: {error}") from error
            depth = 10 if kind.whole_scan else 1000  # of a scan in pieces, each is a message
            lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
            self.subscribe(message, f"~/sources/{name}/tracks", self._reader(k, kind), depth, event_callbacks=lost)
        self.create_timer(LOOK_PERIOD_S, self._on_timer)

    def on_start(self) -> None:
        """Say what it does: a parameter file for another node's name would go unnoticed."""
        names = self.sources.source_configurations
        sources = ", ".join(self.resolve_topic_name(f"~/sources/{name}/tracks") for name in names)
        what = f"{' '.join(self.frame.axes)} in frame '{self.frame.frame_id}' by {self.centre.config.rule.key}"
        self.log.info(f"Fusing {what} from {sources}.")

    def _on_lost(self, event: Any) -> None:
        self.reject(
            {"lost_in_transport": event.total_count_change}, "a queue was full: raise its depth by a QoS override"
        )

    def _reader(self, source: int, kind: MessageType) -> Callable[[Any], None]:
        cross_block: CrossBlock = "conservative" if self.sources.cross_block == "conservative" else "block_diagonal"

        def read(msg: Any) -> None:
            now = self.now_ns()
            stamp_ns = check_header(
                msg.header, frame_id=self.frame.frame_id, now_ns=now, max_future_ns=self.frame.max_future_ns
            )
            tracks, supplied = kind.read(msg, self.centre.config.layout.axes, cross_block)
            if kind.lacks:
                self.counted[f"{kind.lacks}_absent"] += supplied
            self._take(source, screened_tracks(self, tracks, self.centre.config.layout), stamp_ns, now)

        return read

    def _take(self, source: int, scan: TrackBatch, stamp_ns: int, now_ns: int) -> None:
        if reason := self.centre.receive(source, scan, stamp_ns, now_ns):
            name = self.sources.source_configurations[source]
            self.reject({reason: 1}, f"a scan of {name} stamped {stamp_ns / 1e9:.3f} s")
            return
        self._advance(now_ns)

    def _on_timer(self) -> None:
        if self.active and self.released:
            self._handle(self._advance, self.now_ns())

    def on_clock_jump(self) -> None:
        """Forget all tracks and waiting scans."""
        self.centre.reset()

    def _advance(self, now_ns: int) -> None:
        """Publish what is due by now."""
        began = time.perf_counter()
        for result in self.centre.advance(now_ns):
            self.reject(result.kept_out, "a newer scan of the source came before its fusion, or it was too old for it")
            self._publish(result.tracks, result.time_ns)
            self._latency_s = time.perf_counter() - began
            self._last = result.info
            self.counted["steps"] += 1
            self.counted["unconverged"] += result.info.unconverged
            self.counted["unsound"] += result.info.unsound
            self.counted["beyond_half_circle"] += result.info.beyond_half_circle
            self.counted["deleted"] += len(result.info.changes.deleted)
            self.counted["late_scans_predicted"] += result.predicted
            if result.rewound is not None:
                self.counted["rewinds"] += result.rewound.repeated > 0
                self.counted["repeated_steps"] += result.rewound.repeated
                self.counted["vanished"] += len(result.rewound.vanished)
            began = time.perf_counter()

    def _publish(self, fused: TrackBatch, stamp_ns: int) -> None:
        axes = self.centre.config.layout.axes
        self._tracks.publish(track_table_to_msg(fused, axes, stamp_ns))
        if self._odometry.get_subscription_count():
            for msg in odometry_to_msgs(fused, axes):
                self._odometry.publish(msg)
        if self._markers.get_subscription_count():
            self._markers.publish(markers_to_msg(fused, axes, stamp_ns))

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Report each source's silence, tracks, latency; warn of silent sources and double counting."""
        warnings = []
        rule, timeout_s = self.centre.config.rule, self.centre.config.buffer.source_timeout_s
        values: dict[str, Any] = {"rule": rule.key, "tracks": len(self.centre.tracks)}
        values["step_s"] = round(self._latency_s, 6)
        for k, name in enumerate(self.sources.source_configurations):
            silence = self.centre.buffer.silence_s(k, self.now_ns())
            values[f"silence_s/{name}"] = round(silence, 3)
            if silence >= timeout_s:
                warnings.append(f"{name} is silent for {silence:.1f} s")
        if unsound := self.counted["unsound"]:
            warnings.append(f"{unsound} fusions gave no density; a single source was taken instead")
        if beyond := self.counted["beyond_half_circle"]:
            warnings.append(f"{beyond} fusions were of angles more than a half circle apart, which have no mean")
        if self.centre.config.retrodicts:
            values["history_s"] = round(self.centre.history.length_s, 3)
        if self._last is not None:
            values["members"] = self._last.members.tolist()
            if self._last.shared_provenance and rule.guarantee_at(self.centre.config.rule_params) != "conservative":
                warnings.append(f"{rule.key} counts information twice: its members hold each other's")
        return warnings, values


def main() -> None:
    """Run the node."""
    end(run(lambda: FusionCentreNode("fusion_centre")))


if __name__ == "__main__":
    main()
