"""Rao (Fisher information) distances between densities of one elliptical family, and what is built on them.

A `Family` whose constants have shape (...) goes with a batch of densities of that shape. Chen and Zhou 2022,
sections 2.2 to 3.2, and the equations named below.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.elliptical.elliptical import Family
from track_fusion.linalg import Array
from track_fusion.solvers.optimise import minimise_on_interval


def acosh1p(x: Array) -> Array:
    """Inverse hyperbolic cosine of 1 + x, right for small x too."""
    return np.asarray(np.log1p(x + np.sqrt(x * (x + 2.0))))


@dataclasses.dataclass(frozen=True)
class ManhattanPaths:
    """Shortest Manhattan paths: their lengths and the derivatives over what they depend on, each (N,)."""

    length: Array
    over_z: Array
    over_log: Array
    over_deviation: Array  # divided by the deviation


def manhattan_paths(z: Array, mean_log: Array, deviation: Array, radius: Array, weight: Array) -> ManhattanPaths:
    """Minimise r h(z, u) + sqrt(r^2 (l - u)^2 + weight s^2) over u = log alpha, each argument (N,).

    Parameters
    ----------
    z : (N,)            c d_M
    mean_log : (N,)     l, trace of Log(S0^-1 S1) over m
    deviation : (N,)    s, Frobenius norm of the rest of that logarithm
    radius : (N,)       r^2 = 2 a_h / c
    weight : (N,)       2 b_h

    Notes         Both terms are distances from a point of a geodesic in u, hence convex; u lies between their
                  own minima log(1 + z / 2) and l.
    """
    near = np.log1p(0.5 * z)
    reach = mean_log - near
    r = np.sqrt(radius)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        span = reach[rows]
        u = near[rows] + w * span
        slope, curvature = _bend_slopes(z[rows], u, np.sign(span))
        left, radius_here = (1.0 - w) * span, radius[rows]
        rest = np.sqrt(radius_here * left**2 + weight[rows] * deviation[rows] ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Where nothing is left, the slope is that from this side.
            fall = np.where(rest > 0, radius_here * left / rest, r[rows] * np.sign(span))
            bend = np.where(rest > 0, (radius_here - fall**2) / rest, 0.0)
        return (r[rows] * slope - fall) * span, (r[rows] * curvature + bend) * span**2

    u = near + minimise_on_interval(derivatives, len(z)).weights * reach
    bend = _bend(z, u)
    rest = np.sqrt(radius * (mean_log - u) ** 2 + weight * deviation**2)
    slope, _ = _bend_slopes(z, u, np.zeros_like(z))
    with np.errstate(divide="ignore", invalid="ignore"):
        over_z = np.where(bend > 0, r * (0.5 + 0.25 * (z + 2.0) * np.exp(-u)) / np.sqrt(bend * (bend + 2.0)), 0.0)
        over_deviation = np.where(rest > 0, weight / rest, 0.0)
    return ManhattanPaths(r * acosh1p(bend) + rest, over_z, r * slope, over_deviation)


def _bend(z: Array, u: Array) -> Array:
    """Argument of the inverse hyperbolic cosine in (26), less one, at alpha = e^u; without cancellation."""
    return np.asarray(0.125 * z * z * np.exp(-u) + 0.5 * z * (1.0 + np.exp(-u)) + 2.0 * np.sinh(0.5 * u) ** 2)


def _bend_slopes(z: Array, u: Array, side: Array) -> tuple[Array, Array]:
    """First and second derivative over u of the inverse hyperbolic cosine in (26); at its kink the slope `side`."""
    bend = _bend(z, u)
    rise = np.sinh(u) - 0.125 * z * (z + 4.0) * np.exp(-u)
    root = np.sqrt(bend * (bend + 2.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(root > 0, rise / root, side)
        curvature = np.where(root > 0, (1.0 + bend - 0.5 * z - (1.0 + bend) * slope**2) / root, 0.0)
    return slope, curvature


# One axis: the densities are a hyperbolic plane, for which everything is known.


def rao_distance_scalar(family: Family, mean: Array, scatter: Array, other_mean: Array, other_scatter: Array) -> Array:
    """Rao distance (14) of scalar densities; all arguments (...), scatters are sigma^2.

    Raises
    ------
    ValueError    the family has more than one axis
    """
    _check_scalar(family)
    ratio = 0.25 * np.log(other_scatter / scatter)
    z = 0.25 * family.pull * (other_mean - mean) ** 2 / np.sqrt(scatter * other_scatter)
    return np.asarray(_plane_radius(family) * acosh1p(z + 2.0 * np.sinh(ratio) ** 2))


def scalar_geodesic(
    family: Family, mean: Array, scatter: Array, other_mean: Array, other_scatter: Array, fraction: Array | float
) -> tuple[Array, Array]:
    """Point of the geodesic (15)-(21) between scalar densities, at this fraction of its length.

    Returns
    -------
    mean (...), scatter (...)

    Raises
    ------
    ValueError    the family has more than one axis

    Notes         On the hyperboloid 1/sigma and mu/sigma are linear coordinates, in which a geodesic is
                  (sinh((1-t) D) X + sinh(t D) X') / sinh D. Unlike (15)-(21) this needs no case for equal means
                  and no order of the ends.
    """
    radius = _plane_radius(family)
    distance = rao_distance_scalar(family, mean, scatter, other_mean, other_scatter) / radius
    first, second = _sinh_ratio(1.0 - np.asarray(fraction), distance), _sinh_ratio(np.asarray(fraction), distance)
    return _combined(
        family, np.stack([mean, other_mean], -1), np.stack([scatter, other_scatter], -1), np.stack([first, second], -1)
    )


def informative_barycenter(family: Family, mean: Array, scatter: Array) -> tuple[Array, Array]:
    """Barycenter of K scalar densities: it minimises the sum of their squared Rao distances (29).

    Parameters
    ----------
    family : Family      of one axis
    mean : (..., K)
    scatter : (..., K)

    Returns
    -------
    mean (...), scatter (...)    for two densities the midpoint of their geodesic

    Raises
    ------
    ValueError    the family has more than one axis

    Notes         The sum of distances itself is minimised by every point between two densities; its square is
                  what section 5.1 takes. Each step is the gradient step that a negative curvature allows, so the sum
                  falls at every one.
    """
    _check_scalar(family)
    radius = _plane_radius(family)
    centre = _combined(family, mean, scatter, np.ones_like(mean))
    for _ in range(MAX_STEPS):
        there = centre[0][..., None], centre[1][..., None]
        lengths = rao_distance_scalar(_widened(family), mean, scatter, *there) / radius[..., None]
        with np.errstate(invalid="ignore"):
            weights = np.where(lengths > 0, lengths / np.sinh(lengths), 1.0)
        new = _combined(family, mean, scatter, weights)
        moved = rao_distance_scalar(family, *centre, *new)
        centre = new
        if (moved <= ROUNDING).all():
            break
    return centre


#: A step of the barycenter shorter than this is rounding.
ROUNDING, MAX_STEPS = 1e-14, 1000


def _combined(family: Family, mean: Array, scatter: Array, weights: Array) -> tuple[Array, Array]:
    """Return the point of the hyperboloid along a positive combination of points, (..., K) -> (...).

    The point (x, y) of the half-plane, x = mu sqrt(c/2), y = sigma, is ((x^2 + y^2) / y, x / y, 1 / y), with
    determinant 1.
    """
    per_sigma = weights / np.sqrt(scatter)
    total = per_sigma.sum(-1)
    centre = (per_sigma * mean).sum(-1) / total
    spread = 0.5 * family.pull * (per_sigma * (mean - centre[..., None]) ** 2).sum(-1)
    return centre, ((per_sigma * scatter).sum(-1) + spread) / total


def _sinh_ratio(fraction: Array, distance: Array) -> Array:
    """Return sinh(t D) / sinh D, and t where D = 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.exp((fraction - 1.0) * distance) * np.expm1(-2.0 * fraction * distance) / np.expm1(-2.0 * distance)
    return np.asarray(np.where(distance > 0, ratio, fraction))


def _widened(family: Family) -> Family:
    """Give the constants an axis for the sources."""
    a, b, kappa = (np.asarray(v)[..., None] for v in (family.a, family.b, family.kappa))
    return dataclasses.replace(family, a=a, b=b, kappa=kappa)


def _check_scalar(family: Family) -> None:
    if family.axes != 1:
        raise ValueError(f"The Rao distance is known in closed form for families of one axis. Got {family.axes}.")


def _plane_radius(family: Family) -> Array:
    """d_h of Theorem 1: d_h^2 (dx^2 + dy^2) / y^2 is the metric of the half-plane; log sigma is half log S."""
    return np.asarray(2.0 * np.sqrt(family.radius_squared))
