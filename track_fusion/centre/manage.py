"""Stages 6 and 7 of a step: birth, confirmation, coasting and deletion of central tracks, and their identity."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.config import TrackManagerParams
from track_fusion.centre.fuse import Fused
from track_fusion.centre.identity import Identities
from track_fusion.centre.rhythm import Stamps, period_ns
from track_fusion.centre.state import Bools, CentralTracks
from track_fusion.tracks import COASTED, CONFIRMED, SECOND_NS

#: How long a track may coast unless told: so many periods of the slowest source that ever supported it, and at least
#: so many seconds.
COAST_PERIODS, COAST_S = 3, 5.0


@dataclasses.dataclass(frozen=True)
class Changes:
    """Identifiers of tracks that were born, confirmed, deleted, and dropped for being too many tentative ones."""

    born: NDArray[np.int64]
    confirmed: NDArray[np.int64]
    deleted: NDArray[np.int64]
    dropped: NDArray[np.int64]


def manage(
    params: TrackManagerParams, before: CentralTracks, fused: Fused, member: Bools, fresh: Bools,
    supported_ns: NDArray[np.int64], stamps: Sequence[Stamps],
) -> tuple[CentralTracks, Changes]:  # fmt: skip
    """Take the outcome of a fusion: count, confirm, coast and delete.

    Parameters
    ----------
    params : TrackManagerParams
    before : CentralTracks    the old ones, with the links of this step
    fused : Fused             the old ones in their order, then the newborn (their track_id is given here), T
    member : (T, S)           which source has a member in which track
    fresh : (S,)              which source delivered a new scan
    supported_ns : (T,)       stamp of the newest member's scan, -1 without member
    stamps : (S,)             the newest few of each source's scans

    Returns
    -------
    CentralTracks    those that live
    Changes
    """
    new = len(fused.tracks) - len(before)
    ids, uuids, identities = _named(before, new)
    hit = member & fresh
    history = _grown(before.history, new)
    history = np.where(fresh, (history << np.uint32(1)) | hit, history)
    was_confirmed = _grown(before.tracks.is_confirmed, new)
    coasted = np.asarray(~member.any(1))
    confirmed = was_confirmed if was_confirmed.all() else was_confirmed | _confirmed(params, history)
    after = CentralTracks(
        fused.tracks.replace(
            track_id=ids, uuid=uuids, status=confirmed * np.uint8(CONFIRMED) + coasted * np.uint8(COASTED)
        ),
        fused.has, history, _grown(before.updates, new) + fresh, _grown(before.hit_ever, new) | hit,
        np.where(supported_ns >= 0, supported_ns, _grown(before.supported_ns, new)), identities,
        before.links, before.twins,
    )  # fmt: skip
    dead = coasted & _expired(params, after, stamps) if coasted.any() else coasted
    dropped = _surplus(params, ~confirmed & ~dead)
    gone = dead | dropped
    changes = Changes(ids[len(before) :], ids[confirmed & ~was_confirmed & ~dead], ids[dead], ids[dropped])
    return after[~gone] if gone.any() else after, changes


def _named(before: CentralTracks, new: int) -> tuple[NDArray[np.int64], NDArray[np.uint8], Identities]:
    """Numbers and UUIDs of the old tracks, then of so many newborn; the only place where they are given."""
    tracks = before.tracks
    assert tracks.uuid is not None  # central tracks have one
    if new == 0:
        return tracks.track_id, tracks.uuid, before.identities
    ids, uuids, identities = before.identities.given(new)
    return np.concatenate([tracks.track_id, ids]), np.concatenate([tracks.uuid, uuids]), identities


def _grown(array: NDArray[Any], new: int) -> NDArray[Any]:
    """Append a row of zeros for each of the newborn."""
    return np.concatenate([array, np.zeros((new, *array.shape[1:]), array.dtype)]) if new else array


def _confirmed(params: TrackManagerParams, history: NDArray[np.uint32]) -> Bools:
    needed, last = params.confirmation_threshold
    return np.asarray((_ones(history & _mask(np.int64(last))) >= needed).sum(1) >= params.confirmation_sources)


def _expired(params: TrackManagerParams, central: CentralTracks, stamps: Sequence[Stamps]) -> Bools:
    limit, last = params.deletion_threshold
    missed = _ones(~central.history & _mask(np.minimum(central.updates, last))) >= limit
    worn_out = np.all(missed | ~central.hit_ever, axis=1)
    overdue = central.tracks.time_ns - central.supported_ns > _longest_coast_ns(params, central.hit_ever, stamps)
    return np.asarray(worn_out | overdue)


def _longest_coast_ns(params: TrackManagerParams, hit_ever: Bools, stamps: Sequence[Stamps]) -> NDArray[np.int64]:
    """How long each track may be without a member, (T,)."""
    if params.max_coast_s:
        return np.full(len(hit_ever), round(params.max_coast_s * SECOND_NS))
    periods = np.array([period_ns(own) for own in stamps], np.int64)
    return np.asarray(
        np.maximum(COAST_PERIODS * np.where(hit_ever, periods, 0).max(1, initial=0), round(COAST_S * SECOND_NS))
    )


def _surplus(params: TrackManagerParams, tentative: Bools) -> Bools:
    """Tell which tentative tracks, (T,) in the order of birth, are too many: the oldest."""
    count = np.count_nonzero(tentative)
    if count <= params.max_tentative_tracks:
        return np.zeros(len(tentative), bool)
    return np.asarray(tentative & (np.cumsum(tentative) <= count - params.max_tentative_tracks))


def _mask(bits: NDArray[np.int64] | np.int64) -> NDArray[np.uint32]:
    """Lowest bits set: 3 -> 0b111."""
    return np.asarray((np.int64(1) << bits) - 1).astype(np.uint32)


def _ones(bits: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Count set bits."""
    octets = np.ascontiguousarray(bits).view(np.uint8).reshape(*bits.shape, 4)
    return np.asarray(np.unpackbits(octets, axis=-1).sum(-1, dtype=np.int64))
