"""Stages 6 and 7 of a step: birth, confirmation, coasting and deletion of central tracks, and their identity."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.config import TrackManagerParams
from track_fusion.centre.fuse import Fused
from track_fusion.centre.state import Bools, CentralTracks
from track_fusion.tracks import COASTED, CONFIRMED, SECOND_NS


@dataclasses.dataclass(frozen=True)
class Changes:
    """Identifiers of tracks that were born, confirmed and deleted in a step."""

    born: NDArray[np.int64]
    confirmed: NDArray[np.int64]
    deleted: NDArray[np.int64]


def manage(
    params: TrackManagerParams, before: CentralTracks, fused: Fused, member: Bools, fresh: Bools,
    supported_ns: NDArray[np.int64],
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

    Returns
    -------
    CentralTracks    those that live
    Changes
    """
    new = len(fused.tracks) - len(before)
    ids = np.concatenate([before.tracks.track_id, before.next_id + np.arange(new)])
    hit = member & fresh
    history = _grown(before.history, new)
    history = np.where(fresh, (history << np.uint32(1)) | hit, history)
    was_confirmed = _grown(before.tracks.is_confirmed, new)
    coasted = np.asarray(~member.any(1))
    confirmed = was_confirmed if was_confirmed.all() else was_confirmed | _confirmed(params, history)
    after = CentralTracks(
        fused.tracks.replace(track_id=ids, status=confirmed * np.uint8(CONFIRMED) + coasted * np.uint8(COASTED)),
        fused.has, history, _grown(before.updates, new) + fresh, _grown(before.hit_ever, new) | hit,
        np.where(supported_ns >= 0, supported_ns, _grown(before.supported_ns, new)), before.next_id + new,
        before.links, before.twins,
    )  # fmt: skip
    dead = coasted & _expired(params, after) if coasted.any() else coasted
    changes = Changes(ids[len(before) :], ids[confirmed & ~was_confirmed & ~dead], ids[dead])
    return after[~dead] if dead.any() else after, changes


def _grown(array: NDArray[Any], new: int) -> NDArray[Any]:
    """Append a row of zeros for each of the newborn."""
    return np.concatenate([array, np.zeros((new, *array.shape[1:]), array.dtype)]) if new else array


def _confirmed(params: TrackManagerParams, history: NDArray[np.uint32]) -> Bools:
    needed, last = params.confirmation_threshold
    return np.asarray((_ones(history & _mask(np.int64(last))) >= needed).any(1))


def _expired(params: TrackManagerParams, central: CentralTracks) -> Bools:
    limit, last = params.deletion_threshold
    missed = _ones(~central.history & _mask(np.minimum(central.updates, last))) >= limit
    worn_out = np.all(missed | ~central.hit_ever, axis=1)
    overdue = central.tracks.time_ns - central.supported_ns > round(params.max_coast_s * SECOND_NS)
    return np.asarray(worn_out | overdue)


def _mask(bits: NDArray[np.int64] | np.int64) -> NDArray[np.uint32]:
    """Lowest bits set: 3 -> 0b111."""
    return np.asarray((np.int64(1) << bits) - 1).astype(np.uint32)


def _ones(bits: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Count set bits."""
    octets = np.ascontiguousarray(bits).view(np.uint8).reshape(*bits.shape, 4)
    return np.asarray(np.unpackbits(octets, axis=-1).sum(-1, dtype=np.int64))
