"""Weights of the geometric average of Gaussians that balance divergences: Chernoff, minimax information loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.gaussian import weighted_product
from track_fusion.linalg import Array, inverse, logdet, matvec, transpose
from track_fusion.solvers.optimise import (
    Derivatives,
    GradientHessian,
    Solution,
    minimise_on_interval,
    minimise_on_simplex,
)
from track_fusion.solvers.pair import Pair


def chernoff_weights(mean: Array, cov: Array) -> Solution:
    """Minimise the integral of the product of p_i^w_i: Ahmed (9), for K tracks. See `_pooling_weights`.

    At the minimum the geometric average is equally far, in Kullback-Leibler divergence relative to
    each, from every track of positive weight, (10), and nearer to the others.
    """
    return _pooling_weights(mean, cov, naive=False)


def minimax_weights(mean: Array, cov: Array) -> Solution:
    """Minimise the divergence of the naive product relative to the geometric average, Ahmed (11), for K tracks."""
    return _pooling_weights(mean, cov, naive=True)


def _pooling_weights(mean: Array, cov: Array, naive: bool) -> Solution:
    """Minimise c(w) - sum of w_i E[log p_i], c the logarithm of the integral of the product of p_i^w_i.

    The expectation is over the naive product, or left out. c is convex: its gradient is the expectation of
    log p_i over the average, and its Hessian their covariance. Uniform where all tracks are equal.
    """
    batch, count = mean.shape[:2]
    if count == 1:
        return Solution.known(np.ones((batch, 1)))
    if count > 2:
        return minimise_on_simplex(_gradient_hessian(mean, cov, naive), batch, count)
    return minimise_on_interval(_pair_derivatives(mean, cov, naive), batch).of_both()


def _pair_derivatives(mean: Array, cov: Array, naive: bool) -> Derivatives:
    """Twice the derivatives over the weight of track 1, both covariances diagonal with P1 + P2 = 1.

    With t = w P2 + (1 - w) P1 and e the difference of the means, 2 c(w) is the sum over axes of
    log(P1 P2 / t) - w log P1 - (1 - w) log P2 - w (1 - w) e^2 / t.
    """
    pair = Pair.of(cov[:, 0], cov[:, 1])
    first, second, change = pair.first, pair.second, pair.contrast
    square = pair.coordinates(mean[:, 0] - mean[:, 1]) ** 2
    if naive:  # (E1 - E2), of which the logarithms cancel those of c
        linear = (change * (1.0 - square)).sum(0)
    else:
        linear = np.where(change == 0.0, 0.0, np.log(second) - np.log(first)).sum(0)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        whole = len(rows) == first.shape[1]
        p, q, a, e2 = (
            (first, second, change, square) if whole else (x[:, rows] for x in (first, second, change, square))
        )
        total = p + w * a
        rate, share = a / total, e2 / (total * total)
        pull = ((1.0 - w) ** 2 * p - w**2 * q) * share
        slope = (linear if whole else linear[rows]) - (rate + pull).sum(0)
        return slope, (rate * rate + 2.0 * p * q * share / total).sum(0)

    return derivatives


def _gradient_hessian(mean: Array, cov: Array, naive: bool) -> GradientHessian:
    """Twice the gradient and Hessian over the weights, the tracks whitened by the sum of their covariances."""
    batch, count, n = mean.shape
    whiten = np.linalg.inv(np.linalg.cholesky(cov.sum(1)))[:, None]
    white = whiten @ cov @ transpose(whiten)
    points = matvec(whiten, mean - mean[:, :1])
    info, size = inverse(white), logdet(white)
    pull = matvec(info, points)

    def expected(centre: Array, spread: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Twice the expectation of log p_i, up to a constant, over N(centre, spread); and I_i (x_i - centre)."""
        force = matvec(info[rows], points[rows] - centre[:, None])
        distance = ((points[rows] - centre[:, None]) * force).sum(-1)
        trace = np.einsum("bkij,bij->bk", info[rows], spread)
        return -size[rows] - trace - distance, force

    everyone = np.arange(batch)
    level = expected(*weighted_product(points, white, np.ones((batch, count))), everyone)[0] if naive else None

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        spread = inverse(np.einsum("bk,bkij->bij", w, info[rows]))
        centre = matvec(spread, np.einsum("bk,bki->bi", w, pull[rows]))
        gradient, force = expected(centre, spread, rows)
        step = info[rows] @ spread[:, None]
        flat = step.reshape(len(w), count, n * n), transpose(step).reshape(len(w), count, n * n)
        hessian = flat[0] @ transpose(flat[1]) + 2.0 * force @ spread @ transpose(force)
        return gradient if level is None else gradient - level[rows], hessian

    return gradient_hessian
