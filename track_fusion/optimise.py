"""Fusion weights: convex programs over the unit interval and the simplex, one for each fusion of a batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array

#: Newton's method squares the error of a step: after a step this short the weight is exact.
SHORT_STEP = 1e-9
MAX_NEWTON = 100
#: Stragglers go on by themselves once this share of the batch has converged.
COMPACT_AT = 0.5

#: (w, rows) -> first and second derivative of a convex function at w, for these rows of the batch.
Derivatives = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]


@dataclasses.dataclass(frozen=True)
class Solution:
    """Optimal weights with what became of the iteration: converged and iterations have the batch's shape."""

    weights: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]

    @staticmethod
    def concatenate(parts: Sequence[Solution]) -> Solution:
        """Join the solutions of the pieces of a batch."""
        columns = [[getattr(p, f.name) for p in parts] for f in dataclasses.fields(Solution)]
        return Solution(*(np.concatenate(c) for c in columns))


def minimise_on_interval(derivatives: Derivatives, count: int) -> Solution:
    """Minimise `count` convex functions of w on [0, 1] by Newton's method safeguarded by bisection.

    Parameters
    ----------
    derivatives : callable    (w (b,), rows (b,)) -> f'(w), f''(w), each (b,)
    count : int               number of functions

    Returns
    -------
    Solution    weights (count,): a minimiser, 1/2 where f is constant

    Notes         The bracket test is not strict: at an end point Newton may rightly stay there.
    """
    rows = np.arange(count)
    starts_up = derivatives(np.zeros(count), rows)[0] >= 0
    ends_down = derivatives(np.ones(count), rows)[0] <= 0
    weights = np.where(starts_up == ends_down, 0.5, np.where(starts_up, 0.0, 1.0))
    converged = starts_up | ends_down
    iterations = np.zeros(count, np.intp)
    rows = np.flatnonzero(~converged)
    w, low, high = weights[rows], np.zeros(len(rows)), np.ones(len(rows))
    for step in range(1, MAX_NEWTON + 1):
        if not len(rows):
            break
        slope, curvature = derivatives(w, rows)
        low, high = np.where(slope <= 0, w, low), np.where(slope >= 0, w, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = w - slope / curvature
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        done = np.abs(new - w) <= SHORT_STEP
        w = new
        if done.mean() > COMPACT_AT:
            weights[rows], converged[rows], iterations[rows] = w, done, step
            rows, w, low, high = (a[~done] for a in (rows, w, low, high))
    weights[rows], iterations[rows] = w, MAX_NEWTON
    return Solution(weights, converged, iterations)


#: A weight is optimal when the duality gap, a bound on the excess of the objective, is below this.
GAP = 1e-13
#: Weights this small whose multiplier says that they vanish are set to zero.
VANISHING = 1e-7
MAX_INTERIOR = 60

#: w (b, K), rows (b,) -> gradient (b, K) and Hessian (b, K, K) of a convex function.
GradientHessian = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]


def minimise_on_simplex(gradient_hessian: GradientHessian, count: int, sources: int) -> Solution:
    """Minimise `count` convex functions on the simplex of `sources` weights by a primal-dual interior point.

    Parameters
    ----------
    gradient_hessian : callable    (w (b, K), rows (b,)) -> (b, K), (b, K, K)
    count, sources : int           number of functions and of weights K

    Returns
    -------
    Solution    weights (count, K)

    Notes         Each iterate is interior, so the matrices behind the objective stay definite.
    """
    weights = np.full((count, sources), 1.0 / sources)
    converged = np.zeros(count, bool)
    iterations = np.zeros(count, np.intp)
    rows = np.arange(count)
    w = weights.copy()
    z = np.ones_like(w)
    for step in range(1, MAX_INTERIOR + 1):
        if not len(rows):
            break
        gradient, hessian = gradient_hessian(w, rows)
        gap = (w * z).sum(1)
        # The multipliers fit when gradient - z is constant over the sources.
        residual = gradient - z
        residual = np.abs(residual - (w * residual).sum(1, keepdims=True)).max(1)
        done = (gap <= GAP * np.maximum(1.0, np.abs(gradient).max(1))) & (
            (residual * w.min(1) <= GAP) | (residual <= 1e-8)
        )
        weights[rows], iterations[rows] = np.where(done[:, None] & (w < VANISHING) & (w < z), 0.0, w), step
        converged[rows] = done
        if done.any():
            keep = ~done
            rows, w, z, gradient, hessian, gap = (a[keep] for a in (rows, w, z, gradient, hessian, gap))
        w, z = _interior_step(w, z, gradient, hessian, gap)
    return Solution(weights / weights.sum(1, keepdims=True), converged, iterations)


def _interior_step(w: Array, z: Array, gradient: Array, hessian: Array, gap: Array) -> tuple[Array, Array]:
    """Take one step of Newton's method towards the central path, staying inside."""
    sources = w.shape[1]
    if not len(w):
        return w, z
    centre = (0.1 * gap / sources)[:, None] / w
    kkt = np.ones((len(w), sources + 1, sources + 1))
    kkt[:, :sources, :sources] = hessian
    diagonal = np.arange(sources)
    kkt[:, diagonal, diagonal] += z / w
    kkt[:, sources, sources] = 0.0
    right = np.zeros((len(w), sources + 1))
    right[:, :sources] = centre - gradient
    dw = np.linalg.solve(kkt, right[..., None])[:, :sources, 0]
    dz = centre - z - z / w * dw
    return w + _inside(w, dw) * dw, z + _inside(z, dz) * dz


def _inside(v: Array, dv: Array) -> Array:
    """Largest share of a step, at most 1, that stops short of the boundary by a hundredth."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(dv < 0, -v / dv, np.inf).min(1, keepdims=True)
    return np.minimum(1.0, 0.99 * reach)
