"""Distances between elliptical densities that have closed forms, Chen and Zhou 2022: what tests measure against."""

from __future__ import annotations

import numpy as np

from track_fusion.densities.elliptical.elliptical import Family
from track_fusion.densities.elliptical.rao import acosh1p, manhattan_paths
from track_fusion.linalg import Array, mahalanobis_squared, transpose


def same_mean(family: Family, scatter: Array, other: Array) -> Array:
    """Rao distance (24) of densities of one mean, scatters (..., m, m) -> (...)."""
    mean_log, deviation = _log_ratio(scatter, other)
    return np.asarray(np.sqrt(family.radius_squared * mean_log**2 + 2.0 * family.b * deviation**2))


def same_shape(family: Family, mean: Array, scatter: Array, other_mean: Array, scale: Array) -> Array:
    """Distance (26) from (mean, scatter) to (other_mean, scale * scatter) among the densities of this shape.

    Under the root of (26) stands 2 a_h / c alone.
    """
    z = family.pull * mahalanobis_squared(mean - other_mean, scatter)
    bend = z**2 / (8.0 * scale) + 0.5 * z * (1.0 + 1.0 / scale) + 0.5 * (np.sqrt(scale) - 1.0 / np.sqrt(scale)) ** 2
    return np.asarray(np.sqrt(family.radius_squared) * acosh1p(bend))


def projection(family: Family, mean: Array, scatter: Array, other_mean: Array) -> tuple[Array, Array]:
    """Distance (32) to the densities of another mean and the scatter's own shape, and the scale (34) of the nearest."""
    z = family.pull * mahalanobis_squared(mean - other_mean, scatter)
    return np.sqrt(family.radius_squared) * acosh1p(z), 1.0 + 0.5 * z


def geodesic_projection(family: Family, mean: Array, scatter: Array, other_mean: Array) -> Array:
    """Least Rao distance to any density of another mean.

    Notes         By symmetry the shortest path changes the scatter along the residual and, by one factor, across
                  it; the end being free, the factor across is the one that costs least at every step, which
                  leaves a hyperbolic plane with the constants g of `Family` and a perpendicular dropped to a line.
    References    M. Tang et al., Information Geometric Approach to Multisensor Estimation Fusion, 2019 (Gaussian).
    """
    z = family.geodesic_pull * mahalanobis_squared(mean - other_mean, scatter)
    return np.asarray(np.sqrt(family.geodesic_radius_squared) * acosh1p(z))


def minimal_manhattan(family: Family, mean: Array, scatter: Array, other_mean: Array, other_scatter: Array) -> Array:
    """Minimal Manhattan distance (27)-(28) by the package's paths, (..., m), (..., m, m) twice -> (...)."""
    z = family.pull * mahalanobis_squared(mean - other_mean, scatter)
    mean_log, deviation = _log_ratio(scatter, other_scatter)
    shape = np.broadcast_shapes(np.shape(z), mean_log.shape)
    flat = [np.broadcast_to(v, shape).ravel() for v in (z, mean_log, deviation, family.radius_squared, 2.0 * family.b)]
    return manhattan_paths(*flat).length.reshape(shape)


def _log_ratio(scatter: Array, other: Array) -> tuple[Array, Array]:
    """Trace over m of Log(S^-1 S'), and the Frobenius norm of what is left of it."""
    whiten = np.linalg.inv(np.linalg.cholesky(scatter))
    logs = np.log(np.linalg.eigvalsh(whiten @ other @ transpose(whiten)))
    mean_log = logs.mean(-1)
    return mean_log, np.asarray(np.sqrt(((logs - mean_log[..., None]) ** 2).sum(-1)))
