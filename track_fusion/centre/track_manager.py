"""Birth, confirmation, coasting and deletion of central tracks, and their identity."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.params import ParameterError, Params, param
from track_fusion.tracks import COASTED, CONFIRMED, SECOND_NS, StateLayout, TrackBatch

Bools = NDArray[np.bool_]
#: Updates that a history remembers: its width in bits.
MEMORY = 32


@dataclasses.dataclass(frozen=True)
class TrackManagerParams(Params):
    """Thresholds of a central track's life, counted per update of a source."""

    confirmation_threshold: tuple[int, ...] = param(
        (2, 3), "[M, N]: confirm a track with M hits in the last N updates of one source", low=1, high=MEMORY
    )
    deletion_threshold: tuple[int, ...] = param(
        (5, 5),
        "[P, Q]: delete a track that every source that ever hit it missed in P of its last Q updates",
        low=1,
        high=MEMORY,
    )
    max_coast_s: float = param(
        5.0, "delete a track that no source supported for so long", unit="s", low=0.0, strict=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("confirmation_threshold", "deletion_threshold"):
            value = getattr(self, name)
            if len(value) != 2 or value[0] > value[1]:
                raise ParameterError(f"The '{name}' parameter must be two integers, the first not larger. Got {value}.")


@dataclasses.dataclass(frozen=True)
class Changes:
    """Identifiers of tracks that were born, confirmed and deleted in a step."""

    born: NDArray[np.int64]
    confirmed: NDArray[np.int64]
    deleted: NDArray[np.int64]


class TrackManager:
    """The only owner of the central tracks' state.

    Attributes
    ----------
    tracks : TrackBatch    all living tracks, tentative ones included, in the order of their identifiers
    """

    def __init__(self, sources: int, layout: StateLayout, frame_id: str, params: TrackManagerParams) -> None:
        self._params = params
        self.tracks = TrackBatch.empty(layout, frame_id)
        self._history = np.zeros((0, sources), np.uint32)  # newest update in the lowest bit, hit = 1
        self._updates = np.zeros((0, sources), np.int64)
        self._hit_ever = np.zeros((0, sources), bool)
        self._supported_ns = np.zeros(0, np.int64)
        self._next_id = 1

    def commit(self, fused: TrackBatch, member: Bools, fresh: Bools, supported_ns: NDArray[np.int64]) -> Changes:
        """Take the outcome of a step: count, confirm, coast and delete.

        Parameters
        ----------
        fused : TrackBatch      the living tracks in their order, then the newborn (their track_id is given here)
        member : (T, S)         which source has a member in which track
        fresh : (S,)            which source delivered a new scan
        supported_ns : (T,)     stamp of the newest member's scan, -1 without member

        Returns
        -------
        Changes
        """
        old, new = len(self.tracks), len(fused) - len(self.tracks)
        ids, was_confirmed = self.tracks.track_id, self.tracks.is_confirmed
        if new:
            ids = np.append(ids, np.arange(self._next_id, self._next_id + new))
            was_confirmed = np.append(was_confirmed, np.zeros(new, bool))
            self._enrol(new)
        self._remember(member, fresh)
        self._supported_ns = np.where(supported_ns >= 0, supported_ns, self._supported_ns)
        confirmed = was_confirmed if was_confirmed.all() else was_confirmed | self._confirm()
        coasted = np.asarray(~member.any(1))
        status = confirmed * np.uint8(CONFIRMED) + coasted * np.uint8(COASTED)
        dead = coasted & self._expired(fused.time_ns) if coasted.any() else coasted
        self.tracks = fused.replace(track_id=ids, status=status)
        changes = Changes(ids[old:], ids[confirmed & ~was_confirmed & ~dead], ids[dead])
        if dead.any():
            self._keep(~dead)
        return changes

    def _enrol(self, new: int) -> None:
        self._next_id += new
        self._history, self._updates, self._hit_ever, self._supported_ns = (
            np.concatenate([old, np.zeros((new, *old.shape[1:]), old.dtype)])
            for old in (self._history, self._updates, self._hit_ever, self._supported_ns)
        )

    def _remember(self, member: Bools, fresh: Bools) -> None:
        hit = member & fresh
        self._history = np.where(fresh, (self._history << np.uint32(1)) | hit, self._history)
        self._updates = self._updates + fresh
        self._hit_ever = self._hit_ever | hit

    def _confirm(self) -> Bools:
        needed, last = self._params.confirmation_threshold
        return np.asarray((_ones(self._history & _mask(np.int64(last))) >= needed).any(1))

    def _expired(self, time_ns: NDArray[np.int64]) -> Bools:
        limit, last = self._params.deletion_threshold
        missed = _ones(~self._history & _mask(np.minimum(self._updates, last))) >= limit
        worn_out = np.all(missed | ~self._hit_ever, axis=1)
        overdue = time_ns - self._supported_ns > round(self._params.max_coast_s * SECOND_NS)
        return np.asarray(worn_out | overdue)

    def _keep(self, rows: Bools) -> None:
        self.tracks = self.tracks[rows]
        self._history, self._updates = self._history[rows], self._updates[rows]
        self._hit_ever, self._supported_ns = self._hit_ever[rows], self._supported_ns[rows]


def _mask(bits: NDArray[np.int64] | np.int64) -> NDArray[np.uint32]:
    """Lowest bits set: 3 -> 0b111."""
    return np.asarray((np.int64(1) << bits) - 1).astype(np.uint32)


def _ones(bits: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Count set bits."""
    octets = np.ascontiguousarray(bits).view(np.uint8).reshape(*bits.shape, 4)
    return np.asarray(np.unpackbits(octets, axis=-1).sum(-1, dtype=np.int64))
