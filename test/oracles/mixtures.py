"""Densities of mixtures by scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import multivariate_normal


def by_scipy(mixture: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithm of the density of anything with weight (C,), mean (C, n) and cov (C, n, n) at points (N, n)."""
    parts = zip(mixture.weight, mixture.mean, mixture.cov, strict=True)
    return np.log(sum(w * multivariate_normal.pdf(points, m, c) for w, m, c in parts))
