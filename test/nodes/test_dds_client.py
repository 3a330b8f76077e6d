"""An independent DDS implementation (Eclipse Cyclone) reads what the centre publishes, and writes what it fuses.

The types are written down here from the message definitions, and the track table is decoded by struct: nothing of ROS
and nothing of the package stands between the wire and the numbers.
"""

# No postponed annotations here: the client reads those of its types.
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from nodes.support import PATIENT, START_S, STEP_S, clock, track_table
from ros_helpers import NodeProcess, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

pytest.importorskip("cyclonedds", reason="the independent DDS client is in the extra 'test'")
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

#: Discovery range LOCALHOST: on the loopback, without multicast, so by ports that are tried one by one.
CONFIGURATION = """<CycloneDDS><Domain>
  <General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
  <Discovery><Peers><Peer address="127.0.0.1"/></Peers>
    <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex></Discovery>
</Domain></CycloneDDS>"""
RELIABLE = Qos(Policy.Reliability.Reliable(max_blocking_time=10**9), Policy.History.KeepLast(100))
CODES = {2: "B", 6: "I", 8: "d"}  # PointField datatypes that a track table uses
MEANS = {"sensor_1": [10.0, -20.0, 1.5, 0.25], "sensor_2": [10.5, -19.0, 1.0, 0.5]}
COVS = {"sensor_1": np.diag([1.0, 2.0, 0.5, 0.25]) + 0.125, "sensor_2": np.diag([2.0, 1.0, 0.25, 0.5]) - 0.0625}
STAMP_NS = 5_250_000_000


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Field(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class Cloud(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[Field]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class Vector(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Vector  # a Point is laid out alike
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector
    angular: Vector


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odom(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@pytest.fixture
def participant(ros_domain: int) -> Iterator[DomainParticipant]:
    domain = Domain(ros_domain, CONFIGURATION)
    yield DomainParticipant(ros_domain)
    del domain


def reader(participant: DomainParticipant, topic: str, kind: type) -> DataReader:
    return DataReader(participant, Topic(participant, f"rt{topic}", kind, qos=RELIABLE), qos=RELIABLE)


def rows(cloud: Cloud) -> list[dict[str, float]]:
    """Decode a track table as doc/wire-format.md says."""
    data, order = bytes(cloud.data), ">" if cloud.is_bigendian else "<"
    return [
        {
            f.name: struct.unpack_from(order + CODES[f.datatype], data, row * cloud.point_step + f.offset)[0]
            for f in cloud.fields
        }
        for row in range(cloud.width)
    ]


def as_cloud(msg: PointCloud2) -> Cloud:
    """Put a message into the client's type."""
    stamp = Time(sec=msg.header.stamp.sec, nanosec=msg.header.stamp.nanosec)
    fields = [Field(name=f.name, offset=f.offset, datatype=f.datatype, count=f.count) for f in msg.fields]
    return Cloud(
        header=Header(stamp=stamp, frame_id=msg.header.frame_id), height=1, width=msg.width, fields=fields,
        is_bigendian=False, point_step=msg.point_step, row_step=msg.row_step, data=list(msg.data), is_dense=True,
    )  # fmt: skip


def naive_fusion() -> tuple[Any, Any]:
    """Fuse the two tracks by the sum of their information."""
    info = [np.linalg.inv(c) for c in COVS.values()]
    cov = np.linalg.inv(sum(info))
    return cov @ sum(i @ m for i, m in zip(info, MEANS.values(), strict=True)), cov


def test_an_independent_client_reads_and_writes_the_same_numbers(
    ros_context: Any, participant: DomainParticipant
) -> None:
    """Sensor 1 is published by rclpy, sensor 2 by the client; the client reads the fused track in both forms."""
    params = PATIENT | {"state_fusion": "naive", "confirmation_threshold": [1, 1]}
    with NodeProcess("fusion_centre", params=params), Probe(ros_context) as probe:
        tables = reader(participant, "/fusion_centre/tracks", Cloud)
        odometry = reader(participant, "/fusion_centre/odometry", Odom)
        topic = Topic(participant, "rt/fusion_centre/sources/sensor_2/tracks", Cloud, qos=RELIABLE)
        writer = DataWriter(participant, topic, qos=RELIABLE)
        first = probe.publisher("/fusion_centre/sources/sensor_1/tracks", PointCloud2)
        ticker = probe.publisher("/clock", Clock)
        matched = [tables.get_matched_publications, odometry.get_matched_publications, writer.get_matched_subscriptions]
        probe.wait_for(lambda: all(m() for m in matched), START_S, "the client to be matched")
        scans = {s: track_table(STAMP_NS, MEANS[s], COVS[s], ids=[7]) for s in MEANS}
        first.publish(scans["sensor_1"])
        writer.write(as_cloud(scans["sensor_2"]))
        taken: dict[str, list[Any]] = {"tables": [], "odometry": []}

        def arrived() -> bool:
            ticker.publish(clock(STAMP_NS))
            taken["tables"] += tables.take(10)
            taken["odometry"] += odometry.take(10)
            return all(taken.values())

        probe.wait_for(arrived, STEP_S, "the fused track at the client")
    check_table(taken["tables"])
    check_odometry(taken["odometry"])


def check_table(clouds: list[Cloud]) -> None:
    mean, cov = naive_fusion()
    (cloud,) = clouds
    (row,) = rows(cloud)
    assert (cloud.header.stamp.sec, cloud.header.stamp.nanosec, cloud.header.frame_id) == (5, 250_000_000, "map")
    assert (row["track_id"], row["status"], row["source"], row["weight"], row["existence"]) == (1, 1, 3, 1.0, 1.0)
    assert math.isinf(row.get("dof", math.inf))
    axes = [name for name in row if f"cov_{name}_{name}" in row]
    assert axes == ["x", "y", "vx", "vy"]
    np.testing.assert_allclose([row[a] for a in axes], mean, rtol=1e-12)
    got = [row[f"cov_{a}_{b}"] for i, a in enumerate(axes) for b in axes[i:]]
    np.testing.assert_allclose(got, cov[np.triu_indices(4)], rtol=1e-12, atol=1e-15)


def check_odometry(messages: list[Odom]) -> None:
    mean, cov = naive_fusion()
    (msg,) = messages
    assert (msg.header.stamp.sec, msg.header.stamp.nanosec, msg.header.frame_id) == (5, 250_000_000, "map")
    assert msg.child_frame_id == "1"
    position, speed, turn = msg.pose.pose.position, msg.twist.twist.linear, msg.pose.pose.orientation
    np.testing.assert_allclose([position.x, position.y, speed.x, speed.y], mean, rtol=1e-12)
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)
    for got, block in ((msg.pose.covariance, cov[:2, :2]), (msg.twist.covariance, cov[2:, 2:])):
        np.testing.assert_allclose(np.reshape(got, (6, 6))[:2, :2], block, rtol=1e-12, atol=1e-15)
