"""The picture of a demonstration."""

from __future__ import annotations

import numpy as np

from msg_adapters.track_table import track_table_from_msg
from track_fusion.bags.read import read_bag
from track_fusion.demo.plan import Demo
from track_fusion.demo.wiring import FUSED, TRUTH
from track_fusion.report.picture import Line, draw, draw_map
from track_fusion.tracks import TrackBatch

#: Of the sensors, and last of what is fused.
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:red")


def picture(demo: Demo) -> None:
    """Draw what the bag holds."""
    layout, sensors = demo.scene.layout, list(demo.scene.sensors)
    at = list(layout.position)
    topics = {**{s: f"/{s}/tracks" for s in sensors}, "fused": FUSED}
    messages = read_bag(demo.out / "bag", (TRUTH, *topics.values()))
    told = {t: [TrackBatch(layout=layout, **track_table_from_msg(m).columns) for m in messages[t]] for t in messages}
    states = np.concatenate([truth.moments[0][:, at] for truth in told[TRUTH]])
    lines = []
    for name, topic in topics.items():
        moments = [tracks.moments for tracks in told[topic]]
        mean = np.concatenate([m[:, at] for m, _ in moments])
        cov = np.concatenate([c[:, at][..., at] for _, c in moments])
        label = f"fused: {demo.rules[-1].replace('_', ' ')}" if name == "fused" else name.replace("_", " ")
        lines.append(Line(label, COLORS[list(topics).index(name) if name != "fused" else -1], mean, cov))
    truth = Line("truth", "black", states)
    what = "fused over ROS 2" if demo.many_targets else "fused over ROS 2 and fed back to the trackers"
    title = f"{demo.scenario.title}: {what} (one run)"
    if demo.many_targets:
        draw_map(demo.out / "tracks.png", title, [truth, *lines])
    else:
        draw(demo.out / "tracks.png", title, truth, lines)
