"""Folding a rule for two tracks, Gaussians or mixtures, over K tracks, in the order of the sources."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.linalg import Array
from track_fusion.rules.base import FusedTracks, SourceTracks
from track_fusion.rules.shared.mixtures import ReductionParams, fused_tracks, nth
from track_fusion.solvers.optimise import Solution

#: Large batches are worked on in pieces whose arrays stay in the cache.
CHUNK = 1024


class PairFusion(NamedTuple):
    """B pairs fused: mean (B, n), cov (B, n, n), and the search for the weight of track 1 (B,), if there is one."""

    mean: Array
    cov: Array
    search: Solution | None = None


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
    means, covs = tracks.flat
    mean, cov, weights, weighed = means[:, 0].copy(), covs[:, 0].copy(), np.ones((len(means), 1)), True
    info: dict[str, Any] = {}
    for k in range(1, tracks.count):
        share = None if given is None else share_of_first(given, k)
        mean, cov, search = _in_pieces(kernel, mean, cov, means[:, k], covs[:, k], share)
        weighed = search is not None
        if search is not None:
            omega = search.weights[:, None]
            weights = np.concatenate([weights * omega, 1.0 - omega], 1)
            info["converged"] = info.get("converged", True) & search.converged
            info["iterations"] = info.get("iterations", 0) + search.iterations
    return tracks.fused(mean, cov, weights if weighed else None, info=info)


def _in_pieces(kernel: PairKernel, x1: Array, p1: Array, x2: Array, p2: Array, given: float | None) -> PairFusion:
    if len(x1) <= CHUNK:
        return kernel(x1, p1, x2, p2, given)
    pieces = [slice(i, i + CHUNK) for i in range(0, len(x1), CHUNK)]
    means, covs, searches = zip(*(kernel(x1[s], p1[s], x2[s], p2[s], given) for s in pieces), strict=True)
    search = None if searches[0] is None else Solution.concatenate(searches)
    return PairFusion(np.concatenate(means), np.concatenate(covs), search)


def share_of_first(given: Array, k: int) -> float:
    """Weight of the first k tracks against track k; one half where none has any."""
    before, total = float(given[:k].sum()), float(given[: k + 1].sum())
    return before / total if total > 0 else 0.5


class Step(NamedTuple):
    """Two mixtures fused: the mixture (..., C) of weight 1, the weight of the first (...), diagnostics (...)."""

    mixture: Mixture
    omega: Array | None
    info: Mapping[str, NDArray[Any]]  # of DIAGNOSTICS; those left out are neutral


#: Diagnostics of a step: how those of several join, and what is neutral: nothing sought, sampled or left out.
DIAGNOSTICS: dict[str, tuple[Callable[..., NDArray[Any]], float]] = {
    "converged": (np.logical_and, True),
    "iterations": (np.add, 0),
    "omega_error": (np.maximum, 0.0),
    "ess": (np.minimum, 1.0),
    "log_eta": (np.add, 0.0),
    "pruned": (np.maximum, 0.0),
    "skipped": (np.add, 0),
    "undecided": (np.add, 0),
    "least_difference": (np.minimum, 1.0),
}


def fold_mixtures(
    tracks: SourceTracks, params: ReductionParams, step: Callable[[Mixture, Mixture, int], Step], names: Iterable[str]
) -> FusedTracks:
    """Fuse mixtures 1 and 2, the result and mixture 3, and so on, reducing the components each time.

    Parameters
    ----------
    tracks : SourceTracks    K sources
    params : ReductionParams
    step : callable          (fused so far (..., C1), next source (..., C2), its number k) -> Step
    names : iterable         the diagnostics to be told of the whole

    Returns
    -------
    FusedTracks    weights (..., K): the product of the weights along the way, None if the steps have none
    """
    parts = params.sources(tracks).normalised
    fused, weights, weighed = nth(parts, 0), np.ones((*tracks.batch, 1)), True
    info: dict[str, NDArray[Any]] = {name: np.full(tracks.batch, DIAGNOSTICS[name][1]) for name in names}
    for k in range(1, tracks.count):
        mixture, omega, more = step(fused, nth(parts, k), k)
        fused, weighed = params.reduce(mixture), omega is not None
        if omega is not None:
            weights = np.concatenate([weights * omega[..., None], 1.0 - omega[..., None]], -1)
        info |= {name: DIAGNOSTICS[name][0](info[name], values) for name, values in more.items()}
    return fused_tracks(fused, weights if weighed else None, info)
