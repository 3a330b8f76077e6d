"""Quadrature nodes of the variables of Li 2019, for tests."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array


def positive_normal_pair(mean: Array, cov: Array, nodes: int = 200, reach: float = 8.0) -> tuple[Array, Array]:
    """Nodes (nodes^2, 2) and probabilities of two jointly normal variables cut to positive values, Figs. 1, 3 and 4.

    Gauss-Legendre along each axis, as far as `reach` standard deviations.
    """
    sigma = np.sqrt(np.diagonal(cov))
    points, share = np.polynomial.legendre.leggauss(nodes)
    low = np.maximum(mean - reach * sigma, 0.0)
    half = 0.5 * (mean + reach * sigma - low)
    first, second = (low[i] + half[i] * (points + 1.0) for i in (0, 1))
    values = np.stack(np.meshgrid(first, second, indexing="ij"), -1).reshape(-1, 2)
    residual = values - mean
    exponent = (residual * np.linalg.solve(cov, residual.T).T).sum(-1)
    probability = np.outer(share, share).ravel() * np.exp(-0.5 * (exponent - exponent.min()))
    return values, probability / probability.sum()
