"""Sums, means and importance weights of numbers given by their logarithms."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array


def log_of(a: Array) -> Array:
    """Logarithm of non-negative numbers, minus infinity at zero."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(a))


def log_sum_exp(a: Array, axis: int = -1) -> Array:
    """Logarithm of the sum of exponentials along an axis; minus infinity where all terms vanish."""
    top = a.max(axis, keepdims=True, initial=-np.inf)
    top = np.where(np.isfinite(top), top, 0.0)
    return np.asarray(log_of(np.exp(a - top).sum(axis)) + np.squeeze(top, axis))


def log_mean_exp(a: Array, axis: int = -1) -> Array:
    """Logarithm of the mean of exponentials along an axis."""
    return np.asarray(log_sum_exp(a, axis) - np.log(a.shape[axis]))


def normalised(log_weight: Array) -> Array:
    """Weights (..., C) of sum one from their logarithms; all zero where every one vanishes."""
    top = log_weight.max(-1, keepdims=True, initial=-np.inf)
    weight = np.exp(log_weight - np.where(np.isfinite(top), top, 0.0))
    total = weight.sum(-1, keepdims=True)
    return np.asarray(weight / np.where(total > 0.0, total, 1.0))


def effective_sample_size(log_weight: Array) -> Array:
    """Effective number of samples behind importance weights (..., S), Ahmed (40): S / (1 + cv^2).

    cv^2 is the weights' sample variance over their squared mean. It does not detect disjoint densities,
    whose weights may be even and all negligible: look at the normaliser's logarithm too.
    """
    count = log_weight.shape[-1]
    share = normalised(log_weight) * count  # of mean one
    variation = ((share - 1.0) ** 2).sum(-1) / max(count - 1, 1)
    return np.asarray(np.where(share.any(-1), count / (1.0 + variation), 0.0))
