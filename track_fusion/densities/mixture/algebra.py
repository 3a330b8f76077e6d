"""Products, powers and quotients of Gaussians and of Gaussian mixtures, in the log domain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_of, normalised
from track_fusion.densities.mixture.mixture import LOG_2PI, Factored, Mixture
from track_fusion.linalg import (
    Array,
    cholesky,
    inverse,
    is_positive_definite,
    matvec,
    outer,
    symmetrise,
    transpose,
    whitener,
)


def log_normal(residual: Array, cov: Array) -> Array:
    """Log-density of N(0, cov) at the residuals, shapes (..., n), (..., n, n), broadcast: (...)."""
    lower = cholesky(cov)
    z = np.linalg.solve(lower, np.broadcast_to(residual, cov.shape[:-1])[..., None])[..., 0]
    half_logdet = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return np.asarray(-0.5 * ((z * z).sum(-1) + residual.shape[-1] * LOG_2PI) - half_logdet)


class LogMixture(NamedTuple):
    """A mixture with the logarithms of its weights (..., C), which may not be normalised or be tiny."""

    log_weight: Array
    mean: Array
    cov: Array

    @property
    def normalised(self) -> Mixture:
        """The mixture with weights of sum one."""
        return Mixture(normalised(self.log_weight), self.mean, self.cov)

    @property
    def factored(self) -> Factored:
        """The mixture to be evaluated at many points, its weights as they are."""
        return Factored(self.log_weight, self.mean, whitener(self.cov))

    @classmethod
    def of(cls, mixture: Mixture) -> LogMixture:
        """Take the logarithms of a mixture's weights."""
        return cls(log_of(mixture.weight), mixture.mean, mixture.cov)


def product(first: LogMixture, second: LogMixture) -> LogMixture:
    """Product of two mixtures, all pairs of components: Li 2019 (51), Ahmed (28)-(33).

    Parameters
    ----------
    first, second : LogMixture    of (..., C1) and (..., C2) components

    Returns
    -------
    LogMixture    of (..., C1 C2) components, the second's running fastest; its weights sum to the integral
                  of the product

    Notes         In information form, each axis scaled by its standard deviation. O(C1 C2 n^3).
    """
    lead = np.broadcast_shapes(first.mean.shape[:-2], second.mean.shape[:-2])
    n, count = first.mean.shape[-1], first.mean.shape[-2] * second.mean.shape[-2]
    scale = np.sqrt(np.diagonal(first.cov, axis1=-2, axis2=-1).mean(-2) + _variances(second.cov).mean(-2))
    origin = first.mean.mean(-2)
    info1, pull1 = _information(first, origin, scale)
    info2, pull2 = _information(second, origin, scale)
    cov = inverse(info1[..., :, None, :, :] + info2[..., None, :, :, :])
    mean = origin[..., None, None, :] + scale[..., None, None, :] * matvec(
        cov, pull1[..., :, None, :] + pull2[..., None, :, :]
    )
    gap = first.mean[..., :, None, :] - second.mean[..., None, :, :]
    overlap = log_normal(gap, first.cov[..., :, None, :, :] + second.cov[..., None, :, :, :])
    log_weight = first.log_weight[..., :, None] + second.log_weight[..., None, :] + overlap
    cov = cov * outer(scale)[..., None, None, :, :]
    return LogMixture(log_weight.reshape(*lead, count), mean.reshape(*lead, count, n), cov.reshape(*lead, count, n, n))


def _variances(cov: Array) -> Array:
    return np.asarray(np.diagonal(cov, axis1=-2, axis2=-1))


def _information(mixture: LogMixture, origin: Array, scale: Array) -> tuple[Array, Array]:
    """Return P^-1 (..., C, n, n) and P^-1 m (..., C, n) about the origin, in units of `scale` (..., n)."""
    info = inverse(mixture.cov / outer(scale)[..., None, :, :])
    return info, matvec(info, (mixture.mean - origin[..., None, :]) / scale[..., None, :])


def power(mixture: LogMixture, omega: Array | float) -> LogMixture:
    """Approximate a power of a mixture by the powers of its components, Li 2019 (49)-(50).

    Exact for one component; for several it neglects the cross-products, as if they were far apart.

    Parameters
    ----------
    mixture : LogMixture    (..., C)
    omega : (...) > 0       exponent
    """
    omega = np.asarray(omega)[..., None]
    n = mixture.mean.shape[-1]
    half_logdet = np.log(np.diagonal(cholesky(mixture.cov), axis1=-2, axis2=-1)).sum(-1)
    log_scale = (1.0 - omega) * (0.5 * n * LOG_2PI + half_logdet) - 0.5 * n * np.log(omega)
    return LogMixture(omega * mixture.log_weight + log_scale, mixture.mean, mixture.cov / omega[..., None, None])


class GaussianQuotient(NamedTuple):
    """N(x; a, A) / N(x; b, B) = exp(log_scale) N(x; mean, cov); what is not a Gaussian has `proper` False."""

    log_scale: Array
    mean: Array
    cov: Array
    proper: NDArray[np.bool_]


#: A quotient of Gaussians is proper when it is wider than its numerator by less than this factor.
WIDEST = 1e9


def gaussian_quotient(mean: Array, cov: Array, other_mean: Array, other_cov: Array) -> GaussianQuotient:
    """Divide Gaussians, shapes (..., n) and (..., n, n), broadcast; Ahmed (55) with its constant.

    Returns
    -------
    GaussianQuotient    arrays (...), (..., n), (..., n, n); the numerator itself where `proper` is False

    Notes               cov^-1 = A^-1 - B^-1 in axes in which A is the unit matrix. The constant, which the
                        paper omits, is 1 / N(mean; b, cov + B).
    """
    lower = cholesky(cov)
    other_white = whitener(other_cov) @ lower  # W A^1/2, W B W' = 1
    gap = matvec(whitener(cov), other_mean - mean)
    info = transpose(other_white) @ other_white
    rest = np.eye(mean.shape[-1]) - info
    proper = is_positive_definite(rest - np.eye(mean.shape[-1]) / WIDEST)
    wide = inverse(np.where(proper[..., None, None], rest, np.eye(mean.shape[-1])))
    # (1 - G)^-1 (0 - G gap), G = info: the pull away from the denominator's mean.
    new_mean = mean + matvec(lower, -matvec(wide, matvec(info, gap)))
    new_cov = symmetrise(lower @ wide @ transpose(lower))
    log_scale = -log_normal(new_mean - other_mean, new_cov + other_cov)
    return GaussianQuotient(
        np.where(proper, log_scale, 0.0),
        np.where(proper[..., None], new_mean, mean),
        np.where(proper[..., None, None], new_cov, cov),
        proper,
    )


def average(parts: Mixture, weights: Array) -> Mixture:
    """Arithmetic average of K mixtures: the union of their components, Li 2019 (9).

    Parameters
    ----------
    parts : Mixture    weight (..., K, C) and so on; weights are taken as they are
    weights : (..., K)

    Returns
    -------
    Mixture    (..., K C)
    """
    *lead, sources, count = parts.weight.shape
    n = parts.mean.shape[-1]
    return Mixture(
        (weights[..., None] * parts.weight).reshape(*lead, sources * count),
        parts.mean.reshape(*lead, sources * count, n),
        parts.cov.reshape(*lead, sources * count, n, n),
    )


def first_order(first: Mixture, second: Mixture, omega: Array) -> Mixture:
    """First-order covariance intersection (FOCI) of two mixtures: Ahmed (14)-(17), (16) without the inverse.

    Parameters
    ----------
    first, second : Mixture    (..., C1), (..., C2)
    omega : (...)              exponent of the first, inside (0, 1)

    Returns
    -------
    Mixture    (..., C1 C2), each pair's covariance intersection, weighted without regard to their overlap
    """
    parts = product(power(LogMixture.of(first), omega), power(LogMixture.of(second), 1.0 - omega))
    share = omega[..., None, None]
    weight = share * log_of(first.weight)[..., :, None] + (1.0 - share) * log_of(second.weight)[..., None, :]
    return Mixture(normalised(weight.reshape(*weight.shape[:-2], first.count * second.count)), parts.mean, parts.cov)
