"""Stages 3 and 4 of a step: which source track belongs to which central track, and which start new ones."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.association.assignment import assign, nearest_neighbour
from track_fusion.association.gate import gate
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.pool import Pool, Rows
from track_fusion.centre.state import Bools


@dataclasses.dataclass(frozen=True, eq=False)
class Association:
    """The M source tracks that take part in a fusion, and in which.

    Attributes
    ----------
    member : (M,)        rows of the pool, ascending
    target : (M,)        the central track of each, by row, those of the newborn after the T old ones
    births : int         number of the newborn
    remembered : (R,)    the old ones whose own prediction is fused with their members
    """

    member: Rows
    target: Rows
    births: int
    remembered: Rows


def associate(config: CentreConfig, pool: Pool, fresh: Bools) -> Association:
    """Associate the source tracks of a pool; only those of new scans, `fresh` (S,), that may start central tracks."""
    sole = config.params.association == "single_target"
    target, births = _sole_target(pool, fresh & config.can_initiate) if sole else _nearest(config, pool, fresh)
    member = np.flatnonzero(target >= 0)
    target = target[member]
    old = target[target < len(pool.tracks) - len(pool.source)] if config.params.memory else target[:0]
    return Association(member, target, births, np.unique(old))


def _nearest(config: CentreConfig, pool: Pool, fresh: Bools) -> tuple[Rows, int]:
    """Give the target of each source track, (P,), -1 = none, and count the newborn."""
    mean, cov, central_mean, central_cov = pool.split()
    count, gamma, axes = len(central_mean), config.gamma, (config.layout.position, config.layout.periods)
    near = gate(mean, cov, central_mean, central_cov, gamma, *axes)
    # One to one within each source, all sources at once: to each its own copy of the central tracks.
    own = dataclasses.replace(near, col=near.col + count * pool.source[near.row])
    target = assign(own, len(mean), count * len(config.sources), gamma)
    target[target >= 0] %= count
    starters = np.zeros(0, np.intp)  # the track that started each group
    leftover = np.flatnonzero((target < 0) & fresh[pool.source])
    for k in np.unique(pool.source[leftover]):
        left = leftover[pool.source[leftover] == k]
        joined = nearest_neighbour(mean[left], cov[left], mean[starters], cov[starters], gamma, *axes)
        starts = (joined < 0) & config.can_initiate[k]
        joined[starts] = len(starters) + np.arange(starts.sum())
        target[left] = np.where(joined >= 0, count + joined, -1)
        starters = np.append(starters, left[starts])
    return target, len(starters)


def _sole_target(pool: Pool, fresh: Bools) -> tuple[Rows, int]:
    """Associate the first track of each source with the one target, which a new scan starts."""
    target = np.full(len(pool.source), -1, np.intp)
    births = int(len(pool.tracks) == len(pool.source) and bool(fresh[pool.source].any()))
    if births or len(pool.tracks) > len(pool.source):
        target[np.unique(pool.source, return_index=True)[1]] = 0
    return target, births
