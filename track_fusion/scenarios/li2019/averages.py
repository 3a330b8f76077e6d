"""Averages of random variables: moments, mean square errors, best weights of two and bounds (v-fusion).

An average here is of estimates, numbers such as a count of targets, not of densities; those are in rules/. Li et al.,
Second Order Statistics Analysis and Comparison between Arithmetic and Geometric Average Fusion, 2019, section 3.
"""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array, matvec, outer

#: Stands for the logarithm of zero: times a weight of zero it is zero, times any other it has the exponential zero.
LOG_OF_NOTHING = -1e300


def arithmetic_average(values: Array, weights: Array) -> Array:
    """Weighted arithmetic average (6): (..., K), (..., K) -> (...).

    Raises
    ------
    ValueError    the weights are negative or do not sum to 1
    """
    _check_weights(weights)
    return np.asarray(np.einsum("...k,...k->...", weights, values))


def geometric_average(values: Array, weights: Array) -> Array:
    """Weighted geometric average (7)-(8): (..., K), (..., K) -> (...); zero if a value of positive weight is.

    Raises
    ------
    ValueError    a value is negative, or the weights are negative or do not sum to 1
    """
    _check_weights(weights)
    if (values < 0).any():
        raise ValueError(f"The geometric average takes values that are not negative. Got {values.min()}.")
    with np.errstate(divide="ignore"):
        logs = np.where(values == 0, LOG_OF_NOTHING, np.log(values))
    return np.asarray(np.exp(np.einsum("...k,...k->...", weights, logs)))


# Moments of the averages.


def arithmetic_moments(mean: Array, cov: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (12) and variance (13), (15) of an arithmetic average.

    With the moments of the logarithms in place of those of the variables, the moments (23) of the logarithm of the
    geometric average.

    Parameters
    ----------
    mean : (..., K)
    cov : (..., K, K)    covariances between the variables
    weights : (..., K)

    Returns
    -------
    mean (...), variance (...)
    """
    _check_weights(weights)
    return np.asarray((weights * mean).sum(-1)), np.asarray((weights * matvec(cov, weights)).sum(-1))


def lognormal_moments(log_mean: Array, log_variance: Array) -> tuple[Array, Array]:
    """Mean and variance of a variable whose logarithm is normal, each (...).

    The geometric average of jointly lognormal variables is one, its logarithm having the moments (23).
    """
    mean = np.exp(log_mean + 0.5 * log_variance)
    return mean, np.asarray(mean**2 * np.expm1(log_variance))


def average_moments(values: Array, probability: Array, weights: Array, geometric: bool) -> tuple[Array, Array]:
    """Mean and variance of an average over given outcomes: samples, or the nodes of a quadrature.

    Parameters
    ----------
    values : (N, K)         outcomes
    probability : (N,)      their probabilities, sum 1
    weights : (..., K)
    geometric : bool        the geometric average, else the arithmetic one

    Returns
    -------
    mean (...), variance (...)
    """
    average = (geometric_average if geometric else arithmetic_average)(values, weights[..., None, :])
    mean = average @ probability
    return mean, np.asarray((average - mean[..., None]) ** 2 @ probability)


# Mean square errors.


def error_moments(mean: Array, cov: Array, truth: Array | float) -> Array:
    """Second moments of errors, E[(theta_i - theta)(theta_j - theta)], (..., K), (..., K, K) -> (..., K, K).

    Their diagonal holds the mean square errors (4). `arithmetic_moments` with these in place of the covariances gives
    the mean square error (24) of the average, and so do all functions below that take variances: beta is then the
    correlation and gamma the ratio.
    """
    return cov + outer(mean - np.asarray(truth)[..., None])


# Two variables: weights and bounds. `correlation` is rho of (14), the ratio alpha of (17) is second / first.


def relative_variance(weight: Array, ratio: Array, correlation: Array) -> Array:
    """Variance h (18) of the arithmetic average over that of the first variable; weight is that of the second."""
    return np.asarray(
        (1.0 - weight) ** 2 + weight**2 * ratio + 2.0 * weight * (1.0 - weight) * correlation * np.sqrt(ratio)
    )


def best_pair_weights(ratio: Array, correlation: Array) -> Array:
    """Weights (19), (55) that minimise the variance of an average of two variables, (...) -> (..., 2).

    Parameters
    ----------
    ratio : (...)          variance of the second over that of the first, positive
    correlation : (...)    from -1 to 1

    Returns
    -------
    (..., 2)    all weight on the better variable where (22) fails; halves where every weight does

    Notes         (19) holds for correlations below both sqrt(ratio) and 1 / sqrt(ratio), not only for ratios
                  above one.
    """
    cross = correlation * np.sqrt(ratio)
    total = 1.0 + ratio - 2.0 * cross
    with np.errstate(divide="ignore", invalid="ignore"):
        second = np.where(total > 0, (1.0 - cross) / total, 0.5)
    second = np.clip(second, 0.0, 1.0)
    return np.stack([1.0 - second, second], -1)


def variance_bounds(first: Array, second: Array, correlation: Array) -> tuple[Array, Array]:
    """Least (20)-(21) and greatest (16) variance of an average of two variables over all weights, each (...)."""
    ratio = second / first
    weights = best_pair_weights(ratio, correlation)
    return first * relative_variance(weights[..., 1], ratio, correlation), np.maximum(first, second)


# Averages of densities on a grid (f-fusion), section 2.3.


def density_average(densities: Array, width: Array, weights: Array, geometric: bool) -> Array:
    """Average (9) or (10) of K densities on a grid, normalised.

    Parameters
    ----------
    densities : (K, N)    values at the nodes, not negative
    width : (N,)          weights of the quadrature at the nodes
    weights : (K,)

    Returns
    -------
    (N,)

    Raises
    ------
    ValueError    the supports have nothing in common
    """
    average = (geometric_average if geometric else arithmetic_average)(densities.T, weights)
    mass = average @ width
    if not mass > 0:
        raise ValueError("The geometric average of densities needs a common support. Got none.")
    return np.asarray(average / mass)


def density_moments(nodes: Array, density: Array, width: Array) -> tuple[Array, Array]:
    """Mean and variance of a density on a grid."""
    mean = (nodes * density) @ width
    return np.asarray(mean), np.asarray(((nodes - mean) ** 2 * density) @ width)


def _check_weights(weights: Array) -> None:
    if (weights < 0).any() or (np.abs(weights.sum(-1) - 1.0) > 1e-9).any():
        raise ValueError("The 'weights' of an average must be non-negative and sum to 1.")
