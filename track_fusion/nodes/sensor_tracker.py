"""Sensor tracker node: detections in, posterior tracks out, the fused posterior back in."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays
from msg_adapters.detection_table import detection_table_from_msg
from msg_adapters.header import check_header
from msg_adapters.odometry import odometry_to_msgs
from msg_adapters.track_table import track_table_from_msg, track_table_to_msg
from track_fusion.messages.screening import FrameParams, screened_detections, screened_tracks
from track_fusion.models.choices import MOTIONS, SENSORS
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.nodes.managed import ManagedNode
from track_fusion.nodes.process import end, run
from track_fusion.nodes.ros_params import chosen, declare
from track_fusion.params import ParameterError, Params, param
from track_fusion.trackers.filters import FILTERS
from track_fusion.trackers.many_targets import PdaTracker, PdaTrackerParams
from track_fusion.trackers.one_target import (
    MULTI_TARGET,
    LostTrackError,
    SensorTracker,
    SensorTrackerParams,
    TrackerChoice,
)
from track_fusion.tracks import SECOND_NS, TrackBatch

#: How often a tracker that waits for feedback looks at its deadline.
LOOK_PERIOD_S = 0.05


@dataclasses.dataclass(frozen=True)
class FeedbackParams(Params):
    """What a tracker does with the fused posterior on ~/feedback."""

    feedback: str = param(
        "none",
        "none: ignore it; replace: take the fused posterior of each scan for one's own before the next scan",
        choices=("none", "replace"),
    )
    feedback_timeout_s: float = param(
        5.0, "wall time to wait for the feedback of a scan before going on without it", unit="s", low=0.0, strict=True
    )


@dataclasses.dataclass(frozen=True)
class OutputParams(Params):
    """How often a tracker tells its tracks."""

    publish_every: int = param(1, "publish the tracks of every n-th scan only", low=1)


class SensorTrackerNode(ManagedNode):
    """Carries messages to a :class:`track_fusion.trackers.one_target.SensorTracker`, or a multi-target tracker.

    With feedback, a scan waits until the fused posterior of the scan before has come back, so that late feedback
    changes nothing.
    """

    def declare_parameters_(self) -> None:
        """Declare parameters and build the tracker."""
        self.frame = declare(self, FrameParams)
        self.feedback, self.output = declare(self, FeedbackParams), declare(self, OutputParams)
        self.tracker = self._made(declare(self, TrackerChoice))
        self._queue: deque[DetectionArrays] = deque()
        self._awaited_ns = -1
        self._asked_ns = self._taken = 0

    def _made(self, choice: TrackerChoice) -> SensorTracker | PdaTracker:
        """Declare the parameters of motion, sensor and filter, and make the tracker of them."""
        motion = chosen(self, MOTIONS, choice.motion, self.frame.layout)
        sensor = chosen(self, SENSORS, choice.sensor, motion.layout)
        if choice.filter != MULTI_TARGET:
            track_filter = chosen(self, FILTERS, choice.filter, motion, sensor)
            params = declare(self, SensorTrackerParams)
            return SensorTracker(motion, sensor, track_filter, self.frame.frame_id, params)
        if not isinstance(sensor, RangeBearingSensor):
            raise ParameterError(
                f"The 'sensor' parameter must be 'range_bearing' with filter {MULTI_TARGET!r}. Got {choice.sensor!r}."
            )
        if self.feedback.feedback != "none":
            raise ParameterError(
                f"The 'feedback' parameter must be 'none' with filter {MULTI_TARGET!r}. Got {self.feedback.feedback!r}."
            )
        return PdaTracker(motion, sensor, self.frame.frame_id, declare(self, PdaTrackerParams))

    def connect(self) -> None:
        """Create the topics."""
        self._tracks = self.publisher(PointCloud2, "~/tracks", expected=self.managed.expected_subscribers)
        self._odometry = self.publisher(Odometry, "~/odometry")
        self.subscribe(PointCloud2, "~/detections", self._on_detections)
        if self.feedback.feedback == "replace":
            self.subscribe(PointCloud2, "~/feedback", self._on_feedback)
            self.create_timer(LOOK_PERIOD_S, self._on_deadline, clock=self._wall)

    def on_clock_jump(self) -> None:
        """Go back to the initial state."""
        self.on_stop()
        self.tracker.reset()
        self._taken = 0

    def on_stop(self) -> None:
        """Drop waiting scans."""
        self._queue.clear()
        self._awaited_ns = -1

    def _on_detections(self, msg: Any) -> None:
        now = self.now_ns()
        check_header(msg.header, frame_id=self.frame.frame_id, now_ns=now, max_future_ns=self.frame.max_future_ns)
        self._queue.append(detection_table_from_msg(msg, self.tracker.sensor.axes))
        self._work()

    def _on_feedback(self, msg: Any) -> None:
        now = self.now_ns()
        stamp_ns = check_header(
            msg.header, frame_id=self.frame.frame_id, now_ns=now, max_future_ns=self.frame.max_future_ns
        )
        batch = screened_tracks(self, track_table_from_msg(msg), self.tracker.layout)
        if stamp_ns != self._awaited_ns:  # of an empty table, too: it says that there is no feedback of its time only
            self.counted["feedback_of_another_time"] += 1
            return
        assert isinstance(self.tracker, SensorTracker)  # the other takes no feedback
        self.counted["feedback"] += self.tracker.feed_back(batch)
        self._awaited_ns = -1
        self._work()

    def _on_deadline(self) -> None:
        waited = self._wall.now().nanoseconds - self._asked_ns
        if self._awaited_ns >= 0 and self._queue and waited > self.feedback.feedback_timeout_s * SECOND_NS:
            self.counted["feedback_timeouts"] += 1
            self._awaited_ns = -1
            self._work()

    def _work(self) -> None:
        while self._queue and self._awaited_ns < 0:
            self._track(self._queue.popleft())

    def _track(self, scan: DetectionArrays) -> None:
        if scan.time_ns <= self.tracker.time_ns:
            same = scan.time_ns == self.tracker.time_ns
            self.reject({"duplicate_scan" if same else "out_of_order_scan": 1})
            return
        try:
            batch = self.tracker.step(scan.time_ns, *screened_detections(self, scan))
        except LostTrackError as error:
            self.reject({error.reason: 1}, str(error))
            batch = TrackBatch.empty(self.tracker.layout, self.frame.frame_id)
        self.counted["scans"] += 1
        self._taken += 1
        if self._taken % self.output.publish_every:
            return
        if self.feedback.feedback == "replace" and len(batch):
            self._awaited_ns, self._asked_ns = scan.time_ns, self._wall.now().nanoseconds
        self._publish(batch, scan.time_ns)

    def _publish(self, batch: TrackBatch, stamp_ns: int) -> None:
        self._tracks.publish(track_table_to_msg(batch, self.tracker.layout.axes, stamp_ns))
        if self._odometry.get_subscription_count():
            for msg in odometry_to_msgs(batch, self.tracker.layout.axes):
                self._odometry.publish(msg)

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Warn when feedback was missing, or tentative tracks were dropped."""
        missing, values = self.counted["feedback_timeouts"], {"waiting_scans": len(self._queue)}
        warnings = [f"{missing} scans without feedback"] if missing else []
        if isinstance(self.tracker, PdaTracker):
            values["dropped_tentative"] = dropped = self.tracker.tracks.dropped
            if dropped:
                warnings.append(f"{dropped} tentative tracks were dropped: more than max_tentative_tracks at a time")
        return warnings, values


def main() -> None:
    """Run the node."""
    end(run(lambda: SensorTrackerNode("sensor_tracker")))


if __name__ == "__main__":
    main()
