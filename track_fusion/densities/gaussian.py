"""Gaussian densities: products of powers, mergers of near ones, divergences."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import (
    Array,
    inverse,
    keep_sole,
    logdet,
    mahalanobis_squared,
    matvec,
    merged_moments,
    symmetrise,
)


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
    fused_mean, fused_cov = origin + scale * matvec(fused, pull), symmetrise(fused * unit)
    keep_sole(fused_mean, fused_cov, mean, cov, weights)
    return fused_mean, fused_cov


def merge_near(weight: Array, mean: Array, cov: Array, threshold: float) -> tuple[Array, Array, Array]:
    """Merge the components of a mixture that are near to each other, directly or by way of others.

    Parameters
    ----------
    weight : (..., C)
    mean : (..., C, n)
    cov : (..., C, n, n)
    threshold : float       two components are near if (m_i - m_j)' (P_i + P_j)^-1 (m_i - m_j) < threshold^2

    Returns
    -------
    weight, mean, cov    of the same shapes; a component that went into an earlier one has weight 0

    Notes         Components of weight 0 join nothing, nor do particles (without covariance).
    """
    count, n = mean.shape[-2:]
    total = cov[..., :, None, :, :] + cov[..., None, :, :, :]
    solid = (weight > 0) & (np.trace(cov, axis1=-2, axis2=-1) > 0)
    both = solid[..., :, None] & solid[..., None, :]
    distance = mahalanobis_squared(
        mean[..., :, None, :] - mean[..., None, :, :], np.where(both[..., None, None], total, np.eye(n))
    )
    near = (both & (distance < threshold**2)) | np.eye(count, dtype=bool)
    for _ in range(max(count - 1, 1).bit_length()):  # near by way of others: each squaring doubles the way
        near = near @ near
    leader = near.argmax(-1)
    member = weight[..., None, :] * (leader[..., None, :] == np.arange(count)[:, None])
    merged = member.sum(-1)
    share = np.where(merged[..., None] > 0, member, np.eye(count)) / np.where(merged > 0, merged, 1.0)[..., None]
    every = np.broadcast_to(mean[..., None, :, :], (*share.shape, n))
    return merged, *merged_moments(every, np.broadcast_to(cov[..., None, :, :, :], (*share.shape, n, n)), share)


def kl_divergence(mean: Array, cov: Array, other_mean: Array, other_cov: Array) -> Array:
    """Kullback-Leibler divergence of N(mean, cov) relative to N(other_mean, other_cov), in nats.

    Shapes (..., n) and (..., n, n), broadcast; the result has shape (...). Li 2022, section III-D.
    """
    trace = np.trace(np.linalg.solve(other_cov, cov), axis1=-2, axis2=-1)
    distance = mahalanobis_squared(mean - other_mean, other_cov)
    return np.asarray(0.5 * (trace - mean.shape[-1] + logdet(other_cov) - logdet(cov) + distance))
