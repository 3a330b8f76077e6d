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
#: From so many runs on the skewness can be told; fewer are taken for skewed.
TELLING = 30
#: Share of the tail that skewed values may use: of ten runs of squared errors 5e-4 is wrong ten times as often.
CAUTION = 0.1
#: The signed ranks must lie so many standard deviations on the same side (99.5 %); ten of ten runs reach 2.8.
RANK_SIGMAS = 2.576


def surely_positive(values: Array, tail: float = TAIL) -> bool:
    """Tell whether the mean of what values are drawn from is positive.

    Parameters
    ----------
    values : (R,)    one a run, independent; where all are the same, nothing is left to chance
    tail : float     probability of a wrong yes

    Notes    By the t interval. Where the values are skewed it misses the rare runs that make the mean: there the signed
             ranks (Wilcoxon) must say the same, and so must the t statistic freed of skewness (Hall), which
             makes wrong answers some four times rarer when the rare runs are low ones. From less than LEAST_RUNS runs
             nothing is sure.

    References
    ----------
    P. Hall, On the removal of skewness by transformation, 1992: the monotone cubic
    """
    from scipy.special import stdtrit

    runs, mean = len(values), float(values.mean())
    if runs < LEAST_RUNS or not mean > 0.0:
        return False
    deviation = values - mean
    variance = float((deviation**2).sum()) / (runs - 1)
    if variance == 0.0:
        return True
    t, limit = mean / np.sqrt(variance / runs), float(stdtrit(runs - 1, 1.0 - tail))
    third = float((deviation**3).sum()) * runs / ((runs - 1) * (runs - 2))
    skew = third / variance**1.5 / np.sqrt(runs)
    if t <= limit or (abs(skew) <= SKEWED and runs >= TELLING):
        return bool(t > limit)
    straight = t + skew * t**2 / 3.0 + skew**2 * t**3 / 27.0 + skew / 6.0
    limit = float(stdtrit(runs - 1, 1.0 - CAUTION * tail))
    return bool(rank_sigmas(values) > RANK_SIGMAS and min(t, straight) > limit)


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
