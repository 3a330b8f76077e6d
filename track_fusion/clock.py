"""How far the clocks of a robot are trusted."""

from __future__ import annotations

import dataclasses

from track_fusion.params import Params, param
from track_fusion.tracks import SECOND_NS


@dataclasses.dataclass(frozen=True)
class ClockParams(Params):
    """How far the clocks are trusted."""

    clock_tolerance_s: float = param(
        0.1,
        "a backward step of the clock up to this is ridden out, a larger one starts all anew; a scan stamped further "
        "ahead of the clock waits for its time",
        unit="s",
        low=0.0,
    )

    @property
    def tolerance_ns(self) -> int:
        """The same in nanoseconds."""
        return round(self.clock_tolerance_s * SECOND_NS)
