"""Smallest upper bounds of covariances in the Loewner order: closed forms for two, an interior point for more."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, inverse, is_positive_definite, matvec, outer, symmetrise, transpose
from track_fusion.solvers.matrix_program import Program, solve
from track_fusion.solvers.pair import Pair

#: What is to be least of an upper bound.
Criterion = Literal["det", "trace"]
#: One side bounds another if what it lacks is below this share of their sum.
ROUNDING = 1e-13
#: The search starts at this multiple of the sum of the sides, which is surely above each.
START = 2.0
#: Large batches are worked on in pieces whose arrays stay in the cache.
CHUNK = 32


@dataclasses.dataclass(frozen=True)
class Bound:
    """A bound of each of a batch: mean (B, n), cov (B, n, n), whether its search ended and in how many steps (B,)."""

    mean: Array
    cov: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


def bound_of_two(first: Array, second: Array, criterion: Criterion) -> Array:
    """Least upper bound of two covariances, (B, n, n) each: the smallest P >= P1, P2 by determinant or trace.

    By the determinant it is the larger of the two along every axis that diagonalises both; by the trace it is
    P2 + (P1 - P2)_+, the positive part taken in the given units.
    """
    if criterion == "det":
        pair = Pair.of(first, second)
        return pair.rebuild(np.maximum(pair.first, pair.second))
    values, vectors = np.linalg.eigh(first - second)
    return symmetrise(second + (vectors * np.maximum(values, 0.0)[:, None, :]) @ transpose(vectors))


def bound_about(mean: Array, means: Array, covs: Array, criterion: Criterion) -> Bound:
    """Smallest P >= P_i + (x - x_i)(x - x_i)' for all i, at given x.

    Parameters
    ----------
    mean : (B, n)         x
    means : (B, K, n)     x_i
    covs : (B, K, n, n)   P_i

    Returns
    -------
    Bound    its mean is x
    """
    sides = covs + outer(mean[:, None] - means)
    batch, count = means.shape[:2]
    if count > 2:
        return _bound(mean, means, covs, sides, criterion, free=False)
    cov = sides[:, 0].copy() if count == 1 else bound_of_two(sides[:, 0], sides[:, 1], criterion)
    return Bound(mean, cov, np.ones(batch, bool), np.zeros(batch, np.intp))


def bound_anywhere(means: Array, covs: Array, criterion: Criterion) -> Bound:
    """Smallest P, over x as well, with P >= P_i + (x - x_i)(x - x_i)' for all i; shapes as for `bound_about`."""
    start = means.mean(1)
    return _bound(start, means, covs, covs + outer(start[:, None] - means), criterion, free=True)


def _bound(start: Array, means: Array, covs: Array, sides: Array, criterion: Criterion, free: bool) -> Bound:
    """Take one side where it bounds all others, else search, the sides whitened by their sum."""
    batch = len(means)
    lower = np.linalg.cholesky(sides.sum(1))
    whiten = np.linalg.inv(lower)[:, None]
    white = symmetrise(whiten @ covs @ transpose(whiten))
    points = matvec(whiten, means - start[:, None])
    units = np.broadcast_to(np.eye(lower.shape[-1]), lower.shape) if criterion == "det" else transpose(lower) @ lower
    units = units / np.trace(units, axis1=-2, axis2=-1)[:, None, None]
    ruler, ruled = _ruler(white, points, free)
    mean, cov = start.copy(), np.empty_like(lower)
    converged, iterations = ruled.copy(), np.zeros(batch, np.intp)
    at = np.flatnonzero(ruled)
    cov[at] = (covs if free else sides)[at, ruler[at]]
    if free:
        mean[at] = means[at, ruler[at]]
    rows = np.flatnonzero(~ruled)
    if len(rows):
        shift, least, converged[rows], iterations[rows] = _search(
            white[rows], points[rows], units[rows], criterion, free
        )
        mean[rows] += matvec(lower[rows], shift)
        cov[rows] = symmetrise(lower[rows] @ least @ transpose(lower[rows]))
    return Bound(mean, cov, converged, iterations)


def _ruler(white: Array, points: Array, free: bool) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Tell which side bounds all others, about its own mean if the mean is free, and whether there is one."""
    n = white.shape[-1]
    own, offset = white, points[:, :, None] - points[:, None]
    if not free:
        own, offset = white + outer(points), np.broadcast_to(points[:, None], offset.shape)
    lack = own[:, :, None] - white[:, None] - outer(offset) + ROUNDING * np.eye(n)
    rules = np.asarray(is_positive_definite(lack).all(2))
    return np.asarray(rules.argmax(1)), np.asarray(rules.any(1))


def _entries(n: int, free: bool) -> NDArray[np.intp]:
    """Entries (q, 2) of a symmetric matrix, and of the border of a vector if x is free, that are sought."""
    return np.array([(i, j) for i in range(n) for j in range(i, n)] + [(i, n) for i in range(n) if free])


def _search(
    white: Array, points: Array, units: Array, criterion: Criterion, free: bool
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.intp]]:
    """Return x (B, n), P (B, n, n), converged and iterations (B,) of sides whitened by their sum, in pieces."""
    program = _by_det if criterion == "det" else _by_trace
    pieces = [slice(i, i + CHUNK) for i in range(0, len(white), CHUNK)]
    parts = [program(white[s], points[s], units[s], free) for s in pieces]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))  # type: ignore[return-value]


_Part = tuple[Array, Array, NDArray[np.bool_], NDArray[np.intp]]


def _by_trace(white: Array, points: Array, units: Array, free: bool) -> _Part:
    """Minimise tr(U P) with slacks P - P_i - x_i x_i', or [[P - P_i, x - x_i], [(x - x_i)', 1]] if x is free."""
    batch, count, n = points.shape
    size = n + free
    slack = np.zeros((batch, count, size, size))
    slack[..., :n, :n] = START * np.eye(n) - white
    start, slope = np.zeros((batch, size, size)), np.zeros((batch, size, size))
    start[:, :n, :n], slope[:, :n, :n] = START * np.eye(n), units
    if free:
        slack[..., :n, n] = slack[..., n, :n] = -points
        slack[..., n, n] = 1.0
    else:
        slack -= outer(points)
    half = np.broadcast_to(np.eye(size) / np.sqrt(2.0), slack.shape)
    program = Program(start, slack, half, half, _entries(n, free), lambda y, rows: (slope[rows], None))
    y, done, steps = solve(program)
    return (y[:, :n, n] if free else np.zeros((batch, n))), y[:, :n, :n], done, steps


def _by_det(white: Array, points: Array, units: Array, free: bool) -> _Part:
    """Minimise log det P, in A = P^-1/2 and b = A x, in which it is convex, as -2 log det A.

    P >= P_i + (x - x_i)(x - x_i)', with P_i = R_i R_i', says that no singular value of (A R_i, A x_i - b) exceeds one.
    """
    batch, count, n = points.shape
    size = n + free
    start = np.zeros((batch, size, size))
    start[:, :n, :n] = np.eye(n) / np.sqrt(START)
    left, right = np.zeros((batch, count, size, n + size)), np.zeros((batch, count, size, n + size))
    left[..., :n, :n] = np.eye(n)
    right[..., :n, n : 2 * n] = np.linalg.cholesky(white if free else white + outer(points))
    if free:
        right[..., :n, 2 * n], right[..., n, 2 * n] = points, -1.0
    corner = transpose(left) @ start[:, None] @ right
    slack = np.eye(n + size) + corner + transpose(corner)

    def objective(y: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        bend = np.zeros((len(y), size, size))
        bend[:, :n, :n] = np.linalg.inv(y[:, :n, :n])
        return -2.0 * bend, np.sqrt(2.0) * bend

    y, done, steps = solve(Program(start, slack, left, right, _entries(n, free), objective))
    root = inverse(y[:, :n, :n])
    mean = matvec(root, y[:, :n, n]) if free else np.zeros((batch, n))
    return mean, root @ transpose(root), done, steps
