"""Stage 8 of a step: what readers get, and what happened."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.associate import Association
from track_fusion.centre.config import FusionCentreParams
from track_fusion.centre.fuse import Fused
from track_fusion.centre.manage import Changes
from track_fusion.centre.pool import Pool
from track_fusion.tracks import TrackBatch


@dataclasses.dataclass(frozen=True)
class StepInfo:
    """What happened in a step.

    Attributes
    ----------
    members : (S,) int          source tracks that took part, by source
    changes : Changes           births, confirmations, deletions
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
    sources: int, pool: Pool, association: Association, fused: Fused, changes: Changes, merged: NDArray[np.int64]
) -> StepInfo:
    """Sum up a step of a centre of so many sources."""
    member = association.member
    foreign = int(np.count_nonzero(pool.tracks.source[member] & ~pool.bit[member]))
    taken = np.bincount(pool.source[member], minlength=sources)
    shared = foreign + len(association.remembered)
    return StepInfo(
        taken, changes, shared, fused.unconverged, fused.unsound, fused.beyond, association.held, association.released,
        merged,
    )  # fmt: skip
