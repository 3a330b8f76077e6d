"""Does the covariance tell the truth? Normalised estimation error squared with chi-square bounds."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.linalg import Array, mahalanobis_squared
from track_fusion.solvers.chi_square import chi_square_quantile

#: Two-sided probability of the bounds.
CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Consistency:
    """Average NEES over `samples`, divided by the number of axes, with the bounds a consistent filter keeps.

    Attributes
    ----------
    anees : float          1 = consistent, above = overconfident
    low, high : float      chi-square bounds at CONFIDENCE for independent samples
    samples : int
    axes : int
    """

    anees: float
    low: float
    high: float
    samples: int
    axes: int

    @property
    def verdict(self) -> str:
        """One of consistent, overconfident, underconfident, unknown (no sample)."""
        if not self.samples:
            return "unknown"
        if self.anees > self.high:
            return "overconfident"
        return "underconfident" if self.anees < self.low else "consistent"


def nees(error: Array, cov: Array) -> Array:
    """Normalised estimation error squared e' P^-1 e: (..., n), (..., n, n) -> (...)."""
    return mahalanobis_squared(error, cov)


def consistency(values: Array, axes: int) -> Consistency:
    """Average NEES values of `axes` axes each and give the bounds for as many independent samples.

    Errors of one run are correlated over time, so that a consistent filter leaves these bounds somewhat
    more often than 1 - CONFIDENCE says when the samples are the steps of one run.
    """
    values = np.asarray(values, float).ravel()
    return consistency_of_sum(float(values.sum()), len(values), axes)


def consistency_of_sum(total: float, count: int, axes: int) -> Consistency:
    """`consistency` of `count` NEES values whose sum is known."""
    if not count:
        return Consistency(float("nan"), float("nan"), float("nan"), 0, axes)
    tail, terms = 0.5 * (1.0 - CONFIDENCE), count * axes
    low, high = (chi_square_quantile(p, terms) / terms for p in (tail, 1.0 - tail))
    return Consistency(total / terms, low, high, count, axes)
