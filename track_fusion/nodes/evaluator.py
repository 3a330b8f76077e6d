"""Evaluator node: truth and tracks in, RMSE and NEES with chi-square bounds out, as JSON at the end."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from msg_adapters.header import stamp_to_ns
from msg_adapters.odometry import odometry_from_msg
from msg_adapters.track_table import track_table_from_msg
from track_fusion.metrics.evaluation import Evaluation, EvaluationParams
from track_fusion.nodes.managed import ManagedNode
from track_fusion.nodes.process import end, run
from track_fusion.nodes.ros_params import declare
from track_fusion.nodes.screening import FrameParams, screened_tracks
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class EvaluatorParams(Params):
    """What becomes of the result."""

    output: str = param("", "write the result to this JSON file at the end; empty: print it")
    steps: int = param(0, "end after so many evaluated times; 0: run until told to end", low=0)


class EvaluatorNode(ManagedNode):
    """Carries messages to a :class:`track_fusion.metrics.evaluation.Evaluation`."""

    def declare_parameters_(self) -> None:
        """Declare parameters."""
        self.frame, self.params = declare(self, FrameParams), declare(self, EvaluatorParams)
        self.layout = self.frame.layout
        self._evaluation_params = declare(self, EvaluationParams)
        self.finished = False
        self.on_clock_jump()

    def on_clock_jump(self) -> None:
        """Begin to judge anew: the same stamps will come again."""
        self.evaluation = Evaluation(self.layout, self._evaluation_params)
        self._warned, self._look_at = False, 1

    def connect(self) -> None:
        """Create the topics."""
        self.subscribe(Odometry, "~/truth", self._on_truth, depth=100)
        self.subscribe(PointCloud2, "~/tracks", self._on_tracks, depth=100)

    def _on_truth(self, msg: Any) -> None:
        reading = odometry_from_msg(msg, self.layout.axes)
        self.evaluation.add_truth(screened_tracks(self, reading.tracks, self.layout))
        self._check()

    def _on_tracks(self, msg: Any) -> None:
        stamp_ns = stamp_to_ns(msg.header.stamp)
        self.evaluation.add_tracks(stamp_ns, screened_tracks(self, track_table_from_msg(msg), self.layout))
        self._check()

    def _check(self) -> None:
        times = self.evaluation.times
        if not self._warned and times >= self._look_at and self.evaluation.is_overconfident():
            self._warned = True
            self.log.warning(
                "The estimator is overconfident: its errors are larger than its covariance says "
                f"(ANEES {self.evaluation.consistency().anees:.2f})."
            )
        if times >= self._look_at:
            self._look_at = times + 1 + times // 10  # all samples are looked at anew: not at every one
        self.finished = bool(self.params.steps) and times >= self.params.steps

    def close(self) -> None:
        """Write the result."""
        result = self.evaluation.result()
        text = json.dumps(result, indent=1, allow_nan=False)
        if self.params.output:
            Path(self.params.output).write_text(text + "\n")
        else:
            print(text)

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Report the consistency so far."""
        consistency = self.evaluation.consistency()
        overconfident = self.evaluation.is_overconfident()
        values = {"times": self.evaluation.times, "anees": consistency.anees, "anees_high": consistency.high}
        return (["overconfident"] if overconfident else []), values


def main() -> None:
    """Run the node."""
    end(run(lambda: EvaluatorNode("evaluator")))


if __name__ == "__main__":
    main()
