"""What users write today, kept as they write it: the baselines of the benchmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

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


def inverse_covariance_intersection_minimize_scalar(x1: Array, p1: Array, x2: Array, p2: Array) -> tuple[Array, Array]:
    """Fuse one pair by ICI: one bounded minimize_scalar over a function with np.linalg.inv."""
    i1, i2 = np.linalg.inv(p1), np.linalg.inv(p2)

    def cost(w: float) -> float:
        return float(np.linalg.det(np.linalg.inv(i1 + i2 - np.linalg.inv(w * p1 + (1 - w) * p2))))

    w = minimize_scalar(cost, bounds=(0, 1), method="bounded").x
    common = np.linalg.inv(w * p1 + (1 - w) * p2)
    p = np.linalg.inv(i1 + i2 - common)
    return p @ (i1 @ x1 + i2 @ x2 - common @ (w * x1 + (1 - w) * x2)), p


def harmonic_mean_minimize_scalar(x1: Array, p1: Array, x2: Array, p2: Array) -> tuple[Array, Array]:
    """Fuse one pair by HMD-GA at the weight (77): one bounded minimize_scalar over a function with np.linalg.inv."""
    i1, i2, spread = np.linalg.inv(p1), np.linalg.inv(p2), np.outer(x1 - x2, x1 - x2)

    def common(w: float) -> Array:
        return np.linalg.inv((1 - w) * p1 + w * p2 + w * (1 - w) * spread)

    w = minimize_scalar(lambda w: np.linalg.det(common(w)), bounds=(0, 1), method="bounded").x
    info = common(w)
    p = np.linalg.inv(i1 + i2 - info)
    return p @ (i1 @ x1 + i2 @ x2 - info @ ((1 - w) * x1 + w * x2)), p


def covariance_union_slsqp(means: Array, covs: Array, free: bool) -> tuple[Array, Array]:
    """Bound K tracks: one SLSQP over the Cholesky factor, with the lowest eigenvalue of each slack as a constraint."""
    n, low = means.shape[1], np.tril_indices(means.shape[1])
    size, centre = len(low[0]), means.mean(0)

    def parts(v: Array) -> tuple[Array, Array]:
        root = np.zeros((n, n))
        root[low] = v[:size]
        return root @ root.T, (v[size:] if free else centre)

    def slack(v: Array) -> Array:
        p, x = parts(v)
        return np.array(
            [np.linalg.eigvalsh(p - c - np.outer(x - m, x - m))[0] for m, c in zip(means, covs, strict=True)]
        )

    start = np.linalg.cholesky(sum(c + np.outer(centre - m, centre - m) for m, c in zip(means, covs, strict=True)))[low]
    result = minimize(
        lambda v: np.log(np.linalg.det(parts(v)[0])),
        np.concatenate([start, centre]) if free else start,
        method="SLSQP",
        constraints={"type": "ineq", "fun": slack},
    )
    p, x = parts(result.x)
    return x, p


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


def mixture_log_pdf_loop(weight: Array, mean: Array, cov: Array, points: Array) -> Array:
    """Log-density of a mixture: one scipy call a component."""
    parts = zip(weight, mean, cov, strict=True)
    return logsumexp([np.log(w) + multivariate_normal.logpdf(points, m, c) for w, m, c in parts], axis=0)


def runnalls_loop(weight: Array, mean: Array, cov: Array, count: int) -> tuple[list[float], list[Array], list[Array]]:
    """Merge the cheapest pair until `count` are left: the cost of every pair anew at every step."""
    weights, means, covs = list(weight), list(mean), list(cov)

    def merged(i: int, j: int) -> tuple[float, Array, Array]:
        w, d = weights[i] + weights[j], means[i] - means[j]
        m = (weights[i] * means[i] + weights[j] * means[j]) / w
        p = (weights[i] * covs[i] + weights[j] * covs[j]) / w + weights[i] * weights[j] / w**2 * np.outer(d, d)
        return w, m, p

    def cost(i: int, j: int) -> float:
        w, _, p = merged(i, j)
        return 0.5 * float(
            w * np.log(np.linalg.det(p))
            - weights[i] * np.log(np.linalg.det(covs[i]))
            - weights[j] * np.log(np.linalg.det(covs[j]))
        )

    while len(weights) > count:
        pairs = ((i, j) for i in range(len(weights)) for j in range(i + 1, len(weights)))
        i, j = min(pairs, key=lambda pair: cost(*pair))
        weights[i], means[i], covs[i] = merged(i, j)
        del weights[j], means[j], covs[j]
    return weights, means, covs
