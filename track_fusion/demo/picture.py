"""The picture of a demonstration."""

from __future__ import annotations

import numpy as np

from msg_adapters.arrays import merged
from msg_adapters.track_table import track_table_from_msg
from track_fusion.bags.read import read_bag
from track_fusion.demo.plan import Demo
from track_fusion.demo.wiring import FUSED, TRUTH
from track_fusion.report.picture import Line, draw, draw_map

#: Of the sensors, and last of what is fused.
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:red")


def picture(demo: Demo) -> None:
    """Draw what the bag holds."""
    layout, sensors = demo.scene.layout, list(demo.scene.sensors)
    axes, at = layout.axes, list(layout.position)
    topics = {**{s: f"/{s}/tracks" for s in sensors}, "fused": FUSED}
    messages = read_bag(demo.out / "bag", (TRUTH, *topics.values()))
    states = np.concatenate([merged(track_table_from_msg(m), axes)[0][:, at] for m in messages[TRUTH]])
    lines = []
    for name, topic in topics.items():
        moments = [merged(track_table_from_msg(m), axes) for m in messages[topic]]
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
