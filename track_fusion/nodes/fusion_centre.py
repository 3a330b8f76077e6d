"""Fusion-centre node: source tracks in, fused tracks out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt64
from visualization_msgs.msg import MarkerArray

from msg_adapters.markers import markers_to_msg
from msg_adapters.odometry import odometry_to_msgs
from msg_adapters.track_table import track_table_to_msg
from track_fusion.centre.centre import Published
from track_fusion.centre.publish import StepInfo
from track_fusion.messages.centre import MessageCentre
from track_fusion.nodes.managed import ManagedNode, qos
from track_fusion.nodes.process import end, run
from track_fusion.nodes.ros_params import declare
from track_fusion.params import ParameterError
from track_fusion.tracks import SECOND_NS, TrackBatch

#: How often waiting scans and silent sources are looked at, in ROS time.
LOOK_PERIOD_S = 0.02
#: So many pieces of scans a source's queue holds, and are read at once.
PIECES = 1000


class FusionCentreNode(ManagedNode):
    """Carries messages and the time to a :class:`track_fusion.centre.centre.FusionCentre`."""

    def declare_parameters_(self) -> None:
        """Declare parameters and build the centre."""
        self.messages = MessageCentre(partial(declare, self), self._parameter_overrides, self.counts, self.clock)
        self.centre = self.messages.centre
        self._latency_s, self._handled = 0.0, 0
        self._last: StepInfo | None = None

    def connect(self) -> None:
        """Create the topics."""
        self._tracks = self.publisher(PointCloud2, "~/tracks", expected=self.managed.expected_subscribers)
        self._odometry = self.publisher(Odometry, "~/odometry")
        self._markers = self.publisher(MarkerArray, "~/markers")
        self._inputs: dict[int, Any] = {}
        matched = PublisherEventCallbacks(matched=self._tell_count)
        self._processed = self.create_publisher(UInt64, "~/processed", qos(1, latched=True), event_callbacks=matched)
        for k, source in enumerate(self.messages.sources):
            try:
                message = source.kind.load()
            except ImportError as error:
                raise ParameterError(f"The 'source_types' parameter: {error}") from error
            depth = 10 if source.kind.whole_scan else PIECES  # of a scan in pieces, each is a message
            lost, raw = SubscriptionEventCallbacks(message_lost=self._on_lost), source.kind.read_raw is not None
            take = partial(self._take_raw if raw else self._take, k)
            self._inputs[k] = self.subscribe(message, source.topic, take, depth, event_callbacks=lost, raw=raw)
        self._timer = self.create_timer(LOOK_PERIOD_S, self._on_timer)

    def on_start(self) -> None:
        """Say what it does: a parameter file for another node's name would go unnoticed."""
        sources = ", ".join(self.resolve_topic_name(source.topic) for source in self.messages.sources)
        frame, rule = self.messages.frame, self.centre.config.rule
        what = f"{' '.join(frame.axes)} in frame '{frame.frame_id}' by {rule.key}"
        self.log.info(f"Fusing {what} from {sources}.")

    def _on_lost(self, event: Any) -> None:
        self.reject(
            {"lost_in_transport": event.total_count_change}, "a queue was full: raise its depth by a QoS override"
        )

    def _take(self, source: int, msg: Any) -> None:
        self._publish_of(self.messages.take(source, msg, self.now_ns()), 1)

    def _take_raw(self, source: int, first: bytes) -> None:
        """Take at once all that waits, so that a scan of many pieces costs no callback and no decoding each."""
        messages = [first, *self.drained(self._inputs[source], PIECES)]
        self._publish_of(self.messages.take_raw(source, messages, self.now_ns()), len(messages))

    def _publish_of(self, results: Iterator[Published], messages: int) -> None:
        """Publish what some messages made due, and count them as handled."""
        try:
            self._publish_all(results)
        finally:
            self._handled += messages
            if self._processed.get_subscription_count():
                self._tell_count()

    def _tell_count(self, _: Any = None) -> None:
        """Say how many messages were handled, those turned away included; while nobody listens nothing is said."""
        self._processed.publish(UInt64(data=self._handled))

    def _on_timer(self) -> None:
        if self.active and self.released:
            self._handle(self._publish_all, self.messages.advance(self.now_ns()))

    def on_clock_jump(self) -> None:
        """Forget all tracks and waiting scans."""
        self.centre.reset()

    def _publish_all(self, results: Iterator[Published]) -> None:
        """Run the steps that are due, and publish the result of each before the next."""
        began = time.perf_counter()
        for result in results:
            self._publish(result.tracks, result.time_ns)
            self._latency_s, self._last = time.perf_counter() - began, result.info
            began = time.perf_counter()
        if self.centre.resets != self.counted["clock_resets"]:
            self.log.warning("The clock has jumped back: all tracks are forgotten.")
            self.counted["clock_resets"] = self.centre.resets
        self._look_again()

    def _look_again(self) -> None:
        """Set the timer to when time alone may make a step due."""
        now_ns, look_ns = self.now_ns(), round(LOOK_PERIOD_S * SECOND_NS)
        wake_ns = self.centre.wake_ns(now_ns)
        self._timer.timer_period_ns = look_ns if wake_ns is None else min(wake_ns - now_ns, look_ns)
        self._timer.reset()

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
        for k, name in enumerate(source.name for source in self.messages.sources):
            silence = self.centre.buffer.silence_s(k, self.now_ns())
            values[f"silence_s/{name}"] = round(silence, 3)
            if silence >= timeout_s:
                warnings.append(f"{name} is silent for {silence:.1f} s")
        if unsound := self.counted["unsound"]:
            warnings.append(f"{unsound} fusions gave no density; a single source was taken instead")
        if beyond := self.counted["beyond_half_circle"]:
            warnings.append(f"{beyond} fusions were of angles more than a half circle apart, which have no mean")
        if dropped := self.counted["dropped_tentative"]:
            warnings.append(f"{dropped} tentative tracks were dropped: more than max_tentative_tracks at a time")
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
