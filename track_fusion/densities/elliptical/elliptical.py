"""Elliptical families: Student-t, generalised Gaussian, Gaussian.

A density of a family in m axes is |S|^-1/2 h((x - x0)' S^-1 (x - x0)) with the scatter S; its covariance is
kappa S. Chen and Zhou 2022, section 2.2.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from scipy.special import gammaln

from track_fusion.linalg import Array, logdet, mahalanobis_squared


@dataclasses.dataclass(frozen=True)
class Family:
    """An elliptical family in m axes with the constants of its Fisher metric (11), for a batch of families.

    Attributes
    ----------
    axes : int               m
    a, b : (...)             a_h and b_h of (9); both 1/4 for a Gaussian
    kappa : (...)            covariance over scatter
    log_generator : callable u (...) -> log h(u), u broadcast against the batch
    """

    axes: int
    a: Array
    b: Array
    kappa: Array
    log_generator: Callable[[Array], Array]

    @property
    def radius_squared(self) -> Array:
        """2 a_h / c, (...): the squared length of d log(scale) of a scatter, and the radius in (26), (32)."""
        m = self.axes
        return np.asarray(0.25 * m * (4.0 * (m + 2) * self.b - m))

    @property
    def pull(self) -> Array:
        """Curvature c of Lemma 1, (...): weighs a squared Mahalanobis distance taken by the scatter."""
        return np.asarray(2.0 * self.a / self.radius_squared)

    @property
    def geodesic_radius_squared(self) -> Array:
        """g, (...): like `radius_squared`, for the direction of the shortest path to another mean.

        The path changes the scatter along the residual by a factor and, unless b = 1/4, across it by another.
        """
        m, trace = self.axes, self.b - 0.25
        return np.asarray(2.0 * self.b * (2.0 * self.b + trace * m) / (2.0 * self.b + trace * (m - 1)))

    @property
    def geodesic_pull(self) -> Array:
        """2 a_h / g, (...): what c becomes for the geodesic projection; c_h of Theorem 1 in one axis."""
        return np.asarray(2.0 * self.a / self.geodesic_radius_squared)

    def log_pdf(self, x: Array, mean: Array, scatter: Array) -> Array:
        """Log-density (6) at x, shapes (..., m), (..., m), (..., m, m) -> (...)."""
        return self.log_generator(mahalanobis_squared(x - mean, scatter)) - 0.5 * logdet(scatter)


def student_t(dof: Array | float, axes: int) -> Family:
    """Student-t family (8); infinite `dof` is the Gaussian.

    Parameters
    ----------
    dof : (...)    degrees of freedom, > 2, or inf
    axes : int

    Raises
    ------
    ValueError    dof is not above 2: there is no covariance
    """
    nu, m = np.asarray(dof, float), axes
    if not (nu > 2).all():
        raise ValueError(f"The 'dof' of a Student-t family must exceed 2. Got {nu.min()}.")
    information = 0.25 / (1.0 + 2.0 / (nu + m))
    finite = np.isfinite(nu)
    n = np.where(finite, nu, 1.0)
    constant = np.where(finite, gammaln(0.5 * (n + m)) - gammaln(0.5 * n) - 0.5 * m * np.log(0.5 * n), 0.0)
    constant = constant - 0.5 * m * math.log(2.0 * math.pi)

    def log_generator(u: Array) -> Array:
        return np.asarray(constant + np.where(finite, -0.5 * (n + m) * np.log1p(u / n), -0.5 * u))

    return Family(m, information, information, 1.0 / (1.0 - 2.0 / nu), log_generator)


def gaussian(axes: int) -> Family:
    """Return the Gaussian family: a_h = b_h = 1/4, kappa = 1."""
    return student_t(np.inf, axes)


def generalized_gaussian(beta: Array | float, axes: int) -> Family:
    """Generalised Gaussian family (7) of shape `beta`: 1 is the Gaussian, smaller has heavier tails.

    Parameters
    ----------
    beta : (...)    above 0, and above (2 - m) / 4, without which a_h is infinite
    axes : int

    Raises
    ------
    ValueError    beta is too small
    """
    shape, m = np.asarray(beta, float), axes
    least = max(0.0, (2 - m) / 4)
    if not (shape > least).all():
        raise ValueError(f"The 'beta' of a generalised Gaussian in {m} axes must exceed {least:g}. Got {shape.min()}.")
    half = m / (2.0 * shape)
    log_mass = gammaln(half)
    a = shape**2 / m * np.exp(gammaln(2.0 + half - 1.0 / shape) - log_mass - math.log(2.0) / shape)
    kappa = np.exp(gammaln(half + 1.0 / shape) - log_mass + math.log(2.0) / shape) / m
    constant = np.log(shape) + gammaln(0.5 * m) - 0.5 * m * math.log(math.pi) - log_mass - half * math.log(2.0)

    def log_generator(u: Array) -> Array:
        return np.asarray(constant - 0.5 * u**shape)

    return Family(m, a, (m + 2.0 * shape) / (4.0 * m + 8.0), kappa, log_generator)
