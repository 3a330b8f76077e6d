"""Quotients of Gaussian mixtures: what fusion with common information, known or estimated, leads to.

Both exact and weighted-exponential-product fusion of mixtures p_i, p_j give f(x) proportional to
sum over z = (v, r) of w_z N(x; m_z, P_z) / u(x), a mixture of non-Gaussian mixands: Ahmed (26)-(33).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_of
from track_fusion.densities.mixture.algebra import LogMixture, gaussian_quotient, power, product
from track_fusion.densities.mixture.mixture import LOG_2PI, Factored, Mixture, component_index, take_components
from track_fusion.linalg import Array, cholesky, eliminate, matvec, solve, symmetrise, transpose, whitener


@dataclasses.dataclass(frozen=True)
class Quotient:
    """A mixture over a product of powers of mixtures: sum_z w_z N(x; m_z, P_z) / prod_k p_k(x)^e_k.

    Attributes
    ----------
    numerator : LogMixture                        (..., M) mixands z
    denominators : ((Factored, exponent), ...)    mixtures (..., C_k) and their exponents (...)
    """

    numerator: LogMixture
    denominators: tuple[tuple[Factored, Array], ...]

    def log_denominator(self, points: Array) -> Array:
        """Logarithm of u at points (..., S, n): (..., S)."""
        return np.asarray(sum(e[..., None] * p.log_pdf(points) for p, e in self.denominators))

    def denominator_derivatives(self, points: Array) -> tuple[Array, Array, Array]:
        """Logarithm of u (..., S), its gradient (..., S, n) and Hessian (..., S, n, n)."""
        terms = [
            (e[..., None] * v, e[..., None, None] * g, e[..., None, None, None] * h)
            for (v, g, h), e in ((p.derivatives(points), e) for p, e in self.denominators)
        ]
        value, gradient, hessian = (sum(t[1:], t[0]) for t in zip(*terms, strict=True))
        return value, gradient, hessian

    def take(self, index: NDArray[np.intp]) -> Quotient:
        """Pick mixands (..., P) by index."""
        return dataclasses.replace(self, numerator=LogMixture(*(take_components(a, index) for a in self.numerator)))


def exact_quotient(first: Mixture, second: Mixture, common: Mixture) -> Quotient:
    """The exact fusion p_i p_j / p_c of mixtures whose common information is p_c: Ahmed (6), (22)."""
    exponent = np.ones(np.broadcast_shapes(common.weight.shape[:-1], first.weight.shape[:-1]))
    return Quotient(product(LogMixture.of(first), LogMixture.of(second)), ((Factored.of(common), exponent),))


def wep_quotient(first: Mixture, second: Mixture, omega: Array) -> Quotient:
    """The weighted exponential product p_i^omega p_j^(1 - omega) as a quotient: Ahmed (24)-(25)."""
    below = ((Factored.of(first), 1.0 - omega), (Factored.of(second), omega))
    return Quotient(product(LogMixture.of(first), LogMixture.of(second)), below)


class Bound(NamedTuple):
    """An upper bound on each mixand's integral: log_weight (..., M) includes the mixand's own weight.

    `sure` (..., M) tells where one component of the denominator alone makes the mixand integrable; there the
    mixand lies below a Gaussian of `mean` (..., M, n) and covariance `cov` (..., M, n, n).
    """

    log_weight: Array
    mean: Array
    cov: Array
    sure: NDArray[np.bool_]


def exact_bound(quotient: Quotient, common: Mixture) -> Bound:
    """Bound mixands by dividing by single components of the common information: Ahmed (55)-(56), corrected.

    The constant of each quotient of Gaussians, which the paper lacks, is part of it. Of all components
    that give an integrable quotient the one of least bound is taken; where none does, the bound is infinite.
    """
    numerator, n = quotient.numerator, common.mean.shape[-1]
    lower = cholesky(numerator.cov)
    white = whitener(common.cov)
    image = white[..., None, :, :, :] @ lower[..., :, None, :, :]  # (..., M, T, n, n): W_t L_z
    gap = matvec(white[..., None, :, :, :], numerator.mean[..., :, None, :] - common.mean[..., None, :, :])
    info = transpose(image) @ image
    rest = np.eye(n) - info
    pull = matvec(transpose(image), gap)
    positive, logdet, square = eliminate(rest, pull)
    half_logdet = -np.log(np.diagonal(white, axis1=-2, axis2=-1)).sum(-1)
    log_scale = 0.5 * n * LOG_2PI + half_logdet - log_of(common.weight)
    kappa = log_scale[..., None, :] + 0.5 * ((gap * gap).sum(-1) + square - logdet)
    kappa = np.where(positive, kappa, np.inf)  # also where a component of the denominator has no weight
    least = kappa.argmin(-1)[..., None]
    sure = np.isfinite(np.take_along_axis(kappa, least, -1)[..., 0])
    tightest = np.take_along_axis(rest, least[..., None, None], -3)[..., 0, :, :]
    safe = np.where(sure[..., None, None], tightest, np.eye(n))
    cov = symmetrise(lower @ np.linalg.solve(safe, transpose(lower)))
    force = np.take_along_axis(pull, least[..., None], -2)[..., 0, :]
    mean = numerator.mean + sure[..., None] * matvec(lower, solve(safe, force[..., None])[..., 0])
    bound = np.where(np.isfinite(numerator.log_weight), np.take_along_axis(kappa, least, -1)[..., 0], 0.0)
    return Bound(numerator.log_weight + bound, mean, cov, sure)


def wep_bound(first: Mixture, second: Mixture, omega: Array) -> Array:
    """Upper bound on the weight of each mixand of a weighted exponential product, as logarithm (..., M).

    The denominator is no less than the powers of the mixand's own two components, so the mixand is no more than
    (w_v N_v)^omega (w_r N_r)^(1 - omega): the component of the approximation (49)-(51) of Li 2019.
    """
    return product(power(LogMixture.of(first), omega), power(LogMixture.of(second), 1.0 - omega)).log_weight


# The moment-matched denominator, and Laplace's approximation.


def moment_matched(quotient: Quotient, mean: Array, cov: Array) -> tuple[LogMixture, NDArray[np.bool_]]:
    """Divide the numerator by one Gaussian N(mean, cov), (..., n), in place of u: MMGD, Ahmed (13).

    Returns
    -------
    LogMixture         (..., M)
    proper (..., M)    False where the quotient has no integral
    """
    numerator = quotient.numerator
    parts = gaussian_quotient(numerator.mean, numerator.cov, mean[..., None, :], cov[..., None, :, :])
    return LogMixture(numerator.log_weight + parts.log_scale, parts.mean, parts.cov), parts.proper


class Laplace(NamedTuple):
    """Gaussians at the modes of the mixands: log_moment (..., M) is that of each mixand's integral, weight included."""

    log_moment: Array
    mean: Array
    cov: Array
    converged: NDArray[np.bool_]


MAX_NEWTON = 60
#: Newton's method ends when half its decrement, the fall still to be expected in nats, is below this.
DECREMENT = 1e-8
#: Curvatures below this share of the numerator's are not trusted.
FLOOR = 1e-3
#: Relative error of the cost, which must not forbid a last short step.
ROUNDING = 1e-14
#: The longest step, in standard deviations of the numerator.
LONGEST = 4.0


def laplace(quotient: Quotient) -> Laplace:
    """Approximate each mixand by a Gaussian at its mode: Ahmed (46)-(50), the weight by (49).

    Newton's method from the numerator's mean, in its axes; of an indefinite Hessian the absolute
    eigenvalues are taken; a step that does not lower the cost is halved. Where it does not converge, or the
    curvature at the mode is not positive, the numerator's covariance takes its place.
    """
    weight, centre, cov = quotient.numerator
    lower = cholesky(cov)
    y, value, hessian, done = _climb(
        quotient, centre, lower, np.zeros(centre.shape), np.ones(centre.shape[:-1]), MAX_NEWTON
    )
    curvature, axes = np.linalg.eigh(hessian)
    peaked = done & (curvature[..., 0] > FLOOR)
    curvature = np.where(peaked[..., None], curvature, 1.0)
    root = lower @ axes / np.sqrt(curvature)[..., None, :]
    log_moment = weight - value - 0.5 * np.log(curvature).sum(-1)
    return Laplace(log_moment, centre + matvec(lower, y), symmetrise(root @ transpose(root)), done)


def _climb(
    quotient: Quotient, centre: Array, lower: Array, y: Array, damping: Array, steps: int
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Climb to the modes from y (..., M, n); return them, the cost and its Hessian there, and which converged.

    Each mixand takes its own steps and stops when it is done. Once half are, the others go on by themselves.
    """
    value, gradient, hessian = _cost(quotient, centre, lower, y)
    done = np.zeros(damping.shape, bool)
    for taken in range(steps):
        step, fall = _newton_step(gradient, hessian)
        done = fall < DECREMENT
        left = int((~done).sum(-1).max(initial=0))
        if left == 0:
            break
        if left <= centre.shape[-2] // 2:
            at = np.argsort(done, axis=-1, kind="stable")[..., :left]
            c, root, x, size = (take_components(a, at) for a in (centre, lower, y, damping))
            rest = _climb(quotient, c, root, x, size, steps - taken)
            whole: tuple[NDArray[Any], ...] = (y, value, hessian, done)
            for array, part in zip(whole, rest, strict=True):
                np.put_along_axis(array, component_index(array, at), part, at.ndim - 1)
            break
        trial = y + np.where(done, 0.0, damping)[..., None] * step
        new_value, new_gradient, new_hessian = _cost(quotient, centre, lower, trial)
        better = ~done & (new_value <= value - 1e-4 * damping * fall + ROUNDING * np.abs(value))
        y, value = np.where(better[..., None], trial, y), np.where(better, new_value, value)
        gradient = np.where(better[..., None], new_gradient, gradient)
        hessian = np.where(better[..., None, None], new_hessian, hessian)
        damping = np.where(better, np.minimum(2.0 * damping, 1.0), 0.5 * damping)
    return y, value, hessian, done


def _cost(quotient: Quotient, centre: Array, lower: Array, y: Array) -> tuple[Array, Array, Array]:
    """Half |y|^2 plus log u at x = centre + L y, (..., M), with gradient and Hessian over y."""
    value, gradient, hessian = quotient.denominator_derivatives(centre + matvec(lower, y))
    upper = transpose(lower)
    curvature = np.eye(y.shape[-1]) + upper @ hessian @ lower
    return value + 0.5 * (y * y).sum(-1), y + matvec(upper, gradient), symmetrise(curvature)


def _newton_step(gradient: Array, hessian: Array) -> tuple[Array, Array]:
    """Step of descent (..., n) and the fall it expects to first order, (...), regularised."""
    curvature, axes = np.linalg.eigh(hessian)
    slope = matvec(transpose(axes), gradient)
    step = -slope / np.maximum(np.abs(curvature), 0.1)
    length = np.sqrt((step * step).sum(-1, keepdims=True))
    step *= np.minimum(1.0, LONGEST / np.maximum(length, LONGEST))
    return matvec(axes, step), np.asarray(-(slope * step).sum(-1))
