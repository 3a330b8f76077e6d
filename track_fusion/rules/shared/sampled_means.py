"""Harmonic and geometric means of densities by samples, and what takes their place where too few samples count."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.mixture.algebra import LogMixture, product
from track_fusion.densities.mixture.mean_density import Kind, fit_mean_density, sample_mean_density
from track_fusion.densities.mixture.mixture import Mixture, chosen, same
from track_fusion.linalg import Array
from track_fusion.params import param
from track_fusion.rules.shared.mixtures import ReductionParams, nth

#: Where no more than this share of the samples is effective, their moments are those of a few points, and nothing else.
LEAST_EFFECTIVE = 0.01


@dataclasses.dataclass(frozen=True)
class MeanSamplingParams(ReductionParams):
    """How many samples a mean of densities is taken from, and how wide."""

    samples: int = param(5000, "samples in all", low=10)
    inflation: float = param(
        1.0, "alpha: factor on the covariances that samples are drawn from; above 1 it widens the result", low=1.0
    )


def sampled_mean(
    parts: Mixture,
    weights: Array,
    kind: Kind,
    params: MeanSamplingParams,
    rng: np.random.Generator,
    closed: Callable[[], Mixture],
) -> tuple[Mixture, dict[str, NDArray[Any]]]:
    """Fuse K densities by their harmonic or geometric mean, sampled.

    Parameters
    ----------
    parts : Mixture      (..., K, C), normalised
    weights : (..., K)   sum 1
    kind, params, rng    which mean, how many samples and components, generator
    closed : callable    () -> what takes the place of samples of which too few are effective, (..., C)

    Returns
    -------
    Mixture (..., M), and diagnostics (...): converged (false where `closed` had to take its place), ess (share of
    samples that are effective), log_eta (log of the integral of the mean)

    Notes    Equal densities, and one that alone has weight, come back as they are, unless they are to be inflated.
    """
    drawn = sample_mean_density(parts, weights, kind, rng, params.samples, params.inflation)
    fused = fit_mean_density(drawn, _naive_product(parts, params))
    ess = drawn.ess / params.samples
    lost = ess <= LEAST_EFFECTIVE
    if params.inflation == 1.0:
        alone = _all_same(parts) | ((weights > 0.0).sum(-1) == 1)
        fused, lost = chosen(alone, _at(parts, weights.argmax(-1)), fused), lost & ~alone
    if lost.any():
        fused = chosen(lost, closed(), fused)
    return fused, {"converged": ~lost, "ess": ess, "log_eta": drawn.log_eta}


def _naive_product(parts: Mixture, params: ReductionParams) -> LogMixture:
    """Product (..., M) of K mixtures (..., K, C), brought down to `max_components` after each source."""
    fused = LogMixture.of(nth(parts, 0))
    for k in range(1, parts.weight.shape[-2]):
        both = product(fused, LogMixture.of(nth(parts, k)))
        reduced = params.reduce(both.normalised)
        fused = LogMixture.of(reduced) if reduced.count < both.mean.shape[-2] else both
    return fused


def _all_same(parts: Mixture) -> NDArray[np.bool_]:
    """Tell where all K mixtures (..., K, C) are equal, (...)."""
    first = nth(parts, 0)
    alike = np.ones(first.weight.shape[:-1], bool)
    for k in range(1, parts.weight.shape[-2]):
        alike &= same(first, nth(parts, k))
    return alike


def _at(parts: Mixture, source: NDArray[np.intp]) -> Mixture:
    """Pick one source (...) of each K mixtures (..., K, C)."""
    columns = ((array, (1,) * (array.ndim - source.ndim)) for array in vars(parts).values())
    picked = (np.take_along_axis(a, source.reshape(source.shape + one), source.ndim) for a, one in columns)
    return Mixture(*(np.squeeze(a, source.ndim) for a in picked))
