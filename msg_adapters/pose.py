"""geometry_msgs/PoseWithCovarianceStamped: a track that has a position only, such as a localisation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from msg_adapters.arrays import TrackArrays, one_track, slots_of
from msg_adapters.header import stamp_to_ns

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseWithCovarianceStamped

_SLOT = {"x": 0, "y": 1, "z": 2}


def pose_from_msg(
    msg: PoseWithCovarianceStamped, axes: Sequence[str] = ("x", "y"), *, track_id: int = 0, status: int = 1
) -> TrackArrays:
    """Read one position-only track, in the frame of the header; the covariance comes as it is.

    Parameters
    ----------
    msg : PoseWithCovarianceStamped
    axes : sequence of str    of x, y, z
    track_id : int            the message has none
    status : int              status bits; the message has none (1: confirmed)

    Raises
    ------
    MessageError    `missing_axis`: an axis other than x, y, z, or none
    """
    slots = slots_of(axes, _SLOT, "a pose")
    position = msg.pose.pose.position
    mean = np.array([position.x, position.y, position.z], np.float64)[slots]
    cov = np.array(msg.pose.covariance, np.float64).reshape(6, 6)[slots[:, None], slots]
    return one_track(
        tuple(axes), msg.header.frame_id, mean, cov,
        time_ns=stamp_to_ns(msg.header.stamp), track_id=track_id, status=status,
    )  # fmt: skip
