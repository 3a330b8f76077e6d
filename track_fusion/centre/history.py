"""The last steps of a centre: a scan that comes late is put where it belongs, and the steps since are repeated.

A value, as the state is. What is repeated are the steps that would have run had the scan come in time, so that the
state becomes, bit for bit, the one that would be. It numbers its tracks accordingly; by which identifiers readers know
them is kept beside it, and outlives a rewind.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.config import CentreConfig
from track_fusion.centre.manage import Changes
from track_fusion.centre.publish import Fed, StepInfo, publish
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.tracks import ROW_FIELDS, SECOND_NS, TrackBatch

MEGABYTE = 1_000_000

Ids = NDArray[np.int64]
#: A source track at one time: its source, its identifier there, its stamp.
Sighting = tuple[int, int, int]
#: An identifier that a repeated course gave, and one by which readers may know the same track.
Claim = tuple[int, int]


class Stamped(NamedTuple):
    """A scan with its stamp, which an empty one does not hold."""

    stamp_ns: int
    scan: TrackBatch


class Late(NamedTuple):
    """A scan that came late, and whose it is."""

    source: int
    scan: TrackBatch
    stamp_ns: int


class Named(NamedTuple):
    """A state, and the identifiers by which readers know its central tracks, (T,)."""

    state: CentreState
    ids: Ids

    def known(self, tracks: TrackBatch) -> TrackBatch:
        """Give some of the state's tracks the identities by which readers know them."""
        ids = _exchanged(self.state.central.tracks.track_id, self.ids, tracks.track_id)
        if np.array_equal(ids, tracks.track_id):
            return tracks
        return tracks.replace(track_id=ids, uuid=self.state.central.identities.uuids(ids.tolist()))


@dataclasses.dataclass(frozen=True, eq=False)
class Kept:
    """A step that can be repeated.

    Attributes
    ----------
    before : Named
    time_ns : int
    scans : {source: Stamped}
    founders : {Sighting: int}    which source tracks started which central track here, in this or an earlier course
    """

    before: Named
    time_ns: int
    scans: Mapping[int, Stamped]
    founders: Mapping[Sighting, int]

    @cached_property
    def nbytes(self) -> int:
        """Bytes of the scans and of the central tracks before them, which are nearly all there is."""
        batches = [self.before.state.central.tracks, *(stamped.scan for stamped in self.scans.values())]
        return sum(getattr(batch, name).nbytes for batch in batches for name in ROW_FIELDS)


@dataclasses.dataclass(frozen=True, eq=False)
class History:
    """The present of a centre and, where it retrodicts, its last steps.

    Attributes
    ----------
    present : Named
    kept : tuple of Kept    in the order of time
    next_id : int           by what readers will know the next newborn; never goes back
    """

    present: Named
    kept: tuple[Kept, ...] = ()
    next_id: int = 1

    @classmethod
    def of(cls, state: CentreState) -> History:
        """Begin at a state."""
        return cls(Named(state, state.central.tracks.track_id), (), state.central.identities.births)

    @property
    def begin_ns(self) -> int:
        """A scan stamped later than this finds its place."""
        return (self.kept[0].before if self.kept else self.present).state.time_ns


class Rewound(NamedTuple):
    """What a rewind did.

    Attributes
    ----------
    repeated : int               steps that ran again, or anew for a late scan
    vanished : (N,)              identifiers of published tracks that are no more
    kept_out : {reason: count}   late scans: `older_than_history`, `duplicate_scan`, `superseded_scan`,
                                 `duplicate_track_id` (pieces of one)
    """

    repeated: int
    vanished: Ids
    kept_out: Counter[str]


def forward(
    config: CentreConfig, history: History, time_ns: int, scans: Mapping[int, TrackBatch]
) -> tuple[History, TrackBatch, StepInfo]:
    """Make a step, see :func:`track_fusion.centre.step.step`, and remember it where the centre retrodicts."""
    if not config.retrodicts:
        state, published, info = step(config, history.present.state, time_ns, scans)
        return History.of(state), published, info
    own = {k: Stamped(int(scan.time_ns[0]) if len(scan) else time_ns, scan.owned()) for k, scan in scans.items()}
    before = history.present
    present, published, info = _stepped(config, before, time_ns, own, history.next_id)
    kept = Kept(before, time_ns, own, _founders(info))
    next_id = history.next_id + len(info.changes.born)
    return History(present, _bounded(config, (*history.kept, kept)), next_id), published, info


def rewind(config: CentreConfig, history: History, late: Iterable[Late]) -> tuple[History, Rewound]:
    """Put late scans where they belong and repeat the steps since.

    Parameters
    ----------
    config : CentreConfig
    history : History         the one before; it stays as it is
    late : iterable of Late   stamped no later than the last step, in any order

    Returns
    -------
    History    its state is the one that would be had the scans come in time
    Rewound

    Raises
    ------
    ValueError    a scan does not fit its source, or is not late
    """
    steps, first, kept_out = _placed(config, history, late)
    if first == len(steps):
        return history, Rewound(0, history.present.ids[:0], kept_out)
    course, claims = _repeated(config, steps[first:], history)
    seen = _published_ids(config, history.present)
    course = _named(course, claims, set(seen.tolist()), history.next_id)
    kept = _bounded(config, (*steps[:first], *course.kept))
    vanished = np.setdiff1d(seen, course.present.ids)
    return dataclasses.replace(course, kept=kept), Rewound(len(steps) - first, vanished, kept_out)


def _repeated(config: CentreConfig, steps: Sequence[Kept], history: History) -> tuple[History, set[Claim]]:
    """Run steps from the state before the first, giving new identifiers to all that is born.

    A claim is made by each central track that takes up a source track which, in the course before, started one.
    """
    known = {sighting: name for kept in steps for sighting, name in kept.founders.items()}
    present, next_id, kept = steps[0].before, history.next_id, []
    claims: set[Claim] = set()
    for own in steps:
        before = present
        present, _, info = _stepped(config, before, own.time_ns, own.scans, next_id)
        next_id += len(info.changes.born)
        kept.append(Kept(before, own.time_ns, own.scans, {**own.founders, **_founders(info)}))
        claims |= {(given, known[sighting]) for sighting, given in _sightings(info.fed) if sighting in known}
    return History(present, tuple(kept), next_id), claims


def _stepped(
    config: CentreConfig, before: Named, time_ns: int, scans: Mapping[int, Stamped], next_id: int
) -> tuple[Named, TrackBatch, StepInfo]:
    """Make a step; all identifiers that it gives are those of readers, of the newborn from `next_id` on."""
    state, published, info = step(config, before.state, time_ns, {k: own.scan for k, own in scans.items()})
    born = info.changes.born
    own_ids = np.concatenate([before.state.central.tracks.track_id, born])
    named = partial(_exchanged, own_ids, np.concatenate([before.ids, next_id + np.arange(len(born))]))
    changes = Changes(*map(named, vars(info.changes).values()))
    fed = info.fed._replace(central=named(info.fed.central))
    info = dataclasses.replace(info, changes=changes, fed=fed, merged=named(info.merged))
    present = Named(state, named(state.central.tracks.track_id))
    return present, present.known(published), info


def _exchanged(words: Ids, meanings: Ids, ids: Ids) -> Ids:
    """Exchange identifiers, each one of the words, for their meanings."""
    order = np.argsort(words, kind="stable")
    meant = np.asarray(meanings[order[np.searchsorted(words, ids, sorter=order)]])
    meant.setflags(write=False)
    return meant


def _bounded(config: CentreConfig, kept: tuple[Kept, ...]) -> tuple[Kept, ...]:
    """Drop the oldest steps, beyond the bounds of time and memory."""
    oldest_ns = kept[-1].time_ns - config.buffer.history_length_s * SECOND_NS
    nbytes, begin = sum(step.nbytes for step in kept), 0
    while begin < len(kept) and (
        kept[begin].time_ns < oldest_ns or nbytes > config.buffer.history_megabytes * MEGABYTE
    ):
        nbytes -= kept[begin].nbytes
        begin += 1
    return kept[begin:]


# Where late scans belong.


def _placed(config: CentreConfig, history: History, late: Iterable[Late]) -> tuple[list[Kept], int, Counter[str]]:
    """Put late scans into the steps: all steps, how many of them are as before, the scans that have no place."""
    now_ns = history.present.state.time_ns
    steps, kept_out, since_ns = list(history.kept), Counter[str](), now_ns + 1
    for scan in sorted(late, key=lambda scan: (scan.stamp_ns, scan.source)):
        if scan.stamp_ns > now_ns:
            raise ValueError(f"A late scan must not be later than the last step, {now_ns} ns. Got {scan.stamp_ns}.")
        if scan.stamp_ns <= history.begin_ns:
            kept_out["older_than_history"] += 1
            continue
        at = _its_step(config, steps, scan)
        scans, reason = _with(config.sources[scan.source].assembles, steps[at].scans, scan)
        kept_out.update([reason] if reason else [])
        if scans is not None:
            steps[at] = dataclasses.replace(steps[at], scans=scans)
            since_ns = min(since_ns, steps[at].time_ns)
    return steps, bisect_left(steps, since_ns, key=_time_ns), kept_out


def _time_ns(kept: Kept) -> int:
    return kept.time_ns


def _its_step(config: CentreConfig, steps: list[Kept], late: Late) -> int:
    """Return the index of the step of a late scan: one at its stamp, or the next one where steps join scans.

    The step that took a scan of the same stamp is the one: it tells repeated scans, and pieces of one.
    """
    for at, kept in enumerate(steps):
        taken = kept.scans.get(late.source)
        if taken is not None and taken.stamp_ns == late.stamp_ns:
            return at
    at = bisect_left(steps, late.stamp_ns, key=_time_ns)
    if steps[at].time_ns != late.stamp_ns and not config.joins_scans:
        steps.insert(at, Kept(steps[at].before, late.stamp_ns, {}, {}))
    return at


def _with(assembles: bool, scans: Mapping[int, Stamped], late: Late) -> tuple[Mapping[int, Stamped] | None, str | None]:
    """Return the scans of a step with a late one, and why one of them was kept out."""
    new, taken = Stamped(late.stamp_ns, late.scan.owned()), scans.get(late.source)
    if taken is None:
        return {**scans, late.source: new}, None
    if taken.stamp_ns != new.stamp_ns:
        return ({**scans, late.source: new} if taken.stamp_ns < new.stamp_ns else None), "superseded_scan"
    if not assembles:
        return None, "duplicate_scan"
    lacking = ~np.isin(new.scan.track_id, taken.scan.track_id)
    reason = None if lacking.all() else "duplicate_track_id"
    whole = TrackBatch.concatenate([taken.scan, new.scan[lacking]]).owned()
    return ({**scans, late.source: Stamped(new.stamp_ns, whole)} if lacking.any() else None), reason


# By which identifiers readers know the tracks of a repeated course.


def _sightings(fed: Fed) -> Iterator[tuple[Sighting, int]]:
    """Yield each source track that was fused, with its central track."""
    return zip(zip(*(column.tolist() for column in fed[:3]), strict=True), fed.central.tolist(), strict=True)


def _founders(info: StepInfo) -> dict[Sighting, int]:
    """Tell which source track started each newborn: the first that went into it."""
    born = info.changes.born.tolist()
    first = {central: sighting for sighting, central in reversed(list(_sightings(info.fed)))} if born else {}
    return {first[central]: central for central in born}


def _published_ids(config: CentreConfig, present: Named) -> Ids:
    tracks = present.state.central.tracks
    return publish(config.params, tracks.replace(track_id=present.ids)).track_id


def _named(course: History, claims: set[Claim], seen: set[int], next_id: int) -> History:
    """Give the tracks of a repeated course, which numbered its newborn from `next_id` on, the names that readers know.

    Those `seen` now come first, and go to tracks that live now; where a track has a choice, it takes its own, or the
    oldest. A track without a claim gets a name that nobody ever had.
    """
    old, living = course.kept[0].before.ids.tolist(), set(course.present.ids.tolist())
    if claims:
        claims = claims | {(given, given) for given in old}
    names: dict[int, int] = {}
    taken: set[int] = set()
    for given, name in sorted(claims, key=lambda c: (c[1] not in seen, c[0] not in living, c[0] != c[1], c[1], c[0])):
        if given not in names and name not in taken:
            names[given] = name
            taken.add(name)
    for given in (*(old if claims else ()), *range(next_id, course.next_id)):
        if given not in names:
            names[given], next_id = next_id, next_id + 1
    changed = {given: name for given, name in names.items() if given != name}
    return dataclasses.replace(_renamed(course, changed) if changed else course, next_id=next_id)


def _renamed(course: History, names: Mapping[int, int]) -> History:
    """Exchange the identifiers that a course gave; the state before its first step is not of its making."""
    given = [course.present.ids, *(kept.before.ids for kept in course.kept), np.fromiter(names, np.int64)]
    words = np.unique(np.concatenate(given))
    meanings = np.fromiter((names.get(word, word) for word in words.tolist()), np.int64)
    kept = []
    for k, own in enumerate(course.kept):
        before = own.before._replace(ids=_exchanged(words, meanings, own.before.ids)) if k else own.before
        founders = {sighting: names.get(name, name) for sighting, name in own.founders.items()}
        kept.append(dataclasses.replace(own, before=before, founders=founders))
    present = course.present._replace(ids=_exchanged(words, meanings, course.present.ids))
    return History(present, tuple(kept), course.next_id)
