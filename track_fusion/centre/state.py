"""The state of a fusion centre, a value: nothing in it changes, a step makes another one."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.gate import Indices
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.identity import Identities
from track_fusion.centre.links import Links
from track_fusion.centre.rhythm import Stamps
from track_fusion.random_streams import StreamPosition
from track_fusion.tracks import ROW_FIELDS, UUID_BYTES, TrackBatch

Bools = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, eq=False)
class Twins:
    """Pairs of central tracks that may be one target: rows, the smaller first, and for how many steps, (K,) each."""

    first: Indices
    second: Indices
    steps: Indices

    @classmethod
    def none(cls) -> Twins:
        """No pair."""
        return cls(*np.zeros((3, 0), np.intp))

    def __len__(self) -> int:
        """Return the number of pairs K."""
        return len(self.first)

    def after(self, first: Indices, second: Indices, count: int) -> Twins:
        """Take the pairs of a step, among so many tracks: those that were there before have been so a step longer."""
        before = np.zeros(len(first), np.intp)
        at, old = np.nonzero((first * count + second)[:, None] == self.first * count + self.second)
        before[at] = self.steps[old]
        return Twins(first, second, before + 1)

    def renumbered(self, row: Indices) -> Twins:
        """Follow central tracks to their new rows, (T,), -1 = gone."""
        first, second = row[self.first], row[self.second]
        left = (first >= 0) & (second >= 0)
        return Twins(first[left], second[left], self.steps[left])


@dataclasses.dataclass(frozen=True, eq=False)
class CentralTracks:
    """The T central tracks in the order of their identifiers, and what the S sources did for each.

    Attributes
    ----------
    tracks : TrackBatch      all living ones, tentative ones included, each with its UUID
    has : (T, n) bool        which axes each really has
    history : (T, S)         one bit an update of the source, the newest the lowest, hit = 1
    updates : (T, S)         how many updates there were since birth
    hit_ever : (T, S)        whether there was a hit
    supported_ns : (T,)      stamp of the scan of the last member
    identities : Identities  those given so far
    links : Links            which source tracks feed them
    twins : Twins            which may be one target
    """

    tracks: TrackBatch
    has: Bools
    history: NDArray[np.uint32]
    updates: NDArray[np.int64]
    hit_ever: Bools
    supported_ns: NDArray[np.int64]
    identities: Identities
    links: Links = dataclasses.field(default_factory=Links.none)
    twins: Twins = dataclasses.field(default_factory=Twins.none)

    @classmethod
    def none(cls, config: CentreConfig, identities: Identities) -> CentralTracks:
        """No tracks yet, after those that were given identities."""
        shape = 0, len(config.sources)
        tracks = TrackBatch.empty(config.layout, config.frame_id)
        return cls(
            tracks.replace(uuid=np.zeros((0, UUID_BYTES), np.uint8)), np.zeros((0, config.layout.size), bool),
            np.zeros(shape, np.uint32), np.zeros(shape, np.int64), np.zeros(shape, bool), np.zeros(0, np.int64),
            identities,
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of tracks T."""
        return len(self.tracks)

    def __getitem__(self, rows: Bools) -> CentralTracks:
        """Select tracks by a mask."""
        new = np.where(rows, np.cumsum(rows) - 1, -1)
        return CentralTracks(
            self.tracks[rows], self.has[rows], self.history[rows], self.updates[rows], self.hit_ever[rows],
            self.supported_ns[rows], self.identities, self.links.renumbered(new), self.twins.renumbered(new),
        )  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class CentreState:
    """All that a step needs of those before it; its arrays refuse writing, and it can be pickled.

    Attributes
    ----------
    central : CentralTracks
    newest : tuple of TrackBatch or None    newest scan of each source, its own, in the centre's axes and frame
    stamps : tuple of Stamps                the newest few of each source's scans
    random : StreamPosition or None         where the stream of a rule that draws stands
    time_ns : int                           of the last step, -1 before the first
    """

    central: CentralTracks
    newest: tuple[TrackBatch | None, ...]
    stamps: tuple[Stamps, ...]
    random: StreamPosition | None = None
    time_ns: int = -1

    @classmethod
    def initial(cls, config: CentreConfig, identities: Identities | None = None) -> CentreState:
        """Nothing known yet; identities begin now, unless they go on from those given."""
        random = StreamPosition.of(config.random.stream()) if config.draws else None
        central = CentralTracks.none(config, identities or Identities.begun(config.identity))
        sources = len(config.sources)
        return cls(central, (None,) * sources, ((),) * sources, random)

    def __post_init__(self) -> None:
        own = self.central
        _freeze(own.tracks)
        tables = (*vars(own.links).values(), *vars(own.twins).values())
        for array in (own.has, own.history, own.updates, own.hit_ever, own.supported_ns, *tables):
            array.setflags(write=False)

    def __setstate__(self, fields: Mapping[str, Any]) -> None:
        """Take what was pickled; NumPy forgets that it must not be written to."""
        vars(self).update(fields)
        self.__post_init__()
        for scan in self.newest:
            if scan is not None:
                _freeze(scan)


def _freeze(tracks: TrackBatch) -> None:
    for name in ROW_FIELDS:
        getattr(tracks, name).setflags(write=False)
    if tracks.uuid is not None:
        tracks.uuid.setflags(write=False)
