"""Stage 5 of a step: the members of each central track become one density."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from track_fusion.centre.associate import Association
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.pool import Pool, Rows
from track_fusion.centre.state import Bools
from track_fusion.linalg import Array
from track_fusion.params import Params
from track_fusion.random_streams import StreamPosition
from track_fusion.rules import FusedTracks
from track_fusion.tracks import TrackBatch


class Fused(NamedTuple):
    """Central tracks after a fusion.

    Attributes
    ----------
    tracks : TrackBatch    their identifiers and status are those of a member
    has : (M, n)           which axes each has: those that some member has
    unconverged : int      fusions whose weights did not converge
    unsound : int          fusions whose result was no density, so that a single member was taken instead
    beyond : int           fusions of members beyond a half circle, which have no mean direction
    """

    tracks: TrackBatch
    has: Bools
    unconverged: int = 0
    unsound: int = 0
    beyond: int = 0


def fuse(
    config: CentreConfig, pool: Pool, association: Association, random: StreamPosition | None
) -> tuple[Fused, StreamPosition | None]:
    """Fuse the members of each target, with memory those of an old one with its own prediction before all.

    Tracks without members keep their predicted state.

    Returns
    -------
    Fused                      the central tracks in their order, then the newborn
    StreamPosition or None     where the random stream stands now
    """
    count, old = len(pool.source), len(pool.tracks) - len(pool.source)
    target = np.concatenate([association.remembered, association.target])
    # The pool is in source order: members stay so.
    order = np.concatenate([count + association.remembered, association.member])[np.argsort(target, kind="stable")]
    size = np.bincount(target, minlength=old + association.births)
    first = np.cumsum(size) - size
    rng = None if random is None else random.generator()
    extras = {} if rng is None else {"seed": rng}
    rows: list[Rows] = []
    parts: list[Fused] = []
    for members in sorted(set(size.tolist())) or [0]:
        alike = np.flatnonzero(size == members)
        if members == 0:
            rows.append(alike)
            parts.append(_coasting(pool, count + alike))
            continue
        at = order[first[alike][:, None] + np.arange(members)]
        for some, params in _weighed(config, pool, at):
            rows.append(alike[some])
            parts.append(_applied(config, pool, at[some], params, extras))
    return _in_order(rows, parts), None if rng is None else StreamPosition.of(rng)


def _coasting(pool: Pool, at: Rows) -> Fused:
    kept = pool.tracks[at]
    return Fused(kept.replace(source=np.zeros(len(at), np.uint32)), pool.has[at])


def _in_order(rows: Sequence[Rows], parts: Sequence[Fused]) -> Fused:
    """Join parts, each with the rows of the whole that it holds."""
    if len(parts) == 1:
        return parts[0]
    order = np.argsort(np.concatenate(rows), kind="stable")
    tracks, has, *counts = zip(*parts, strict=True)
    return Fused(TrackBatch.concatenate(tracks)[order], np.concatenate(has)[order], *map(sum, counts))


def _weighed(config: CentreConfig, pool: Pool, at: Rows) -> Iterator[tuple[Rows | slice, Params]]:
    """Split members (M, K) by their sources where weights are given: rows, and the rule's parameters for them.

    Of fewer members than weights, the weights keep their proportions; where all are zero, they are equal.
    """
    count, weights = at.shape[1], config.weights
    if count == 1 or count >= len(weights):
        yield slice(None), config.rule_params
        return
    central = at >= len(pool.source)
    place = np.where(central, 0, pool.source[np.where(central, 0, at)] + config.params.memory)
    kinds, kind = np.unique(place, axis=0, return_inverse=True)
    for k, own in enumerate(kinds):
        total = weights[own].sum()
        share = weights[own] / total if total else np.full(count, 1.0 / count)
        given: dict[str, Any] = {"weights": tuple(share)}
        yield np.flatnonzero(kind.ravel() == k), dataclasses.replace(config.rule_params, **given)


def _applied(config: CentreConfig, pool: Pool, at: Rows, params: Params, extras: Mapping[str, Any]) -> Fused:
    """Put members, (M, K) rows of the pool, through the rule; a single one is taken as it is.

    So is the last member of a target whose fusion gives no density: its numbers must not harm the other targets.
    """
    first = _first(pool, at)
    if at.shape[1] == 1:
        return first
    try:
        fused = config.rule.apply(pool.gather(at, extras, config.rule.takes_particles), params)
    except np.linalg.LinAlgError:
        if len(at) == 1:
            return _first(pool, at[:, -1:])._replace(unsound=1)
        each = [_applied(config, pool, at[k : k + 1], params, extras) for k in range(len(at))]
        return _in_order(list(np.arange(len(at))[:, None]), each)
    weight, mean, cov = _components(fused)
    dof = np.full(len(at), np.inf) if fused.dof is None else fused.dof
    unconverged = int(np.count_nonzero(~np.asarray(fused.info.get("converged", True))))
    beyond = int(np.count_nonzero(fused.info.get("beyond_half_circle", False)))
    tracks = first.tracks.replace(weight=weight, mean=mean, cov=cov, dof=dof)
    result = Fused(tracks, first.has, unconverged, beyond=beyond)
    sound = result.tracks.sound
    if sound.all():
        return result
    good, bad = np.flatnonzero(sound), np.flatnonzero(~sound)
    kept = result._replace(tracks=result.tracks[good], has=result.has[good])
    return _in_order([good, bad], [kept, _first(pool, at[bad, -1:])._replace(unsound=len(bad))])


def _first(pool: Pool, at: Rows) -> Fused:
    """Return the first of the members, (M, K), with the provenance, existence and axes of all."""
    bit = pool.bit[at]
    existence = np.where(bit > 0, pool.tracks.existence[at], 0.0).max(1)
    tracks = pool.tracks[at[:, 0]].replace(source=np.bitwise_or.reduce(bit, axis=1), existence=existence)
    return Fused(tracks, np.asarray(pool.has[at].any(1)))


def _components(fused: FusedTracks) -> tuple[Array, Array, Array]:
    """Fused result as weight (M, C), mean (M, C, n), cov (M, C, n, n)."""
    if fused.mixture is not None:
        return fused.mixture.weight, fused.mixture.mean, fused.mixture.cov
    return np.ones((len(fused.mean), 1)), fused.mean[:, None], fused.cov[:, None]
