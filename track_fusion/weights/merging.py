"""Weights at which merged Gaussians are worth most: convex programs over the log det of the merged covariance."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, logdet, transpose
from track_fusion.solvers.optimise import (
    Derivatives,
    GradientHessian,
    Solution,
    minimise_on_interval,
    minimise_on_simplex,
    minimise_one,
)
from track_fusion.solvers.pair import FEW, Pair, SinglePair

T = TypeVar("T", float, Array)


def merging_weights(mean: Array, cov: Array, linear: Array | None = None) -> Solution:
    """Minimise sum of w_i l_i - log det P_AA(w), P_AA the covariance of the mixture at weights w, of a flat batch.

    With l_i = log det P_i it is the diversity program of Li 2022 (40), with twice the divergence of track i from
    a target more, (39), and with zero the weight (77) of Sharma by the determinant.

    Parameters
    ----------
    mean, cov
    linear : (B, K) or None    l; None = log det P_i

    Returns
    -------
    Solution    uniform where all tracks are equal
    """
    if mean.shape[1] == 1:
        return Solution.known(np.ones(mean.shape[:2]))
    if mean.shape[1] > 2:
        return minimise_on_simplex(_gradient_hessian(mean, cov, linear), len(mean), mean.shape[1])
    slope = None if linear is None else linear[:, 0] - linear[:, 1]
    if 0 < len(mean) <= FEW:
        slopes = [None if slope is None else float(s) for s in (mean if slope is None else slope)]
        return Solution.concatenate([_single(*parts) for parts in zip(mean, cov, slopes, strict=True)])
    pair = Pair.of(cov[:, 0], cov[:, 1])
    difference = pair.coordinates(mean[:, 0] - mean[:, 1])
    return minimise_on_interval(pair_derivatives(pair, difference, slope), len(mean)).of_both()


def pair_derivatives(pair: Pair, difference: Array, slope: Array | None) -> Derivatives:
    """Derivatives over the weight of track 1 of w s - log det P_AA, both covariances diagonal.

    In these axes P_AA = D + w (1 - w) e e', D = w P1 + (1 - w) P2, whose determinant is det D times
    1 + w (1 - w) q with q = e' D^-1 e.

    Parameters
    ----------
    pair : Pair
    difference : (n, B)       e, the difference of the means in the axes of the pair
    slope : (B,) or None      s; None = log det P1 - log det P2
    """
    second, change, square = pair.second, -pair.contrast, difference**2
    if slope is None:
        slope = np.where(change == 0.0, 0.0, np.log(pair.first) - np.log(second)).sum(0)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        whole = len(rows) == second.shape[1]
        p2, c, e2 = (second, change, square) if whole else (second[:, rows], change[:, rows], square[:, rows])
        d = p2 + w * c
        rate, share = c / d, e2 / d
        fall = share * rate
        first, curvature = _join(w, rate.sum(0), (rate * rate).sum(0), share.sum(0), fall.sum(0), (fall * rate).sum(0))
        return (slope if whole else slope[rows]) + first, curvature

    return derivatives


def _single(mean: Array, cov: Array, slope: float | None) -> Solution:
    """Find the weights of one pair, mean (2, n), as a batch of one; in plain numbers where no axis is very sharp."""
    pair = SinglePair.of(cov[0], cov[1])
    if pair is None:
        two = Pair.of(cov[:1], cov[1:])
        given = None if slope is None else np.array([slope])
        return minimise_on_interval(pair_derivatives(two, two.coordinates(mean[:1] - mean[1:]), given), 1).of_both()
    square = ((pair.inverse @ (mean[0] - mean[1])) ** 2).tolist()
    axes = [(q, -c, e) for q, c, e in zip(pair.second, pair.contrast, square, strict=True)]
    start = sum(math.log((q + c) / q) for q, c, _ in axes) if slope is None else slope

    def derivatives(w: float) -> tuple[float, float]:
        a = b = q = r = s = 0.0
        for p2, c, e2 in axes:
            d = p2 + w * c
            rate, share = c / d, e2 / d
            fall = share * rate
            a, b, q, r, s = a + rate, b + rate * rate, q + share, r + fall, s + fall * rate
        first, curvature = _join(w, a, b, q, r, s)
        return start + first, curvature

    omega, converged, iterations = minimise_one(derivatives)
    return Solution(np.array([[omega, 1.0 - omega]]), np.array([converged]), np.array([iterations]))


def _join(w: T, rate: T, square: T, q: T, fall: T, fall_rate: T) -> tuple[T, T]:
    """Derivatives of -log det D - log(1 + w (1 - w) q) from sums over axes; those of q are -fall and 2 fall_rate."""
    v, dv = w * (1.0 - w), 1.0 - 2.0 * w
    psi = 1.0 + v * q
    rise = (dv * q - v * fall) / psi
    bend = (2.0 * v * fall_rate - 2.0 * q - 2.0 * dv * fall) / psi
    return -rate - rise, square - bend + rise * rise


def _gradient_hessian(mean: Array, cov: Array, linear: Array | None) -> GradientHessian:
    """Gradient and Hessian over the weights of sum of w_i l_i - log det P_AA."""
    batch, count, n = mean.shape
    lower = np.linalg.cholesky(cov.sum(1))
    whiten = np.linalg.inv(lower)[:, None]
    white = whiten @ cov @ transpose(whiten)
    points = (whiten @ (mean - mean.mean(1, keepdims=True))[..., None])[..., 0]
    slopes = logdet(white) if linear is None else linear

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        centred, spread, info = _about_mean(w, points[rows], white[rows])
        # On the simplex the derivative of P_AA along w_i is P_i + (x_i - x)(x_i - x)', up to a common term.
        step = info @ spread
        gradient = slopes[rows] - np.trace(step, axis1=-2, axis2=-1)
        flat = step.reshape(len(w), count, n * n), transpose(step).reshape(len(w), count, n * n)
        curvature = flat[0] @ transpose(flat[1]) + 2.0 * centred @ info[:, 0] @ transpose(centred)
        return gradient, curvature

    return gradient_hessian


def _about_mean(w: Array, x: Array, white: Array) -> tuple[Array, Array, Array]:
    """X_i - x (b, K, n), P_i + (x_i - x)(x_i - x)' (b, K, n, n), and P_AA^-1 (b, 1, n, n), x the mean at weights w."""
    centred = x - np.einsum("bk,bki->bi", w, x)[:, None]
    spread = white + centred[..., :, None] * centred[..., None, :]
    return centred, spread, np.linalg.inv(np.einsum("bk,bkij->bij", w, spread))[:, None]


def merging_weights_by_trace(mean: Array, cov: Array) -> Solution:
    """Minimise the trace of the inverse of P_AA(w), of a flat batch: (77) of Sharma by the trace, for K tracks.

    Notes         P_AA is concave in the weights, and the trace of an inverse convex and falling: a convex program.
    """
    batch, count, n = mean.shape
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1).sum(1))
    unit = (scale.min(1, keepdims=True) / scale) ** 2  # the trace is in the given units, up to a factor
    white, points = cov / (scale[:, None, :, None] * scale[:, None, None, :]), mean / scale[:, None]

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        centred, spread, info = _about_mean(w, points[rows], white[rows])
        weigh = info @ (unit[rows, None, :, None] * info)  # M^-1 U M^-1
        gradient = -(weigh * spread).sum((-2, -1))
        step = (info @ spread).reshape(len(w), count, n * n)
        bend = step @ transpose((weigh @ spread).swapaxes(-1, -2).reshape(len(w), count, n * n))
        return gradient, bend + transpose(bend) + 2.0 * centred @ weigh[:, 0] @ transpose(centred)

    return minimise_on_simplex(gradient_hessian, batch, count)
