"""Which scans make up the next fusion step, and when it may run. doc/fusion-centre.md states the rules."""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from collections.abc import Sequence

from track_fusion.params import Params, param
from track_fusion.tracks import SECOND_NS, TrackBatch


@dataclasses.dataclass(frozen=True)
class ScanBufferParams(Params):
    """When a fusion step runs and which scans are too late for it."""

    trigger: str = param(
        "all_sources",
        "all_sources: fuse once every live source has delivered a scan of that time or later; "
        "any_source: fuse at every scan",
        choices=("all_sources", "any_source"),
    )
    fusion_timeout_s: float = param(0.1, "how long a scan waits for the other sources", unit="s", low=0.0)
    source_timeout_s: float = param(
        1.0,
        "after this silence a source is not waited for; when all are silent, tracks coast",
        unit="s",
        low=0.0,
        strict=True,
    )
    max_delay_s: float = param(10.0, "a scan older than this on arrival is rejected", unit="s", low=0.0, strict=True)
    out_of_sequence: str = param(
        "predict",
        "a scan older than the last fusion: neglect it, or keep it as its source's newest and predict it from then on",
        choices=("neglect", "predict"),
    )


@dataclasses.dataclass
class _Source:
    waiting: deque[tuple[int, int, TrackBatch]] = dataclasses.field(default_factory=deque)  # stamp, arrival, scan
    newest_ns: int = -1
    heard_ns: int = -1
    assembles: bool = False


class ScanBuffer:
    """Orders the scans of several sources into fusion steps.

    Parameters
    ----------
    assembles : sequence of bool    one a source: its scans arrive piece by piece (one message a track), so that a
                                    scan is complete only when a later one has begun
    params : ScanBufferParams
    """

    def __init__(self, assembles: Sequence[bool], params: ScanBufferParams) -> None:
        self._sources = [_Source(assembles=a) for a in assembles]
        self._params = params
        self.fused_ns = -1

    def reset(self) -> None:
        """Forget everything, after the clock has jumped back."""
        self.__init__([s.assembles for s in self._sources], self._params)  # type: ignore[misc]

    def add(self, source: int, scan: TrackBatch, stamp_ns: int, now_ns: int) -> str | None:
        """Take in a scan; return None, or the reason for which it was turned away."""
        state = self._sources[source]
        self._greet(now_ns)
        state.heard_ns = now_ns
        if stamp_ns < now_ns - self._params.max_delay_s * SECOND_NS:
            return "stale_scan"
        if stamp_ns < state.newest_ns:
            return "out_of_order_scan"
        if stamp_ns == state.newest_ns:
            return self._repeat(state, scan, stamp_ns)
        if stamp_ns < self.fused_ns and self._params.out_of_sequence == "neglect":
            return "late_scan"
        state.newest_ns = stamp_ns
        state.waiting.append((stamp_ns, now_ns, scan))
        return None

    def _greet(self, now_ns: int) -> None:
        """Start the silence of sources that were never heard."""
        for s in self._sources:
            if s.heard_ns < 0:
                s.heard_ns = now_ns

    @staticmethod
    def _repeat(state: _Source, scan: TrackBatch, stamp_ns: int) -> str | None:
        if not state.assembles:
            return "duplicate_scan"
        if not state.waiting or state.waiting[-1][0] != stamp_ns:
            return "late_scan"
        _, arrival, before = state.waiting[-1]
        if set(scan.track_id.tolist()) & set(before.track_id.tolist()):
            return "duplicate_track_id"
        state.waiting[-1] = (stamp_ns, arrival, TrackBatch.concatenate([before, scan]))
        return None

    def pop(self, now_ns: int) -> tuple[int, dict[int, TrackBatch], Counter[str]] | None:
        """Return the next step that may run, or None: time, new scans by source, counts of superseded ones."""
        stamps = [s.waiting[0] for s in self._sources if s.waiting]
        if not stamps:
            return None
        oldest, arrival, _ = min(stamps, key=lambda entry: entry[:2])
        time_ns = max(oldest, self.fused_ns)
        overdue = now_ns - arrival >= self._params.fusion_timeout_s * SECOND_NS
        if not overdue and self._params.trigger == "all_sources" and not self._complete(time_ns, now_ns):
            return None
        if not overdue and any(s.waiting and self._growing(s, time_ns) for s in self._sources):
            return None
        self.fused_ns = time_ns
        scans: dict[int, TrackBatch] = {}
        superseded: Counter[str] = Counter()
        for k, state in enumerate(self._sources):
            while state.waiting and state.waiting[0][0] <= time_ns:
                superseded["superseded_scan"] += k in scans
                scans[k] = state.waiting.popleft()[2]
        return time_ns, scans, +superseded

    @staticmethod
    def _growing(source: _Source, time_ns: int) -> bool:
        return source.assembles and source.waiting[0][0] <= time_ns and source.newest_ns <= time_ns

    def _complete(self, time_ns: int, now_ns: int) -> bool:
        silence = self._params.source_timeout_s * SECOND_NS
        live = [s for s in self._sources if now_ns - s.heard_ns < silence]
        return all(s.newest_ns >= time_ns for s in live)

    def silent_since(self, source: int, now_ns: int) -> float:
        """Seconds since the source was last heard (or since the first scan of any); negative: nothing yet."""
        heard = self._sources[source].heard_ns
        return -1.0 if heard < 0 else (now_ns - heard) / SECOND_NS

    def all_silent(self, now_ns: int) -> bool:
        """Tell whether every source has been silent for source_timeout_s, after something was heard."""
        return all(self.silent_since(k, now_ns) >= self._params.source_timeout_s for k in range(len(self._sources)))
