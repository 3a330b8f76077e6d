"""Weights at which a mixture of Gaussians itself fits a target density best, Li 2022 (33)."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_sum_exp
from track_fusion.densities.mixture.mixture import Factored, Mixture, gaussian
from track_fusion.linalg import Array, cholesky, symmetrise, transpose, whitener
from track_fusion.solvers.optimise import Solution, minimise_on_simplex

#: Expectations over each Gaussian: nodes of Gauss and Hermite an axis, by the number of axes; of more axes, so many
#: points drawn once and for all.
NODES, DRAWN = {1: 100, 2: 60, 3: 16, 4: 8}, 4000
#: Large batches are worked on in pieces whose arrays stay in the cache.
CHUNK = 32


def target_weights(mean: Array, cov: Array, target: Mixture) -> Solution:
    """Minimise the divergence of the sum of w_i N(x_i, P_i) from a target, over the simplex.

    Parameters
    ----------
    mean, cov
    target : Mixture    (B, T), normalised

    Notes         With q the mean of the K densities the divergence is the expectation over q of
                  (f / q) log(f / p) - f / q + p / q, convex in the weights of f at each point, so that it is so on any
                  points with weights; where f is p its slope is zero on any.
    """
    pieces = [slice(at, at + CHUNK) for at in range(0, max(len(mean), 1), CHUNK)]
    return Solution.concatenate([_piece(mean[s], cov[s], target.at(s)) for s in pieces])


def _piece(mean: Array, cov: Array, target: Mixture) -> Solution:
    batch, count, n = mean.shape
    nodes, share = _nodes(n)
    points = mean[:, :, None] + nodes @ transpose(_roots(cov))  # of each density, (B, K, S, n)
    points = points.reshape(batch, count * len(nodes), n)
    logs = Factored.of(gaussian(mean, cov)).log_pdf(points[:, None])  # (B, K, K S)
    log_q = log_sum_exp(logs, 1) - np.log(count)
    ratio, chance = np.exp(logs - log_q[:, None]), np.tile(share, count) / count
    beyond = log_q - Factored.of(target).log_pdf(points)

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        part = ratio[rows]
        whole = np.einsum("bk,bks->bs", w, part)  # f / q
        gradient = (part * (chance * (np.log(whole) + beyond[rows]))[:, None]).sum(-1)
        return gradient, (part * (chance / whole)[:, None]) @ transpose(part)

    return minimise_on_simplex(gradient_hessian, batch, count)


def _roots(cov: Array) -> Array:
    """Roots R_i of covariances (B, K, n, n), R_i R_i' = P_i, that turn with the axes, but for signs.

    Products of nodes depend on the axes that they are taken along: those of the sum of the squares of the covariances,
    where their sum is the unit matrix, are the same whatever axes these are given in.
    """
    lower = cholesky(cov.sum(1))
    whiten = whitener(cov.sum(1))[:, None]
    white = symmetrise(whiten @ cov @ transpose(whiten))
    axes = np.asarray(np.linalg.eigh((white @ white).sum(1))[1], np.float64)
    turned = symmetrise(transpose(axes)[:, None] @ white @ axes[:, None])
    return np.asarray((lower @ axes)[:, None] @ cholesky(turned))


@functools.lru_cache
def _nodes(n: int) -> tuple[Array, Array]:
    """Points (S, n) and weights (S,) of sum 1 for expectations over standard normal variables."""
    if n not in NODES:
        half = np.random.default_rng(0).normal(size=(DRAWN // 2, n))
        points = np.concatenate([half, -half])
        return points @ transpose(whitener(points.T @ points / DRAWN)), np.full(DRAWN, 1.0 / DRAWN)
    x, w = np.polynomial.hermite_e.hermegauss(NODES[n])
    axes = np.meshgrid(*[x] * n, indexing="ij")
    chances = np.meshgrid(*[w / w.sum()] * n, indexing="ij")
    return np.stack([a.ravel() for a in axes], -1), np.prod([c.ravel() for c in chances], 0)
