"""Fusion weights, given or sought, and the geometric average of Gaussians at them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from track_fusion.densities.elliptical.projection import ProjectionMean
from track_fusion.densities.gaussian import weighted_product
from track_fusion.linalg import Array
from track_fusion.params import Params, param
from track_fusion.rules.base import EACH, FusedTracks, SourceTracks, Values
from track_fusion.solvers.optimise import Solution
from track_fusion.solvers.upper_bound import Bound

#: Parameters of examples.
GIVEN: Values = {"criterion": "given", "weights": EACH}
TRACE: Values = {"criterion": "trace"}
UNIFORM: Values = {"criterion": "uniform"}


@dataclasses.dataclass(frozen=True)
class WeightParams(Params):
    """How the fusion weights omega are chosen."""

    criterion: str = param(
        "uniform", "fusion weights: all equal (uniform), or given by 'weights'", choices=("uniform", "given")
    )
    weights: tuple[float, ...] = param(
        (), "fusion weights for criterion given, one a source, sum 1", low=0.0, high=1.0, kind=float
    )

    def given(self, count: int) -> Array | None:
        """Return the weights given for `count` sources, (K,); None: the criterion finds them.

        Raises
        ------
        ValueError    given weights do not fit, or are given for another criterion
        """
        if self.criterion == "given":
            return check_weights(self.weights, count)
        if self.weights:
            raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {self.criterion!r}.")
        return None

    def fixed(self, tracks: SourceTracks) -> Array | None:
        """Return the weights (..., K) that need no search, given or uniform; None: the criterion finds them.

        Raises
        ------
        ValueError    as `given`
        """
        share = self.given(tracks.count)
        if self.criterion == "uniform":
            share = np.full(tracks.count, 1.0 / tracks.count)
        return None if share is None else np.broadcast_to(share, tracks.mean.shape[:-1])


def check_weights(weights: tuple[float, ...], count: int) -> Array:
    """Return given fusion weights as an array, (K,), or say what is wrong with them.

    Raises
    ------
    ValueError    not one weight a source, a negative one, or a sum other than 1
    """
    array = np.asarray(weights, float)
    if array.shape != (count,):
        raise ValueError(f"The 'weights' parameter must hold one weight a source, {count}. Got {len(weights)}.")
    if (array < 0).any() or abs(array.sum() - 1.0) > 1e-9:
        raise ValueError(f"The 'weights' parameter must be non-negative and sum to 1. Got {weights}.")
    return array


def pooled(tracks: SourceTracks, weights: Array) -> FusedTracks:
    """Return the geometric average at weights (..., K): P^-1 = sum of w_i P_i^-1."""
    return FusedTracks(*weighted_product(tracks.mean, tracks.cov, weights), weights)


def pooled_by(find: Callable[[Array, Array], Solution | ProjectionMean], tracks: SourceTracks) -> FusedTracks:
    """Return the geometric average at the weights found for the flat batch, mean (B, K, n), cov (B, K, n, n)."""
    mean, cov = tracks.flat
    search = find(mean, cov)
    moments = weighted_product(mean, cov, search.weights)
    return tracks.fused(*moments, search.weights, info=diagnostics(search))


def diagnostics(search: Solution | ProjectionMean | Bound) -> dict[str, Any]:
    """Tell how a search over a flat batch went, (B,)."""
    return {"converged": search.converged, "iterations": search.iterations}
