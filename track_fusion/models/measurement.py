"""Measurement models: what a sensor sees of a state."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.linalg import Array
from track_fusion.tracks import StateLayout


@dataclasses.dataclass(frozen=True)
class LinearSensor:
    """A sensor that reads some axes of the state: z = H x + v, v ~ N(0, R).

    Attributes
    ----------
    axes : tuple of str    what a detection holds
    matrix : (m, n)        H
    noise : (m, m)         R, squared SI units
    """

    axes: tuple[str, ...]
    matrix: Array
    noise: Array

    @classmethod
    def position(cls, layout: StateLayout, sd: float) -> LinearSensor:
        """Make a sensor of all position axes with standard deviation sd in metres, as Li 2022 (48)."""
        axes = tuple(layout.axes[i] for i in layout.position)
        return cls(axes, np.eye(layout.size)[list(layout.position)], sd**2 * np.eye(len(axes)))
