"""The fusion centre as an object: it holds configuration, state and waiting scans together."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from track_fusion.centre import buffer
from track_fusion.centre.buffer import ScanBuffer, Step
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.history import History, Late, Rewound, forward, rewind
from track_fusion.centre.pool import predicted_to
from track_fusion.centre.publish import StepInfo
from track_fusion.centre.state import CentreState
from track_fusion.tracks import SECOND_NS, TrackBatch


class Published(NamedTuple):
    """The outcome of a step.

    Attributes
    ----------
    time_ns : int
    tracks : TrackBatch         to be published, at that time
    info : StepInfo             what happened
    kept_out : Counter          scans that took no part, by reason
    rewound : Rewound or None   what was repeated before the step for scans that came late
    beyond_share : int          late scans that were predicted instead, `max_rewind_share` being used up
    """

    time_ns: int
    tracks: TrackBatch
    info: StepInfo
    kept_out: Counter[str]
    rewound: Rewound | None = None
    beyond_share: int = 0


class FusionCentre:
    """Fuses the tracks of sources into central tracks.

    Tell it of each scan by `receive` and of time by `advance`, and it decides when a step runs, as the node does; or
    decide yourself, and call `step`.

    doc/fusion-centre.md has an example.

    Parameters
    ----------
    config : CentreConfig
    timer : function    seconds, of any zero: how long repeating steps takes (`max_rewind_share`)

    Attributes
    ----------
    config : CentreConfig
    history : History        a value: keep it, and set it again to go back; holds the state, and the last steps where
                             late scans make the centre repeat them
    buffer : ScanBuffer      likewise
    resets : int             how often the clock was seen to step back further than is ridden out
    """

    def __init__(self, config: CentreConfig, timer: Callable[[], float] = time.perf_counter) -> None:
        self.config, self.resets, self._timer = config, 0, timer
        self.history, self.buffer = History.of(CentreState.initial(config)), ScanBuffer.empty(config)
        self._allowance_s, self._told_ns = self._most_s, -1

    def reset(self) -> None:
        """Forget all tracks and scans; identities go on, so that none is given again."""
        given = self.state.central.identities._replace(births=self.history.next_id)
        self.history, self.buffer = History.of(CentreState.initial(self.config, given)), ScanBuffer.empty(self.config)

    @property
    def state(self) -> CentreState:
        """What the next step begins with; tracks are numbered in it as if all scans had come in time."""
        return self.history.present.state

    @property
    def tracks(self) -> TrackBatch:
        """All living central tracks, tentative ones included."""
        return self.history.present.known(self.state.central.tracks)

    def step(self, time_ns: int, scans: Mapping[int, TrackBatch]) -> tuple[TrackBatch, StepInfo]:
        """Fuse at one time; see :func:`track_fusion.centre.step.step`."""
        self.history, published, info = forward(self.config, self.history, time_ns, scans)
        self.buffer = dataclasses.replace(self.buffer, fused_ns=time_ns)
        return published, info

    def receive(self, source: int, scan: TrackBatch, stamp_ns: int, now_ns: int) -> str | None:
        """Take in a scan; return None, or why it was turned away: see :func:`track_fusion.centre.buffer.add`.

        Here its stamps, as the source tells them, become those of the centre's clock: later by its `time_offset_s`.
        """
        self._heed(now_ns)
        offset_ns = self.config.sources[source].settings.time_offset_ns
        scan = scan.replace(time_ns=scan.time_ns + offset_ns) if offset_ns else scan
        self.buffer, reason = buffer.add(self.config, self.buffer, source, scan, stamp_ns + offset_ns, now_ns)
        return reason

    def advance(self, now_ns: int) -> Iterator[Published]:
        """Run the steps that are due by now, one whenever the next result is asked for."""
        self._heed(now_ns)
        while True:
            living = len(self.state.central) > 0
            self.buffer, due = buffer.advance(self.config, self.buffer, now_ns, living)
            if due is None:
                return
            rewound = self._rewound(due, now_ns) if due.late else None
            beyond_share = 0 if rewound else len(due.late)
            own = buffer.predicted(self.config, due) if beyond_share else due
            kept_out = own.kept_out + rewound.kept_out if rewound else own.kept_out
            tracks, info = self.step(own.time_ns, own.scans)
            tracks = self._shown(tracks, own.publish_ns)
            yield Published(own.publish_ns, tracks, info, kept_out, rewound, beyond_share)

    @property
    def _most_s(self) -> float:
        return self.config.buffer.max_rewind_share * self.config.buffer.history_length_s

    def _rewound(self, due: Step, now_ns: int) -> Rewound | None:
        """Repeat steps for late scans, if the share of the time that this may take allows it."""
        share = self.config.buffer.max_rewind_share
        if self._told_ns >= 0:
            passed_s = max(now_ns - self._told_ns, 0) / SECOND_NS
            self._allowance_s = min(self._allowance_s + share * passed_s, self._most_s)
        self._told_ns = now_ns
        if share < 1.0 and self._allowance_s <= 0.0:
            return None
        began_s = self._timer()
        late = (Late(source, scan, stamp_ns) for source, scan, stamp_ns in due.late)
        self.history, rewound = rewind(self.config, self.history, late)
        self._allowance_s -= self._timer() - began_s
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
