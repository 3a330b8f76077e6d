"""1000 tracks in a message: track table against one Odometry a track, to and from a validated batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from benchmark.measure import Result, race
from msg_adapters.odometry import odometry_from_msg, odometry_to_msgs
from msg_adapters.track_table import track_table_from_msg, track_table_to_msg
from track_fusion.tracks import StateLayout, TrackBatch

TRACKS = 1000
STAMP_NS = 1_000_000_000


def _validated(arrays) -> TrackBatch:
    fields = {name: value for name, value in vars(arrays).items() if name != "axes"}
    batch, rejected = TrackBatch.screened(layout=StateLayout(arrays.axes), **fields)
    assert not rejected
    return batch


def _from_odometry(messages, axes) -> TrackBatch:
    """Read each message, then validate all together: the fairest way to the same batch."""
    read = [odometry_from_msg(m, axes).tracks for m in messages]
    joined = {
        f.name: np.concatenate([getattr(a, f.name) for a in read])
        for f in dataclasses.fields(read[0])
        if isinstance(getattr(read[0], f.name), np.ndarray)
    }
    return _validated(dataclasses.replace(read[0], **joined))


def run() -> Iterator[Result]:
    rng = np.random.default_rng(0)
    layout = StateLayout(("x", "y", "vx", "vy"))
    factor = rng.normal(size=(TRACKS, 4, 4))
    cov = factor @ factor.swapaxes(1, 2) + np.eye(4)
    batch = TrackBatch.gaussian(layout, "map", rng.normal(size=(TRACKS, 4)), cov, time_ns=STAMP_NS)
    table = track_table_to_msg(batch, layout.axes, STAMP_NS)
    messages = odometry_to_msgs(batch, layout.axes)
    table_in, odometry_in = race(
        lambda: _validated(track_table_from_msg(table)),
        lambda: _from_odometry(messages, layout.axes),
    )
    yield Result("1000 tracks in, Odometry", odometry_in)
    yield Result("1000 tracks in, track table", table_in, "Odometry", odometry_in / table_in, at_least=50.0)
    table_out, odometry_out = race(
        lambda: track_table_to_msg(batch, layout.axes, STAMP_NS), lambda: odometry_to_msgs(batch, layout.axes)
    )
    yield Result("1000 tracks out, Odometry", odometry_out)
    yield Result("1000 tracks out, track table", table_out, "Odometry", odometry_out / table_out, at_least=50.0)
