"""A state's named axes: their units, and which of them wrap."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from track_fusion.angles import KNOWN_PERIODS, periods_of

_UNITS = {"x": "m", "y": "m", "z": "m", "vx": "m/s", "vy": "m/s", "vz": "m/s",
          "ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2", "turn_rate": "rad/s", "speed": "m/s",
          "range": "m", "range_rate": "m/s", "length": "m", "width": "m", "height": "m",
          **dict.fromkeys(KNOWN_PERIODS, "rad")}  # fmt: skip
#: A period is a multiple of another up to this share of it: who writes 6.283185307 means a turn.
ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True)
class StateLayout:
    """The named axes of a state, in order. Units follow from the names, and so do periods unless given.

    Unknown names are allowed and have the unit "" (a state may hold anything).

    Attributes
    ----------
    axes : n distinct names
    periods : (n,)    of angular axes (pi for a yaw whose sign is unknown), infinite for the others; empty: as the names
                      say, see :func:`track_fusion.angles.periods_of`
    """

    axes: tuple[str, ...]
    periods: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise ValueError(f"The 'axes' of a layout must be distinct names. Got {self.axes!r}.")
        object.__setattr__(self, "periods", tuple(map(float, self.periods)) or periods_of(self.axes))
        if len(self.periods) != self.size or not all(p > 0 for p in self.periods):
            raise ValueError(
                f"The 'periods' of a layout must be {self.size} numbers > 0, infinite where an axis does not wrap. "
                f"Got {self.periods}."
            )

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
        """Which axes wrap, shape (n,)."""
        return np.isfinite(self.periods)

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

    def part(self, axes: Sequence[str]) -> StateLayout:
        """Return a layout of some of the axes, in the order given, with their periods.

        Raises
        ------
        ValueError    an axis is missing
        """
        return StateLayout(tuple(axes), tuple(self.periods[i] for i in self.indices(axes)))

    def into(self, other: StateLayout) -> tuple[int, ...]:
        """Return where the axes of another layout stand in this one, whose states can be read as the other's.

        Raises
        ------
        ValueError    an axis is missing, or its period is no multiple of the other's: a sign cannot be invented, nor
                      can what wraps be unrolled
        """
        at = self.indices(other.axes)
        for axis, i, period in zip(other.axes, at, other.periods, strict=True):
            own = self.periods[i]
            if math.isfinite(own) and abs(math.remainder(own, period)) > ROUNDING * own:
                raise ValueError(f"The axis '{axis}', of period {own:g}, cannot be read as one of period {period:g}.")
        return at


def planar_layout() -> StateLayout:
    """Position and velocity in the plane: x, y, vx, vy."""
    return StateLayout(("x", "y", "vx", "vy"))
