"""The fusion centre as an object: it holds configuration, state and waiting scans together."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from track_fusion.centre import buffer
from track_fusion.centre.buffer import ScanBuffer
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.history import History, Late, Rewound, forward, rewind
from track_fusion.centre.pool import predicted_to
from track_fusion.centre.publish import StepInfo
from track_fusion.centre.state import CentreState
from track_fusion.tracks import TrackBatch


class Published(NamedTuple):
    """The outcome of a step.

    Attributes
    ----------
    time_ns : int              for which the tracks are published; strictly increasing
    tracks : TrackBatch
    info : StepInfo            what happened in the step
    kept_out : Counter         scans that take no part, by reason
    rewound : Rewound, None    what was repeated before it, for scans that had come late
    predicted : int            late scans for which nothing was repeated, since that had taken its share of the time
    """

    time_ns: int
    tracks: TrackBatch
    info: StepInfo
    kept_out: Counter[str]
    rewound: Rewound | None = None
    predicted: int = 0


class Debt(NamedTuple):
    """What rewinds owe: while they owe nothing one may begin; they pay with their share of the time that goes by.

    So they take no more than that share of any long time, of a short one no more than one rewind beyond it.
    """

    owed_s: float = 0.0
    seen_s: float = 0.0

    def at(self, now_s: float, share: float) -> Debt:
        """Return what is owed at a time."""
        return Debt(max(0.0, self.owed_s - share * (now_s - self.seen_s)), now_s)

    def with_rewind(self, took_s: float) -> Debt:
        """Add a rewind that began at the time of this debt."""
        return Debt(self.owed_s + took_s, self.seen_s)


class FusionCentre:
    """Fuses the tracks of sources into central tracks.

    Tell it of each scan by `receive` and of time by `advance`, and it decides when a step runs, as the node does; or
    decide yourself, and call `step`.

    doc/fusion-centre.md has an example.

    Attributes
    ----------
    config : CentreConfig
    history : History        the state and, with retrodiction, the last steps; a value: keep it, set it to go back
    buffer : ScanBuffer      likewise
    resets : int             how often the clock was seen to step back further than is ridden out

    Parameters
    ----------
    config : CentreConfig
    clock : callable    tells the seconds by which the time that rewinds take is measured; one that stands still lets
                        all of them through, so that results do not depend on the machine
    """

    def __init__(self, config: CentreConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self.config, self.resets, self._clock, self._debt = config, 0, clock, Debt()
        self.history, self.buffer = History.of(CentreState.initial(config)), ScanBuffer.empty(config)

    def reset(self) -> None:
        """Forget all tracks and scans; identifiers go on counting."""
        fresh = CentreState.initial(self.config)
        central = dataclasses.replace(fresh.central, next_id=self.history.next_id)
        self.state, self.buffer = dataclasses.replace(fresh, central=central), ScanBuffer.empty(self.config)

    @property
    def state(self) -> CentreState:
        """The state, which with retrodiction has numbers of its own; who sets it forgets the steps before it."""
        return self.history.present.state

    @state.setter
    def state(self, state: CentreState) -> None:
        self.history = History.of(state)

    @property
    def tracks(self) -> TrackBatch:
        """All living central tracks, tentative ones included."""
        return self.history.present.tracks

    def step(self, time_ns: int, scans: Mapping[int, TrackBatch]) -> tuple[TrackBatch, StepInfo]:
        """Fuse at one time; see :func:`track_fusion.centre.step.step`."""
        self.history, published, info = forward(self.config, self.history, time_ns, scans)
        self.buffer = dataclasses.replace(self.buffer, fused_ns=time_ns)
        return published, info

    def receive(self, source: int, scan: TrackBatch, stamp_ns: int, now_ns: int) -> str | None:
        """Take in a scan; return None, or why it was turned away: see :func:`track_fusion.centre.buffer.add`."""
        self._heed(now_ns)
        self.buffer, reason = buffer.add(self.config, self.buffer, source, scan, stamp_ns, now_ns)
        return reason

    def advance(self, now_ns: int) -> Iterator[Published]:
        """Run the steps that are due by now, one whenever the next result is asked for."""
        self._heed(now_ns)
        while True:
            self._debt = self._debt.at(self._clock(), self.config.buffer.max_rewind_share)
            living, may_rewind = len(self.state.central) > 0, self._debt.owed_s == 0.0
            self.buffer, due = buffer.advance(self.config, self.buffer, now_ns, living, may_rewind)
            if due is None:
                return
            rewound = self._rewind(due.late) if due.late else None
            kept_out = due.kept_out if rewound is None else due.kept_out + rewound.kept_out
            tracks, info = self.step(due.time_ns, due.scans)
            shown = self._shown(tracks, due.publish_ns)
            yield Published(due.publish_ns, shown, info, kept_out, rewound, due.predicted)

    def _rewind(self, late: tuple[tuple[int, TrackBatch, int], ...]) -> Rewound:
        """Repeat the steps since the late scans, which have waited for this next step: one rewind for all of them."""
        self.history, rewound = rewind(self.config, self.history, [Late(*one) for one in late])
        self._debt = self._debt.with_rewind(self._clock() - self._debt.seen_s)
        return rewound

    def wake_ns(self, now_ns: int) -> int | None:
        """Return when to call `advance` even if no scan comes; see :func:`track_fusion.centre.buffer.wake_ns`."""
        return buffer.wake_ns(self.config, self.buffer, now_ns)

    def _heed(self, now_ns: int) -> None:
        """Start anew when the clock has stepped back by more than its tolerance."""
        if now_ns < self.buffer.now_ns - self.config.clock.tolerance_ns:
            self.resets += 1
            self.reset()

    def _shown(self, tracks: TrackBatch, time_ns: int) -> TrackBatch:
        return tracks if not len(tracks) else predicted_to(tracks, time_ns, self.config.motion)
