import numpy as np
import pytest
from adapters.clouds import STAMP, make_tracks
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.arrays import MessageError
from msg_adapters.diagnostics import WARN, diagnostic_array
from msg_adapters.markers import markers_to_msg
from msg_adapters.pose import pose_from_msg


def pose() -> PoseWithCovarianceStamped:
    msg = PoseWithCovarianceStamped()
    msg.header.frame_id = "map"
    msg.header.stamp.nanosec = 9
    msg.pose.pose.position.x, msg.pose.pose.position.y, msg.pose.pose.position.z = 1.0, 2.0, 3.0
    msg.pose.covariance = np.arange(36, dtype=float)
    return msg


def test_a_pose_is_a_track_with_a_position() -> None:
    tracks = pose_from_msg(pose(), ("z", "x"), track_id=5)
    assert (tracks.axes, tracks.frame_id, tracks.track_id.tolist(), tracks.time_ns.tolist()) == (
        ("z", "x"), "map", [5], [9],
    )  # fmt: skip
    assert tracks.mean.tolist() == [[[3.0, 1.0]]]
    assert tracks.cov.tolist() == [[[[14.0, 12.0], [2.0, 0.0]]]]  # asymmetric as it came


@pytest.mark.parametrize("axes", [("x", "vx"), ("yaw",), ()])
def test_a_pose_has_no_other_axes(axes: tuple[str, ...]) -> None:
    with pytest.raises(MessageError) as error:
        pose_from_msg(pose(), axes)
    assert error.value.reason == "missing_axis"


def kinds(msg: MarkerArray) -> list[tuple[str, int]]:
    return [(m.ns, m.type) for m in msg.markers[1:]]


def test_the_first_marker_deletes_the_old_ones_even_of_an_empty_scan() -> None:
    msg = markers_to_msg(make_tracks(0), ("x", "y", "vx", "vy"), STAMP)
    assert [m.action for m in msg.markers] == [Marker.DELETEALL]
    assert [m.action for m in markers_to_msg(make_tracks(2), ("x", "y", "vx", "vy"), STAMP).markers] == [
        Marker.DELETEALL, *[Marker.ADD] * 6,
    ]  # fmt: skip


def test_a_planar_track_is_an_ellipse_an_arrow_and_a_text() -> None:
    axes = ("x", "y", "vx", "vy")
    cov = np.diag([0.0, 0.0, 1.0, 1.0])
    turn = Rotation.from_euler("z", 0.4).as_matrix()[:2, :2]
    cov[:2, :2] = turn @ np.diag([9.0, 4.0]) @ turn.T
    tracks = make_tracks(1, 1, axes, mean=np.array([[[1.0, 2.0, 3.0, 4.0]]]), cov=cov[None, None],
                         track_id=np.array([2**32 - 1]))  # fmt: skip
    msg = markers_to_msg(tracks, axes, STAMP, horizon_s=0.5, namespace="fused/")
    assert kinds(msg) == [
        ("fused/covariance", Marker.CYLINDER), ("fused/velocity", Marker.ARROW), ("fused/id", Marker.TEXT_VIEW_FACING),
    ]  # fmt: skip
    ellipse, arrow, text = msg.markers[1:]
    assert sorted([ellipse.scale.x, ellipse.scale.y]) == pytest.approx([8.0, 12.0])  # 2 sigma to either side
    assert text.text == "4294967295"
    assert [(p.x, p.y) for p in arrow.points] == [(1.0, 2.0), (2.5, 4.0)]
    check_ellipsoid(ellipse, cov[:2, :2])


def check_ellipsoid(marker: Marker, cov: np.ndarray) -> None:
    """The surface of the drawn body lies at two standard deviations."""
    q = marker.pose.orientation
    size = len(cov)
    lengths = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    sphere = np.random.default_rng(0).normal(size=(50, 3))
    sphere[:, size:] = 0.0
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    surface = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(sphere * lengths / 2)[:, :size]
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", surface, np.linalg.inv(cov), surface), 4.0)


@pytest.mark.parametrize("seed", range(20))
def test_a_track_in_space_is_an_ellipsoid(seed: int) -> None:
    axes = ("vx", "z", "y", "x")
    tracks = make_tracks(3, 1, axes, seed)
    msg = markers_to_msg(tracks, axes, STAMP)
    assert kinds(msg)[:2] == [("covariance", Marker.SPHERE), ("id", Marker.TEXT_VIEW_FACING)]  # no vy, no arrow
    for k in range(3):
        check_ellipsoid(msg.markers[1 + 2 * k], tracks.cov[k, 0][1:, 1:][::-1, ::-1])


def test_a_tracks_markers_bear_its_number_from_scan_to_scan() -> None:
    """All 2^32 numbers fit, each another one."""
    axes, numbers = ("x", "y", "vx", "vy"), [7, 2**31 - 1, 2**31, 2**32 - 1]
    drawn = [markers_to_msg(make_tracks(4, track_id=np.array(ids)), axes, STAMP) for ids in (numbers, numbers[::-1])]
    told = [{m.text: m.id for m in msg.markers if m.text} for msg in drawn]
    assert told[0] == told[1] == {"7": 7, str(2**31 - 1): 2**31 - 1, str(2**31): -(2**31), str(2**32 - 1): -1}
    assert {m.id for m in drawn[0].markers[1:]} == set(told[0].values())


def test_tracks_that_cannot_be_drawn_are_left_out() -> None:
    tracks = make_tracks(3)
    tracks.cov[1, 0, 0, 0] = np.nan
    msg = markers_to_msg(tracks, ("x", "y", "vx", "vy"), STAMP)
    assert [m.text for m in msg.markers if m.text] == [str(tracks.track_id[0]), str(tracks.track_id[2])]
    with pytest.raises(ValueError, match="must include x and y"):
        markers_to_msg(make_tracks(1, 1, ("range",)), ("range",), STAMP)


def test_markers_pass_the_wire_and_tell_the_status() -> None:
    tracks = make_tracks(3, status=np.array([0, 1, 3], np.uint8))
    tracks.cov[0] = 0.0  # a particle cloud's component; RViz wants no scale of 0
    msg = markers_to_msg(tracks, ("x", "y", "vx", "vy"), STAMP, lifetime_s=1.5)
    back = deserialize_message(serialize_message(msg), MarkerArray)
    assert msg._check_fields
    ellipses = [m for m in back.markers if m.ns == "covariance"]
    assert len({(m.color.r, m.color.g, m.color.b) for m in ellipses}) == 3
    assert len({(m.ns, m.id) for m in back.markers[1:]}) == 9
    assert min(m.scale.x for m in ellipses) > 0
    assert (back.markers[1].lifetime.sec, back.markers[1].lifetime.nanosec) == (1, 500_000_000)
    assert {m.header.frame_id for m in back.markers} == {"map"}


def test_a_diagnostic_status() -> None:
    msg = diagnostic_array(
        STAMP, "/fusion_centre", WARN, "late", {"age [s]": 0.1234567891, "rejected": 3, "rule": "ci", "ok": True}
    )
    back = deserialize_message(serialize_message(msg), DiagnosticArray)
    (status,) = back.status
    assert (status.name, status.message, status.level) == ("/fusion_centre", "late", b"\x01")
    assert [(v.key, v.value) for v in status.values] == [
        ("age [s]", "0.123457"), ("rejected", "3"), ("rule", "ci"), ("ok", "True"),
    ]  # fmt: skip
    assert back.header.stamp.nanosec == STAMP % 10**9
    assert diagnostic_array(0, "n", b"\x02", "", {}).status[0].level == b"\x02"


@pytest.mark.parametrize("level", [4, -1, b"", b"\x07", b"\x00\x01"])
def test_levels_that_do_not_exist(level: int | bytes) -> None:
    with pytest.raises(ValueError, match="must be 0"):
        diagnostic_array(0, "n", level, "", {})
