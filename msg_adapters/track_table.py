"""The track table: full posteriors of many tracks in one sensor_msgs/PointCloud2 (doc/wire-format.md)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters._table import PLANS, cov_name
from msg_adapters._table_reading import Block, Column, Fields, Rows, Signature, signature
from msg_adapters._table_writing import Layout, make_layout, new_cloud, upper_triangle
from msg_adapters.arrays import MessageError, TrackArrays, TrackLike
from msg_adapters.classes import Classes, message_class
from msg_adapters.header import stamp_to_ns

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2

_UUID_BYTES = 16
_MAX_ID = 2**32 - 1
_REQUIRED = ("track_id", "status", "source", "existence", "weight")
#: Fields which are never axes.
_RESERVED = frozenset({*_REQUIRED, "uuid", "dof", "phd"})
#: Padding every track to the components of the largest may cost this many components in all, whatever the
#: size of the message; else one long track among many short ones would fill the memory.
MAX_PADDED_COMPONENTS = 1_000_000


def track_table_to_msg(
    tracks: TrackLike, axes: Sequence[str], stamp_ns: int, classes: Classes = message_class
) -> PointCloud2:
    """Write tracks as one cloud, one row a component; components of weight 0 are padding and left out.

    Parameters
    ----------
    tracks : TrackLike          N >= 0 tracks in one frame, as TrackArrays or the library's TrackBatch
    axes : sequence of str      the names of the n axes (`batch.layout.axes`)
    stamp_ns : int              header.stamp: the time for which every row is valid; also an empty scan has one
    classes : callable          gives the classes of the message and its parts, those of ROS unless given

    Returns
    -------
    PointCloud2    its `fields` are shared between messages: do not change one in place

    Raises
    ------
    ValueError    a track's time differs from the stamp, an id does not fit 32 bits or two neighbours have
                  the same (they would merge), axis names do not give distinct fields
    """
    _check_rows(tracks, stamp_ns)
    layout = _layout(tuple(axes), tracks.uuid is not None, bool((tracks.dof != np.inf).any()), tracks.phd)
    if tracks.mean.shape[2] != len(axes):
        raise ValueError(f"The 'mean' must have {len(axes)} axes, {tuple(axes)}. Got {tracks.mean.shape[2]}.")
    if tracks.mean.shape[1] == 1:
        track: Any = slice(None)
        weight, mean, cov = tracks.weight[:, 0], tracks.mean[:, 0], tracks.cov[:, 0]
    else:
        keep = tracks.weight != 0
        keep[:, 0] |= ~keep.any(1)  # a track does not vanish because its weights are wrong
        track = np.nonzero(keep)[0]
        weight, mean, cov = tracks.weight[keep], tracks.mean[keep], tracks.cov[keep]
    msg, rows = new_cloud(layout, len(weight), stamp_ns, tracks.frame_id, classes)
    for name in ("track_id", "status", "source", "existence"):
        rows[name] = getattr(tracks, name)[track]
    for name in ("uuid", "dof"):
        if name in layout.dtype.names:  # type: ignore[operator]
            rows[name] = getattr(tracks, name)[track]
    if tracks.phd:
        rows["phd"] = 1
    rows["weight"], rows["mean"], rows["cov"] = weight, mean, upper_triangle(layout, cov)
    return msg


def track_table_from_msg(msg: PointCloud2) -> TrackArrays:
    """Read a track table; the axes are those fields f for which `cov_f_f` exists, in their order.

    Values are passed through, NaN included; the library judges them. Any numeric datatype and byte
    order is taken, unknown fields are ignored, an organised cloud is read row by row.

    Returns
    -------
    TrackArrays    N tracks of C components, C the largest number of adjoining rows with one id. An id
                   which comes back later is a second entry

    Raises
    ------
    MessageError    `missing_field`, `bad_field`, `wrong_data_length`, `inconsistent_rows` (rows of one
                    track differ in what they should share), `too_ragged` (see MAX_PADDED_COMPONENTS)
    """
    plan = _plan(signature(msg))
    rows = Rows(msg)
    own = _own_columns(plan, rows)
    size = len(plan.axes)
    mean = rows.matrix(plan.mean)
    cov = rows.matrix(plan.cov).reshape(rows.count, size, size)
    weight = rows.floats(plan.weight)
    ids = own["track_id"]
    again = ids[1:] == ids[:-1]
    if again.size and again.any():
        _check_agreement(own, again)
        start, pick, pad = _components(again)
        own = {name: column[start] for name, column in own.items()}
        weight, mean, cov = np.where(pad, 0.0, weight[pick]), mean[pick], cov[pick]
    else:
        weight, mean, cov = weight[:, None], mean[:, None], cov[:, None]
    phd = _phd(own.pop("phd", None))
    dof = own.pop("dof", None)
    count = len(mean)
    return TrackArrays(
        axes=plan.axes, frame_id=msg.header.frame_id, weight=weight, mean=mean, cov=cov,
        time_ns=np.full(count, stamp_to_ns(msg.header.stamp), np.int64),
        dof=np.full(count, np.inf) if dof is None else dof, phd=phd, **own,
    )  # fmt: skip


def _check_rows(tracks: TrackLike, stamp_ns: int) -> None:
    ids = tracks.track_id
    late = tracks.time_ns != stamp_ns
    if late.any():
        first = int(np.flatnonzero(late)[0])
        raise ValueError(
            f"The 'time_ns' of every track must be the stamp, {stamp_ns}: predict to it first. "
            f"Got {tracks.time_ns[first]} for track {ids[first]}."
        )
    if len(ids) and not (ids.min() >= 0 and ids.max() <= _MAX_ID):
        raise ValueError(f"The 'track_id' must lie between 0 and {_MAX_ID}. Got {ids.min()} to {ids.max()}.")
    if (ids[1:] == ids[:-1]).any():
        raise ValueError("The 'track_id' must be unique: rows of one id are components of one track.")


@lru_cache(maxsize=PLANS)
def _layout(axes: tuple[str, ...], uuid: bool, dof: bool, phd: bool) -> Layout:
    columns = [("track_id", "u4", 1), ("uuid", "u1", _UUID_BYTES), ("status", "u1", 1), ("phd", "u1", 1),
               ("source", "u4", 1), ("existence", "f8", 1), ("dof", "f8", 1), ("weight", "f8", 1)]  # fmt: skip
    written = {"uuid": uuid, "dof": dof, "phd": phd}
    columns = [c for c in columns if written.get(c[0], True)]
    if reserved := sorted(_RESERVED.intersection(axes)):
        raise ValueError(f"The axes must not have the names of other fields. Got {', '.join(reserved)}.")
    layout = make_layout(tuple(columns), axes, with_cov=True)
    read = _axes(f.name for f in layout.fields)
    if read != axes:
        raise ValueError(f"The axes must be told from their covariance names. Got {axes!r}, read as {read!r}.")
    return layout


@dataclasses.dataclass(frozen=True, eq=False)
class _Plan:
    """Where everything stands in the rows of one kind of track table."""

    axes: tuple[str, ...]
    weight: Column
    mean: Block
    cov: Block
    own: tuple[Column, ...]  # one value a track
    uuid: Column | None


def _axes(names: Any) -> tuple[str, ...]:
    """Return the names f, in order, for which there is a `cov_f_f`."""
    ordered = dict.fromkeys(names)
    return tuple(f for f in ordered if f not in _RESERVED and cov_name(f, f) in ordered)


@lru_cache(maxsize=PLANS)
def _plan(sig: Signature) -> _Plan:
    fields = Fields(sig)
    fields.require(_REQUIRED, " of a track table")
    axes = _axes(fields)
    if not axes:
        raise MessageError(
            "missing_field",
            f"The cloud must have an axis: a field f beside a field cov_f_f, such as x and cov_x_x. Got {fields}.",
        )
    cov = fields.covariance(axes, " (covariance of the axes)")
    own = [fields.column(f) for f in ("track_id", "status", "source", "existence")]
    own += [fields.column(f) for f in ("dof", "phd") if f in fields]
    uuid = fields.column("uuid", _UUID_BYTES) if "uuid" in fields else None
    if uuid is not None and uuid.code != "u1":
        raise MessageError("bad_field", f"The field 'uuid' must be 16 UINT8. Got 16 {uuid.code}.")
    return _Plan(axes, fields.column("weight"), fields.block(axes), cov, tuple(own), uuid)


_INTEGERS: dict[str, tuple[type[np.generic], str]] = {
    "track_id": (np.int64, "u4"), "status": (np.uint8, "u1"), "source": (np.uint32, "u4"), "phd": (np.uint8, "u1"),
}  # fmt: skip


def _own_columns(plan: _Plan, rows: Rows) -> dict[str, NDArray[Any]]:
    """Copy the columns that have one value a track, still one a row."""
    own = {c.name: rows.integers(c, *_INTEGERS[c.name]) if c.name in _INTEGERS else rows.floats(c) for c in plan.own}
    if plan.uuid is not None:
        own["uuid"] = rows.column(plan.uuid, _UUID_BYTES).copy()
    return own


def _check_agreement(own: dict[str, NDArray[Any]], again: NDArray[np.bool_]) -> None:
    """Raise `inconsistent_rows` where a row differs from the one before it, of the same track."""
    for name, column in own.items():
        differs = column[1:] != column[:-1]
        if column.dtype.kind == "f":
            differs &= ~(np.isnan(column[1:]) & np.isnan(column[:-1]))
        bad = again & (differs.any(1) if differs.ndim > 1 else differs)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise MessageError(
                "inconsistent_rows",
                f"The rows of one track must agree in '{name}'. "
                f"Got {column[row]} and {column[row + 1]} for track {own['track_id'][row]}.",
            )


def _components(again: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Tell which rows make up each track.

    Returns
    -------
    start (N,), its first row; pick (N, C), the row of each component; pad (N, C), where that is a
    repetition of the first, made to fill up
    """
    start = np.flatnonzero(np.concatenate([[True], ~again]))
    length = np.diff(start, append=len(again) + 1)
    components = int(length.max())
    if len(start) * components > max(MAX_PADDED_COMPONENTS, len(again) + 1):
        raise MessageError(
            "too_ragged",
            f"The tracks, each padded to the components of the largest, must not exceed {MAX_PADDED_COMPONENTS} "
            f"components. Got {len(start)} tracks, the largest of {components}.",
        )
    step = np.arange(components)
    pad = step >= length[:, None]
    return start, np.where(pad, start[:, None], start[:, None] + step), pad


def _phd(flag: NDArray[np.uint8] | None) -> bool:
    """Read the `phd` column: a batch is of one kind. Without rows, the presence of the field counts."""
    if flag is None or len(flag) == 0:
        return flag is not None
    if (flag != flag[0]).any():
        raise MessageError("inconsistent_rows", "All tracks of a table must agree in 'phd'. Got 0 and others.")
    return bool(flag[0])
