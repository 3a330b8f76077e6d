"""PointCloud2 as a table: what reading and writing share, its names and number types."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from sensor_msgs.msg import PointField

#: How many field lists are remembered, of each kind. A node meets one for each of its publishers.
PLANS = 64
#: Datatypes of a PointField as NumPy codes without byte order.
CODES = {
    PointField.INT8: "i1", PointField.UINT8: "u1", PointField.INT16: "i2", PointField.UINT16: "u2",
    PointField.INT32: "i4", PointField.UINT32: "u4", PointField.FLOAT32: "f4", PointField.FLOAT64: "f8",
}  # fmt: skip
#: Bytes of a double.
WORD = 8


def cov_name(a: str, b: str) -> str:
    """Name the covariance of two axes."""
    return f"cov_{a}_{b}"


def upper_pairs(axes: Sequence[str]) -> list[tuple[str, str]]:
    """List the pairs of the upper triangle, row by row."""
    return list(itertools.combinations_with_replacement(axes, 2))
