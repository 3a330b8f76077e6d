"""Replay node: a published scenario, or a bag, in lockstep with the fusion or at the pace of the clock."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import rclpy.utilities
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays
from msg_adapters.detection_table import detection_table_to_msg
from msg_adapters.header import stamp_from_ns, stamp_to_ns
from msg_adapters.odometry import odometry_to_msgs
from track_fusion.nodes.bag_player import BagParams, BagPlayer
from track_fusion.nodes.managed import Fault, ManagedNode, end, qos, run
from track_fusion.nodes.ros_params import declare
from track_fusion.params import ParameterError, Params, param, unknown_name_error
from track_fusion.scenarios import SCENARIOS, get_scenario
from track_fusion.tracks import SECOND_NS, TrackBatch

#: How often the state of the network and the deadline are looked at, wall time.
LOOK_PERIOD_S = 0.02
#: At the end, readers that are still there take the last messages within this wall time.
ACK_DEADLINE_S = 2
#: A covariance for the truth, which has none: small against any sensor, and positive definite.
TRUTH_VARIANCE = 1e-12


@dataclasses.dataclass(frozen=True)
class ReplayParams(Params):
    """What is replayed, and how fast."""

    scenario: str = param(
        "li2022-linear",
        "the scenario to replay",
        choices=tuple(key for key, scenario in SCENARIOS.items() if scenario.over_ros),
    )
    bag: str = param("", "a rosbag2 directory to play instead of a scenario")
    seed: int = param(0, "seed of the random streams", low=0)
    run: int = param(0, "index of the Monte Carlo run", low=0)
    steps: int = param(0, "replay so many steps, also beyond the scenario's own number; 0: that number", low=0)
    sensors: tuple[str, ...] = param((), "sensors of the scenario to publish; empty: all", kind=str)
    frame_id: str = param("map", "frame of what the scenario publishes")
    pace: str = param(
        "lockstep",
        "lockstep: publish a step when the result of the one before has come back on ~/fused; "
        "realtime: by the wall clock, times 'rate'",
        choices=("lockstep", "realtime"),
    )
    result_every: int = param(
        1, "at pace lockstep, wait for the result of every n-th step: centre and trackers work at that period", low=1
    )
    detection_covariances: bool = param(
        True, "send the sensor's noise with each detection; false: the trackers' parameters give it"
    )
    rate: float = param(
        1.0, "seconds of scenario or bag time a second of wall time, at pace realtime", low=0.0, strict=True
    )
    deadline_s: float = param(
        10.0,
        "end with an error when a participant or a result is missing for so long (wall time)",
        unit="s",
        low=0.0,
        strict=True,
    )
    expected_truth_subscribers: int = param(0, "wait for so many subscribers of ~/truth before the first step", low=0)
    expected_subscribers_each: int = param(1, "wait for so many subscribers of each detection or bag topic", low=0)


class ReplayNode(ManagedNode):
    """Publishes a scenario (/clock, ~/truth, ~/<sensor>/detections) or a bag; ends when all is published."""

    def declare_parameters_(self) -> None:
        """Declare parameters and draw the scenario."""
        self.params = declare(self, ReplayParams)
        self.bag = declare(self, BagParams, "bag_")
        self.finished = False
        self._step = 0
        self._waiting_since = time.monotonic()
        if self.params.bag and self.params.pace == "lockstep" and self._given("pace"):
            raise ParameterError("The 'pace' parameter must be realtime with a bag. Got 'lockstep'.")

    def _given(self, name: str) -> bool:
        return name in self._parameter_overrides

    def connect(self) -> None:
        """Create the topics."""
        self._clock_out = self.create_publisher(ClockMessage, "/clock", qos(10))
        if self.params.bag:
            self._player = BagPlayer(self, self._tell_time, self.params.bag, self.bag, self.params.rate)
            self._wanted = dict.fromkeys(self._player.publishers, self.params.expected_subscribers_each)
        else:
            self._connect_scenario()
        self.create_timer(LOOK_PERIOD_S, self._tick, clock=self._wall)
        self._started = False

    def _connect_scenario(self) -> None:
        try:
            self._scene = get_scenario(self.params.scenario).played()
        except ImportError as error:
            raise Fault(str(error)) from None
        names = self.params.sensors or tuple(self._scene.sensors)
        for name in names:
            if name not in self._scene.sensors:
                raise unknown_name_error(name, self._scene.sensors, "sensor")
        self._steps = self.params.steps or self._scene.steps
        draw = self.params.seed, self.params.run, self._steps
        self._states, self._drawn = self._scene.states(*draw), self._scene.detections(*draw)
        self._truth = self.publisher(Odometry, "~/truth", depth=100)
        self._detections = {name: self.publisher(PointCloud2, f"~/{name}/detections") for name in names}
        self._wanted = dict.fromkeys(self._detections.values(), self.params.expected_subscribers_each)
        self._wanted[self._truth] = self.params.expected_truth_subscribers
        if self.params.pace == "lockstep":
            self._fused = self.subscribe(PointCloud2, "~/fused", self._on_fused)

    def _tick(self) -> None:
        """Start when everybody is there, keep the pace, watch the deadline."""
        if not self.active or self.finished:
            return
        if not self._started:
            missing = self._missing_participants()
            if missing:
                self._check_deadline("; ".join(missing))
                return
            self._started = True
            self._began = time.monotonic()
            self._next()
        elif self.params.pace == "lockstep" and not self.params.bag:
            if not self.counted["results"]:  # a participant may have met our clock after our first message
                self._tell_time(self._stamp_ns())
            self._check_deadline(f"no result of step {self._step} on {self._fused.topic_name}. {self._network()}")

    def _check_deadline(self, what: str) -> None:
        if time.monotonic() - self._waiting_since > self.params.deadline_s:
            raise Fault(f"Nothing for {self.params.deadline_s:g} s: {what}")

    def _missing_participants(self) -> list[str]:
        missing = [
            f"{pub.topic_name} has no subscriber"
            if wanted == 1
            else f"{pub.topic_name} has {pub.get_subscription_count()} of {wanted} subscribers"
            for pub, wanted in self._wanted.items()
            if pub.get_subscription_count() < wanted
        ]
        if self.params.pace == "lockstep" and not self.params.bag and not self.count_publishers(self._fused.topic_name):
            missing.append(f"{self._fused.topic_name} has no publisher")
        return missing

    def _network(self) -> str:
        return "; ".join(self._missing_participants()) or "All topics are connected."

    def _next(self) -> None:
        """Publish the next step, and at pace realtime set the timer for the one after."""
        if self.params.bag:
            self._player.start(self._finish)
            return
        while self._step < self._steps:
            self._step += 1
            self._publish_step(self._step)
            self._waiting_since = time.monotonic()
            if self.params.pace == "realtime":
                if self._step == 1:
                    period = self._scene.dt_s / self.params.rate
                    self._pacer = self.create_timer(period, self._next, clock=self._wall)
                return
            if self._step % self.params.result_every == 0:
                return
        self._finish()

    def _stamp_ns(self) -> int:
        return round(self._step * self._scene.dt_s * SECOND_NS)

    def _tell_time(self, now_ns: int) -> None:
        self._clock_out.publish(ClockMessage(clock=stamp_from_ns(now_ns)))

    def _publish_step(self, step: int) -> None:
        stamp_ns = self._stamp_ns()
        self._tell_time(stamp_ns)
        layout, states = self._scene.layout, self._states[step]
        there = np.flatnonzero(np.isfinite(states).all(1))
        sharp = np.tile(TRUTH_VARIANCE * np.eye(layout.size), (len(there), 1, 1))
        truth = TrackBatch.gaussian(
            layout, self.params.frame_id, states[there], sharp, time_ns=stamp_ns, track_id=1 + there
        )
        for msg in odometry_to_msgs(truth, layout.axes):
            self._truth.publish(msg)
        for name, pub in self._detections.items():
            sensor, z = self._scene.sensors[name], self._drawn[name][step - 1]
            noise = np.broadcast_to(sensor.noise, (len(z), *sensor.noise.shape))
            covs = noise if self.params.detection_covariances else None
            scan = DetectionArrays(sensor.axes, self.params.frame_id, stamp_ns, z, covs)
            pub.publish(detection_table_to_msg(scan))

    def _on_fused(self, msg: Any) -> None:
        stamp_ns = stamp_to_ns(msg.header.stamp)
        if self._started and stamp_ns == self._stamp_ns():
            self.counted["results"] += 1
            self._next()

    def _finish(self) -> None:
        took = time.monotonic() - self._began
        what = f"{self.counted['messages']} messages" if self.params.bag else f"{self._steps} steps"
        self.log.info(f"Replayed {what} in {took:.2f} s.")
        if hasattr(self, "_pacer"):
            self._pacer.cancel()
        self.finished = True

    def close(self) -> None:
        """Let reliable readers take the last messages before the writer is gone."""
        for pub in (*self._wanted, self._clock_out) if self.finished and rclpy.utilities.ok() else ():
            pub.wait_for_all_acked(Duration(seconds=ACK_DEADLINE_S))

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Report progress."""
        return [], {"step": self._step, "finished": self.finished}


def main() -> None:
    """Run the node."""
    end(run(lambda: ReplayNode("replay")))


if __name__ == "__main__":
    main()
