"""Stage 8 of a step: two central tracks that are one target become one."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.gate import Indices, gate
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.pool import conditioned
from track_fusion.centre.state import Bools, CentralTracks, Twins
from track_fusion.linalg import is_well_conditioned
from track_fusion.solvers.chi_square import chi_square_quantile

#: Share of true pairs of duplicates whose difference lies inside their gate.
GATE_PROBABILITY = 0.99
#: Steps in a row that a difference must stay inside.
STEPS = 3
#: The updates of a source, a bit each, in which it must not have supported both: the newest three.
LATELY = np.uint32(0b111)


def merge(config: CentreConfig, central: CentralTracks) -> tuple[CentralTracks, NDArray[np.int64]]:
    """Make one of each two central tracks that no source tells apart and that stay together.

    The confirmed one lives, of two alike the older; the links of the other move to it.

    Returns
    -------
    CentralTracks
    (K, 2) int64     identifiers of those that live and of those that ended in them
    """
    none = np.zeros((0, 2), np.int64)
    if config.params.merge_duplicates == "off":
        return central, none
    first, second = _close(config, central)
    if not len(first):
        return (dataclasses.replace(central, twins=Twins.none()) if len(central.twins) else central), none
    twins = central.twins.after(first, second, len(central))
    ready = twins.steps >= STEPS
    central = dataclasses.replace(central, twins=twins)
    if not ready.any():
        return central, none
    return _united(central, *_ends(central.tracks.is_confirmed, first[ready], second[ready]))


def _close(config: CentreConfig, central: CentralTracks) -> tuple[Indices, Indices]:
    """Pairs of living tracks inside each other's gate that no source supports both, the older first."""
    sources = np.int64(1) << np.arange(len(config.sources))
    support = ((central.history & LATELY) > 0) @ sources
    nobody = np.zeros(0, np.intp)
    across = config.params.merge_duplicates == "across_sources"
    if len(central) < 2 or (across and np.bitwise_and.reduce(support)):  # a source that supports all tells all apart
        return nobody, nobody
    own = support if across else np.zeros_like(support)
    kinds, kind = np.unique(own, return_inverse=True)
    apart = ((kinds[:, None] & kinds) == 0).any(1)[kind.ravel()]
    rows = np.flatnonzero(apart & (support > 0))
    if len(rows) < 2:
        return nobody, nobody
    mean, cov = central.tracks[rows].moments
    cov = conditioned(cov, is_well_conditioned(cov))
    own = own[rows]
    gamma, layout = chi_square_quantile(GATE_PROBABILITY, config.layout.size), config.layout
    near = gate(
        mean, cov, mean, cov, gamma, layout.position, layout.periods, lambda i, j: (i < j) & ((own[i] & own[j]) == 0)
    )
    return rows[near.row], rows[near.col]


def _ends(confirmed: Bools, first: Indices, second: Indices) -> tuple[Indices, Indices]:
    """Tell which of two tracks lives and which ends; one that ends takes up no other, and ends once."""
    turned = confirmed[second] & ~confirmed[first]
    lives, ends = np.where(turned, second, first), np.where(turned, first, second)
    ends, at = np.unique(ends, return_index=True)
    lives = lives[at]
    final = ~np.isin(lives, ends)
    return lives[final], ends[final]


def _united(central: CentralTracks, lives: Indices, ends: Indices) -> tuple[CentralTracks, NDArray[np.int64]]:
    ids, row, left = central.tracks.track_id, np.arange(len(central)), np.ones(len(central), bool)
    row[ends], left[ends] = lives, False
    moved = dataclasses.replace(central, links=central.links.renumbered(row))
    return moved[left], np.stack([ids[lives], ids[ends]], 1)
