"""What the rules on Gaussian mixtures share: reading the sources, keeping the number of components down."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from track_fusion.densities.mixture.algebra import LogMixture, power, product
from track_fusion.densities.mixture.mixture import Mixture, moments
from track_fusion.densities.mixture.reduction import REDUCTIONS, prune
from track_fusion.linalg import Array, is_positive_definite
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, SourceTracks
from track_fusion.rules.shared.weights import WeightParams

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


@dataclasses.dataclass(frozen=True)
class AverageParams(WeightParams, ReductionParams):
    """The fusion weights and the number of components."""

    def shares(self, tracks: SourceTracks) -> Array:
        """Return the fusion weights (..., K), uniform or given.

        Raises
        ------
        ValueError    given weights do not fit, or are given for another criterion
        """
        weights = self.fixed(tracks)
        assert weights is not None  # nothing is sought
        return weights


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
