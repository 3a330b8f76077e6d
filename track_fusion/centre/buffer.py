"""Which scans make up the next fusion step, and when it may run; a value. doc/fusion-centre.md states the rules."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import NamedTuple

from track_fusion.centre.config import CentreConfig
from track_fusion.tracks import SECOND_NS, TrackBatch


class Waiting(NamedTuple):
    """A scan that waits: its stamp, when its first piece came, its tracks."""

    stamp_ns: int
    arrival_ns: int
    scan: TrackBatch


@dataclasses.dataclass(frozen=True, eq=False)
class Queue:
    """The scans of one source that wait, in order; the stamp of its newest one; when it was last heard; -1 = never."""

    waiting: tuple[Waiting, ...] = ()
    newest_ns: int = -1
    heard_ns: int = -1


@dataclasses.dataclass(frozen=True, eq=False)
class ScanBuffer:
    """The scans of S sources on their way to a step.

    Attributes
    ----------
    queues : tuple of Queue, (S,)
    fused_ns : int                   time of the last step, -1 before the first
    """

    queues: tuple[Queue, ...]
    fused_ns: int = -1

    @classmethod
    def empty(cls, config: CentreConfig) -> ScanBuffer:
        """Nothing heard yet."""
        return cls((Queue(),) * len(config.sources))

    def silence_s(self, source: int, now_ns: int) -> float:
        """Seconds since the source was last heard (or since the first scan of any); negative: nothing yet."""
        heard = self.queues[source].heard_ns
        return -1.0 if heard < 0 else (now_ns - heard) / SECOND_NS


class Step(NamedTuple):
    """A step that may run: its time, the new scans by source, counts of those that a newer one superseded."""

    time_ns: int
    scans: dict[int, TrackBatch]
    superseded: Counter[str]


def add(
    config: CentreConfig, buffer: ScanBuffer, source: int, scan: TrackBatch, stamp_ns: int, now_ns: int
) -> tuple[ScanBuffer, str | None]:
    """Take in a scan; return None, or the reason for which it was turned away.

    Parameters
    ----------
    config : CentreConfig
    buffer : ScanBuffer    the one before; it stays as it is
    source : int           whose scan it is
    scan : TrackBatch      all its tracks at `stamp_ns`, or, where scans come piece by piece, some
    stamp_ns : int
    now_ns : int           time of arrival

    Returns
    -------
    ScanBuffer
    str or None    `stale_scan`, `out_of_order_scan`, `duplicate_scan`, `late_scan`, `duplicate_track_id`,
                   `too_many_tracks` (of pieces put together, too; as if the source had not been heard)
    """
    # The silence of sources that were never heard begins with the first scan of any.
    queues = [q if q.heard_ns >= 0 else Queue(heard_ns=now_ns) for q in buffer.queues]
    queue = Queue(queues[source].waiting, queues[source].newest_ns, now_ns)
    reason = _refusal(config, buffer, queue, stamp_ns, now_ns)
    if reason is None and stamp_ns == queue.newest_ns:
        queue, reason = _assembled(config.sources[source].assembles, queue, scan)
    elif reason is None:
        queue = Queue((*queue.waiting, Waiting(stamp_ns, now_ns, scan.owned())), stamp_ns, now_ns)
    most = config.sources[source].settings.max_tracks_per_scan
    if reason is None and any(len(waiting.scan) > most for waiting in queue.waiting):
        return buffer, "too_many_tracks"
    queues[source] = queue
    return ScanBuffer(tuple(queues), buffer.fused_ns), reason


def _refusal(config: CentreConfig, buffer: ScanBuffer, queue: Queue, stamp_ns: int, now_ns: int) -> str | None:
    if stamp_ns < now_ns - config.buffer.max_delay_s * SECOND_NS:
        return "stale_scan"
    if stamp_ns < queue.newest_ns:
        return "out_of_order_scan"
    late = queue.newest_ns < stamp_ns < buffer.fused_ns
    return "late_scan" if late and config.buffer.out_of_sequence == "neglect" else None


def _assembled(assembles: bool, queue: Queue, piece: TrackBatch) -> tuple[Queue, str | None]:
    """Put a piece to the newest scan of its source, whose stamp it bears."""
    if not assembles:
        return queue, "duplicate_scan"
    if not queue.waiting or queue.waiting[-1].stamp_ns != queue.newest_ns:
        return queue, "late_scan"
    last = queue.waiting[-1]
    if set(piece.track_id.tolist()) & set(last.scan.track_id.tolist()):
        return queue, "duplicate_track_id"
    last = last._replace(scan=TrackBatch.concatenate([last.scan, piece]).owned())
    return Queue((*queue.waiting[:-1], last), queue.newest_ns, queue.heard_ns), None


def advance(config: CentreConfig, buffer: ScanBuffer, now_ns: int, living: bool) -> tuple[ScanBuffer, Step | None]:
    """Return the next step that may run, or None.

    When all sources have been silent for `source_timeout_s`, a step without scans runs as often, so that tracks coast.

    Parameters
    ----------
    living : bool    whether there are central tracks
    """
    after, step = _popped(config, buffer, now_ns)
    idle = now_ns - buffer.fused_ns >= config.buffer.source_timeout_s * SECOND_NS
    if step is None and living and idle and all_silent(config, buffer, now_ns):
        return ScanBuffer(buffer.queues, now_ns), Step(now_ns, {}, Counter())
    return after, step


def all_silent(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> bool:
    """Tell whether every source has been silent for `source_timeout_s`, after something was heard."""
    return all(buffer.silence_s(k, now_ns) >= config.buffer.source_timeout_s for k in range(len(buffer.queues)))


def _popped(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> tuple[ScanBuffer, Step | None]:
    """Return the next step of scans that wait, or None."""
    heads = [q.waiting[0] for q in buffer.queues if q.waiting]
    if not heads:
        return buffer, None
    oldest = min(heads, key=lambda head: head[:2])
    time_ns = max(oldest.stamp_ns, buffer.fused_ns)
    overdue = now_ns - oldest.arrival_ns >= config.buffer.fusion_timeout_s * SECOND_NS
    if not overdue and not _is_complete(config, buffer, time_ns, now_ns):
        return buffer, None
    scans: dict[int, TrackBatch] = {}
    superseded: Counter[str] = Counter()
    queues = []
    for k, queue in enumerate(buffer.queues):
        due = sum(head.stamp_ns <= time_ns for head in queue.waiting)
        if due:
            scans[k] = queue.waiting[due - 1].scan
            superseded["superseded_scan"] += due - 1
        queues.append(Queue(queue.waiting[due:], queue.newest_ns, queue.heard_ns) if due else queue)
    return ScanBuffer(tuple(queues), time_ns), Step(time_ns, scans, +superseded)


def _is_complete(config: CentreConfig, buffer: ScanBuffer, time_ns: int, now_ns: int) -> bool:
    """Tell whether all scans of a time are there, as far as the trigger asks, each with all its pieces."""
    for queue, source in zip(buffer.queues, config.sources, strict=True):
        started = bool(queue.waiting) and queue.waiting[0].stamp_ns <= time_ns
        if source.assembles and started and queue.newest_ns <= time_ns:
            return False
        live = now_ns - queue.heard_ns < config.buffer.source_timeout_s * SECOND_NS
        if config.buffer.trigger == "all_sources" and live and queue.newest_ns < time_ns:
            return False
    return True
