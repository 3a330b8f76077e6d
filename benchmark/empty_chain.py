"""The processes of a scenario with callbacks that only pass a message of the usual size on.

`python -m benchmark.empty_chain sensor_tracker|fusion_centre ...` starts the real node with its work taken out.
"""

from __future__ import annotations

import sys

import numpy as np

from msg_adapters.track_table import track_table_to_msg
from track_fusion.nodes.fusion_centre import FusionCentreNode
from track_fusion.nodes.process import end, run
from track_fusion.nodes.sensor_tracker import SensorTrackerNode
from track_fusion.tracks import TrackBatch, planar_layout


def canned():
    """A track table with one track."""
    batch = TrackBatch.gaussian(planar_layout(), "map", np.zeros((1, 4)), np.eye(4)[None])
    return track_table_to_msg(batch, batch.layout.axes, 0)


class EmptyTracker(SensorTrackerNode):
    """Answers a detection once the feedback of the one before is there."""

    def connect(self):
        self._message, self._waiting, self._free = canned(), None, True
        super().connect()

    def _on_detections(self, msg):
        self._waiting = msg.header.stamp
        self._pass_on()

    def _on_feedback(self, msg):
        self._free = True
        self._pass_on()

    def _pass_on(self):
        if self._free and self._waiting is not None:
            self._message.header.stamp, self._waiting, self._free = self._waiting, None, False
            self._tracks.publish(self._message)


class EmptyCentre(FusionCentreNode):
    """Answers when a message of each source is there."""

    def connect(self):
        self._message, self._there = canned(), set()
        super().connect()

    def _take(self, source, msg):
        self._there.add(source)
        if len(self._there) == len(self.messages.sources):
            self._there.clear()
            self._message.header.stamp = msg.header.stamp
            self._tracks.publish(self._message)


if __name__ == "__main__":
    role = sys.argv.pop(1)
    node = {"sensor_tracker": EmptyTracker, "fusion_centre": EmptyCentre}[role]
    end(run(lambda: node(role)))
