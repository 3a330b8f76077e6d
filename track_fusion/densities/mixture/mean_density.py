"""Harmonic and geometric mean densities of Gaussians and mixtures by sampling: HMD-S and GMD-S of Sharma et al."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from track_fusion.densities.log_domain import log_of, log_sum_exp
from track_fusion.densities.mixture.algebra import LogMixture, average
from track_fusion.densities.mixture.mixture import Factored, Mixture, sample
from track_fusion.densities.mixture.sampling import Weighted, single_shot_em
from track_fusion.linalg import Array

Kind = Literal["harmonic", "geometric"]
#: Smallest covariance of a fused component, as a share of the naive product's: keeps those of few samples definite.
FLOOR = 1e-3


def sample_mean_density(
    parts: Mixture, weights: Array, kind: Kind, rng: np.random.Generator, count: int, inflation: float = 1.0
) -> Weighted:
    """Draw samples of the mean density of K densities, weighted.

    Parameters
    ----------
    parts : Mixture          (..., K, C), normalised
    weights : (..., K)       sum 1
    kind : str               harmonic: 1 / sum of w_i / p_i, (66); geometric: product of p_i^w_i, (61)
    rng, count               generator and number of samples
    inflation : float >= 1   alpha: samples are drawn from covariances this much larger and weighted as if they
                             were not, which widens the result

    Returns
    -------
    Weighted    points (..., S, n), log_weight (..., S)

    Notes         The proposal is the balanced mixture of all sources, which has half the error of choosing samples
                  pair by pair by (74), and no bias. Importance weights of the harmonic mean are bounded.
    References    N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking: Performance and
                  Comparison, eqs. (59)-(66), the constants of (62)-(66) completed.
    """
    sources = parts.weight.shape[-2]
    proposal = average(parts, np.full(parts.weight.shape[:-1], 1.0 / sources))
    wide = proposal if inflation == 1.0 else dataclasses.replace(proposal, cov=inflation * proposal.cov)
    points = sample(wide, rng, count).points
    each = Factored.of(parts).log_pdf(points[..., None, :, :])  # (..., K, S)
    target = log_mean_density(each, weights, kind)
    return Weighted(points, target - log_sum_exp(each - np.log(sources), -2))


def log_mean_density(log_pdfs: Array, weights: Array, kind: Kind) -> Array:
    """Logarithm (..., S) of the un-normalised mean of densities given by their logarithms (..., K, S)."""
    share = weights[..., None]
    if kind == "harmonic":
        return -log_sum_exp(log_of(share) - log_pdfs, -2)
    return np.asarray(np.where(share > 0.0, share * log_pdfs, 0.0).sum(-2))


def fit_mean_density(samples: Weighted, product: LogMixture) -> Mixture:
    """Fit a mixture to samples of a mean density, (..., M): Sharma (70)-(73).

    Parameters
    ----------
    samples : Weighted      of the mean density
    product : LogMixture    (..., M), the product of the sources' components, whose shares of the density the fused
                            components are; one component has the moments of the samples
    """
    if product.mean.shape[-2] == 1:
        mean, cov = samples.moments()
        return Mixture(np.ones((*mean.shape[:-1], 1)), mean[..., None, :], cov[..., None, :, :])
    return single_shot_em(samples, product, FLOOR)
