"""Stage 8 of a step: what readers get, and what happened."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.associate import Association
from track_fusion.centre.config import FusionCentreParams
from track_fusion.centre.fuse import Fused
from track_fusion.centre.manage import Changes
from track_fusion.centre.pool import Pool
from track_fusion.centre.state import CentralTracks
from track_fusion.tracks import TrackBatch


class Fed(NamedTuple):
    """Which source track went into which central track, M of them, in the order of the sources.

    Attributes
    ----------
    source : (M,)      index of the source
    track_id : (M,)    identifier that the source gave it
    stamp_ns : (M,)    stamp of its scan
    central : (M,)     identifier of the central track
    """

    source: NDArray[np.intp]
    track_id: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    central: NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class StepInfo:
    """What happened in a step.

    Attributes
    ----------
    members : (S,) int          source tracks that took part, by source
    changes : Changes           births, confirmations, deletions
    fed : Fed                   the same source tracks, one by one
    shared_provenance : int     members that already hold another one's information: source tracks that say so, and
                                with memory each central track that was fused with new ones
    unconverged : int           fusions whose weights did not converge
    unsound : int               fusions whose result was no density, so that a single member was taken instead
    beyond_half_circle : int    fusions of members that have no mean direction, made about the most certain one
    held : int                  tracks of new scans held out of the fusion: too far from the central track they feed
    released : int              tracks held out for too long, which are free to start or join another one
    merged : (K, 2)             identifiers of central tracks and of those that ended in them, as duplicates
    """

    members: NDArray[np.intp]
    changes: Changes
    fed: Fed
    shared_provenance: int
    unconverged: int
    unsound: int
    beyond_half_circle: int
    held: int
    released: int
    merged: NDArray[np.int64]


def publish(params: FusionCentreParams, tracks: TrackBatch) -> TrackBatch:
    """Return those of the central tracks that are published."""
    return tracks if params.publish_tentative or tracks.is_confirmed.all() else tracks[tracks.is_confirmed]


def told(
    pool: Pool, association: Association, fused: Fused, before: CentralTracks, changes: Changes,
    merged: NDArray[np.int64],
) -> StepInfo:  # fmt: skip
    """Sum up a step."""
    member, sources = association.member, before.history.shape[1]
    ids = np.concatenate([before.tracks.track_id, changes.born])[association.target]
    fed = Fed(pool.source[member], pool.tracks.track_id[member], pool.stamp_ns[member], ids)
    foreign = int(np.count_nonzero(pool.tracks.source[member] & ~pool.bit[member]))
    taken = np.bincount(pool.source[member], minlength=sources)
    shared = foreign + len(association.remembered)
    return StepInfo(
        taken, changes, fed, shared, fused.unconverged, fused.unsound, fused.beyond, association.held,
        association.released, merged,
    )  # fmt: skip
