"""Folding a rule for two tracks over K tracks, in the order of the sources."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array
from track_fusion.rules.base import FusedTracks, SourceTracks

#: Large batches are worked on in pieces whose arrays stay in the cache.
CHUNK = 1024


@dataclasses.dataclass(frozen=True)
class PairFusion:
    """B pairs fused: mean (B, n), cov (B, n, n), the weight of track 1 (B,), and what became of its search."""

    mean: Array
    cov: Array
    omega: Array | None = None
    converged: NDArray[np.bool_] | None = None
    iterations: NDArray[np.intp] | None = None

    @staticmethod
    def concatenate(parts: list[PairFusion]) -> PairFusion:
        """Join the pieces of a batch."""
        columns = {f.name: [getattr(p, f.name) for p in parts] for f in dataclasses.fields(PairFusion)}
        joined: dict[str, Any] = {k: None if c[0] is None else np.concatenate(c) for k, c in columns.items()}
        return PairFusion(**joined)


#: x1 (B, n), P1 (B, n, n), x2, P2, the given weight of track 1 or None
PairKernel = Callable[[Array, Array, Array, Array, float | None], PairFusion]


def fold(tracks: SourceTracks, kernel: PairKernel, given: Array | None = None) -> FusedTracks:
    """Fuse tracks 1 and 2, the result and track 3, and so on.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    kernel : PairKernel      fuses pairs, flat
    given : (K,) or None     weights of the tracks: track k meets those before it with its share of their sum

    Returns
    -------
    FusedTracks    weights (..., K): the product of the weights along the way, None if the kernel has none;
                   info converged (every time), iterations (in all), where the kernel searches
    """
    batch, (count, n) = tracks.mean.shape[:-2], tracks.mean.shape[-2:]
    means, covs = tracks.mean.reshape(-1, count, n), tracks.cov.reshape(-1, count, n, n)
    mean, cov, weights = means[:, 0].copy(), covs[:, 0].copy(), np.ones((len(means), 1))
    converged, iterations, searched, weighed = np.ones(len(means), bool), np.zeros(len(means), np.intp), False, True
    for k in range(1, count):
        share = None if given is None else share_of_first(given, k)
        step = _in_pieces(kernel, mean, cov, means[:, k], covs[:, k], share)
        mean, cov = step.mean, step.cov
        if step.omega is None:
            weighed = False
        else:
            weights = np.concatenate([weights * step.omega[:, None], 1.0 - step.omega[:, None]], 1)
        if step.converged is not None and step.iterations is not None:
            converged, iterations, searched = converged & step.converged, iterations + step.iterations, True
    info: dict[str, Any] = {}
    if searched:
        info = {"converged": converged.reshape(batch), "iterations": iterations.reshape(batch)}
    return FusedTracks(
        mean.reshape(*batch, n), cov.reshape(*batch, n, n), weights.reshape(*batch, count) if weighed else None,
        info=info,
    )  # fmt: skip


def _in_pieces(kernel: PairKernel, x1: Array, p1: Array, x2: Array, p2: Array, given: float | None) -> PairFusion:
    if len(x1) <= CHUNK:
        return kernel(x1, p1, x2, p2, given)
    pieces = [slice(i, i + CHUNK) for i in range(0, len(x1), CHUNK)]
    return PairFusion.concatenate([kernel(x1[s], p1[s], x2[s], p2[s], given) for s in pieces])


def share_of_first(given: Array, k: int) -> float:
    """Weight of the first k tracks against track k; one half where none has any."""
    before, total = float(given[:k].sum()), float(given[: k + 1].sum())
    return before / total if total > 0 else 0.5
