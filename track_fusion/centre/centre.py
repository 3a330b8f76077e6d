"""The fusion centre as an object: it holds configuration, state and waiting scans together."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from track_fusion.centre import buffer
from track_fusion.centre.buffer import ScanBuffer
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.pool import predicted_to
from track_fusion.centre.publish import StepInfo
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.tracks import TrackBatch


class Published(NamedTuple):
    """The outcome of a step: the tracks to publish and their time, what happened, scans kept out by reason."""

    time_ns: int
    tracks: TrackBatch
    info: StepInfo
    kept_out: Counter[str]


class FusionCentre:
    """Fuses the tracks of sources into central tracks.

    Tell it of each scan by `receive` and of time by `advance`, and it decides when a step runs, as the node does; or
    decide yourself, and call `step`.

    doc/fusion-centre.md has an example.

    Attributes
    ----------
    config : CentreConfig
    state : CentreState      a value: keep it, and set it again to go back
    buffer : ScanBuffer      likewise
    resets : int             how often the clock was seen to step back further than is ridden out
    """

    def __init__(self, config: CentreConfig) -> None:
        self.config, self.resets = config, 0
        self.state, self.buffer = CentreState.initial(config), ScanBuffer.empty(config)

    def reset(self) -> None:
        """Forget all tracks and scans; identifiers go on counting."""
        given = self.state.central.identities
        self.state, self.buffer = CentreState.initial(self.config, given), ScanBuffer.empty(self.config)

    @property
    def tracks(self) -> TrackBatch:
        """All living central tracks, tentative ones included."""
        return self.state.central.tracks

    def step(self, time_ns: int, scans: Mapping[int, TrackBatch]) -> tuple[TrackBatch, StepInfo]:
        """Fuse at one time; see :func:`track_fusion.centre.step.step`."""
        self.state, published, info = step(self.config, self.state, time_ns, scans)
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
            self.buffer, due = buffer.advance(self.config, self.buffer, now_ns, living=len(self.tracks) > 0)
            if due is None:
                return
            tracks, info = self.step(due.time_ns, due.scans)
            yield Published(due.publish_ns, self._shown(tracks, due.publish_ns), info, due.kept_out)

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
