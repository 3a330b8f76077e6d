"""Odometry read from its bytes is Odometry read from its class, bit for bit."""

import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message

from msg_adapters.arrays import MessageError
from msg_adapters.header import make_header
from msg_adapters.odometry import odometry_from_msg
from msg_adapters.odometry_raw import odometry_from_raw

AXES = [("x", "y", "vx", "vy"), ("x", "y"), ("vx", "vy"), ("x", "y", "z", "yaw", "vx", "vy", "vz", "turn_rate")]

KINDS = ["turned", "bad", "identity", "nan"]


def message(rng, frame, child, stamp_ns, kind):
    msg = Odometry(header=make_header(stamp_ns, frame), child_frame_id=child)
    p, q, v, w = msg.pose.pose.position, msg.pose.pose.orientation, msg.twist.twist.linear, msg.twist.twist.angular
    p.x, p.y, p.z, v.x, v.y, v.z, w.x, w.y, w.z = rng.normal(size=9).tolist()
    turn = rng.normal(size=4)
    turn *= {"turned": 1 / np.linalg.norm(turn), "bad": 3 / np.linalg.norm(turn), "identity": 0.0, "nan": np.nan}[kind]
    q.x, q.y, q.z, q.w = [0.0, 0.0, 0.0, 1.0] if kind == "identity" else turn.tolist()
    for covariance in (msg.pose, msg.twist):
        covariance.covariance = rng.normal(size=36) * 10.0 ** rng.integers(-5, 5)
    return msg


def read(msg, axes, cross_block):
    """Read by the class: the tracks, or the reason."""
    try:
        return odometry_from_msg(msg, axes, cross_block)
    except MessageError as error:
        return error.reason, str(error)


@given(
    seed=st.integers(0, 10**6), axes=st.sampled_from(AXES),
    cross_block=st.sampled_from(["block_diagonal", "conservative"]),
    rows=st.lists(
        st.tuples(st.text(max_size=9), st.text(max_size=9), st.integers(-1, 1), st.sampled_from(KINDS)),
        max_size=8,
    ),
)  # fmt: skip
def test_the_bytes_say_what_the_class_says(seed, axes, cross_block, rows):
    rng = np.random.default_rng(seed)
    names = [(frame.replace("\0", ""), child.replace("\0", ""), t, kind) for frame, child, t, kind in rows]
    messages = [message(rng, frame, child, 10**18 + 7 * t, kind) for frame, child, t, kind in names]
    reading = odometry_from_raw([serialize_message(m) for m in messages], axes, cross_block)
    wanted = [read(m, axes, cross_block) for m in messages]
    errors = sorted((w[0], w[1]) for w in wanted if isinstance(w[0], str))
    assert sorted((e.reason, str(e)) for e in reading.errors) == errors
    good = [w for w in wanted if not isinstance(w[0], str)]
    assert reading.supplied == sum(w.cross_block_absent for w in good)
    groups = {}
    for one in good:
        groups.setdefault((int(one.tracks.time_ns[0]), one.tracks.frame_id), []).append(one.tracks)
    assert [(s.stamp_ns, s.frame_id) for s in reading.scans] == list(groups) or len(errors)
    assert {(s.stamp_ns, s.frame_id) for s in reading.scans} == set(groups)
    for scan in reading.scans:
        parts = groups[scan.stamp_ns, scan.frame_id]
        for field in dataclasses.fields(scan.tracks):
            value = getattr(scan.tracks, field.name)
            if isinstance(value, np.ndarray):
                whole = np.concatenate([getattr(part, field.name) for part in parts])
                assert (value.dtype, value.tobytes()) == (whole.dtype, whole.tobytes()), field.name
            else:
                assert value == getattr(parts[0], field.name)


def test_big_endian_bytes_are_read():
    data = struct.pack(">BBBBiII", 0, 0, 0, 0, 5, 6, 4) + b"map\0" + struct.pack(">I", 3) + b"t7\0\0"
    data += b"\0" * (-(len(data) - 4) % 8) + np.arange(85.0).astype(">f8").tobytes()
    (scan,) = odometry_from_raw([data], ("x", "y")).scans
    assert (scan.stamp_ns, scan.frame_id, scan.tracks.track_id.tolist()) == (5_000_000_006, "map", [7])
    assert scan.tracks.mean[0, 0].tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: b"\0\7" + data[2:], "unknown_encoding"),
        (lambda data: data[:-8], "truncated_message"),
        (lambda data: data[:10], "truncated_message"),
        (lambda data: data[:12] + b"\xff\xff\xff\x7f" + data[16:], "truncated_message"),
        (lambda data: data[:16] + b"\xff" + data[17:], "truncated_message"),
        (lambda data: b"", "unknown_encoding"),
    ],
)
def test_what_is_no_odometry_is_told_and_harms_no_other(change, reason):
    good = serialize_message(message(np.random.default_rng(0), "map", "track_1", 10**18, "turned"))
    reading = odometry_from_raw([change(good), good], ("x", "y"))
    assert [e.reason for e in reading.errors] == [reason]
    assert [len(s.tracks.track_id) for s in reading.scans] == [1]
