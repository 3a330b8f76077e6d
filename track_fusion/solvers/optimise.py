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
#: w -> first and second derivative of one convex function at w.
ScalarDerivatives = Callable[[float], tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class Solution:
    """Optimal weights with what became of the iteration: converged and iterations have the batch's shape."""

    weights: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]

    def of_both(self) -> Solution:
        """Make weights (B, 2) of two sources of the first one's (B,)."""
        return dataclasses.replace(self, weights=np.stack([self.weights, 1.0 - self.weights], -1))

    def __getitem__(self, rows: NDArray[np.intp]) -> Solution:
        """Pick some of the batch."""
        return Solution(self.weights[rows], self.converged[rows], self.iterations[rows])

    @staticmethod
    def known(weights: Array) -> Solution:
        """Take weights of a batch, (B,) or (B, K), for which nothing is sought."""
        return Solution(weights, np.ones(len(weights), bool), np.zeros(len(weights), np.intp))

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
        done = (np.abs(new - w) <= SHORT_STEP) | (high - low <= SHORT_STEP)
        w = new
        if done.mean() > COMPACT_AT or step == MAX_NEWTON:
            weights[rows], converged[rows], iterations[rows] = w, done, step
            left = ~done
            rows, w, low, high = rows[left], w[left], low[left], high[left]
    return Solution(weights, converged, iterations)


def minimise_one(derivatives: ScalarDerivatives) -> tuple[float, bool, int]:
    """Minimise one convex function of w on [0, 1]: `minimise_on_interval` in plain numbers.

    For a single function, arrays of one element would cost several times as much.

    Returns
    -------
    w, converged, iterations
    """
    starts_up, ends_down = derivatives(0.0)[0] >= 0, derivatives(1.0)[0] <= 0
    if starts_up or ends_down:
        return (0.5 if starts_up == ends_down else 0.0 if starts_up else 1.0), True, 0
    w, low, high = 0.5, 0.0, 1.0
    for step in range(1, MAX_NEWTON + 1):
        slope, curvature = derivatives(w)
        low, high = (w if slope <= 0 else low), (w if slope >= 0 else high)
        new = w - slope / curvature if curvature > 0 else -1.0
        if not low <= new <= high:
            new = 0.5 * (low + high)
        done = abs(new - w) <= SHORT_STEP or high - low <= SHORT_STEP
        w = new
        if done:
            return w, True, step
    return w, False, MAX_NEWTON


#: A weight is optimal when a bound on the excess of the objective, relative to its gradient, is below this.
GAP = 1e-12
#: Weights this small whose multiplier says that they vanish are set to zero.
VANISHING = 1e-7
#: What is left of a vanishing multiplier, relative to the gradient: rounding of the Hessian.
FLOOR = 1e-14
MAX_INTERIOR = 60

#: w (b, K), rows (b,) -> gradient (b, K) and Hessian (b, K, K) of a convex function.
GradientHessian = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]


def minimise_on_simplex(
    gradient_hessian: GradientHessian, count: int, sources: int, start: Array | None = None
) -> Solution:
    """Minimise `count` convex functions on the simplex of `sources` weights by a primal-dual interior point.

    Parameters
    ----------
    gradient_hessian : callable    (w (b, K), rows (b,)) -> (b, K), (b, K, K)
    count, sources : int           number of functions and of weights K
    start : (count, K) or None     positive weights of sum 1 to start from; None = equal ones

    Returns
    -------
    Solution    weights (count, K)

    Notes         Each iterate is interior, so the matrices behind the objective stay definite. The
                  objective of a convex f exceeds its minimum by at most g'w - min g, g its gradient; that is
                  the test of convergence, or a step too short to matter where rounding hides the gap.
    """
    weights = np.full((count, sources), 1.0 / sources) if start is None else start.copy()
    converged = np.zeros(count, bool)
    iterations = np.zeros(count, np.intp)
    rows = np.arange(count)
    w, z, moved = weights.copy(), np.empty((0, sources)), np.ones(count)
    for step in range(1, MAX_INTERIOR + 1):
        if not len(rows):
            break
        gradient, hessian = gradient_hessian(w, rows)
        excess = gradient - gradient.min(1, keepdims=True)
        if step == 1:  # multipliers that fit the gradient and are far from zero
            z = excess + excess.max(1, keepdims=True)
        scale = np.maximum(1.0, np.abs(gradient).max(1))
        gap = (w * z).sum(1) / scale
        done = ((w * excess).sum(1) <= GAP * scale) | ((gap <= GAP) & (moved <= SHORT_STEP))
        if done.mean() > COMPACT_AT or step == MAX_INTERIOR:
            vanish = done[:, None] & (w < VANISHING) & (w * scale[:, None] < excess)
            weights[rows], iterations[rows], converged[rows] = np.where(vanish, 0.0, w), step, done
            left = ~done
            rows, w, z, gap, scale = rows[left], w[left], z[left], gap[left], scale[left]
            gradient, hessian = gradient[left], hessian[left]
        if len(rows):
            w, z, moved = _interior_step(w, z, gradient, hessian, gap, scale)
    return Solution(weights / weights.sum(1, keepdims=True), converged, iterations)


def _interior_step(
    w: Array, z: Array, gradient: Array, hessian: Array, gap: Array, scale: Array
) -> tuple[Array, Array, Array]:
    """Take one step of Newton's method towards the central path, staying inside.

    The aim and the distance kept from the boundary shrink with the gap, so that the last steps square it.
    """
    sources = w.shape[1]
    centre = (np.minimum(0.01, gap) * gap * scale / sources)[:, None] / w
    kkt = np.ones((len(w), sources + 1, sources + 1))
    kkt[:, :sources, :sources] = hessian
    diagonal = np.arange(sources)
    # The floor keeps a row solvable whose tracks are all equal: no multiplier, and any weights do.
    kkt[:, diagonal, diagonal] += np.maximum(z / w, FLOOR * scale[:, None])
    kkt[:, sources, sources] = 0.0
    right = np.zeros((len(w), sources + 1))
    right[:, :sources] = centre - gradient
    dw = np.linalg.solve(kkt, right[..., None])[:, :sources, 0]
    dz = centre - z - z / w * dw
    share = 1.0 - np.clip(gap, 1e-6, 0.01)[:, None]
    dw *= _inside(w, dw, share)
    return w + dw, z + _inside(z, dz, share) * dz, np.abs(dw).max(1)


def _inside(v: Array, dv: Array, share: Array) -> Array:
    """Largest part of a step, at most all of it, that goes only this share of the way to the boundary."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(dv < 0, -v / dv, np.inf).min(1, keepdims=True)
    return np.asarray(np.minimum(1.0, share * reach))
