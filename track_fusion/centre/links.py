"""Which source track feeds which central track; doc/fusion-centre.md states what a link gives a right to."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.gate import Indices

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
#: The source's own identifier takes so many bits of a key, as on the wire; the source stands above them.
ID_BITS = 32


def key_of(source: Indices, track_id: Ints) -> Ints:
    """Name source tracks by one number each, (P,): the source and its own identifier."""
    return np.asarray(source.astype(np.int64) << ID_BITS | track_id)


@dataclasses.dataclass(frozen=True, eq=False)
class Links:
    """L links, at most one a source track, in the order of their keys.

    Attributes
    ----------
    key : (L,)     the source track, see :func:`key_of`
    row : (L,)     the central track that it feeds
    idle : (L,)    updates of its source in a row in which it was absent or held out of the fusion
    """

    key: Ints
    row: Indices
    idle: Ints

    @classmethod
    def none(cls) -> Links:
        """Nothing feeds anything."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp), np.zeros(0, np.int64))

    def __len__(self) -> int:
        """Return the number of links L."""
        return len(self.key)

    def __getitem__(self, at: Bools | Indices) -> Links:
        """Select links."""
        return Links(self.key[at], self.row[at], self.idle[at])

    def of(self, key: Ints) -> tuple[Indices, Ints]:
        """Return the central track of each source track, -1 = none, and its idle updates, (P,) each."""
        if not len(self):
            return np.full(len(key), -1, np.intp), np.zeros(len(key), np.int64)
        at = np.minimum(np.searchsorted(self.key, key), len(self) - 1)
        known = self.key[at] == key
        return np.where(known, self.row[at], -1), np.where(known, self.idle[at], 0)

    def after(self, key: Ints, row: Indices, idle: Ints, fresh: Bools, patience: int, shared: bool) -> Links:
        """Take the outcome of an association.

        Parameters
        ----------
        key, row, idle : (P,)    of the source tracks that were associated, row -1 = without link
        fresh : (S,)             which sources delivered a new scan
        patience : int           idle updates that a link outlives
        shared : bool            whether an absent track keeps its link beside others of its source
        """
        at = np.flatnonzero(row >= 0)
        new = Links(key[at], row[at], idle[at])
        new = new[np.argsort(new.key)]
        if not len(self) or np.array_equal(self.key, new.key):
            return new
        absent = self[~np.isin(self.key, key)]
        if len(absent):
            source = absent.key >> ID_BITS
            rest = Links(absent.key, absent.row, absent.idle + fresh[source])
            left = rest.idle <= patience
            if not shared:
                left &= ~np.isin(rest.feeds, new.feeds)
            new = Links(*(np.concatenate(both) for both in zip(new.arrays, rest[left].arrays, strict=True)))
        return new[np.argsort(new.key)]

    @property
    def feeds(self) -> Ints:
        """One number for the source and the central track of each link, (L,)."""
        return key_of(self.key >> ID_BITS, self.row)

    @property
    def arrays(self) -> tuple[Ints, Indices, Ints]:
        """All that it holds."""
        return self.key, self.row, self.idle

    def renumbered(self, row: Indices) -> Links:
        """Follow central tracks to their new rows, (T,), -1 = gone."""
        moved = Links(self.key, row[self.row], self.idle)
        return moved if (moved.row >= 0).all() else moved[moved.row >= 0]
