"""Evaluator node: truth and tracks in, RMSE and NEES with chi-square bounds out, as JSON at the end."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

from sensor_msgs.msg import PointCloud2

from msg_adapters.header import stamp_to_ns
from msg_adapters.track_table import track_table_from_msg
from msg_adapters.types import MESSAGE_TYPES
from track_fusion.messages.screening import FrameParams, screened_tracks
from track_fusion.metrics.evaluation import Evaluation, EvaluationParams
from track_fusion.metrics.gospa import SetDistanceParams
from track_fusion.nodes.managed import ManagedNode, class_of
from track_fusion.nodes.process import end, run
from track_fusion.nodes.ros_params import declare
from track_fusion.params import Params, param

#: How often the end of the run is looked for, wall time.
LOOK_PERIOD_S = 0.1
#: When nothing has arrived for this wall time, what was sent has arrived.
SILENCE_S = 1.0


@dataclasses.dataclass(frozen=True)
class EvaluatorParams(Params):
    """Where the truth comes from, and what becomes of the result."""

    truth_type: str = param(
        "track_table",
        "message type of ~/truth: track_table (a step is one message, so that who is not in it is not there) or "
        "odometry (one message a target: a step may lack some, which is reported)",
        choices=MESSAGE_TYPES,
    )
    output: str = param("", "write the result to this JSON file at the end; empty: print it")
    steps: int = param(
        0,
        "end after so many evaluated times, or when the publisher of the truth has gone; 0: run until told to end",
        low=0,
    )


class EvaluatorNode(ManagedNode):
    """Carries messages to a :class:`track_fusion.metrics.evaluation.Evaluation`."""

    def declare_parameters_(self) -> None:
        """Declare parameters."""
        self.frame, self.params = declare(self, FrameParams), declare(self, EvaluatorParams)
        self._truth: Any = None
        self.layout, self.kind = self.frame.layout, MESSAGE_TYPES[self.params.truth_type]
        self._evaluation_params = declare(self, EvaluationParams)
        self._scored = declare(self, SetDistanceParams, "gospa_")
        self.finished = self._had_truth = False
        self._foreign = ""
        self.on_clock_jump()

    def on_clock_jump(self) -> None:
        """Begin to judge anew: the same stamps will come again."""
        self.evaluation = Evaluation(self.layout, self._evaluation_params, self.kind.whole_scan, self._scored)
        self._warned, self._look_at, self._heard_s = False, 1, time.monotonic()

    def connect(self) -> None:
        """Create the topics."""
        depth = 100 if self.kind.whole_scan else 1000  # of a step in pieces, each is a message
        self._truth = self.subscribe(class_of(self.kind.message), "~/truth", self._on_truth, depth)
        self.subscribe(PointCloud2, "~/tracks", self._on_tracks, depth=100)
        self.every(LOOK_PERIOD_S, self._look_for_end)

    def _on_truth(self, msg: Any) -> None:
        reading = self.kind.read(msg, self.layout.axes, "block_diagonal")
        tracks = screened_tracks(self, reading.tracks, self.layout)
        self.evaluation.add_truth(tracks, stamp_to_ns(msg.header.stamp))
        self._check()

    def _on_tracks(self, msg: Any) -> None:
        arrival_ns, stamp_ns = self.now_ns(), stamp_to_ns(msg.header.stamp)
        tracks = screened_tracks(self, track_table_from_msg(msg), self.layout)
        self.evaluation.add_tracks(stamp_ns, tracks, arrival_ns)
        self._check()

    def _check(self) -> None:
        self._heard_s, times = time.monotonic(), self.evaluation.times
        if not self._warned and times >= self._look_at and self.evaluation.is_overconfident():
            self._warned = True
            self.log.warning(
                "The estimator is overconfident: its errors are larger than its covariance says "
                f"(ANEES {self.evaluation.consistency().anees:.2f})."
            )
        if times >= self._look_at:
            self._look_at = times + 1 + times // 10  # all samples are looked at anew: not at every one
        self.finished = self.kind.whole_scan and self._has_all()

    def _has_all(self) -> bool:
        return 0 < self.params.steps <= self.evaluation.times

    def _look_for_end(self) -> None:
        """End when the truth has: all its pieces are here, or nobody is there to send more."""
        there = self.count_publishers(self._truth.topic_name) > 0
        self._had_truth |= there
        gone = bool(self.params.steps) and self._had_truth and not there
        silent = self.active and self.released and time.monotonic() - self._heard_s > SILENCE_S
        self.finished |= silent and (gone or self._has_all())

    def close(self) -> None:
        """Write the result."""
        result = self.evaluation.result()
        if result["times"] < self.params.steps or result["unjudged"]:
            times = f"{result['times']} of {self.params.steps or 'the'} times were judged"
            self.log.warning(f"{times}; {result['unjudged']} samples could not be.")
        text = json.dumps(result, indent=1, allow_nan=False)
        if self.params.output:
            Path(self.params.output).write_text(text + "\n")
        else:
            print(text)

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Report the consistency so far, and what could not be judged."""
        consistency, unjudged = self.evaluation.consistency(), self.evaluation.unjudged
        warnings = ["overconfident"] if self.evaluation.is_overconfident() else []
        if self.evaluation.is_incomplete:
            warnings.append(f"{unjudged} samples could not be judged for want of the truth")
        if foreign := self._other_types():
            warnings.append(foreign)
        values = {"times": self.evaluation.times, "anees": consistency.anees, "anees_high": consistency.high}
        return warnings, values | {"unjudged": unjudged}

    def _other_types(self) -> str:
        """Name a publisher of the truth that cannot be heard, its type being another."""
        offers = self.get_publishers_info_by_topic(self._truth.topic_name) if self._truth else []
        other = next((o.topic_type for o in offers if o.topic_type != self.kind.message), "")
        if not other:
            return ""
        text = f"~/truth is published as {other}, but truth_type is '{self.params.truth_type}'"
        if not self._foreign:
            self.log.warning(f"{text}: none of it is read.")
        self._foreign = other
        return text


def main() -> None:
    """Run the node."""
    end(run(lambda: EvaluatorNode("evaluator")))


if __name__ == "__main__":
    main()
