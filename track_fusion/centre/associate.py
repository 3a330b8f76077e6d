"""Stages 3 and 4 of a step: which source track belongs to which central track, and which start new ones."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.association.assignment import assign, nearest_neighbour
from track_fusion.association.gate import Candidates, gate, joined, within
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.links import Ints, Links
from track_fusion.centre.pool import Pool, Rows
from track_fusion.centre.state import Bools

#: Where a linked pair beyond the gate counts as lying: at the gate itself rounding would choose between it and a miss.
JUST_INSIDE = 1.0 - 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class Association:
    """The M source tracks that take part in a fusion, and in which.

    Attributes
    ----------
    member : (M,)        rows of the pool, ascending
    target : (M,)        the central track of each, by row, those of the newborn after the T old ones
    births : int         number of the newborn
    remembered : (R,)    the old ones whose own prediction is fused with their members
    links : Links        which source tracks feed which central ones from now on, by row as `target`
    held : int           tracks of new scans that neither take part nor start anything, since they feed another one
    released : int       those that are so no longer, their patience being over
    """

    member: Rows
    target: Rows
    births: int
    remembered: Rows
    links: Links
    held: int = 0
    released: int = 0


def associate(config: CentreConfig, pool: Pool, links: Links, fresh: Bools) -> Association:
    """Associate the source tracks of a pool; only those of new scans, `fresh` (S,), that may start central tracks."""
    if config.params.association == "single_target":
        target, births = _sole_target(pool, fresh & config.can_initiate)
        return _taken(config, pool, target, births, Links.none())
    linked, idle = links.of(pool.key)
    near, inside = _candidates(config, pool, linked)
    target = _assigned(config, pool, near)
    held, idle, released = _held(config, pool, target, linked, inside, idle, fresh)
    births = _start(config, pool, target, held, fresh)
    row = np.where(target >= 0, target, np.where(held, linked, -1))
    after = links.after(pool.key, row, idle, fresh, config.params.patience, _shares(config))
    return _taken(config, pool, target, births, after, int(np.count_nonzero(held & fresh[pool.source])), released)


def _taken(
    config: CentreConfig, pool: Pool, target: Rows, births: int, links: Links, held: int = 0, released: int = 0
) -> Association:
    """Sum up the target of each source track, (P,), -1 = none."""
    member = np.flatnonzero(target >= 0)
    target = target[member]
    old = target[target < len(pool.tracks) - len(pool.source)] if config.params.memory else target[:0]
    return Association(member, target, births, np.unique(old), links, held, released)


def _shares(config: CentreConfig) -> bool:
    """Whether several tracks of a source may feed one central track by turns."""
    return config.params.merge_duplicates == "also_within_a_source"


def _candidates(config: CentreConfig, pool: Pool, linked: Rows) -> tuple[Candidates, Bools]:
    """Pairs within the gate, and linked ones out to the wider gate, which then cost as at the gate.

    Parameters
    ----------
    linked : (P,)    the central track that each source track feeds, -1 = none

    Returns
    -------
    Candidates
    (P,) bool     which source tracks have the central track that they feed among them
    """
    tracks, layout = pool.split(), config.layout
    near = gate(*tracks, config.gamma, layout.position, layout.periods)
    inside = np.zeros(len(linked), bool)
    inside[near.row[near.col == linked[near.row]]] = True
    stray = np.flatnonzero((linked >= 0) & ~inside)
    if not len(stray):
        return near, inside
    wide = within(*tracks, stray, linked[stray], config.keep_gamma, layout.periods)
    inside[wide.row] = True
    near = joined(near, dataclasses.replace(wide, distance=np.minimum(wide.distance, JUST_INSIDE * config.gamma)))
    return near, inside


def _assigned(config: CentreConfig, pool: Pool, near: Candidates) -> Rows:
    """Give the old central track of each source track, (P,), -1 = none: one to one within each source."""
    sources, count = len(pool.source), len(pool.tracks) - len(pool.source)
    # All sources at once: to each its own copy of the central tracks.
    own = Candidates(near.row, near.col + count * pool.source[near.row], near.distance, near.logdet)
    target = assign(own, sources, count * len(config.sources), config.gamma)
    target[target >= 0] %= count
    return target


def _held(
    config: CentreConfig, pool: Pool, target: Rows, linked: Rows, inside: Bools, idle: Ints, fresh: Bools
) -> tuple[Bools, Ints, int]:
    """Tell which source tracks without target are held out, (P,), the idle updates of all, and how many are released.

    Held out is who feeds a central track and lies too far from it, or whose place another track of his source has
    taken, until his patience is over; where tracks may share one, also who lies within reach.
    """
    out = (target < 0) & (linked >= 0)
    if not out.any():
        return out, np.zeros(len(target), np.int64), 0
    spare = out & inside if _shares(config) else np.zeros(len(out), bool)
    idle = np.where(out & ~spare, idle + fresh[pool.source], 0)
    held = spare | (out & (idle <= config.params.patience))
    return held, idle, int(np.count_nonzero(out & ~held))


def _start(config: CentreConfig, pool: Pool, target: Rows, held: Bools, fresh: Bools) -> int:
    """Start tracks from what is left of new scans: write them into `target`, and return how many."""
    leftover = np.flatnonzero((target < 0) & ~held & fresh[pool.source])
    if not len(leftover):
        return 0
    mean, cov, central, _ = pool.split()
    starters = np.zeros(0, np.intp)  # the track that started each group
    for k in np.unique(pool.source[leftover]):
        left = leftover[pool.source[leftover] == k]
        group = nearest_neighbour(
            mean[left], cov[left], mean[starters], cov[starters], config.gamma, config.layout.position,
            config.layout.periods,
        )  # fmt: skip
        starts = (group < 0) & config.can_initiate[k]
        group[starts] = len(starters) + np.arange(starts.sum())
        target[left] = np.where(group >= 0, len(central) + group, -1)
        starters = np.append(starters, left[starts])
    return len(starters)


def _sole_target(pool: Pool, fresh: Bools) -> tuple[Rows, int]:
    """Associate the first track of each source with the one target, which a new scan starts."""
    target = np.full(len(pool.source), -1, np.intp)
    births = int(len(pool.tracks) == len(pool.source) and bool(fresh[pool.source].any()))
    if births or len(pool.tracks) > len(pool.source):
        target[np.unique(pool.source, return_index=True)[1]] = 0
    return target, births
