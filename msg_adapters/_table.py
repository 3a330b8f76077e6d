"""PointCloud2 as a table: what reading and writing share, its names and number types."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

#: How many field lists are remembered, of each kind. A node meets one for each of its publishers.
PLANS = 64
#: Datatypes of a PointField as NumPy codes without byte order.
CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Bytes of a double.
WORD = 8


def cov_name(a: str, b: str) -> str:
    """Name the covariance of two axes."""
    return f"cov_{a}_{b}"


def upper_pairs(axes: Sequence[str]) -> list[tuple[str, str]]:
    """List the pairs of the upper triangle, row by row."""
    return list(itertools.combinations_with_replacement(axes, 2))
