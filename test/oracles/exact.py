"""Referees that share no code with the package: covariance intersection in mpmath, to 40 digits."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
mp = mpmath.mp.clone() if hasattr(mpmath.mp, "clone") else mpmath.MPContext()
mp.dps = 40
GOLDEN = (mp.sqrt(5) - 1) / 2


def exact(array: Array) -> Any:
    """Turn doubles into an mpmath matrix without rounding."""
    return mp.matrix(np.asarray(array).tolist())


class Intersection:
    """Covariance intersection of K tracks in 40 digits: P(w)^-1 = sum of w_i P_i^-1."""

    def __init__(self, cov: Array) -> None:
        self.infos = [exact(c) ** -1 for c in cov]

    def cov(self, weights: Any) -> Any:
        total = weights[0] * self.infos[0]
        for w, info in zip(weights[1:], self.infos[1:], strict=True):
            total = total + w * info
        return total**-1

    def mean(self, weights: Any, mean: Array) -> Any:
        pull = weights[0] * self.infos[0] * exact(mean[0])
        for w, info, x in zip(weights[1:], self.infos[1:], mean[1:], strict=True):
            pull = pull + w * info * exact(x)
        return self.cov(weights) * pull

    def objective(self, weights: Any, criterion: str) -> Any:
        """Logarithm of the criterion: a difference is a relative excess."""
        cov = self.cov(weights)
        return mp.log(mp.det(cov) if criterion == "det" else trace(cov))

    def best_pair(self, criterion: str) -> Any:
        """Minimise over the weight of a pair by golden section, to about 1e-12 in w and its square in value."""
        low, high = mp.mpf(0), mp.mpf(1)

        def value(w: Any) -> Any:
            return self.objective((w, 1 - w), criterion)

        c, d = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        at_c, at_d = value(c), value(d)
        for _ in range(58):
            if at_c <= at_d:
                high, d, at_d = d, c, at_c
                c = high - GOLDEN * (high - low)
                at_c = value(c)
            else:
                low, c, at_c = c, d, at_d
                d = low + GOLDEN * (high - low)
                at_d = value(d)
        return min(value(low), value(high), value(mp.mpf(0)), value(mp.mpf(1)))

    def excess_bound(self, weights: Any, criterion: str) -> float:
        """Bound how far the criterion lies above its minimum over the simplex, relative to it.

        For a convex f it is at most g'w - min g. The derivative along weight k is taken by a central
        difference in 40 digits.
        """
        step = mp.mpf(10) ** -15
        gradient = []
        for k in range(len(weights)):
            up = [w + (step if i == k else 0) for i, w in enumerate(weights)]
            down = [w - (step if i == k else 0) for i, w in enumerate(weights)]
            gradient.append((self.objective(up, criterion) - self.objective(down, criterion)) / (2 * step))
        return float(sum(w * g for w, g in zip(weights, gradient, strict=True)) - min(gradient))


def trace(matrix: Any) -> Any:
    return sum(matrix[i, i] for i in range(matrix.rows))


def errors(mean: Array, cov: Array, wanted_mean: Any, wanted_cov: Any) -> tuple[float, float]:
    """Return the errors of mean and cov in units of the wanted covariance, along its worst direction."""
    white = mp.cholesky(wanted_cov) ** -1
    shift = white * (exact(mean) - wanted_mean)
    change = white * (exact(cov) - wanted_cov) * white.T
    return float(max(abs(x) for x in shift)), float(max(abs(x) for x in change))


def mutual_fusion(mean: Array, cov: Array, common_mean: Any, common_cov: Any) -> tuple[Any, Any]:
    """Fuse two tracks less a common part in 40 digits: P^-1 = P1^-1 + P2^-1 - C^-1."""
    (first, second), part = (exact(c) ** -1 for c in cov), common_cov**-1
    fused = (first + second - part) ** -1
    return fused * (first * exact(mean[0]) + second * exact(mean[1]) - part * common_mean), fused


def blend(weight: Any, first: Any, second: Any) -> Any:
    """Return w A + (1 - w) B exactly."""
    return weight * first + (1 - weight) * second
