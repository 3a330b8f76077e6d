"""The detection table: measurements of one scan in one sensor_msgs/PointCloud2 (doc/wire-format.md)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

from msg_adapters._table import PLANS, cov_name, upper_pairs
from msg_adapters._table_reading import Block, Fields, Rows, Signature, signature
from msg_adapters._table_writing import make_layout, new_cloud, upper_triangle
from msg_adapters.arrays import DetectionArrays
from msg_adapters.header import stamp_to_ns

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2


def detection_table_to_msg(detections: DetectionArrays) -> PointCloud2:
    """Write the detections of one scan as one cloud, one row a detection, with `cov_*` when they have it.

    Returns
    -------
    PointCloud2    its `fields` are shared between messages: do not change one in place

    Raises
    ------
    ValueError    axis names do not give distinct fields, or the shapes do not fit
    """
    value, cov, axes = detections.value, detections.cov, detections.axes
    if value.ndim != 2 or value.shape[1] != len(axes) or (cov is not None and cov.shape != (*value.shape, len(axes))):
        raise ValueError(
            f"The 'value' must have shape (N, {len(axes)}) for {axes}, and 'cov' (N, {len(axes)}, {len(axes)}). "
            f"Got {value.shape} and {None if cov is None else cov.shape}."
        )
    layout = make_layout((), tuple(axes), with_cov=cov is not None)
    msg, rows = new_cloud(layout, len(value), detections.time_ns, detections.frame_id)
    rows["mean"] = value
    if cov is not None:
        rows["cov"] = upper_triangle(layout, cov)
    return msg


def detection_table_from_msg(msg: PointCloud2, axes: Sequence[str]) -> DetectionArrays:
    """Read the named axes of every row; the other fields are ignored, so that a lidar cloud will do.

    Parameters
    ----------
    msg : PointCloud2
    axes : sequence of str    the m fields that are wanted, in the order in which they are wanted

    Returns
    -------
    DetectionArrays    value (N, m); cov (N, m, m), None when the message has no `cov_*` of these axes

    Raises
    ------
    MessageError    `missing_field` (a covariance which is given in part included), `bad_field`,
                    `wrong_data_length`
    """
    of_value, of_cov = _plan(signature(msg), tuple(axes))
    rows = Rows(msg)
    value = rows.matrix(of_value)
    cov = None if of_cov is None else rows.matrix(of_cov).reshape(rows.count, len(axes), len(axes))
    return DetectionArrays(tuple(axes), msg.header.frame_id, stamp_to_ns(msg.header.stamp), value, cov)


@lru_cache(maxsize=PLANS)
def _plan(sig: Signature, axes: tuple[str, ...]) -> tuple[Block, Block | None]:
    """Find where the axes stand, and their covariance."""
    fields = Fields(sig)
    fields.require(axes, " of a detection table")
    names = (n for a, b in upper_pairs(axes) for n in (cov_name(a, b), cov_name(b, a)))
    some = any(n in fields for n in names)
    return fields.block(axes), fields.covariance(axes, " (covariance of the axes)") if some else None
