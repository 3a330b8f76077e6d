"""Which scans make up the next fusion step, and when it may run; a value. doc/fusion-centre.md states the rules."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from track_fusion.centre.config import CentreConfig, ScanBufferParams
from track_fusion.centre.rhythm import STAMPS_KEPT, period_ns
from track_fusion.tracks import SECOND_NS, TrackBatch

#: A source is due this share of a period after its last scan: stamps jitter.
DUE_SHARE = 0.9


class Waiting(NamedTuple):
    """A scan that waits: its stamp, when its first and its last piece came, its tracks."""

    stamp_ns: int
    arrival_ns: int
    touched_ns: int
    scan: TrackBatch


@dataclasses.dataclass(frozen=True, eq=False)
class Queue:
    """The scans of one source on their way.

    Attributes
    ----------
    waiting : tuple of Waiting    in the order of their stamps
    taken_ns : int                stamp of the newest one that a step took, -1 = none yet
    heard_ns : int                when one was last taken in, -1 = never
    stamps : tuple of int         the newest few taken in, ascending
    ids, expected : frozenset     of a source in pieces: the tracks of its newest scan so far, those of the one before
    """

    waiting: tuple[Waiting, ...] = ()
    taken_ns: int = -1
    heard_ns: int = -1
    stamps: tuple[int, ...] = ()
    ids: frozenset[int] = frozenset()
    expected: frozenset[int] = frozenset()

    def newest_ns(self, horizon_ns: int) -> int:
        """Return the newest stamp up to a time, -1 = none."""
        return max((w.stamp_ns for w in self.waiting if w.stamp_ns <= horizon_ns), default=self.taken_ns)


@dataclasses.dataclass(frozen=True, eq=False)
class ScanBuffer:
    """The scans of S sources on their way to a step.

    Attributes
    ----------
    queues : tuple of Queue, (S,)
    fused_ns : int        time of the last step, -1 before the first
    ran_ns : int          when it ran
    published_ns : int    at which time its tracks were published
    now_ns : int          the time that was told last
    """

    queues: tuple[Queue, ...]
    fused_ns: int = -1
    ran_ns: int = -1
    published_ns: int = -1
    now_ns: int = -1

    @classmethod
    def empty(cls, config: CentreConfig) -> ScanBuffer:
        """Nothing heard yet."""
        return cls((Queue(),) * len(config.sources))

    def silence_s(self, source: int, now_ns: int) -> float:
        """Seconds since a scan of the source was taken in (or the first of any was); negative: nothing yet."""
        heard = self.queues[source].heard_ns
        return -1.0 if heard < 0 else (now_ns - heard) / SECOND_NS


class Step(NamedTuple):
    """A step that may run.

    Attributes
    ----------
    time_ns : int
    scans : dict           the new scans by source
    kept_out : Counter     scans that take no part, by reason
    publish_ns : int       at which time its tracks are published
    late : tuple           source, scan and stamp of those that belong to the past, for retrodiction
    """

    time_ns: int
    scans: dict[int, TrackBatch]
    kept_out: Counter[str]
    publish_ns: int
    late: tuple[tuple[int, TrackBatch, int], ...] = ()


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
    str or None    `stale_scan`, `out_of_order_scan`, `duplicate_scan`, `late_scan`, `duplicate_track_id` (of a piece
                   those tracks alone are turned away that its scan has already), `too_many_tracks` (of pieces put
                   together, too; as if the source had not been heard)
    """
    queue = buffer.queues[source]
    reason = _refusal(config.buffer, buffer, queue, stamp_ns, now_ns)
    if reason is None:
        queue, reason = _taken_in(config, source, queue, Waiting(stamp_ns, now_ns, now_ns, scan))
    most = config.sources[source].settings.max_tracks_per_scan
    if reason is None and any(len(waiting.scan) > most for waiting in queue.waiting):
        return buffer, "too_many_tracks"
    queues = list(buffer.queues)
    if reason is None:
        # The silence of sources that were never heard begins with the first scan of any.
        queues = [q if q.heard_ns >= 0 else dataclasses.replace(q, heard_ns=now_ns) for q in queues]
        queue = dataclasses.replace(queue, heard_ns=now_ns)
    queues[source] = queue
    return dataclasses.replace(buffer, queues=tuple(queues), now_ns=now_ns), reason


def _refusal(params: ScanBufferParams, buffer: ScanBuffer, queue: Queue, stamp_ns: int, now_ns: int) -> str | None:
    if stamp_ns < now_ns - params.max_delay_s * SECOND_NS:
        return "stale_scan"
    if stamp_ns >= buffer.fused_ns or stamp_ns == queue.taken_ns or params.out_of_sequence == "retrodict":
        return None
    if stamp_ns < queue.taken_ns:
        return "out_of_order_scan"
    return "late_scan" if params.out_of_sequence == "neglect" else None


def _taken_in(config: CentreConfig, source: int, queue: Queue, new: Waiting) -> tuple[Queue, str | None]:
    """Sort a scan in, or put a piece to the scan whose stamp it bears."""
    assembles = config.sources[source].assembles
    ids = frozenset(new.scan.track_id.tolist()) if assembles else frozenset[int]()
    newest = queue.stamps[-1] if queue.stamps else -1
    if new.stamp_ns == newest:
        queue = dataclasses.replace(queue, ids=queue.ids | ids)
    same = next((w for w in queue.waiting if w.stamp_ns == new.stamp_ns), None)
    joins_what_was_taken = assembles and config.retrodicts
    if same is None and new.stamp_ns == queue.taken_ns and not joins_what_was_taken:
        return queue, "late_scan" if assembles else "duplicate_scan"
    if same is not None and not assembles:
        return queue, "duplicate_scan"
    if same is not None:
        return _joined(queue, same, new)
    waiting = sorted((*queue.waiting, new._replace(scan=new.scan.owned())), key=lambda w: w.stamp_ns)
    stamps = tuple(sorted((*queue.stamps, new.stamp_ns))[-STAMPS_KEPT:])
    queue = dataclasses.replace(queue, waiting=tuple(waiting), stamps=stamps)
    return dataclasses.replace(queue, ids=ids, expected=queue.ids) if new.stamp_ns > newest else queue, None


def _joined(queue: Queue, scan: Waiting, piece: Waiting) -> tuple[Queue, str | None]:
    """Put those tracks of a piece to a scan that it lacks."""
    lacking = ~np.isin(piece.scan.track_id, scan.scan.track_id)
    reason = None if lacking.all() else "duplicate_track_id"
    if not lacking.any():
        return queue, reason
    whole = TrackBatch.concatenate([scan.scan, piece.scan[lacking]]).owned()
    grown = scan._replace(scan=whole, touched_ns=piece.arrival_ns)
    waiting = tuple(grown if w is scan else w for w in queue.waiting)
    return dataclasses.replace(queue, waiting=waiting), reason


def predicted(config: CentreConfig, step: Step) -> Step:
    """Take the late scans of a step as new ones: the newest of each source that brings no other, if not too old."""
    scans, kept_out = dict(step.scans), Counter(step.kept_out)
    for source, scan, stamp_ns in sorted(step.late, key=lambda late: late[2], reverse=True):
        if source in scans:
            kept_out["superseded_scan"] += 1
        elif _is_aged(config, step.time_ns, stamp_ns):
            kept_out["aged_scan"] += 1
        else:
            scans[source] = scan
    return step._replace(scans=scans, kept_out=kept_out, late=())


def _is_aged(config: CentreConfig, time_ns: int, stamp_ns: int) -> bool:
    return time_ns - stamp_ns > config.params.max_scan_age_s * SECOND_NS


def advance(config: CentreConfig, buffer: ScanBuffer, now_ns: int, living: bool) -> tuple[ScanBuffer, Step | None]:
    """Return the next step that may run, or None; the times of steps strictly increase.

    When all sources have been silent for `source_timeout_s`, a step runs as often, so that tracks coast.

    Parameters
    ----------
    living : bool    whether there are central tracks
    """
    buffer = dataclasses.replace(buffer, now_ns=now_ns)
    time_ns = _tick(config, buffer, now_ns) if config.buffer.trigger == "rate" else _due(config, buffer, now_ns)
    idle = now_ns - buffer.fused_ns >= config.buffer.source_timeout_s * SECOND_NS
    if time_ns is None and living and idle and all_silent(config, buffer, now_ns):
        time_ns = now_ns
    return (buffer, None) if time_ns is None else _taken(config, buffer, time_ns, now_ns)


def all_silent(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> bool:
    """Tell whether every source has been silent for `source_timeout_s`, after something was heard."""
    return all(buffer.silence_s(k, now_ns) >= config.buffer.source_timeout_s for k in range(len(buffer.queues)))


def wake_ns(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> int | None:
    """Return when time alone may make a step due; None: only another scan can."""
    return min((time_ns for time_ns in _deadlines(config, buffer, now_ns) if time_ns > now_ns), default=None)


def _deadlines(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> Iterator[int]:
    params, timeout_ns = config.buffer, round(config.buffer.source_timeout_s * SECOND_NS)
    heard = [queue.heard_ns for queue in buffer.queues if queue.heard_ns >= 0]
    yield from (since_ns + timeout_ns for since_ns in (*heard, *([buffer.fused_ns] if heard else ())))
    if params.trigger == "rate":
        period = round(SECOND_NS / params.output_rate_hz)
        yield (now_ns // period + 1) * period
        return
    yield buffer.ran_ns + _least_gap_ns(params)
    for queue in buffer.queues:
        for waiting in queue.waiting:
            since_ns = _since_ns(config, waiting)
            yield since_ns
            yield since_ns + round(params.gather_window_s * SECOND_NS)
            yield since_ns + round(params.fusion_timeout_s * SECOND_NS)
            yield waiting.touched_ns + round(params.assembly_window_s * SECOND_NS)


def _least_gap_ns(params: ScanBufferParams) -> int:
    return round(SECOND_NS / params.max_output_rate_hz) if params.max_output_rate_hz else 0


def _since_ns(config: CentreConfig, waiting: Waiting) -> int:
    """Tell since when a scan has waited: one ahead of the clock does not before its time."""
    return max(waiting.arrival_ns, waiting.stamp_ns - config.clock.tolerance_ns)


def _tick(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> int | None:
    """Return the last tick, when no step has run at it and anything was heard."""
    period = round(SECOND_NS / config.buffer.output_rate_hz)
    time_ns = now_ns // period * period
    heard = any(queue.heard_ns >= 0 for queue in buffer.queues)
    return time_ns if heard and time_ns > buffer.fused_ns else None


def _due(config: CentreConfig, buffer: ScanBuffer, now_ns: int) -> int | None:
    """Return the time of the next step of scans that wait, when it may run."""
    timeout_ns = round(config.buffer.fusion_timeout_s * SECOND_NS)
    waiting = [w for q in buffer.queues for w in q.waiting if w.stamp_ns <= now_ns + config.clock.tolerance_ns]
    ahead = [w for w in waiting if w.stamp_ns > buffer.fused_ns]
    if waiting and not ahead:  # none advances time: when no other comes, one step of the least advance takes them up
        overdue = now_ns - min(_since_ns(config, w) for w in waiting) >= timeout_ns
        return buffer.fused_ns + 1 if overdue else None
    time_ns = _next_stamp(config.buffer, buffer, [w.stamp_ns for w in ahead], now_ns)
    if time_ns is None:
        return None
    waited_ns = now_ns - min(_since_ns(config, w) for w in ahead if w.stamp_ns == time_ns)
    return time_ns if waited_ns >= timeout_ns or _is_complete(config, buffer, time_ns, now_ns, waited_ns) else None


def _next_stamp(params: ScanBufferParams, buffer: ScanBuffer, stamps: list[int], now_ns: int) -> int | None:
    """Return which of the stamps is the time of the next step; those closer than the rate allows are joined."""
    gap_ns = _least_gap_ns(params) if buffer.fused_ns >= 0 else 0
    far = [stamp_ns for stamp_ns in stamps if stamp_ns >= buffer.fused_ns + gap_ns]
    if far:
        return min(far)
    return max(stamps) if stamps and now_ns >= buffer.ran_ns + gap_ns else None


def _is_complete(config: CentreConfig, buffer: ScanBuffer, time_ns: int, now_ns: int, waited_ns: int) -> bool:
    """Tell whether all scans of a time are there, as far as the trigger asks, each with all its pieces."""
    params, timeout_ns = config.buffer, config.buffer.source_timeout_s * SECOND_NS
    gathered = waited_ns >= params.gather_window_s * SECOND_NS
    for queue, source in zip(buffer.queues, config.sources, strict=True):
        if source.assembles and _in_pieces(params, queue, time_ns, now_ns):
            return False
        newest_ns, live = queue.newest_ns(now_ns + config.clock.tolerance_ns), now_ns - queue.heard_ns < timeout_ns
        if not live or newest_ns >= time_ns:
            continue
        if params.trigger == "all_sources" or (not gathered and _is_due(queue, newest_ns, time_ns)):
            return False
    return True


def _is_due(queue: Queue, newest_ns: int, time_ns: int) -> bool:
    period = period_ns(queue.stamps)
    return period > 0 and time_ns - newest_ns >= DUE_SHARE * period


def _in_pieces(params: ScanBufferParams, queue: Queue, time_ns: int, now_ns: int) -> bool:
    """Tell whether the newest scan of a source, if stamped up to a time, may lack pieces."""
    if not queue.waiting or queue.waiting[-1].stamp_ns > time_ns or queue.waiting[-1].stamp_ns < queue.stamps[-1]:
        return False
    if params.trigger == "all_sources":
        return True  # whatever the order of arrival across sources, the steps are the same
    all_there = bool(queue.expected) and queue.expected <= queue.ids
    return not all_there and now_ns - queue.waiting[-1].touched_ns < params.assembly_window_s * SECOND_NS


def _taken(config: CentreConfig, buffer: ScanBuffer, time_ns: int, now_ns: int) -> tuple[ScanBuffer, Step]:
    """Take the scans of a step: of each source the newest one up to its time, and the late ones for retrodiction."""
    params, past_ns = config.buffer, buffer.fused_ns if config.buffer.out_of_sequence == "retrodict" else -1
    scans: dict[int, TrackBatch] = {}
    kept_out: Counter[str] = Counter()
    late: list[tuple[int, TrackBatch, int]] = []
    queues = list(buffer.queues)
    for k, queue in enumerate(buffer.queues):
        due = [w for w in queue.waiting if w.stamp_ns <= time_ns]
        if params.trigger == "rate" and config.sources[k].assembles and _in_pieces(params, queue, time_ns, now_ns):
            due = due[:-1]
        if not due:
            continue
        late += [(k, w.scan, w.stamp_ns) for w in due if w.stamp_ns <= past_ns]
        new = [w for w in due if w.stamp_ns > past_ns]
        kept_out["superseded_scan"] += max(len(new) - 1, 0)
        if new and _is_aged(config, time_ns, new[-1].stamp_ns):
            kept_out["aged_scan"] += 1
        elif new:
            scans[k] = new[-1].scan
        taken_ns = max(queue.taken_ns, due[-1].stamp_ns)
        queues[k] = dataclasses.replace(queue, waiting=queue.waiting[len(due) :], taken_ns=taken_ns)
    publish_ns = time_ns if params.publish_at == "stamp" else max(now_ns, time_ns, buffer.published_ns + 1)
    step = Step(time_ns, scans, +kept_out, publish_ns, tuple(late))
    return ScanBuffer(tuple(queues), time_ns, now_ns, publish_ns, now_ns), step
