"""Rules that sample: their generators, and pieces of a large batch."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture, padded
from track_fusion.rules.base import FusedTracks, SourceTracks

#: Points that a rule samples at once; larger batches are worked on in pieces, to bound the memory.
POINTS = 300_000


#: One generator for each fusion of two sources, in order.
Generators = list[np.random.Generator]


def fuse_sampled(
    tracks: SourceTracks, points: int, fuse: Callable[[SourceTracks, Generators], FusedTracks]
) -> FusedTracks:
    """Call a rule that samples with its generators, on pieces of the batch if that is large.

    Parameters
    ----------
    tracks : SourceTracks    extras["seed"]: an int or a Generator, 0 if absent; extras["common"]: Mixture (..., T) or
                             a sequence of them
    points : int             how many points one fusion samples
    fuse : callable          (tracks, generators) -> FusedTracks

    Notes    Every piece draws the same random numbers, as every member of a batch does. Each step of a fold has a
             generator of its own, since how many numbers a step draws depends on the batch.
    """
    rng = np.random.default_rng(tracks.extras.get("seed", 0))
    seeds = rng.integers(1 << 63, size=max(tracks.count - 1, 1))
    lead = tracks.mean.shape[:-2]
    size, step = math.prod(lead), max(1, POINTS // points)
    if size <= step:
        return fuse(tracks, [np.random.default_rng(s) for s in seeds])
    pieces = (_piece(tracks, lead, slice(at, at + step)) for at in range(0, size, step))
    return _joined([fuse(p, [np.random.default_rng(s) for s in seeds]) for p in pieces], tracks)


def _piece(tracks: SourceTracks, lead: tuple[int, ...], rows: slice) -> SourceTracks:
    """Cut rows of the batch, flat, out of tracks and of what they have in common."""
    index = np.unravel_index(np.arange(math.prod(lead))[rows], lead)
    extras = dict(tracks.extras)
    if "common" in extras:
        given = extras["common"]
        single = isinstance(given, Mixture)
        common = [m.broadcast(lead).at(index) for m in ([given] if single else given)]
        extras["common"] = common[0] if single else common
    mixture = tracks.mixture and tracks.mixture.at(index)
    return SourceTracks(tracks.mean[index], tracks.cov[index], None, mixture, extras)


def _joined(results: list[FusedTracks], tracks: SourceTracks) -> FusedTracks:
    """Put pieces together again, their mixtures padded to the same number of components."""
    mixtures = [r.mixture for r in results if r.mixture is not None]
    count = max((m.count for m in mixtures), default=0)
    columns = zip(*(vars(padded(m, count)).values() for m in mixtures), strict=True)
    weights = [r.weights for r in results if r.weights is not None]
    return tracks.fused(
        np.concatenate([r.mean for r in results]),
        np.concatenate([r.cov for r in results]),
        np.concatenate(weights) if weights else None,
        mixture=Mixture(*map(np.concatenate, columns)) if mixtures else None,
        info={name: np.concatenate([r.info[name] for r in results]) for name in results[0].info},
    )
