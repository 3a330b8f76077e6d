"""Cross-covariances of the errors of local Kalman filters that track one target, from their gains.

The recursion of Bar-Shalom: what a fusion centre must know of its sources to fuse their tracks exactly.
"""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array, symmetrise, transpose


def kalman_gain(cov: Array, matrix: Array, noise: Array) -> Array:
    """Gain W of the Kalman update that conditions on z = H x + v.

    Parameters
    ----------
    cov : (..., n, n)       predicted
    matrix : (..., m, n)    H
    noise : (..., m, m)     R

    Returns
    -------
    (..., n, m)
    """
    cross = matrix @ cov
    spread = symmetrise(cross @ transpose(matrix) + noise)
    return np.asarray(np.swapaxes(np.linalg.solve(spread, cross), -1, -2), np.float64)


def kept_share(gain: Array, matrix: Array) -> Array:
    """Share 1 - W H of the predicted error that an update keeps, (..., n, n)."""
    return np.eye(matrix.shape[-1]) - gain @ matrix


def initial_cross(cov: Array, count: int) -> Array:
    """Cross-covariances (..., K, K, n, n) of K filters that start from one estimate of covariance (..., n, n)."""
    return np.broadcast_to(cov[..., None, None, :, :], (*cov.shape[:-2], count, count, *cov.shape[-2:])).copy()


def predict_cross(cross: Array, transition: Array, noise: Array) -> Array:
    """Predict: F P_ij F' + Q, the process noise being common to all filters.

    Parameters
    ----------
    cross : (..., K, K, n, n)
    transition, noise : (..., n, n)    F and Q

    Returns
    -------
    (..., K, K, n, n)
    """
    matrix = transition[..., None, None, :, :]
    return matrix @ cross @ transpose(matrix) + noise[..., None, None, :, :]


def update_cross(cross: Array, kept: Array) -> Array:
    """Update by measurements of independent noise: (1 - W_i H_i) P_ij (1 - W_j H_j)'.

    Parameters
    ----------
    cross : (..., K, K, n, n)    predicted
    kept : (..., K, n, n)        `kept_share` of each filter; one for a filter without a measurement

    Returns
    -------
    (..., K, K, n, n)    its diagonal blocks lack W R W' and are the filters' own business
    """
    return kept[..., :, None, :, :] @ cross @ transpose(kept)[..., None, :, :, :]
