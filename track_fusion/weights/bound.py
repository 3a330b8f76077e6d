"""Weights of a mixture by a bound on the divergence of its components from it, Li 2022 (45)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, logdet, mahalanobis_squared, transpose
from track_fusion.solvers.optimise import Solution, minimise_on_simplex

#: Weight of the track that one of the searches starts near.
NEAR = 0.8
#: Least curvature Newton's method assumes, relative to the largest: the objective is not convex.
FLAT = 1e-6


def bound_weights(mean: Array, cov: Array) -> Solution:
    """Minimise the sum of w_i log(|P_i|^1/2 sum of w_j z_ij), z_ij the integral of p_i p_j, over the simplex.

    Notes         From four axes on the objective may have several minima: the best that is found from the centre and
                  from near every corner, and the iterations of that.
    """
    batch, count = mean.shape[:2]
    overlap = _overlap(mean, cov)
    corners = np.eye(count) * NEAR + (1.0 - np.eye(count)) * (1.0 - NEAR) / max(count - 1, 1)
    starts = np.concatenate([np.full((1, count), 1.0 / count), corners]) if count > 1 else np.ones((1, 1))
    several = np.tile(overlap, (len(starts), 1, 1))

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Gradient, and the Hessian with its eigenvalues made positive."""
        z = several[rows]
        mass = np.einsum("bij,bj->bi", z, w)
        share = z / mass[..., None]
        gradient = np.log(mass) + np.einsum("bi,bij->bj", w, share)
        hessian = share + transpose(share) - transpose(share) @ (w[..., None] * share)
        values, vectors = np.linalg.eigh(hessian)
        values = np.abs(values)
        values = np.maximum(values, np.maximum(FLAT * values.max(1, keepdims=True), np.finfo(float).tiny))
        return gradient, (vectors * values[:, None, :]) @ transpose(vectors)

    ends = minimise_on_simplex(gradient_hessian, len(several), count, np.repeat(starts, batch, 0))
    values = (ends.weights * np.log(np.einsum("bij,bj->bi", several, ends.weights))).sum(1)
    # Of equal minima the one from the centre: of equal tracks all weigh the same.
    values = np.round(np.where(ends.converged, values, np.inf), 12).reshape(len(starts), batch)
    best = values.argmin(0) if batch else np.zeros(0, np.intp)
    return ends[best * batch + np.arange(batch)]


def _overlap(mean: Array, cov: Array) -> Array:
    """|P_i|^1/2 z_ij over its value for i = j, which is the same for all, (B, K, K)."""
    n = mean.shape[-1]
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1).sum(1))[:, None]
    mean, cov = mean / scale, cov / (scale[..., :, None] * scale[..., None, :])
    total = cov[:, :, None] + cov[:, None]
    distance = mahalanobis_squared(mean[:, :, None] - mean[:, None], total)
    return np.asarray(np.exp(0.5 * (logdet(cov)[:, :, None] + n * np.log(2.0) - logdet(total) - distance)))
