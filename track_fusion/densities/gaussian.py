"""Gaussian densities: products of powers, mixtures' moments, divergences."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array, inverse, logdet, mahalanobis_squared, matvec, outer, symmetrise


def weighted_product(mean: Array, cov: Array, weights: Array) -> tuple[Array, Array]:
    """Moments of the normalised product of Gaussians raised to powers, Li 2022 (16)-(17).

    With weights that sum to one it is the geometric average (covariance intersection at given
    weights); with unit weights the naive product (14).

    Parameters
    ----------
    mean : (..., K, n)
    cov : (..., K, n, n)     positive definite
    weights : (..., K)       non-negative, at least one positive

    Returns
    -------
    mean (..., n), cov (..., n, n)

    Notes         Axes are scaled by their standard deviations first, so that units do not matter.
    """
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1).sum(-2))
    unit = scale[..., :, None] * scale[..., None, :]
    info = weights[..., None, None] * inverse(cov / unit[..., None, :, :])
    fused = inverse(info.sum(-3))
    origin = mean[..., 0, :]
    pull = matvec(info, (mean - origin[..., None, :]) / scale[..., None, :]).sum(-2)
    return origin + scale * matvec(fused, pull), symmetrise(fused * unit)


def merge(mean: Array, cov: Array, weights: Array) -> tuple[Array, Array]:
    """Mean and covariance of a Gaussian mixture, Li 2022 (5), (10)-(11).

    Parameters
    ----------
    mean : (..., K, n)
    cov : (..., K, n, n)
    weights : (..., K)    sum to one

    Returns
    -------
    mean (..., n), cov (..., n, n)
    """
    origin = mean[..., 0, :]
    offset = mean - origin[..., None, :]
    shift = (weights[..., None] * offset).sum(-2)
    spread = cov + outer(offset - shift[..., None, :])
    return origin + shift, symmetrise((weights[..., None, None] * spread).sum(-3))


def kl_divergence(mean: Array, cov: Array, other_mean: Array, other_cov: Array) -> Array:
    """Kullback-Leibler divergence of N(mean, cov) relative to N(other_mean, other_cov), in nats.

    Shapes (..., n) and (..., n, n), broadcast; the result has shape (...). Li 2022, section III-D.
    """
    trace = np.trace(np.linalg.solve(other_cov, cov), axis1=-2, axis2=-1)
    distance = mahalanobis_squared(mean - other_mean, other_cov)
    return np.asarray(0.5 * (trace - mean.shape[-1] + logdet(other_cov) - logdet(cov) + distance))
