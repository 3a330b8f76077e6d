"""Replay node: a published scenario, or a bag, in lockstep with the fusion or at the pace of the clock."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

import rclpy.utilities
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock as ClockMessage

from msg_adapters.header import stamp_from_ns
from track_fusion.nodes.bag_player import BagParams, BagPlayer
from track_fusion.nodes.managed import ManagedNode, qos
from track_fusion.nodes.process import end, run
from track_fusion.nodes.ros_params import declare
from track_fusion.nodes.scenario_player import ScenarioParams, ScenarioPlayer
from track_fusion.params import Fault, Params, param

#: How often the state of the network and the deadline are looked at, wall time.
LOOK_PERIOD_S = 0.02
#: A writer may know of a reader before the reader knows of the writer, and then drops what comes: the start waits so
#: long after all are there, wall time.
SETTLE_S = 0.3
#: At the end, readers that are still there take the last messages within this wall time.
ACK_DEADLINE_S = 2


@dataclasses.dataclass(frozen=True)
class ReplayParams(Params):
    """How fast a scenario or a bag is replayed, and for whom."""

    bag: str = param("", "a rosbag2 directory to play instead of a scenario")
    pace: str = param(
        "auto",
        "auto: lockstep for a scenario, realtime for a bag; lockstep: publish a step when the result of the one before "
        "has come back on ~/fused, a message of a bag when the one before is counted on ~/processed; "
        "realtime: by the wall clock, times 'rate'",
        choices=("auto", "lockstep", "realtime"),
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
    expected_subscribers_each: int = param(1, "wait for so many subscribers of each detection or bag topic", low=0)


class ReplayNode(ManagedNode):
    """Lets a player publish, with /clock, once everybody is there; ends when all is published."""

    def declare_parameters_(self) -> None:
        """Declare parameters."""
        self.params, self.scenario = declare(self, ReplayParams), declare(self, ScenarioParams)
        self.bag = declare(self, BagParams, "bag_")
        self.finished = self._started = False
        self._complete_s = math.inf

    def connect(self) -> None:
        """Create the topics."""
        self._clock_out = self.create_publisher(ClockMessage, "/clock", qos(10))
        params, each = self.params, self.params.expected_subscribers_each
        self._player: BagPlayer | ScenarioPlayer
        pace = ("realtime" if params.bag else "lockstep") if params.pace == "auto" else params.pace
        rate = params.rate if pace == "realtime" else None
        if params.bag:
            self._player = BagPlayer(self, self._tell_time, params.bag, self.bag, rate, each)
        else:
            self._player = ScenarioPlayer(self, self._tell_time, self.scenario, rate, each)
        self.every(LOOK_PERIOD_S, self._tick)

    def _tell_time(self, now_ns: int) -> None:
        self._clock_out.publish(ClockMessage(clock=stamp_from_ns(now_ns)))

    def _tick(self) -> None:
        """Start when everybody is there; then watch the deadline."""
        if not self.active or self.finished:
            return
        missing = "; ".join(self._missing_participants())
        if self._started:
            if awaited := self._player.awaited():
                self._check_deadline(f"{awaited} {missing or 'All topics are connected.'}")
        elif missing:
            self._complete_s = math.inf
            self._check_deadline(missing)
        else:
            self._complete_s = min(self._complete_s, time.monotonic())
            if time.monotonic() - self._complete_s >= SETTLE_S:
                self._started, self._began_s = True, time.monotonic()
                self._player.start(self._finish)

    def _check_deadline(self, what: str) -> None:
        if time.monotonic() - self._player.since_s > self.params.deadline_s:
            raise Fault(f"Nothing for {self.params.deadline_s:g} s: {what}")

    def _missing_participants(self) -> list[str]:
        missing = [
            f"{pub.topic_name} has no subscriber"
            if wanted == 1
            else f"{pub.topic_name} has {pub.get_subscription_count()} of {wanted} subscribers"
            for pub, wanted in self._player.wanted.items()
            if pub.get_subscription_count() < wanted
        ]
        results = self._player.results
        if results is not None and not self.count_publishers(results.topic_name):
            missing.append(f"{results.topic_name} has no publisher")
        return missing

    def _finish(self, what: str) -> None:
        self.log.info(f"Replayed {what} in {time.monotonic() - self._began_s:.2f} s.")
        self.finished = True

    def close(self) -> None:
        """Let reliable readers take the last messages before the writer is gone."""
        for pub in (*self._player.wanted, self._clock_out) if self.finished and rclpy.utilities.ok() else ():
            pub.wait_for_all_acked(Duration(seconds=ACK_DEADLINE_S))

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Report progress."""
        return [], {"finished": self.finished}


def main() -> None:
    """Run the node."""
    end(run(lambda: ReplayNode("replay")))


if __name__ == "__main__":
    main()
