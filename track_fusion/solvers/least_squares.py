"""Sums of squares that are not convex, minimised over the simplex of weights, one for each fusion of a batch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, inverse, matvec, outer, transpose
from track_fusion.solvers.optimise import Solution

MAX_STEPS = 300
#: A step of the weights this short ends the search, as does one shortened to this part.
SHORT_STEP, SHORTEST = 1e-9, 1e-9
#: A step must lower the sum by this part of what its slope promises, but for rounding of the sum.
ARMIJO, ROUNDING = 1e-4, 4e-15
#: The vector of roots turns by no more than this in a step, in radians: farther off the model of the sum is a guess.
LONGEST_TURN = 0.5
#: What is added to the first Hessian, relative to its largest diagonal entry.
DAMPING = 1e-3

#: w (b, K), rows (b,) -> residuals (b, R) and their Jacobian over w (b, R, K).
Residuals = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]


def minimise_squares_on_simplex(residuals: Residuals, start: Array) -> tuple[Solution, Array]:
    """Find a local minimum of sums of squares over weights, by the method of Broyden, Fletcher, Goldfarb and Shanno.

    Parameters
    ----------
    residuals : callable    (w (b, K), rows (b,)) -> (b, R), (b, R, K)
    start : (B, K)          weights to start from, all positive

    Returns
    -------
    Solution, value (B,)

    Notes         The weights are squares of a vector of length one, so that the simplex has no boundary; a weight
                  may tend to zero. The first Hessian is that of Gauss and Newton, the residuals need not be
                  small. The sum falls at every step.
    """
    batch = len(start)
    weights, values = start.copy(), np.empty(batch)
    converged, iterations = np.zeros(batch, bool), np.zeros(batch, np.intp)
    rows, root = np.arange(batch), np.sqrt(start)
    value, gradient, normal = _at(residuals, root, rows)
    metric = _first_metric(normal)
    part, way = np.ones(batch), _way(metric, gradient, root)
    for step in range(1, MAX_STEPS + 1):
        if not len(rows):
            break
        new = root + part[:, None] * way
        new /= np.linalg.norm(new, axis=1, keepdims=True)
        new_value, new_gradient, _ = _at(residuals, new, rows)
        promise = part * (gradient * way).sum(1)
        good = new_value <= value + ARMIJO * promise + ROUNDING * value
        move = np.abs(new**2 - root**2).max(1)
        done = (good & (move <= SHORT_STEP)) | (part <= SHORTEST)
        metric = _updated(metric, _tangent(new - root, new), _tangent(new_gradient - gradient, new), good)
        keep = good[:, None]
        root, gradient = np.where(keep, new, root), np.where(keep, new_gradient, gradient)
        value, part = np.where(good, new_value, value), np.where(good, 1.0, 0.3 * part)
        way = np.where(keep, _way(metric, gradient, root), way)
        if done.any() or step == MAX_STEPS:
            out = done | (step == MAX_STEPS)
            at = rows[out]
            weights[at], values[at], converged[at], iterations[at] = root[out] ** 2, value[out], done[out], step
            left = ~out
            rows, root, value, gradient = rows[left], root[left], value[left], gradient[left]
            metric, part, way = metric[left], part[left], way[left]
    return Solution(weights / weights.sum(1, keepdims=True), converged, iterations), values


def _at(residuals: Residuals, root: Array, rows: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Half the sum of squares, its gradient and Gauss-Newton Hessian over the vector whose squares are the weights."""
    rest, slope = residuals(root**2, rows)
    weighed = slope * root[:, None]
    tangent = 2.0 * (weighed - (weighed @ root[..., None]) * root[:, None])
    return 0.5 * (rest**2).sum(1), matvec(transpose(tangent), rest), transpose(tangent) @ tangent


def _tangent(move: Array, root: Array) -> Array:
    """Take away what would lengthen the vector of roots."""
    return np.asarray(move - (move * root).sum(1, keepdims=True) * root)


def _way(metric: Array, gradient: Array, root: Array) -> Array:
    """Quasi-Newton step along the sphere of roots, (b, K)."""
    way = _tangent(-matvec(metric, gradient), root)
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return np.asarray(way * np.minimum(1.0, LONGEST_TURN / np.maximum(length, LONGEST_TURN)))


def _first_metric(normal: Array) -> Array:
    """Inverse of the damped Gauss-Newton Hessian."""
    size = normal.shape[1]
    top = np.diagonal(normal, axis1=1, axis2=2).max(1, initial=0.0)
    top = np.where(top > np.finfo(float).tiny, top, 1.0)  # zero: the weights do not matter
    return inverse(normal / top[:, None, None] + DAMPING * np.eye(size)) / top[:, None, None]


def _updated(metric: Array, move: Array, change: Array, good: NDArray[np.bool_]) -> Array:
    """Update the inverse Hessian by a step and the change of the gradient, where the curvature is positive."""
    product = (move * change).sum(1)
    use = good & (product > 1e-12 * np.linalg.norm(move, axis=1) * np.linalg.norm(change, axis=1))
    scale = np.where(use, product, 1.0)[:, None, None]
    image = matvec(metric, change)
    stretch = 1.0 + ((change * image).sum(1)[:, None, None] / scale)
    cross = image[..., :, None] * move[..., None, :]
    update = (stretch * outer(move) - cross - transpose(cross)) / scale
    return np.asarray(np.where(use[:, None, None], metric + update, metric))
