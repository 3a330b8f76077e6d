"""Pairs of correlated random variables, normal or Poisson, as Li et al. 2019 average them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtri, pdtr

from track_fusion.linalg import Array

#: Normal variables of Figs. 1, 3 and 4; rates of the Poisson variables of Fig. 2.
MEAN, VARIANCES = np.array([50.0, 60.0]), np.array([100.0, 200.0])
RATES = (10.0, 12.0)


@dataclasses.dataclass(frozen=True)
class Variables:
    """Two correlated variables.

    Attributes
    ----------
    label : str           for charts
    make : callable       standard normals (N, 2) -> the variables (M, 2), none negative
    origin : float        about which second moments are kept
    truths : tuple        values of the parameter for which errors are studied
    """

    label: str
    make: Callable[[Array], Array]
    origin: float
    truths: tuple[int, ...] = ()


def correlated(normals: Array, correlation: float) -> Array:
    """Correlate independent standard normals (N, 2)."""
    second = correlation * normals[:, 0] + np.sqrt(1.0 - correlation**2) * normals[:, 1]
    return np.stack([normals[:, 0], second], -1)


def normal_pair(normals: Array, correlation: float) -> Array:
    """Draw the normal variables of Figs. 1, 3, 4; pairs with a value that is not positive are left out."""
    values = MEAN + np.sqrt(VARIANCES) * correlated(normals, correlation)
    return np.asarray(values[(values > 0).all(-1)])


def poisson_pair(normals: Array, correlation: float) -> Array:
    """Draw the Poisson variables of Fig. 2, coupled by a Gaussian copula."""
    latent = correlated(normals, copula_correlation(RATES, correlation))
    return np.stack([np.searchsorted(steps(rate), z) for rate, z in zip(RATES, latent.T, strict=True)], -1).astype(
        float
    )


def steps(rate: float) -> Array:
    """Standard normal deviates at which a Poisson variable steps up to 1, 2, ..."""
    cumulative = pdtr(np.arange(rate + 20.0 * np.sqrt(rate)), rate)
    return np.asarray(ndtri(cumulative[cumulative < 1.0]))


@functools.lru_cache
def copula_correlation(rates: tuple[float, float], correlation: float, terms: int = 200) -> float:
    """Correlation of normals that gives two Poisson variables a given one.

    Parameters
    ----------
    rates : tuple of float
    correlation : float    from 0 to what comonotone variables of these rates have
    terms : int            of the series

    Notes    A variable that steps up at c_1, c_2, ... has the Hermite coefficients
             a_k = sum of phi(c_n) He_(k-1)(c_n) / sqrt(k!); the covariance is the sum of a_k b_k r^k.
    """
    first, second = (_hermite(steps(rate), terms) for rate in rates)

    def excess(r: float) -> float:
        covariance = (first * second) @ r ** np.arange(1.0, terms + 1.0)
        return float(covariance / np.sqrt(rates[0] * rates[1]) - correlation)

    return float(brentq(excess, 0.0, 1.0))


def _hermite(steps_at: Array, terms: int) -> Array:
    """Hermite coefficients a_1 ... a_terms of a variable that steps up by one at each of the given deviates."""
    density = np.exp(-0.5 * steps_at**2) / np.sqrt(2.0 * np.pi)
    before, now = np.zeros_like(steps_at), np.ones_like(steps_at)  # He_k / sqrt(k!)
    coefficients = np.empty(terms)
    for k in range(1, terms + 1):
        coefficients[k - 1] = (density * now).sum() / np.sqrt(k)
        before, now = now, (steps_at * now - np.sqrt(k - 1.0) * before) / np.sqrt(k)
    return coefficients
