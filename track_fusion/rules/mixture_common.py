"""What the rules on Gaussian mixtures share: reading the sources, keeping the number of components down."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.mixture.algebra import LogMixture, power, product
from track_fusion.densities.mixture.mixture import Mixture, chosen, moments, padded, same
from track_fusion.densities.mixture.reduction import REDUCTIONS, prune
from track_fusion.linalg import Array, is_positive_definite
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, SourceTracks, check_weights

#: Components of less than this share are dropped before any merging: they only cost time.
NEGLIGIBLE = 1e-12


@dataclasses.dataclass(frozen=True)
class ReductionParams(Params):
    """How many components the mixtures may have before and after fusion, and how they get there."""

    max_source_components: int = param(0, "most components of each source, reduced before fusion; 0: no limit", low=0)
    max_components: int = param(
        100, "most components of the fused mixture; after each source when several are folded; 0: no limit", low=0
    )
    reduction: str = param(
        "runnalls",
        "how to reduce components: merge by Runnalls' cost, by Salmond's distance, or cap: keep the heaviest",
        choices=tuple(REDUCTIONS),
    )

    def reduce(self, mixture: Mixture) -> Mixture:
        """Bring a fused mixture down to `max_components`."""
        return self._reduced(mixture, self.max_components)

    def sources(self, tracks: SourceTracks) -> Mixture:
        """Return the tracks' densities, (..., K, C), brought down to `max_source_components`; see source_mixtures."""
        return self._reduced(source_mixtures(tracks), self.max_source_components)

    def largest_product(self, tracks: SourceTracks) -> int:
        """Return the most components that a product has while the tracks are folded."""
        count = 1 if tracks.mixture is None else tracks.mixture.weight.shape[-1]
        count = min(count, self.max_source_components or count)
        before: int = count ** max(tracks.count - 1, 1)
        return count * min(before, max(self.max_components, count) if self.max_components else before)

    def _reduced(self, mixture: Mixture, count: int) -> Mixture:
        if not 0 < count < mixture.count:
            return mixture
        return REDUCTIONS[self.reduction](prune(mixture, NEGLIGIBLE)[0], count)


def source_mixtures(tracks: SourceTracks) -> Mixture:
    """Return the tracks' densities as mixtures, weight (..., K, C); a Gaussian track has one component.

    Weights are as given: those of an un-normalised mixture (PHD) sum to its expected number of targets.

    Raises
    ------
    ValueError    a mixture has no weight, or a component no positive definite covariance (particles)
    """
    if tracks.mixture is None:
        return Mixture(np.ones((*tracks.mean.shape[:-1], 1)), tracks.mean[..., None, :], tracks.cov[..., None, :, :])
    total = tracks.mixture.weight.sum(-1)
    if not (total > 0.0).all():
        raise ValueError("The 'mixture.weight' of source tracks must not all be 0.")
    if not is_positive_definite(tracks.mixture.cov).all():
        raise ValueError(
            "The 'mixture.cov' of source tracks must be positive definite: this rule does not take particles."
        )
    return tracks.mixture


def nth(parts: Mixture, k: int) -> Mixture:
    """Mixture (..., C) of the k-th of K sources (..., K, C)."""
    return Mixture(parts.weight[..., k, :], parts.mean[..., k, :, :], parts.cov[..., k, :, :, :])


def average_weights(criterion: str, weights: tuple[float, ...], batch: tuple[int, ...], count: int) -> Array:
    """Fusion weights (..., K) by criterion uniform or given.

    Raises
    ------
    ValueError    given weights do not fit, or are given for another criterion
    """
    if weights and criterion != "given":
        raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {criterion!r}.")
    if criterion == "given":
        return np.broadcast_to(check_weights(weights, count), (*batch, count))
    return np.full((*batch, count), 1.0 / count)


def fused_tracks(mixture: Mixture, weights: Array | None, info: Mapping[str, Any] | None = None) -> FusedTracks:
    """Return the fused mixture with its merged moments."""
    mean, cov = moments(mixture)
    return FusedTracks(mean, cov, weights, mixture=mixture, info=info or {})


def geometric_average(tracks: SourceTracks, weights: Array, params: ReductionParams) -> Mixture:
    """Approximate geometric average of K mixtures, Li 2019 (49)-(51): powers of components, then their products.

    Parameters
    ----------
    tracks : SourceTracks        K sources, each normalised first
    weights : (..., K)           the same for all of the batch
    params : ReductionParams

    Returns
    -------
    Mixture    of weight 1
    """
    parts = params.sources(tracks).normalised
    fused: Mixture | None = None
    for k in range(tracks.count):
        if weights.size and not weights[..., k].any():
            continue  # a density to the power of 0 says nothing
        raised = power(LogMixture.of(nth(parts, k)), weights[..., k])
        if fused is None:
            fused = raised.normalised
        else:
            fused = params.reduce(product(LogMixture.of(fused), raised).normalised)
    assert fused is not None  # weights sum to 1
    return fused


def naive_product(parts: Mixture, params: ReductionParams) -> LogMixture:
    """Product (..., M) of K mixtures (..., K, C), brought down to `max_components` after each source."""
    fused = LogMixture.of(nth(parts, 0))
    for k in range(1, parts.weight.shape[-2]):
        both = product(fused, LogMixture.of(nth(parts, k)))
        reduced = params.reduce(both.normalised)
        fused = LogMixture.of(reduced) if reduced.count < both.mean.shape[-2] else both
    return fused


def all_same(parts: Mixture) -> NDArray[np.bool_]:
    """Tell where all K mixtures (..., K, C) are equal, (...)."""
    first = nth(parts, 0)
    alike = np.ones(first.weight.shape[:-1], bool)
    for k in range(1, parts.weight.shape[-2]):
        alike &= same(first, nth(parts, k))
    return alike


# Folding rules for two mixtures over K sources.


class Step(NamedTuple):
    """Two mixtures fused: the mixture (..., C) of weight 1, the weight of the first (...), diagnostics (...)."""

    mixture: Mixture
    omega: Array | None
    info: Mapping[str, NDArray[Any]]


def either(take: NDArray[np.bool_], one: Step, other: Step) -> Step:
    """Take, where `take` (...), the step `one`, else `other`; both have a weight of the first, or neither has."""
    omega = None if one.omega is None or other.omega is None else np.where(take, one.omega, other.omega)
    info = {name: np.where(take, one.info[name], other.info[name]) for name in other.info}
    return Step(chosen(take, one.mixture, other.mixture), omega, info)


def has_one_component(mixture: Mixture) -> NDArray[np.bool_]:
    """Tell which mixtures (...) are Gaussian: the other components, if any, have no weight."""
    return np.asarray((mixture.weight > 0.0).sum(-1) == 1)


def heaviest(mixture: Mixture) -> Mixture:
    """Return the heaviest component (..., 1) of each mixture (..., C)."""
    return mixture.take(mixture.weight.argmax(-1)[..., None])


#: How a diagnostic of several steps becomes that of the whole; what is not named here must hold at every step.
JOIN: dict[str, Callable[..., NDArray[Any]]] = {
    "iterations": np.add,
    "log_eta": np.add,
    "ess": np.minimum,
    "pruned": np.maximum,
    "skipped": np.add,
}


def fold_mixtures(
    tracks: SourceTracks,
    params: ReductionParams,
    step: Callable[[Mixture, Mixture, int], Step],
    info: Mapping[str, float],
) -> FusedTracks:
    """Fuse mixtures 1 and 2, the result and mixture 3, and so on, reducing the components each time.

    Parameters
    ----------
    tracks : SourceTracks    K sources
    params : ReductionParams
    step : callable          (fused so far (..., C1), next source (..., C2), its number k) -> Step
    info                     the diagnostics and what they are for a single source

    Returns
    -------
    FusedTracks    weights (..., K): the product of the weights along the way, None if the steps have none
    """
    parts = params.sources(tracks).normalised
    lead = tracks.mean.shape[:-2]
    fused, weights, weighed = nth(parts, 0), np.ones((*lead, 1)), True
    found = {name: np.full(lead, value) for name, value in info.items()}
    for k in range(1, tracks.count):
        result = step(fused, nth(parts, k), k)
        fused = params.reduce(result.mixture)
        if result.omega is None:
            weighed = False
        else:
            omega = result.omega[..., None]
            weights = np.concatenate([weights * omega, 1.0 - omega], -1)
        for name in found:
            found[name] = JOIN.get(name, np.logical_and)(found[name], result.info[name])
    return fused_tracks(fused, weights if weighed else None, found)


# Rules that sample.

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
    return _joined([fuse(p, [np.random.default_rng(s) for s in seeds]) for p in pieces], lead)


def _piece(tracks: SourceTracks, lead: tuple[int, ...], rows: slice) -> SourceTracks:
    """Cut rows of the batch, flat, out of tracks and of what they have in common."""
    size = math.prod(lead)

    def cut(array: Array) -> Array:
        return array.reshape(size, *array.shape[len(lead) :])[rows]

    def cut_mixture(mixture: Mixture) -> Mixture:
        return Mixture(cut(mixture.weight), cut(mixture.mean), cut(mixture.cov))

    extras = dict(tracks.extras)
    if "common" in extras:
        given = extras["common"]
        single = isinstance(given, Mixture)
        common = [cut_mixture(m.broadcast(lead)) for m in ([given] if single else given)]
        extras["common"] = common[0] if single else common
    mixture = tracks.mixture and cut_mixture(tracks.mixture)
    return SourceTracks(cut(tracks.mean), cut(tracks.cov), None, mixture, extras)


def _joined(results: list[FusedTracks], lead: tuple[int, ...]) -> FusedTracks:
    """Put pieces together again, their mixtures padded to the same number of components."""

    def join(arrays: list[NDArray[Any]]) -> NDArray[Any]:
        whole = np.concatenate(arrays)
        return whole.reshape(*lead, *whole.shape[1:])

    mixtures = [r.mixture for r in results if r.mixture is not None]
    count = max((m.count for m in mixtures), default=0)
    columns = zip(*(vars(padded(m, count)).values() for m in mixtures), strict=True)
    weights = [r.weights for r in results if r.weights is not None]
    return FusedTracks(
        join([r.mean for r in results]),
        join([r.cov for r in results]),
        join(weights) if weights else None,
        mixture=Mixture(*(join(list(c)) for c in columns)) if mixtures else None,
        info={name: join([r.info[name] for r in results]) for name in results[0].info},
    )
