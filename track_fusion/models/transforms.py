"""Transforms of states between the axes and frames of those who report them."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, symmetrise
from track_fusion.tracks import StateLayout, TrackBatch


@dataclasses.dataclass(frozen=True, eq=False)
class Transform:
    """An affine map of states: x' = A x + b, P' = A P A'.

    Attributes
    ----------
    layout : StateLayout    the m axes of what it takes
    frame_id : str          and their frame
    matrix : (n, m)         A
    offset : (n,)           b

    Raises
    ------
    ValueError    the shapes do not fit each other or the layout
    """

    layout: StateLayout
    frame_id: str
    matrix: Array
    offset: Array

    def __post_init__(self) -> None:
        shapes = self.matrix.shape, self.offset.shape
        if shapes != ((len(self.offset), self.layout.size), (len(self.offset),)):
            raise ValueError(
                f"The 'matrix' and 'offset' of a transform must have shapes (n, {self.layout.size}) and (n,). "
                f"Got {shapes[0]} and {shapes[1]}."
            )

    @property
    def brings(self) -> NDArray[np.bool_]:
        """Which axes of the result tell of the state, (n,)."""
        return np.asarray(self.matrix.any(1))

    def __call__(self, tracks: TrackBatch, layout: StateLayout, frame_id: str) -> TrackBatch:
        """Bring tracks, component by component, into the n axes of a layout and its frame."""
        mean = tracks.mean @ self.matrix.T + self.offset
        cov = symmetrise(self.matrix @ tracks.cov @ self.matrix.T)
        return tracks.replace(layout=layout, frame_id=frame_id, mean=mean, cov=cov)
