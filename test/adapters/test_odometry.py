import zlib

import numpy as np
import pytest
from adapters.clouds import STAMP, make_tracks
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation

from msg_adapters.arrays import MessageError
from msg_adapters.odometry import UNOBSERVED_VARIANCE, odometry_from_msg, odometry_to_msgs, track_id_of

AXES = ("x", "y", "z", "yaw", "vx", "vy", "vz", "turn_rate")
PLANE = ("x", "y", "vx", "vy")


def message(*, pose: np.ndarray | None = None, twist: np.ndarray | None = None, **orientation: float) -> Odometry:
    """Position (1, 2, 3), velocity (4, 5, 6), angular velocity (7, 8, 9), given covariances."""
    msg = Odometry(child_frame_id="track_7")
    msg.header.frame_id = "map"
    msg.header.stamp.sec = 5
    for target, values in ((msg.pose.pose.position, (1.0, 2.0, 3.0)), (msg.twist.twist.linear, (4.0, 5.0, 6.0)),
                           (msg.twist.twist.angular, (7.0, 8.0, 9.0))):  # fmt: skip
        target.x, target.y, target.z = values
    for key, value in orientation.items():
        setattr(msg.pose.pose.orientation, key, value)
    rng = np.random.default_rng(3)
    msg.pose.covariance = rng.normal(size=36) if pose is None else pose.ravel()
    msg.twist.covariance = rng.normal(size=36) if twist is None else twist.ravel()
    return msg


def reason(msg: Odometry, axes: tuple[str, ...] = PLANE) -> str:
    with pytest.raises(MessageError) as error:
        odometry_from_msg(msg, axes)
    return error.value.reason


@given(st.lists(st.sampled_from(AXES), min_size=1, max_size=8, unique=True), st.integers(0, 3), st.integers(0, 99))
def test_all_but_the_cross_block_comes_back(axes: list[str], count: int, seed: int) -> None:
    # Lone horizontal velocities would be mixed with an unknown one by the orientation.
    if "yaw" in axes and ("vx" in axes) != ("vy" in axes):
        axes = [a for a in axes if a != "yaw"] or ["x"]
    tracks = make_tracks(count, 1, axes, seed)
    tracks.mean[..., [a == "yaw" for a in axes]] %= np.pi
    msgs = odometry_to_msgs(tracks, axes, "track_")
    assert len(msgs) == count
    twist = np.array([a in ("vx", "vy", "vz", "turn_rate") for a in axes])
    for k, msg in enumerate(msgs):
        assert msg.child_frame_id == f"track_{tracks.track_id[k]}"
        back, absent = odometry_from_msg(deserialize_message(serialize_message(msg), Odometry), axes)
        assert absent == (twist.any() and not twist.all())
        assert (back.track_id.tolist(), back.time_ns.tolist()) == ([tracks.track_id[k]], [STAMP])
        assert (back.axes, back.frame_id) == (tuple(axes), "map")
        np.testing.assert_allclose(back.mean[0, 0], tracks.mean[k, 0], atol=1e-12)
        want = np.where(twist[:, None] == twist, tracks.cov[k, 0], 0.0)
        np.testing.assert_allclose(back.cov[0, 0], want, atol=1e-9)


def test_what_the_track_does_not_say_is_vague_and_the_orientation_identity() -> None:
    tracks = make_tracks(1)
    (msg,) = odometry_to_msgs(tracks, PLANE)
    pose, twist = msg.pose.covariance.reshape(6, 6), msg.twist.covariance.reshape(6, 6)
    np.testing.assert_array_equal(pose[:2, :2], tracks.cov[0, 0, :2, :2])
    np.testing.assert_array_equal(twist[:2, :2], tracks.cov[0, 0, 2:, 2:])
    for block in (pose, twist):
        np.testing.assert_array_equal(block[2:, 2:], UNOBSERVED_VARIANCE * np.eye(4))
        assert not block[:2, 2:].any()
    q = msg.pose.pose.orientation
    assert (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 1.0)
    assert msg._check_fields
    (flat,) = odometry_to_msgs(tracks, PLANE, unobserved_variance=0.0)
    assert not flat.pose.covariance.reshape(6, 6)[2:].any()


def test_with_yaw_the_twist_is_in_the_child_frame() -> None:
    axes = ("x", "y", "yaw", "vx", "vy")
    tracks = make_tracks(1, 1, axes, mean=np.array([[[0.0, 0.0, np.pi / 2, 0.0, 3.0]]]),
                         cov=np.diag([1.0, 1.0, 0.01, 4.0, 9.0])[None, None])  # fmt: skip
    (msg,) = odometry_to_msgs(tracks, axes)  # drives north, heads north: forward
    assert msg.twist.twist.linear.x == pytest.approx(3.0)
    assert msg.twist.twist.linear.y == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(msg.twist.covariance.reshape(6, 6)[:2, :2], np.diag([9.0, 4.0]), atol=1e-12)


@pytest.mark.parametrize("angles", [(0.0, 0.0, np.pi / 2), (0.3, -0.5, 2.0), (0.0, 0.0, -3.1)])
def test_a_body_twist_and_its_covariance_are_turned_into_the_parent_frame(angles: tuple[float, ...]) -> None:
    rotation = Rotation.from_euler("xyz", angles)
    x, y, z, w = rotation.as_quat()
    root = np.random.default_rng(0).normal(size=(6, 6))
    msg = message(twist=root @ root.T, x=x, y=y, z=z, w=w)
    axes = ("vx", "vy", "vz", "turn_rate", "yaw")
    back = odometry_from_msg(msg, axes).tracks
    np.testing.assert_allclose(back.mean[0, 0, :3], rotation.apply([4.0, 5.0, 6.0]))
    assert back.mean[0, 0, 3] == pytest.approx(rotation.apply([7.0, 8.0, 9.0])[2])
    assert back.mean[0, 0, 4] == pytest.approx(angles[2])
    # The spread of turned samples is the turned covariance: its square root, column by column.
    sampled = np.vstack([rotation.apply(root[:3].T).T, rotation.apply(root[3:].T).T[2:]])
    np.testing.assert_allclose(back.cov[0, 0, :4, :4], sampled @ sampled.T, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_an_unknown_that_is_not_asked_for_spoils_nothing(angle: float) -> None:
    pose, twist = np.eye(6), np.eye(6)
    pose[3, 3] = twist[3, 3] = twist[5, 5] = np.inf
    back = odometry_from_msg(message(pose=pose, twist=twist, z=np.sin(angle), w=np.cos(angle)), PLANE).tracks
    np.testing.assert_allclose(back.cov[0, 0], np.eye(4), atol=1e-12)
    twist[2, 2] = np.nan
    level = odometry_from_msg(message(twist=twist), ("vx", "vy")).tracks
    np.testing.assert_array_equal(level.cov[0, 0], np.eye(2))


def test_a_twist_in_the_parent_frame_is_left_alone() -> None:
    half = np.sqrt(0.5)
    back = odometry_from_msg(message(z=half, w=half), ("vx", "vy"), twist_frame="parent").tracks
    assert back.mean[0, 0].tolist() == [4.0, 5.0]


def test_covariances_come_bit_by_bit_asymmetric_ones_too() -> None:
    msg = message()
    back = odometry_from_msg(msg, ("x", "z", "vy")).tracks
    pose, twist = msg.pose.covariance, msg.twist.covariance
    assert back.cov[0, 0].tolist() == [[pose[0], pose[2], 0.0], [pose[12], pose[14], 0.0], [0.0, 0.0, twist[7]]]
    assert pose[2] != pose[12]
    assert back.mean[0, 0].tolist() == [1.0, 3.0, 5.0]
    msg.twist.covariance[7] = np.nan
    assert np.isnan(odometry_from_msg(msg, ("x", "vy")).tracks.cov[0, 0, 1, 1])


@pytest.mark.parametrize(
    ("axes", "absent"), [(("x", "y"), False), (("vx", "vy"), False), (("x", "vx"), True), (("yaw", "turn_rate"), True)]
)
def test_the_absent_cross_block_is_told(axes: tuple[str, ...], absent: bool) -> None:
    assert odometry_from_msg(message(), axes).cross_block_absent is absent


def test_conservative_needs_no_inflation_where_no_block_is_absent() -> None:
    plain = odometry_from_msg(message(), ("x", "y")).tracks
    np.testing.assert_array_equal(odometry_from_msg(message(), ("x", "y"), "conservative").tracks.cov, plain.cov)


def blocks(seed: int) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    a, b = (m @ m.T * 10.0 ** rng.uniform(-2, 2) for m in rng.normal(size=(2, 3, 3)))
    return a, b, rng


def bound(a: np.ndarray, b: np.ndarray, weight: float, cross_block: str = "conservative") -> np.ndarray:
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    pose[:3, :3], twist[:3, :3] = a, b
    axes = ("x", "y", "z", "vx", "vy", "vz")
    cov = odometry_from_msg(message(pose=pose, twist=twist), axes, cross_block, cross_weight=weight).tracks.cov
    return cov[0, 0]


@pytest.mark.parametrize("weight", [0.5, 0.2, 0.9])
@pytest.mark.parametrize("seed", range(5))
def test_conservative_bounds_every_admissible_cross_block(weight: float, seed: int) -> None:
    a, b, rng = blocks(seed)
    inflated = bound(a, b, weight)
    root_a, root_b = np.linalg.cholesky(a), np.linalg.cholesky(b)
    for _ in range(200):
        contraction = rng.normal(size=(3, 3))
        contraction /= np.linalg.norm(contraction, 2) / rng.choice([1.0, rng.uniform()])  # spectral norm <= 1
        cross = root_a @ contraction @ root_b.T
        joint = np.block([[a, cross], [cross.T, b]])
        scale = np.sqrt(np.diag(joint))
        assert np.linalg.eigvalsh(joint / np.outer(scale, scale)).min() > -1e-9  # it is admissible
        assert np.linalg.eigvalsh((inflated - joint) / np.outer(scale, scale)).min() > -1e-9


def test_the_weight_of_conservative_is_that_of_the_pose() -> None:
    a, b, _ = blocks(0)
    np.testing.assert_allclose(bound(a, b, 0.2), np.block([[5 * a, 0 * a], [0 * a, 1.25 * b]]))


@pytest.mark.parametrize("weight", [0.5, 0.2, 0.9])
def test_conservative_is_tight(weight: float) -> None:
    a, b, _ = blocks(11)
    cross = np.linalg.cholesky(a) @ np.linalg.cholesky(b).T  # perfectly correlated
    joint = np.block([[a, cross], [cross.T, b]])
    scale = np.sqrt(np.diag(joint))
    gap = np.linalg.eigvalsh((bound(a, b, weight) - joint) / np.outer(scale, scale))
    np.testing.assert_allclose(gap[:3], 0.0, atol=1e-9)  # it touches, in three directions
    shaved = bound(a, b, weight) * (1 - 1e-6)
    assert np.linalg.eigvalsh((shaved - joint) / np.outer(scale, scale)).min() < -1e-9


def test_block_diagonal_is_the_blocks_and_not_conservative() -> None:
    a, b, _ = blocks(11)
    plain = bound(a, b, 0.5, "block_diagonal")
    np.testing.assert_array_equal(plain, np.block([[a, 0 * a], [0 * a, b]]))
    cross = 0.1 * np.linalg.cholesky(a) @ np.linalg.cholesky(b).T
    assert np.linalg.eigvalsh(plain - np.block([[a, cross], [cross.T, b]])).min() < 0


@pytest.mark.parametrize(
    ("name", "number"),
    [("7", 7), ("track_7", 7), ("robot1/track_12", 12), ("track12", 12), ("0", 0), ("4294967295", 2**32 - 1),
     ("map-3", 3)],
)  # fmt: skip
def test_numbered_names(name: str, number: int) -> None:
    assert track_id_of(name) == number


@pytest.mark.parametrize("name", ["base_link", "4294967296", "a3f9", "f00d-9a7e81", "track_٣", "9" * 5000])
def test_other_names_give_a_stable_hash(name: str) -> None:
    assert track_id_of(name) == zlib.crc32(name.encode())
    assert 0 <= track_id_of(name) < 2**32


def test_a_given_prefix_decides() -> None:
    assert track_id_of("left_1", "left_") == 1
    assert track_id_of("right_1", "left_") == zlib.crc32(b"right_1")
    assert track_id_of("left_", "left_") == zlib.crc32(b"left_")
    assert odometry_from_msg(message(), PLANE, child_prefix="other_").tracks.track_id[0] == zlib.crc32(b"track_7")


def test_the_hash_is_the_documented_one() -> None:
    assert track_id_of("123456789x") == zlib.crc32(b"123456789x")
    assert zlib.crc32(b"123456789") == 0xCBF43926  # the published check value of CRC-32


def test_messages_that_cannot_be_read() -> None:
    assert reason(message(), ("x", "ax")) == "missing_axis"
    assert reason(message(), ()) == "missing_axis"
    nameless = message()
    nameless.child_frame_id = ""
    assert reason(nameless) == "missing_child_frame"


@pytest.mark.parametrize("w", [0.0, np.nan, 2.0, np.inf])
def test_an_orientation_that_is_none(w: float) -> None:
    assert reason(message(w=w)) == "bad_orientation"
    assert reason(message(w=w), ("yaw",)) == "bad_orientation"
    assert odometry_from_msg(message(w=w), ("x", "y")).tracks.mean[0, 0].tolist() == [1.0, 2.0]  # not needed


@pytest.mark.parametrize(
    "parameter", [{"cross_block": "none"}, {"cross_weight": 0.0}, {"cross_weight": 1.0}, {"twist_frame": "body"}]
)
def test_parameters_out_of_range(parameter: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(parameter))):
        odometry_from_msg(message(), PLANE, **parameter)


def test_axes_without_a_place_are_left_out_but_not_all() -> None:
    tracks = make_tracks(1, 1, ("x", "ax"))
    (msg,) = odometry_to_msgs(tracks, ("x", "ax"))
    assert msg.pose.covariance[0] == tracks.cov[0, 0, 0, 0]
    with pytest.raises(ValueError, match="must include one of"):
        odometry_to_msgs(make_tracks(1, 1, ("ax",)), ("ax",))


def test_a_mixture_is_merged_and_its_yaw_does_not_turn_around() -> None:
    axes = ("x", "yaw")
    tracks = make_tracks(1, 2, axes, weight=np.array([[0.5, 0.5]]), mean=np.array([[[0.0, 3.1], [2.0, -3.1]]]),
                         cov=np.tile(np.diag([1.0, 0.01]), (1, 2, 1, 1)))  # fmt: skip
    (msg,) = odometry_to_msgs(tracks, axes)
    assert msg.pose.pose.position.x == 1.0
    assert msg.pose.covariance[0] == pytest.approx(2.0)  # 1 within, 1 between
    q = msg.pose.pose.orientation
    assert abs(q.z) == pytest.approx(1.0)  # heads to pi
    assert msg.pose.covariance[35] == pytest.approx(0.01 + (np.pi - 3.1) ** 2)
