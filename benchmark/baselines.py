"""What users write today, kept as they write it: the baselines of the benchmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

Array = NDArray[np.float64]


def covariance_intersection_minimize_scalar(x1: Array, p1: Array, x2: Array, p2: Array) -> tuple[Array, Array]:
    """Fuse one pair: one bounded minimize_scalar over a function with np.linalg.inv."""
    i1, i2 = np.linalg.inv(p1), np.linalg.inv(p2)

    def cost(w: float) -> float:
        return float(np.linalg.det(np.linalg.inv(w * i1 + (1 - w) * i2)))

    w = minimize_scalar(cost, bounds=(0, 1), method="bounded").x
    p = np.linalg.inv(w * i1 + (1 - w) * i2)
    return p @ (w * i1 @ x1 + (1 - w) * i2 @ x2), p


def covariance_intersection_slsqp(means: Array, covs: Array) -> tuple[Array, Array]:
    """Fuse K tracks: one SLSQP on the simplex over a function with np.linalg.inv."""
    infos = [np.linalg.inv(p) for p in covs]

    def fused(w: Array) -> Array:
        return np.linalg.inv(sum(wi * i for wi, i in zip(w, infos, strict=True)))

    count = len(covs)
    result = minimize(
        lambda w: np.linalg.det(fused(w)),
        np.full(count, 1 / count),
        method="SLSQP",
        bounds=[(0, 1)] * count,
        constraints={"type": "eq", "fun": lambda w: np.sum(w) - 1},
    )
    p = fused(result.x)
    return p @ sum(wi * i @ x for wi, i, x in zip(result.x, infos, means, strict=True)), p


def lapack_floor(p1: Array, p2: Array) -> tuple[Array, Array, Array]:
    """One batched Cholesky, eigh and inverse of the arrays of a batch of pairs: what no kernel can do without."""
    return np.linalg.cholesky(p1 + p2), np.linalg.eigh(p1)[0], np.linalg.inv(p2)


def karcher_pyriemann(groups: Array) -> list[Array]:
    """Riemannian mean of each group of covariances, (B, K, n, n): a loop over pyriemann, its defaults."""
    from pyriemann.geometry.mean import mean_riemann

    return [mean_riemann(covs) for covs in groups]


def log_euclidean_pyriemann(groups: Array) -> list[Array]:
    """Log-Euclidean mean of each group of covariances, (B, K, n, n): a loop over pyriemann."""
    from pyriemann.geometry.mean import mean_logeuclid

    return [mean_logeuclid(covs) for covs in groups]


def mhdp_mean_minimize(means: Array, covs: Array, pull: float) -> Array:
    """Mean of MHDP, squared criterion: one scipy.optimize.minimize over a function with np.linalg.inv."""
    infos = [np.linalg.inv(p) for p in covs]

    def cost(x: Array) -> float:
        return float(sum(np.arccosh(1 + pull * (x - m) @ i @ (x - m)) ** 2 for m, i in zip(means, infos, strict=True)))

    return minimize(cost, means.mean(0)).x
