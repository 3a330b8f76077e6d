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
    from pyriemann.utils.mean import mean_riemann

    return [mean_riemann(covs) for covs in groups]


def log_euclidean_pyriemann(groups: Array) -> list[Array]:
    """Log-Euclidean mean of each group of covariances, (B, K, n, n): a loop over pyriemann."""
    from pyriemann.utils.mean import mean_logeuclid

    return [mean_logeuclid(covs) for covs in groups]


def mhdp_mean_minimize(means: Array, covs: Array, pull: float) -> Array:
    """Mean of MHDP, squared criterion: one scipy.optimize.minimize over a function with np.linalg.inv."""
    infos = [np.linalg.inv(p) for p in covs]

    def cost(x: Array) -> float:
        return float(sum(np.arccosh(1 + pull * (x - m) @ i @ (x - m)) ** 2 for m, i in zip(means, infos, strict=True)))

    return minimize(cost, means.mean(0)).x


def association_costs_by_loop(row_mean: Array, row_cov: Array, col_mean: Array, col_cov: Array, gamma: float) -> Array:
    """Fill the table of association costs pair by pair, with np.linalg.inv and np.linalg.det."""
    cost = np.full((len(row_mean), len(col_mean)), 1e9)
    for i in range(len(row_mean)):
        for j in range(len(col_mean)):
            s, r = row_cov[i] + col_cov[j], row_mean[i] - col_mean[j]
            d2 = r @ np.linalg.inv(s) @ r
            if d2 <= gamma:
                cost[i, j] = d2 + np.log(np.linalg.det(s))
    return cost


def two_filters_and_intersection_looped(
    mean0: Array, cov0: Array, f: Array, q: Array, h: Array, rs: list[Array], zs: list[Array], weight: float | None
) -> Array:
    """Run two Kalman filters with covariance intersection fed back, run by run, step by step.

    zs: (R, T, m) a sensor. weight: of the first filter, or None: one bounded minimize_scalar of the trace a step.
    """
    runs, steps = zs[0].shape[:2]
    found = np.empty((runs, steps, len(mean0)))
    eye = np.eye(len(mean0))
    for run in range(runs):
        x, p = mean0, cov0
        for k in range(steps):
            x, p = f @ x, f @ p @ f.T + q
            xs, infos = [], []
            for r, z in zip(rs, zs, strict=True):
                gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
                xs.append(x + gain @ (z[run, k] - h @ x))
                infos.append(np.linalg.inv((eye - gain @ h) @ p))
            i1, i2 = infos
            w = weight
            if w is None:
                w = minimize_scalar(_fused_trace, bounds=(0, 1), args=(i1, i2), method="bounded").x
            p = np.linalg.inv(w * i1 + (1 - w) * i2)
            x = p @ (w * i1 @ xs[0] + (1 - w) * i2 @ xs[1])
            found[run, k] = x
    return found


def _fused_trace(w: float, i1: Array, i2: Array) -> float:
    return float(np.trace(np.linalg.inv(w * i1 + (1 - w) * i2)))
