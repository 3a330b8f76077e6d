"""Clouds and tracks for the adapter tests; clouds are packed by `struct`, which shares nothing with the adapters."""

from __future__ import annotations

import array
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from msg_adapters.arrays import TrackArrays
from msg_adapters.header import make_header
from track_fusion import angles

FORMATS = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
U1, U4, F4, F8 = PointField.UINT8, PointField.UINT32, PointField.FLOAT32, PointField.FLOAT64
STAMP = 1_700_000_000_123_456_789

#: One field: name, datatype, and its value or tuple of values in each row.
Column = tuple[str, int, Sequence[Any]]


def cloud(
    columns: Sequence[Column], *, rows: int | None = None, big_endian: bool = False, height: int = 1,
    row_padding: int = 0, gap: int = 0, stamp: int = STAMP, frame: str = "map",
) -> PointCloud2:  # fmt: skip
    """Pack columns, unaligned, with `gap` bytes of rubbish before each field."""
    order = ">" if big_endian else "<"
    rows = len(columns[0][2]) if rows is None else rows
    fields, offset = [], 0
    for name, datatype, values in columns:
        count = len(values[0]) if len(values) and isinstance(values[0], tuple) else 1
        offset += gap
        fields.append(PointField(name=name, offset=offset, datatype=datatype, count=count))
        offset += count * struct.calcsize("=" + FORMATS[datatype])
    data = bytearray()
    for row in range(rows):
        for _, datatype, values in columns:
            value = values[row] if isinstance(values[row], tuple) else (values[row],)
            data += b"\xa5" * gap + struct.pack(f"{order}{len(value)}{FORMATS[datatype]}", *value)
        if height > 1 and (row + 1) % (rows // height) == 0:
            data += b"\x5a" * row_padding
    width = rows // height
    return PointCloud2(
        header=make_header(stamp, frame), height=height, width=width, fields=fields, is_bigendian=big_endian,
        point_step=offset, row_step=width * offset + row_padding, data=array.array("B", bytes(data)),
    )  # fmt: skip


def track_columns(**changes: Any) -> list[Column]:
    """Columns of four rows: track 7, track 9 of two components, track 8; change or leave out (None) by name."""
    columns: dict[str, tuple[int, Sequence[Any]]] = {
        "track_id": (U4, [7, 9, 9, 8]), "status": (U1, [1, 0, 0, 3]), "source": (U4, [3, 1, 1, 0x80000000]),
        "existence": (F8, [1.0, 0.5, 0.5, 0.25]), "weight": (F8, [1.0, 0.75, 0.25, 1.0]),
        "x": (F8, [1.0, 2.0, 3.0, 4.0]), "y": (F8, [-1.0, -2.0, -3.0, -4.0]),
        "cov_x_x": (F8, [11.0, 12.0, 13.0, 14.0]), "cov_x_y": (F8, [0.1, 0.2, 0.3, 0.4]),
        "cov_y_y": (F8, [21.0, 22.0, 23.0, 24.0]),
    }  # fmt: skip
    columns.update({k: v for k, v in changes.items() if v is not None})
    return [(k, *v) for k, v in columns.items() if k not in changes or changes[k] is not None]


def check_track_columns(tracks: TrackArrays) -> None:
    """Assert that the four rows of `track_columns` were read."""
    assert tracks.axes == ("x", "y")
    assert tracks.track_id.tolist() == [7, 9, 8]
    assert tracks.status.tolist() == [1, 0, 3]
    assert tracks.source.tolist() == [3, 1, 0x80000000]
    assert tracks.existence.tolist() == [1.0, 0.5, 0.25]
    assert tracks.weight.tolist() == [[1.0, 0.0], [0.75, 0.25], [1.0, 0.0]]
    assert tracks.mean.tolist() == [[[1, -1], [1, -1]], [[2, -2], [3, -3]], [[4, -4], [4, -4]]]
    np.testing.assert_allclose(
        tracks.cov[1], [[[12, 0.2], [0.2, 22]], [[13, 0.3], [0.3, 23]]], rtol=1e-7
    )  # FLOAT32 has 7 digits
    assert tracks.time_ns.tolist() == [STAMP] * 3
    assert np.isposinf(tracks.dof).all()
    assert tracks.uuid is None
    assert not tracks.phd
    assert tracks.frame_id == "map"


class Tracks(TrackArrays):
    """Arrays that know their moments, as those of the library do."""

    @property
    def moments(self) -> tuple[Any, Any]:
        """Mean (N, n) and covariance (N, n, n)."""
        if self.mean.shape[1] == 1:
            return self.mean[:, 0], self.cov[:, 0]
        return angles.moments(self.weight, self.mean, self.cov, angles.periods_of(self.axes))


def make_tracks(count: int = 3, components: int = 1, axes: Sequence[str] = ("x", "y", "vx", "vy"), seed: int = 0,
                **fields: Any) -> Tracks:  # fmt: skip
    """Make valid random tracks."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, components, len(axes), len(axes)))
    weight = rng.uniform(0.1, 1.0, (count, components))
    values: dict[str, Any] = {
        "weight": weight / weight.sum(1, keepdims=True), "mean": 10 * rng.normal(size=(count, components, len(axes))),
        "cov": root @ root.swapaxes(-1, -2) + 0.1 * np.eye(len(axes)), "time_ns": np.full(count, STAMP),
        "track_id": rng.permutation(count).astype(np.int64), "source": rng.integers(0, 2**32, count, np.uint32),
        "status": rng.integers(0, 8, count, np.uint8), "existence": rng.uniform(0, 1, count),
        "dof": np.full(count, np.inf),
    }  # fmt: skip
    return Tracks(axes=tuple(axes), frame_id="map", **{**values, **fields})


def live(tracks: TrackArrays, track: int) -> list[tuple[float, list[float], list[list[float]]]]:
    """Return the components of a track that have weight."""
    parts = zip(tracks.weight[track], tracks.mean[track], tracks.cov[track], strict=True)
    return [(w, m.tolist(), c.tolist()) for w, m, c in parts if w != 0]
