"""nav_msgs/Odometry, one message a track: what every ROS tool reads, without the position-velocity block.

Of a state the message carries x, y, z and yaw (pose, in header.frame_id) and vx, vy, vz and turn_rate
(twist). By REP-105 and the message's definition a twist is expressed in child_frame_id, whose
orientation is that of the pose. A track without yaw is written with the identity orientation, so that
both frames coincide; with yaw the velocity is turned into the body frame, and turned back in reading.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from msg_adapters.arrays import CrossBlock, Floats, MergedLike, MessageError, TrackArrays, slots_of
from msg_adapters.header import make_header, stamp_to_ns
from msg_adapters.orientation import (
    bad_orientation,
    from_yaw,
    rotation_matrices,
    unit_quaternions,
    yaw_rotations,
    yaws,
)

if TYPE_CHECKING:
    from nav_msgs.msg import Odometry

#: Where an axis stands in the message: 0 to 5 the pose, 6 to 11 the twist.
_SLOT = {"x": 0, "y": 1, "z": 2, "yaw": 5, "vx": 6, "vy": 7, "vz": 8, "turn_rate": 11}
_POSE, _TWIST = slice(0, 6), slice(6, 12)
_SIZE = 12
#: Variance (SI units squared) of what a track does not say, such as z of a track in the plane. Zero would
#: say "certain": robot_localization takes a zero variance for an oversight and puts 1e-6 in its place.
UNOBSERVED_VARIANCE = 1e6
#: "42", "track_42", "robot_1/track_42", "track42"; but not the last digits of a hexadecimal name.
_NUMBERED = re.compile(r"(?:.*[_/#:.\-])?[A-Za-z]*?([0-9]+)", re.ASCII | re.DOTALL)
_MAX_ID = 2**32 - 1


class OdometryReading(NamedTuple):
    """What an Odometry message says of the state.

    `cross_block_absent` is true when the axes come from both the pose and the twist, so that their
    cross-covariance, which the message cannot carry, was supplied by `cross_block`.
    """

    tracks: TrackArrays
    cross_block_absent: bool


def odometry_to_msgs(
    tracks: MergedLike,
    axes: Sequence[str],
    child_prefix: str = "",
    unobserved_variance: float = UNOBSERVED_VARIANCE,
) -> list[Odometry]:
    """Write each track as a message, its mixture merged, child_frame_id = child_prefix + id.

    Parameters
    ----------
    tracks : MergedLike            N tracks, SI units
    axes : sequence of str         the names of the n axes; those which the message has no place for are left out
    child_prefix : str             such as "track_"
    unobserved_variance : float    variance of the message's axes that are not in `axes` (m^2, rad^2, ...);
                                   their value is 0. 0 makes RViz draw flat ellipses, but reads as "certain"

    Returns
    -------
    list of N Odometry    stamped with the time of their track

    Raises
    ------
    ValueError    the message has a place for none of the axes
    """
    have = [k for k, a in enumerate(axes) if a in _SLOT]
    if not have:
        raise ValueError(f"The axes must include one of {', '.join(_SLOT)}. Got {tuple(axes)!r}.")
    slots = np.array([_SLOT[axes[k]] for k in have])
    track_mean, track_cov = tracks.moments
    mean = np.zeros((len(track_mean), _SIZE))
    cov = np.zeros((len(mean), _SIZE, _SIZE))
    cov[:] = unobserved_variance * np.eye(_SIZE)
    mean[:, slots] = track_mean[:, have]
    cov[:, slots[:, None], slots] = track_cov[:, np.array(have)[:, None], have]
    yaw = mean[:, _SLOT["yaw"]]
    if "yaw" in axes:
        mean, cov = _turned(mean, cov, yaw_rotations(-yaw))
    names = [f"{child_prefix}{i}" for i in tracks.track_id.tolist()]
    stamps = tracks.time_ns.tolist()
    return [
        _message(tracks.frame_id, names[k], stamps[k], mean[k].tolist(), cov[k], float(yaw[k]))
        for k in range(len(mean))
    ]


def odometry_from_msg(
    msg: Odometry,
    axes: Sequence[str],
    cross_block: CrossBlock = "block_diagonal",
    *,
    cross_weight: float = 0.5,
    child_prefix: str | None = None,
    twist_frame: Literal["child", "parent"] = "child",
    status: int = 1,
) -> OdometryReading:
    """Read one track, in the frame of the message's header.

    Covariances come as they are, asymmetric ones included: the library screens them. Where the
    orientation is not the identity, velocity and its covariance are turned from the body into the
    parent frame.

    Parameters
    ----------
    msg : nav_msgs/Odometry
    axes : sequence of str    the n axes wanted, of x, y, z, yaw, vx, vy, vz, turn_rate; positions or
                              velocities alone will do
    cross_block : str         what stands for the covariance between pose and twist, which the message lacks:
                              `block_diagonal`, zero (not conservative), or `conservative`, see Notes
    cross_weight : float      w of `conservative`, between 0 and 1
    child_prefix : str or None    the track id is the number after this prefix, or, for None, at the end of
                              child_frame_id; a name without number gives its CRC-32. With None two names with
                              one number ("left_1", "right_1") are one id
    twist_frame : str         `parent` for publishers which give the twist in header.frame_id, against the
                              definition of the message
    status : int              status bits of the track; the message has none (1: confirmed)

    Returns
    -------
    OdometryReading    one Gaussian track, and whether a cross block is absent

    Raises
    ------
    MessageError    `missing_axis`, `missing_child_frame`, `bad_orientation`
    ValueError      a parameter is out of range

    Notes
    -----
    `conservative`: with A the pose block, B the twist block, 0 < w < 1, and any C for which [[A, C], [C', B]] is
    positive semidefinite, [[A / w, 0], [0, B / (1 - w)]] is no smaller, and at this w no smaller blocks will do: the
    proof is in doc/wire-format.md. At w = 1/2 both double. The twist is turned first; that changes neither A nor the
    claim.
    """
    _check_parameters(cross_block, cross_weight, twist_frame)
    if not msg.child_frame_id:
        raise missing_child_frame()
    values, track_id = values_of(msg), track_id_of(msg.child_frame_id, child_prefix)
    tracks, good, absent = tracks_of(
        values[None], axes, msg.header.frame_id, stamp_to_ns(msg.header.stamp), [track_id], cross_block,
        cross_weight=cross_weight, twist_frame=twist_frame, status=status,
    )  # fmt: skip
    if not good[0]:
        raise bad_orientation(*values[3:7].tolist())
    return OdometryReading(tracks, absent)


def values_of(msg: Odometry) -> Floats:
    """Return the numbers of a message in the order of its definition, (85,): pose, its covariance, twist, its own."""
    position, turn = msg.pose.pose.position, msg.pose.pose.orientation
    linear, angular = msg.twist.twist.linear, msg.twist.twist.angular
    pose = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
    twist = [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z]
    return np.concatenate([pose, msg.pose.covariance, twist, msg.twist.covariance])


def missing_child_frame() -> MessageError:
    """Make the error for a message that names no track."""
    return MessageError("missing_child_frame", "The child_frame_id must name the track. Got an empty one.")


def tracks_of(
    values: Floats, axes: Sequence[str], frame_id: str, stamp_ns: int, ids: Sequence[int], cross_block: CrossBlock,
    *, cross_weight: float = 0.5, twist_frame: Literal["child", "parent"] = "child", status: int = 1,
) -> tuple[TrackArrays, NDArray[np.bool_], bool]:  # fmt: skip
    """Read the tracks of N messages of one stamp and frame, as odometry_from_msg says.

    Parameters
    ----------
    values : (N, 85)    as values_of gives them
    ids : (N,)

    Returns
    -------
    TrackArrays     those that can be read
    (N,) bool       which they are: not those without an orientation where one is needed
    bool            whether a cross block is absent
    """
    slots = slots_of(axes, _SLOT, "an Odometry message")
    in_twist = slots >= _TWIST.start
    turns = twist_frame == "child" and bool(in_twist.any())
    unit, good = unit_quaternions(values[:, 3:7])
    if not (turns or "yaw" in axes):
        good = np.ones(len(values), bool)
    values, unit = values[good], unit[good]
    mean, cov = _states(values, yaws(unit) if "yaw" in axes else np.zeros(len(unit)))
    bent = np.flatnonzero(values[:, 3:6].any(1))
    if turns and len(bent):  # the identity leaves every bit as it is
        mean[bent], cov[bent] = _turned(mean[bent], cov[bent], rotation_matrices(unit[bent]))
    absent = bool(in_twist.any() and not in_twist.all())
    cov = cov[:, slots[:, None], slots]
    if absent and cross_block == "conservative":
        inflation = np.where(in_twist, 1 / (1 - cross_weight), 1 / cross_weight)
        cov *= np.where(in_twist[:, None] == in_twist, inflation, 1.0)
    track_id = np.array(ids, np.int64)[good]
    count = len(track_id)
    tracks = TrackArrays(
        axes=tuple(axes), frame_id=frame_id, weight=np.ones((count, 1)), mean=mean[:, None, slots], cov=cov[:, None],
        time_ns=np.full(count, stamp_ns, np.int64), track_id=track_id, source=np.zeros(count, np.uint32),
        status=np.full(count, status, np.uint8), existence=np.ones(count), dof=np.full(count, np.inf),
    )  # fmt: skip
    return tracks, good, absent


def track_id_of(name: str, prefix: str | None = None) -> int:
    """Return the track id, 0 to 2^32 - 1, that a name stands for.

    The number after `prefix`; with prefix None the number at the end of the name ("track_7" is 7);
    where there is none, the CRC-32 of the name: the same on every machine and in every run.
    """
    if prefix is None:
        match = _NUMBERED.fullmatch(name)
        digits = match.group(1) if match else ""
    else:
        digits = name.removeprefix(prefix) if name.startswith(prefix) else ""
    if digits.isascii() and digits.isdigit() and len(digits) <= len(str(_MAX_ID)) and int(digits) <= _MAX_ID:
        return int(digits)
    return zlib.crc32(name.encode())


def _check_parameters(cross_block: str, cross_weight: float, twist_frame: str) -> None:
    if cross_block not in ("block_diagonal", "conservative"):
        raise ValueError(f"The 'cross_block' must be 'block_diagonal' or 'conservative'. Got {cross_block!r}.")
    if not 0 < cross_weight < 1:
        raise ValueError(f"The 'cross_weight' must lie between 0 and 1, exclusively. Got {cross_weight}.")
    if twist_frame not in ("child", "parent"):
        raise ValueError(f"The 'twist_frame' must be 'child' or 'parent'. Got {twist_frame!r}.")


def _message(frame: str, child: str, stamp_ns: int, mean: list[float], cov: Floats, yaw: float) -> Odometry:
    """Build one message from a full state, the twist in the body frame."""
    from geometry_msgs.msg import Point, Pose, PoseWithCovariance, Twist, TwistWithCovariance, Vector3
    from nav_msgs.msg import Odometry

    pose = Pose(position=Point(x=mean[0], y=mean[1], z=mean[2]), orientation=from_yaw(yaw))
    twist = Twist(linear=Vector3(x=mean[6], y=mean[7], z=mean[8]), angular=Vector3(x=mean[9], y=mean[10], z=mean[11]))
    # Contiguous copies: a reshaped view would keep the whole batch alive.
    return Odometry(
        header=make_header(stamp_ns, frame),
        child_frame_id=child,
        pose=PoseWithCovariance(pose=pose, covariance=cov[_POSE, _POSE].flatten()),
        twist=TwistWithCovariance(twist=twist, covariance=cov[_TWIST, _TWIST].flatten()),
    )


def _states(values: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Return the full states, mean (N, 12) and cov (N, 12, 12), the twist as it stands in the messages."""
    mean = np.zeros((len(values), _SIZE))
    mean[:, :3], mean[:, 5], mean[:, _TWIST] = values[:, :3], yaw, values[:, 43:49]
    cov = np.zeros((len(values), _SIZE, _SIZE))
    cov[:, _POSE, _POSE] = values[:, 7:43].reshape(-1, 6, 6)
    cov[:, _TWIST, _TWIST] = values[:, 49:].reshape(-1, 6, 6)
    return mean, cov


def _turned(mean: Floats, cov: Floats, rotation: Floats) -> tuple[Floats, Floats]:
    """Apply a rotation (N, 3, 3) to linear and angular velocity and to the covariance of the twist.

    Block by block, so that what is not finite in one (an unknown angular velocity) does not spoil another.
    """
    mean, cov = mean.copy(), cov.copy()
    parts = (slice(6, 9), slice(9, 12))
    for a in parts:
        mean[:, a] = np.einsum("nij,nj->ni", rotation, mean[:, a])
        for b in parts:
            with np.errstate(invalid="ignore"):  # the library judges what is not finite
                cov[:, a, b] = rotation @ cov[:, a, b] @ rotation.swapaxes(-1, -2)
    return mean, cov
