"""Writing a PointCloud2 as a table: one aligned structured array, laid out once for each list of axes."""

from __future__ import annotations

import dataclasses
from array import array
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters._table import CODES, PLANS, WORD, cov_name, upper_pairs
from msg_adapters.arrays import Floats
from msg_adapters.classes import Classes, message_class
from msg_adapters.header import make_header

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2

_DATATYPES = {code: datatype for datatype, code in CODES.items()}


@dataclasses.dataclass(frozen=True)
class Place:
    """What is said in a sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclasses.dataclass(frozen=True, eq=False)
class Layout:
    """How rows are written: an aligned structured type, and the field list that tells of it."""

    dtype: np.dtype[Any]
    fields: tuple[Place, ...]
    upper: NDArray[np.intp]  # the upper triangle in a flattened (n, n)


@lru_cache(maxsize=2 * PLANS)
def make_layout(columns: tuple[tuple[str, str, int], ...], axes: tuple[str, ...], with_cov: bool) -> Layout:
    """Lay out a row: (name, code, count) columns, the axes as `mean`, the upper triangle as `cov`.

    Raises
    ------
    ValueError    names collide, so that a reader could not tell them apart
    """
    pairs = upper_pairs(axes) if with_cov else []
    names = [name for name, _, _ in columns] + list(axes) + [cov_name(a, b) for a, b in pairs]
    repeated = sorted({n for n in names if names.count(n) > 1})
    if repeated or not axes or "" in axes:
        raise ValueError(
            "The axes must be distinct names, and so must the fields made from them. "
            f"Got {axes!r}{', which give twice ' + ', '.join(repeated) if repeated else ''}."
        )
    # Aligned, since a C++ reader may look at the values where they stand.
    blocks = [("mean", "<f8", (len(axes),)), ("cov", "<f8", (len(pairs),))]
    scalars = [(name, "<" + code, (count,) if count > 1 else ()) for name, code, count in columns]
    dtype = np.dtype(scalars + blocks[: 1 + with_cov], align=True)
    places = {name: int(place[1]) for name, place in (dtype.fields or {}).items()}
    fields = [_field(name, places[name], code, count) for name, code, count in columns]
    fields += [_field(a, places["mean"] + WORD * k, "f8", 1) for k, a in enumerate(axes)]
    fields += [_field(cov_name(*p), places["cov"] + WORD * k, "f8", 1) for k, p in enumerate(pairs)]
    upper = np.array([i * len(axes) + j for i in range(len(axes)) for j in range(i, len(axes))], np.intp)
    return Layout(dtype, tuple(fields), upper)


def _field(name: str, offset: int, code: str, count: int) -> Place:
    return Place(name, offset, _DATATYPES[code], count)


@lru_cache(maxsize=2 * PLANS)
def _point_fields(layout: Layout, classes: Classes) -> tuple[Any, ...]:
    """Make the PointFields, shared by all messages of a layout: 30 of them cost as much as all the rest."""
    kind = classes("sensor_msgs/msg/PointField")
    return tuple(kind(**vars(place)) for place in layout.fields)


def new_cloud(
    layout: Layout, rows: int, stamp_ns: int, frame_id: str, classes: Classes = message_class
) -> tuple[PointCloud2, NDArray[Any]]:
    """Make a cloud of zeroed rows, and the structured array (rows,) through which to fill it.

    The array is the message's memory: filling it in place spares two copies. The PointFields are shared with other
    messages: do not change those of a message.
    """
    step = layout.dtype.itemsize
    msg: PointCloud2 = classes("sensor_msgs/msg/PointCloud2")(
        header=make_header(stamp_ns, frame_id, classes), height=1, width=rows,
        fields=list(_point_fields(layout, classes)), is_bigendian=False, point_step=step, row_step=rows * step,
        data=array("B"), is_dense=True,
    )  # fmt: skip
    if rows == 0:
        return msg, np.zeros(0, layout.dtype)
    data = msg.data  # an array.array; its setter would copy
    data.append(0)
    data *= rows * step
    return msg, np.ndarray((rows,), layout.dtype, data)


def upper_triangle(layout: Layout, cov: Floats) -> Floats:
    """Take the upper triangles of (rows, n, n), as (rows, n (n + 1) / 2)."""
    rows, size = len(cov), cov.shape[-1]
    # The mode only spares numpy a buffer; every index is in range.
    return cov.reshape(rows, size * size).take(layout.upper, axis=1, mode="clip")
