"""On which side of zero a mean over runs lies, beyond doubt."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array

#: Probability that a mean of zero is called positive: half of what two-sided confidence of 99.9 % leaves.
TAIL = 5e-4
#: From fewer runs the spread of a run cannot be told well enough.
LEAST_RUNS = 10
#: Skewness times R^-1/2 from which on the t interval cannot be trusted at such a TAIL: there the next term of the
#: Edgeworth series is as large as TAIL itself.
SKEWED = 0.1
#: The signed ranks must lie so many standard deviations on the same side (99.5 %); ten of ten runs reach 2.8.
RANK_SIGMAS = 2.576


def surely_positive(values: Array, tail: float = TAIL) -> bool:
    """Tell whether the mean of what values are drawn from is positive.

    Parameters
    ----------
    values : (R,)    one a run, independent; where all are the same, nothing is left to chance
    tail : float     probability of a wrong yes

    Notes    By the t interval. Where the values are skewed it misses the rare runs that make the mean: there the signed
             ranks (Wilcoxon) must say the same, and so must the interval corrected for the skewness (Johnson), which
             makes wrong answers some four times rarer when the rare runs are low ones. From less than LEAST_RUNS runs
             nothing is sure.

    References
    ----------
    N. J. Johnson, Modified t tests and confidence intervals for asymmetrical populations, 1978, (2.6)
    """
    from scipy.special import stdtrit

    runs, mean = len(values), float(values.mean())
    if runs < LEAST_RUNS or not mean > 0.0:
        return False
    deviation = values - mean
    variance = float((deviation**2).sum()) / (runs - 1)
    limit = float(stdtrit(runs - 1, 1.0 - tail)) * np.sqrt(variance / runs)
    third = float((deviation**3).sum()) * runs / ((runs - 1) * (runs - 2))
    if mean <= limit or abs(third) <= SKEWED * np.sqrt(runs * variance**3):
        return bool(mean > limit)
    correction = third / variance * (1.0 / (6.0 * runs) + mean**2 / (3.0 * variance))
    return bool(rank_sigmas(values) > RANK_SIGMAS and mean + min(correction, 0.0) > limit)


def rank_sigmas(values: Array) -> float:
    """Sum of the signed ranks (R,) -> in standard deviations of what symmetry about zero gives, zeros left out.

    References
    ----------
    F. Wilcoxon, Individual comparisons by ranking methods, 1945; ties share the mean of their ranks
    """
    values = values[values != 0.0]
    if not len(values):
        return 0.0
    _, at, count = np.unique(np.abs(values), return_inverse=True, return_counts=True)
    rank = (np.cumsum(count) - 0.5 * (count - 1))[at]
    return float((np.sign(values) * rank).sum() / np.sqrt((rank**2).sum()))
