"""Plain arrays on the library's side of an adapter: no ROS, no track_fusion."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class MessageError(ValueError):
    """A message cannot be read; `reason` is the snake_case key under which it is counted."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclasses.dataclass(frozen=True, eq=False)
class TrackArrays:
    """N tracks of C components as decoded from a message; values are not judged here.

    Shapes as in `track_fusion.tracks.TrackBatch`, whose field names these are: weight (N, C),
    mean (N, C, n), cov (N, C, n, n), the others (N,), uuid (N, 16) or None. Components are padded
    with weight 0, repeating the first.
    """

    axes: tuple[str, ...]
    frame_id: str
    weight: Floats
    mean: Floats
    cov: Floats
    time_ns: NDArray[np.int64]
    track_id: NDArray[np.int64]
    source: NDArray[np.uint32]
    status: NDArray[np.uint8]
    existence: Floats
    dof: Floats
    uuid: NDArray[np.uint8] | None = None
    phd: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class DetectionArrays:
    """N detections of one scan: value (N, m), cov (N, m, m) or None when the message carries none."""

    axes: tuple[str, ...]
    frame_id: str
    time_ns: int
    value: Floats
    cov: Floats | None
