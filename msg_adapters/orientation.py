"""Orientations: quaternions (x, y, z, w) and rotation matrices parent_from_body."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters.arrays import Floats, MessageError

if TYPE_CHECKING:
    from geometry_msgs.msg import Quaternion

#: How far the squared norm of a quaternion may be from 1; beyond, it is no orientation but an oversight.
QUATERNION_TOLERANCE = 1e-2


def unit_quaternion(q: Quaternion) -> tuple[float, float, float, float]:
    """Return x, y, z, w of an orientation, scaled to norm 1.

    Raises
    ------
    MessageError    `bad_orientation`: not a number, zero (never filled in) or far from norm 1
    """
    unit, good = unit_quaternions(np.array([[q.x, q.y, q.z, q.w]]))
    if not good[0]:
        raise bad_orientation(q.x, q.y, q.z, q.w)
    x, y, z, w = unit[0].tolist()
    return x, y, z, w


def unit_quaternions(q: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Scale quaternions (N, 4), x y z w, to norm 1, and tell which are orientations, (N,)."""
    x, y, z, w = q.T
    with np.errstate(all="ignore"):  # what is no orientation is told
        norm = x * x + y * y + z * z + w * w
        return q / np.sqrt(norm)[:, None], np.abs(norm - 1.0) <= QUATERNION_TOLERANCE


def bad_orientation(x: float, y: float, z: float, w: float) -> MessageError:
    """Make the error for a quaternion that is no orientation."""
    return MessageError(
        "bad_orientation",
        f"The orientation must be a unit quaternion, since the twist is in its frame. Got ({x}, {y}, {z}, {w}) "
        "(x, y, z, w).",
    )


def yaw_of(q: Quaternion) -> float:
    """Return the yaw of an orientation, rad; raise as unit_quaternion does."""
    return float(yaws(np.array([unit_quaternion(q)]))[0])


def yaws(unit: Floats) -> Floats:
    """Return the yaw of each unit quaternion (N, 4), rad, (N,)."""
    x, y, z, w = unit.T
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def from_yaw(yaw: float) -> Quaternion:
    """Return the orientation of a turn about z, rad."""
    from geometry_msgs.msg import Quaternion

    return Quaternion(x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))


def yaw_rotations(yaw: Floats) -> Floats:
    """Return the rotations about z by angles (N,), rad: (N, 3, 3)."""
    out = np.zeros((len(yaw), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(yaw)
    out[:, 1, 0] = np.sin(yaw)
    out[:, 0, 1] = -out[:, 1, 0]
    out[:, 2, 2] = 1.0
    return out


def rotation_matrix(x: float, y: float, z: float, w: float) -> Floats:
    """Return the rotation (3, 3) of a unit quaternion."""
    return np.asarray(rotation_matrices(np.array([[x, y, z, w]]))[0])


def rotation_matrices(unit: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of unit quaternions (N, 4)."""
    x, y, z, w = unit.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), -1, 0))


def from_matrix(r: list[list[float]]) -> Quaternion:
    """Return the orientation of a rotation matrix, by its largest component, which no cancellation spoils."""
    from geometry_msgs.msg import Quaternion

    trace = r[0][0] + r[1][1] + r[2][2]
    squared = [1 + 2 * r[0][0] - trace, 1 + 2 * r[1][1] - trace, 1 + 2 * r[2][2] - trace, 1 + trace]
    big = max(range(4), key=squared.__getitem__)
    s = math.sqrt(squared[big]) * 2
    if big == 3:
        x, y, z, w = (r[2][1] - r[1][2]) / s, (r[0][2] - r[2][0]) / s, (r[1][0] - r[0][1]) / s, s / 4
        return Quaternion(x=x, y=y, z=z, w=w)
    i, j, k = big, (big + 1) % 3, (big + 2) % 3
    out = [0.0] * 3
    out[i], out[j], out[k] = s / 4, (r[j][i] + r[i][j]) / s, (r[k][i] + r[i][k]) / s
    return Quaternion(x=out[0], y=out[1], z=out[2], w=(r[k][j] - r[j][k]) / s)
