"""What is known of each pair of a target and a track that were ever near each other, in a memory that does not grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array

#: So many targets are held; those not seen for the longest are settled.
MAX_TARGETS = 1000
#: So many tracks are held of one target; the first ones are settled.
MAX_TRACKS_EACH = 100

Rows = NDArray[np.intp]


class PairTable:
    """Counts by target and track, a row a pair.

    What is settled enters the sums as it stands, and its rows are used again: a target that comes back later begins
    anew.

    Attributes
    ----------
    near : (R,)            times at which both were near each other
    together : (R,)        the same, each by its share of all that was near either
    matched : (R, A)       times at which they were a pair, by level
    settled_near : int     of settled targets, the times near the track that was near most often
    settled_targets : int
    """

    def __init__(self, levels: int) -> None:
        self._row: dict[int, dict[int, int]] = {}  # by target, the last seen last, then by track, the first seen first
        self._free: list[int] = []
        self._target_times: dict[int, int] = {}
        self._track_times: dict[int, int] = {}  # the last seen last
        self._ids = np.zeros((0, 2), np.int64)
        self.near, self.together = np.zeros((2, 0))
        self.matched = np.zeros((0, levels))
        self._settled = np.zeros(levels)
        self.settled_near = self.settled_targets = 0

    def seen(self, targets: NDArray[np.int64], tracks: NDArray[np.int64], row: Rows, col: Rows) -> Rows:
        """Count a time of targets (N,) and tracks (M,), of which pairs (P,) are near; return their rows, (P,)."""
        for times, ids in ((self._target_times, targets), (self._track_times, tracks)):
            for one in ids.tolist():
                times[one] = times.pop(one, 0) + 1
        for target in targets.tolist():
            self._row[target] = self._row.pop(target, {})
        pairs = zip(targets[row].tolist(), tracks[col].tolist(), strict=True)
        return np.array([self._row_of(target, track) for target, track in pairs], np.intp)

    def rows(self, targets: NDArray[np.int64], tracks: NDArray[np.int64], row: Rows, col: Rows) -> Rows:
        """Return the rows of pairs that were seen before."""
        pairs = zip(targets[row].tolist(), tracks[col].tolist(), strict=True)
        return np.array([self._row[target][track] for target, track in pairs], np.intp)

    def alignment(self, rows: Rows) -> Array:
        """How well pairs go together over all times, 0 to 1."""
        together = self.together[rows]
        return np.asarray(together / (self._either(rows) - together))

    def association(self) -> Array:
        """Sum over all pairs of times matched, each weighted by how exclusively they are a pair, (A,)."""
        return self._settled + self._association(self._living())

    def nearby(self) -> tuple[Rows, Rows, Array]:
        """Return the pairs held: indices of their targets and tracks, and how often they were near."""
        rows = self._living()
        target, track = (np.unique(self._ids[rows, k], return_inverse=True)[1] for k in (0, 1))
        return target, track, self.near[rows]

    def settle(self) -> list[int]:
        """Settle what there is no room for; return those targets."""
        gone = []
        while len(self._row) > MAX_TARGETS:
            target = next(iter(self._row))
            rows = list(self._row[target].values())
            self.settled_near += int(self.near[rows].max(initial=0.0))
            self._drop(target, rows)
            del self._row[target], self._target_times[target]
            gone.append(target)
        self.settled_targets += len(gone)
        for target, of_target in self._row.items():
            if len(of_target) > MAX_TRACKS_EACH:
                self._drop(target, self._oldest(of_target))
        if len(self._track_times) > 2 * MAX_TARGETS:
            self._forget_tracks()
        return gone

    def _oldest(self, of_target: dict[int, int]) -> list[int]:
        """Rows of the first tracks of a target, the one that was near most often excepted."""
        rows = list(of_target.values())
        most = max(rows, key=lambda row: self.near[row])
        return [row for row in rows[: len(rows) - MAX_TRACKS_EACH + 1] if row != most]

    def _forget_tracks(self) -> None:
        """Forget the tracks not seen for the longest of which no pair is held."""
        held = {track for of_target in self._row.values() for track in of_target}
        for track in [t for t in self._track_times if t not in held][: len(self._track_times) - MAX_TARGETS]:
            del self._track_times[track]

    def _drop(self, target: int, rows: list[int]) -> None:
        self._settled += self._association(np.array(rows, np.intp))
        for row in rows:
            del self._row[target][int(self._ids[row, 1])]
        self.near[rows] = self.together[rows] = self.matched[rows] = 0
        self._free += rows

    def _association(self, rows: Rows) -> Array:
        matched = self.matched[rows]
        return np.asarray((matched**2 / (self._either(rows)[:, None] - matched)).sum(0))

    def _either(self, rows: Rows) -> Array:
        """Times of the target plus times of the track."""
        pairs = self._ids[rows].tolist()
        return np.array([self._target_times[t] + self._track_times[k] for t, k in pairs], float)

    def _living(self) -> Rows:
        return np.array([row for of_target in self._row.values() for row in of_target.values()], np.intp)

    def _row_of(self, target: int, track: int) -> int:
        of_target = self._row[target]
        if track not in of_target:
            if not self._free:
                self._grow()
            of_target[track] = self._free.pop()
            self._ids[of_target[track]] = target, track
        return of_target[track]

    def _grow(self) -> None:
        """Make room for twice as many pairs."""
        size = len(self.near)
        more = max(size, 64)
        self._free += range(size + more - 1, size - 1, -1)
        self._ids = np.concatenate([self._ids, np.zeros((more, 2), np.int64)])
        self.near, self.together = (np.concatenate([x, np.zeros(more)]) for x in (self.near, self.together))
        self.matched = np.concatenate([self.matched, np.zeros((more, self.matched.shape[1]))])
