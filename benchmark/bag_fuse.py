"""A bag fused without ROS: seconds of bag a second, with 3 sources of 100 tracks each at ten scans a second."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmark.measure import Result
from msg_adapters.track_table import track_table_to_msg
from track_fusion.bags.fuse import TABLE, centre_of, fuse_bag
from track_fusion.bags.write import add_topic, bag_class, create_bag, serialised
from track_fusion.tracks import SECOND_NS, TrackBatch, planar_layout

SOURCES, TRACKS, STEPS = 3, 100, 300
PERIOD_NS = SECOND_NS // 10
ROUNDS = 7


def run() -> Iterator[Result]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bag, params = _bag(folder / "bag"), _params(folder / "centre.yaml")
        took_s = min(_took_s(bag, params, folder / f"out_{k}") for k in range(ROUNDS))
    bag_s = STEPS * PERIOD_NS / SECOND_NS
    yield Result(f"{bag_s:g} s of bag, {SOURCES} x {TRACKS} tracks, 10 Hz", took_s, "real time", bag_s / took_s, 30.0)


def _took_s(bag: Path, params: Path, out: Path) -> float:
    began = time.process_time()
    outcome = fuse_bag(bag, centre_of(params, print), out)
    assert (outcome.messages, sum(outcome.rejected.values())) == (SOURCES * STEPS, 0)
    assert outcome.steps >= STEPS - 1
    return time.process_time() - began


def _params(path: Path) -> Path:
    topics = "".join(f"    s{k}.topic: /s{k}/tracks\n" for k in range(SOURCES))
    names = ", ".join(f"s{k}" for k in range(SOURCES))
    path.write_text(
        f"fusion_centre:\n  ros__parameters:\n    source_configurations: [{names}]\n{topics}    trigger: all_sources\n"
    )
    return path


def _bag(path: Path) -> Path:
    """Targets 50 m apart that move straight; each source errs as its covariance says."""
    rng, layout = np.random.default_rng(0), planar_layout()
    home = np.stack([50.0 * (np.arange(TRACKS) % 10), 50.0 * (np.arange(TRACKS) // 10)], -1)
    mean = np.concatenate([home, rng.normal(0, 1, (TRACKS, 2))], 1)
    sd = np.array([0.5, 0.5, 0.2, 0.2])
    writer = create_bag(path, "mcap")
    topics = [add_topic(writer, f"/s{k}/tracks", TABLE) for k in range(SOURCES)]
    for step in range(1, STEPS + 1):
        mean[:, :2] += PERIOD_NS / SECOND_NS * mean[:, 2:]
        stamp_ns = step * PERIOD_NS
        for k, topic in enumerate(topics):
            cov = np.tile(np.diag(sd**2), (TRACKS, 1, 1))
            batch = TrackBatch.gaussian(layout, "map", mean + sd * rng.normal(size=mean.shape), cov, time_ns=stamp_ns)
            msg = track_table_to_msg(batch, layout.axes, stamp_ns, bag_class)
            writer.write(topic, stamp_ns + (k + 1) * 1_000_000, serialised(msg))
    writer.close()
    return path
