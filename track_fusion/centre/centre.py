"""The fusion centre as an object: it holds configuration, state and waiting scans together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from track_fusion.centre import buffer
from track_fusion.centre.buffer import ScanBuffer
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.publish import StepInfo
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.tracks import TrackBatch


class Published(NamedTuple):
    """The outcome of a step: its time, the tracks to publish, what happened, counts of scans that were superseded."""

    time_ns: int
    tracks: TrackBatch
    info: StepInfo
    superseded: Counter[str]


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
    """

    def __init__(self, config: CentreConfig) -> None:
        self.config = config
        self.state, self.buffer = CentreState.initial(config), ScanBuffer.empty(config)

    def reset(self) -> None:
        """Forget all tracks and scans; identities go on, so that none is given again."""
        given = self.state.central.identities
        self.state, self.buffer = CentreState.initial(self.config, given), ScanBuffer.empty(self.config)

    @property
    def tracks(self) -> TrackBatch:
        """All living central tracks, tentative ones included."""
        return self.state.central.tracks

    def step(self, time_ns: int, scans: Mapping[int, TrackBatch]) -> tuple[TrackBatch, StepInfo]:
        """Fuse at one time; see :func:`track_fusion.centre.step.step`."""
        self.state, published, info = step(self.config, self.state, time_ns, scans)
        self.buffer = ScanBuffer(self.buffer.queues, time_ns)
        return published, info

    def receive(self, source: int, scan: TrackBatch, stamp_ns: int, now_ns: int) -> str | None:
        """Take in a scan; return None, or why it was turned away: see :func:`track_fusion.centre.buffer.add`.

        Here its stamps, as the source tells them, become those of the centre's clock: later by its `time_offset_s`.
        """
        offset_ns = self.config.sources[source].settings.time_offset_ns
        scan = scan.replace(time_ns=scan.time_ns + offset_ns) if offset_ns else scan
        self.buffer, reason = buffer.add(self.config, self.buffer, source, scan, stamp_ns + offset_ns, now_ns)
        return reason

    def advance(self, now_ns: int) -> Iterator[Published]:
        """Run the steps that are due by now, one whenever the next result is asked for."""
        while True:
            self.buffer, due = buffer.advance(self.config, self.buffer, now_ns, living=len(self.tracks) > 0)
            if due is None:
                return
            yield Published(due.time_ns, *self.step(due.time_ns, due.scans), due.superseded)
