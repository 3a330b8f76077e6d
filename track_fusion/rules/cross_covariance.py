"""Fusion with known cross-covariances: the best linear unbiased combination of correlated tracks."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.linalg import Array, is_positive_definite, matvec, symmetrise, transpose
from track_fusion.params import Params, param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks

#: An eigenvalue of the joint correlation may be so far below zero by rounding.
ROUNDING = 1e-9
#: Differences of tracks whose variance, relative to the tracks' sum, is below this are known to be zero.
CERTAIN = 1e-12


@dataclasses.dataclass(frozen=True)
class CrossCovarianceParams(Params):
    """Where the cross-covariances come from."""

    method: str = param(
        "correlation",
        "correlation: assume the coefficient 'correlation' between any two tracks; given: take the cross-covariances "
        "that come with the tracks (Bar-Shalom's recursion has them from the local Kalman gains)",
        choices=("correlation", "given"),
    )
    correlation: float = param(
        0.4, "correlation coefficient of the errors of any two tracks, for method correlation", low=0.0, high=0.99
    )


def fuse(tracks: SourceTracks, params: CrossCovarianceParams) -> FusedTracks:
    """Fuse K correlated tracks by least squares with their joint covariance; for two, Bar-Shalom and Campo.

    The combination of least covariance among all that are linear and unbiased, if the cross-covariances are right.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); for method given the extras cross_cov
                             (..., K, K, n, n), of which only the blocks i < j are read: cov(x_i, x_j)
    params : CrossCovarianceParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n)

    Raises
    ------
    ValueError     cross_cov has a wrong shape, is not finite, or is larger than the covariances admit
    LinAlgError    a covariance is singular

    Notes          The correlation coefficient stands for P_ij = rho R_i R_j', R_i the symmetric square root of
                   P_i in coordinates in which the sum of all P is one: admissible for any number of tracks and
                   independent of units; for two tracks it is rho times their geometric mean. Where two tracks are
                   surely equal the joint covariance is singular and either is taken. An assumed coefficient promises
                   nothing where it is another: two tracks of variance 1 with the coefficient .9 claim .7 at the
                   default of .4, for an error of variance .95. O(K^3 n^3).
    References     Y. Bar-Shalom and L. Campo, The effect of the common process noise on the two-sensor fused-track
                   covariance, 1986; N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking:
                   Performance and Comparison, section 1.
    """
    (mean, cov), (count, n) = tracks.flat, tracks.mean.shape[-2:]
    if count == 1:
        return tracks.fused(mean[:, 0].copy(), cov[:, 0].copy())
    lower = np.linalg.cholesky(cov.sum(1))
    whiten = np.linalg.inv(lower)[:, None]
    own = symmetrise(whiten @ cov @ transpose(whiten))
    if params.method == "given":
        cross = whiten[:, None] @ _cross_cov(tracks).reshape(-1, count, count, n, n) @ transpose(whiten)[:, None]
    else:
        values, vectors = np.linalg.eigh(own)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ transpose(vectors)
        cross = params.correlation * (root[:, :, None] @ root[:, None])
    joint = _joint(own, cross)
    gain = _gain(joint, count, n)
    fused = gain @ joint @ transpose(gain)
    weight = gain.reshape(-1, n, count, n).swapaxes(1, 2)
    shift = matvec(weight, matvec(whiten, mean - mean[:, :1])).sum(1)
    fused_mean = mean[:, 0] + matvec(lower, shift)
    fused_cov = symmetrise(lower @ fused @ transpose(lower))
    return tracks.fused(fused_mean, fused_cov)


def _cross_cov(tracks: SourceTracks) -> Array:
    cross = np.asarray(tracks.extras["cross_cov"], float)
    wanted = (*tracks.mean.shape[:-1], *tracks.mean.shape[-2:-1], *tracks.cov.shape[-2:])
    if cross.shape != wanted:
        raise ValueError(f"The 'cross_cov' of source tracks must have shape {wanted}. Got {cross.shape}.")
    if not np.isfinite(cross).all():
        raise ValueError("The 'cross_cov' of source tracks must be finite.")
    return cross


def _joint(own: Array, cross: Array) -> Array:
    """Joint covariance (B, K n, K n) of blocks on the diagonal (B, K, n, n) and above it (B, K, K, n, n)."""
    batch, count, n, _ = own.shape
    joint = np.empty((batch, count, count, n, n))
    for i in range(count):
        joint[:, i, i] = own[:, i]
        for j in range(i + 1, count):
            joint[:, i, j], joint[:, j, i] = cross[:, i, j], transpose(cross[:, i, j])
    whole = joint.swapaxes(2, 3).reshape(batch, count * n, count * n)
    if not is_positive_definite(whole + ROUNDING * np.eye(count * n)).all():
        lowest = np.linalg.eigvalsh(whole).min()
        raise ValueError(
            "The 'cross_cov' of source tracks must not be larger than their covariances admit. "
            f"Relative to the tracks' sum, the lowest eigenvalue of the joint covariance is {lowest:.3g}."
        )
    return whole


def _gain(joint: Array, count: int, n: int) -> Array:
    """Gain (B, n, K n) on the stacked tracks: track 1 less its regression on the differences from it."""
    contrast = np.zeros(((count - 1) * n, count * n))
    contrast[:, :n] = -np.tile(np.eye(n), (count - 1, 1))
    contrast[:, n:] = np.eye((count - 1) * n)
    spread = contrast @ joint  # (B, (K-1) n, K n)
    values, vectors = np.linalg.eigh(symmetrise(spread @ contrast.T))
    weight = np.where(values > CERTAIN, 1.0 / np.maximum(values, CERTAIN), 0.0)
    regress = (transpose(spread[..., :n]) @ vectors * weight[:, None, :]) @ transpose(vectors)
    return np.asarray(np.eye(n, count * n) - regress @ contrast)


RULE = Rule(
    key="cross_covariance",
    title="Fusion with known cross-covariance",
    fuse=fuse,
    params=CrossCovarianceParams,
    family="gaussian",
    arity="n_ary",
    guarantee=lambda params: "exact" if params.method == "given" else "structural",
    caveat="exact with method given; an assumed correlation coefficient that is too small claims too little",
    source="Sharma 1 (Bar-Shalom and Campo)",
    cost="K^3 n^3",
    needs_when=(("cross_cov", "method", "given"),),
    example=Example(({}, {"method": "given"}), idempotent=False),
)
