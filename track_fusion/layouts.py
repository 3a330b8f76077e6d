"""The named axes of a state."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

_UNITS = {"x": "m", "y": "m", "z": "m", "vx": "m/s", "vy": "m/s", "vz": "m/s",
          "ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2", "yaw": "rad", "turn_rate": "rad/s",
          "range": "m", "bearing": "rad", "elevation": "rad", "range_rate": "m/s"}  # fmt: skip
_ANGLES = frozenset({"yaw", "bearing", "elevation"})


@dataclasses.dataclass(frozen=True)
class StateLayout:
    """The named axes of a state, in order. Units and angular axes follow from the names.

    Unknown names are allowed and have the unit "" (a state may hold anything).
    """

    axes: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise ValueError(f"The 'axes' of a layout must be distinct names. Got {self.axes!r}.")

    @property
    def size(self) -> int:
        """Number of axes n."""
        return len(self.axes)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI unit of each axis."""
        return tuple(_UNITS.get(a, "") for a in self.axes)

    @cached_property
    def angular(self) -> NDArray[np.bool_]:
        """Which axes wrap at pi, shape (n,)."""
        return np.array([a in _ANGLES for a in self.axes])

    @cached_property
    def position(self) -> tuple[int, ...]:
        """Indices of x, y and z, as far as present."""
        return tuple(self.axes.index(a) for a in ("x", "y", "z") if a in self.axes)

    @cached_property
    def velocity(self) -> tuple[int, ...]:
        """Indices of vx, vy and vz, as far as present."""
        return tuple(self.axes.index(a) for a in ("vx", "vy", "vz") if a in self.axes)

    def indices(self, axes: Sequence[str]) -> tuple[int, ...]:
        """Return where the named axes stand.

        Raises
        ------
        ValueError    an axis is missing; the message names it
        """
        missing = [a for a in axes if a not in self.axes]
        if missing:
            raise ValueError(f"The layout has no axis {', '.join(missing)}. It has {', '.join(self.axes)}.")
        return tuple(self.axes.index(a) for a in axes)


def planar_layout() -> StateLayout:
    """Position and velocity in the plane: x, y, vx, vy."""
    return StateLayout(("x", "y", "vx", "vy"))
