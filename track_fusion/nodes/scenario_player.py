"""Playing a published scenario: its truth and detections, in lockstep with the fusion or at the pace of the clock."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays
from msg_adapters.detection_table import detection_table_to_msg
from msg_adapters.header import stamp_to_ns
from msg_adapters.track_table import track_table_to_msg
from track_fusion.nodes.managed import ManagedNode
from track_fusion.params import Fault, Params, param, unknown_name_error
from track_fusion.scenarios import SCENARIOS, get_scenario
from track_fusion.tracks import SECOND_NS, TrackBatch

#: A covariance for the truth, which has none: small against any sensor, and positive definite.
TRUTH_VARIANCE = 1e-12


@dataclasses.dataclass(frozen=True)
class ScenarioParams(Params):
    """Which scenario is played, and which draw of it."""

    scenario: str = param(
        "li2022-linear",
        "the scenario to replay",
        choices=tuple(key for key, scenario in SCENARIOS.items() if scenario.over_ros),
    )
    seed: int = param(0, "seed of the random streams", low=0)
    run: int = param(0, "index of the Monte Carlo run", low=0)
    steps: int = param(0, "replay so many steps, also beyond the scenario's own number; 0: that number", low=0)
    sensors: tuple[str, ...] = param((), "sensors of the scenario to publish; empty: all", kind=str)
    frame_id: str = param("map", "frame of what the scenario publishes")
    result_every: int = param(
        1, "at pace lockstep, wait for the result of every n-th step: centre and trackers work at that period", low=1
    )
    detection_covariances: bool = param(
        True, "send the sensor's noise with each detection; false: the trackers' parameters give it"
    )
    expected_truth_subscribers: int = param(0, "wait for so many subscribers of ~/truth before the first step", low=0)


class ScenarioPlayer:
    """Publishes ~/truth, a track table a step, and ~/<sensor>/detections, each after the clock of its time.

    Parameters
    ----------
    node : ManagedNode
    tell_time : callable     publishes /clock, ns
    params : ScenarioParams
    rate : float or None     scenario seconds a wall second; None: a step when the result of the one before is back
    subscribers_each : int   how many to wait for on each topic of detections

    Attributes
    ----------
    wanted : {publisher: int}       how many subscribers of each must be there before the start
    results : subscription or None  of the results that are waited for
    since_s : float                 wall time since which the next result is waited for

    Raises
    ------
    Fault             a package that the scenario needs is missing
    ParameterError    no such sensor
    """

    def __init__(
        self, node: ManagedNode, tell_time: Callable[[int], None], params: ScenarioParams, rate: float | None,
        subscribers_each: int,
    ) -> None:  # fmt: skip
        self._node, self._tell_time, self._params, self._rate = node, tell_time, params, rate
        try:
            self._scene = get_scenario(params.scenario).played()
        except ImportError as error:
            raise Fault(str(error)) from None
        names = params.sensors or tuple(self._scene.sensors)
        for name in names:
            if name not in self._scene.sensors:
                raise unknown_name_error(name, self._scene.sensors, "sensor")
        self._step, self._steps = 0, params.steps or self._scene.steps
        draw = params.seed, params.run, self._steps
        self._states, self._drawn = self._scene.states(*draw), self._scene.detections(*draw)
        self._truth = node.publisher(PointCloud2, "~/truth", depth=100)
        self._detections = {name: node.publisher(PointCloud2, f"~/{name}/detections") for name in names}
        self.wanted = dict.fromkeys(self._detections.values(), subscribers_each)
        self.wanted[self._truth] = params.expected_truth_subscribers
        self.results = None if rate else node.subscribe(PointCloud2, "~/fused", self._on_fused)
        self.since_s = time.monotonic()

    def start(self, finish: Callable[[str], None]) -> None:
        """Begin to play; after the last step `finish` is told how much that was."""
        self._finish = finish
        self._go_on()
        if self._rate:
            self._pacer = self._node.every(self._scene.dt_s / self._rate, self._go_on)

    def awaited(self) -> str:
        """Say which result is waited for; empty: none."""
        if self.results is None:
            return ""
        if not self._node.counted["results"]:  # a participant may have met our clock after our first message
            self._tell_time(self._stamp_ns())
        return f"no result of step {self._step} on {self.results.topic_name}."

    def _go_on(self) -> None:
        """Publish the next step, or all up to the next that has a result to wait for; finish after the last."""
        while self._step < self._steps:
            self._step += 1
            self._node.counted["step"] = self._step
            self._publish()
            self.since_s = time.monotonic()
            if self._rate or self._step % self._params.result_every == 0:
                return
        if self._rate:
            self._pacer.cancel()
        self._finish(f"{self._steps} steps")

    def _on_fused(self, msg: Any) -> None:
        if self._step and stamp_to_ns(msg.header.stamp) == self._stamp_ns():
            self._node.counted["results"] += 1
            self._go_on()

    def _stamp_ns(self) -> int:
        return round(self._step * self._scene.dt_s * SECOND_NS)

    def _publish(self) -> None:
        stamp_ns, frame_id = self._stamp_ns(), self._params.frame_id
        self._tell_time(stamp_ns)
        layout, states = self._scene.layout, self._states[self._step]
        there = np.flatnonzero(np.isfinite(states).all(1))
        sharp = np.tile(TRUTH_VARIANCE * np.eye(layout.size), (len(there), 1, 1))
        truth = TrackBatch.gaussian(layout, frame_id, states[there], sharp, time_ns=stamp_ns, track_id=1 + there)
        self._truth.publish(track_table_to_msg(truth, layout.axes, stamp_ns))
        for name, pub in self._detections.items():
            sensor, z = self._scene.sensors[name], self._drawn[name][self._step - 1]
            noise = np.broadcast_to(sensor.noise, (len(z), *sensor.noise.shape))
            covs = noise if self._params.detection_covariances else None
            pub.publish(detection_table_to_msg(DetectionArrays(sensor.axes, frame_id, stamp_ns, z, covs)))
