"""Arithmetic average: the mixture of the tracks' densities."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.gaussian import merge
from track_fusion.densities.pair import FEW, Pair, SinglePair
from track_fusion.linalg import Array, logdet, transpose
from track_fusion.optimise import (
    Derivatives,
    GradientHessian,
    Solution,
    minimise_on_interval,
    minimise_on_simplex,
    minimise_one,
)
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, Mixture, Rule, SourceTracks, check_weights

T = TypeVar("T", float, Array)


@dataclasses.dataclass(frozen=True)
class ArithmeticAverageParams(Params):
    """How the fusion weights are chosen and what is handed on."""

    criterion: str = param(
        "diversity",
        "fusion weights: by diversity preference, eq. (40), uniform, or given by 'weights'",
        choices=("diversity", "uniform", "given"),
    )
    weights: tuple[float, ...] = param(
        (), "fusion weights for criterion given, one a source, sum 1", low=0.0, high=1.0, kind=float
    )
    output: str = param(
        "merged",
        "merged: one Gaussian with the mixture's mean and covariance; mixture: the mixture, its modes preserved",
        choices=("merged", "mixture"),
    )


def fuse(tracks: SourceTracks, params: ArithmeticAverageParams) -> FusedTracks:
    """Fuse K tracks by the arithmetic average of their densities: f = sum of w_i f_i.

    Conservative at weights that do not depend on the means, if each track is: the merged covariance is the
    weighted mean of the tracks' covariances plus the spread of their means.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); mixtures are averaged as mixtures
    params : ArithmeticAverageParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), the mixture for output mixture

    Raises
    ------
    ValueError    given weights do not fit

    Notes          Weights by diversity depend on the means, for which the promise is not proved. The
                   diversity program (40) is the concave maximisation of log det P_AA(w) minus the mean log
                   det P_i; at its interior optimum all divergences (37) are equal. O(K n^3).
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, eqs. (6), (10)-(11), (37), (40).
    """
    batch, (count, n) = tracks.mean.shape[:-2], tracks.mean.shape[-2:]
    info: dict[str, NDArray[np.bool_] | NDArray[np.intp]] = {}
    if params.weights and params.criterion != "given":
        raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {params.criterion!r}.")
    if params.criterion == "given":
        weights = np.broadcast_to(check_weights(params.weights, count), (*batch, count))
    elif params.criterion == "uniform" or count == 1:
        weights = np.full((*batch, count), 1.0 / count)
    else:
        found = diversity_weights(tracks.mean.reshape(-1, count, n), tracks.cov.reshape(-1, count, n, n))
        weights = found.weights.reshape(*batch, count)
        info = {"converged": found.converged.reshape(batch), "iterations": found.iterations.reshape(batch)}
    mean, cov = merge(tracks.mean, tracks.cov, weights)
    mixture = _mixture(tracks, weights) if params.output == "mixture" else None
    return FusedTracks(mean, cov, weights, mixture=mixture, info=info)


def _mixture(tracks: SourceTracks, weights: Array) -> Mixture:
    """List the components of all sources, weighted by their source."""
    if tracks.mixture is None:
        return Mixture(weights, tracks.mean, tracks.cov)
    part, (*batch, n) = tracks.mixture, (*tracks.mean.shape[:-2], tracks.mean.shape[-1])
    weight = (weights[..., None] * part.weight).reshape(*batch, -1)
    return Mixture(weight, part.mean.reshape(*batch, -1, n), part.cov.reshape(*batch, -1, n, n))


def diversity_weights(mean: Array, cov: Array) -> Solution:
    """Find the weights of diversity preference, Li 2022 (40), of a flat batch.

    Parameters
    ----------
    mean : (B, K, n)
    cov : (B, K, n, n)

    Returns
    -------
    Solution    weights (B, K); uniform where all tracks are equal
    """
    if mean.shape[1] > 2:
        return minimise_on_simplex(_gradient_hessian(mean, cov), len(mean), mean.shape[1])
    if 0 < len(mean) <= FEW:
        return Solution.concatenate([_single_weights(m, c) for m, c in zip(mean, cov, strict=True)])
    found = minimise_on_interval(_pair_derivatives(mean, cov), len(mean))
    return Solution(np.stack([found.weights, 1.0 - found.weights], -1), found.converged, found.iterations)


def _pair_derivatives(mean: Array, cov: Array) -> Derivatives:
    """Derivatives over the weight of track 1 of mean log det P_i - log det P_AA, both covariances diagonal.

    In these axes P_AA = D + w (1 - w) e e', D = w P1 + (1 - w) P2, whose determinant is det D times
    1 + w (1 - w) q with q = e' D^-1 e.
    """
    pair = Pair.of(cov[:, 0], cov[:, 1])
    second, change = pair.second, -pair.contrast
    square = pair.coordinates(mean[:, 0] - mean[:, 1]) ** 2
    entropy = np.where(change == 0.0, 0.0, np.log(pair.first) - np.log(second)).sum(0)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        whole = len(rows) == second.shape[1]
        p2, c, e2 = (second, change, square) if whole else (second[:, rows], change[:, rows], square[:, rows])
        d = p2 + w * c
        rate, share = c / d, e2 / d
        fall = share * rate
        slope, curvature = _join(w, rate.sum(0), (rate * rate).sum(0), share.sum(0), fall.sum(0), (fall * rate).sum(0))
        return (entropy if whole else entropy[rows]) + slope, curvature

    return derivatives


def _single_weights(mean: Array, cov: Array) -> Solution:
    """Find the weights of one pair, mean (2, n), as a batch of one; in plain numbers where no axis is very sharp."""
    pair = SinglePair.of(cov[0], cov[1])
    if pair is None:
        found = minimise_on_interval(_pair_derivatives(mean[None], cov[None]), 1)
        return Solution(np.stack([found.weights, 1.0 - found.weights], -1), found.converged, found.iterations)
    square = ((pair.inverse @ (mean[0] - mean[1])) ** 2).tolist()
    axes = [(q, -c, e) for q, c, e in zip(pair.second, pair.contrast, square, strict=True)]
    entropy = sum(math.log((q + c) / q) for q, c, _ in axes)

    def derivatives(w: float) -> tuple[float, float]:
        a = b = q = r = s = 0.0
        for p2, c, e2 in axes:
            d = p2 + w * c
            rate, share = c / d, e2 / d
            fall = share * rate
            a, b, q, r, s = a + rate, b + rate * rate, q + share, r + fall, s + fall * rate
        slope, curvature = _join(w, a, b, q, r, s)
        return entropy + slope, curvature

    omega, converged, iterations = minimise_one(derivatives)
    return Solution(np.array([[omega, 1.0 - omega]]), np.array([converged]), np.array([iterations]))


def _join(w: T, rate: T, square: T, q: T, fall: T, fall_rate: T) -> tuple[T, T]:
    """Derivatives of -log det D - log(1 + w (1 - w) q) from sums over axes; those of q are -fall and 2 fall_rate."""
    v, dv = w * (1.0 - w), 1.0 - 2.0 * w
    psi = 1.0 + v * q
    rise = (dv * q - v * fall) / psi
    bend = (2.0 * v * fall_rate - 2.0 * q - 2.0 * dv * fall) / psi
    return -rate - rise, square - bend + rise * rise


def _gradient_hessian(mean: Array, cov: Array) -> GradientHessian:
    """Gradient and Hessian over the weights of mean log det P_i - log det P_AA."""
    batch, count, n = mean.shape
    lower = np.linalg.cholesky(cov.sum(1))
    whiten = np.linalg.inv(lower)[:, None]
    white = whiten @ cov @ transpose(whiten)
    points = (whiten @ (mean - mean.mean(1, keepdims=True))[..., None])[..., 0]
    entropy = logdet(white)

    def gradient_hessian(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        x = points[rows]
        centred = x - np.einsum("bk,bki->bi", w, x)[:, None]
        spread = white[rows] + centred[..., :, None] * centred[..., None, :]
        info = np.linalg.inv(np.einsum("bk,bkij->bij", w, spread))[:, None]
        # On the simplex the derivative of P_AA along w_i is P_i + (x_i - x)(x_i - x)', up to a common term.
        step = info @ spread
        gradient = entropy[rows] - np.trace(step, axis1=-2, axis2=-1)
        flat = step.reshape(len(w), count, n * n), transpose(step).reshape(len(w), count, n * n)
        curvature = flat[0] @ transpose(flat[1]) + 2.0 * centred @ info[:, 0] @ transpose(centred)
        return gradient, curvature

    return gradient_hessian


RULE = Rule(
    key="arithmetic_average",
    title="Arithmetic average",
    fuse=fuse,
    params=ArithmeticAverageParams,
    family="gaussian",
    arity="n_ary",
    guarantee="conservative",
    caveat="merged, at weights that do not depend on the means (uniform, given), if every track is",
    source="Li 2022 (6), (10)-(11), (40)",
    cost="K n^3, about ten times that for diversity with K > 2",
)
