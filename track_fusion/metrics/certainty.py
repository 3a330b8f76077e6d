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

    Notes    By the t interval, and where the values are skewed by the signed ranks (Wilcoxon) too: there the interval
             of a few runs misses the rare ones that make the mean. From less than LEAST_RUNS runs nothing is sure.
    """
    from scipy.special import stdtrit

    runs, mean = len(values), float(values.mean())
    if runs < LEAST_RUNS or not mean > 0.0:
        return False
    spread = float(values.std(ddof=1))
    if mean <= float(stdtrit(runs - 1, 1.0 - tail)) * spread / np.sqrt(runs):
        return False
    return not _is_skewed(values) or rank_sigmas(values) > RANK_SIGMAS


def _is_skewed(values: Array) -> bool:
    deviation = values - values.mean()
    spread = np.sqrt((deviation**2).mean())
    return bool(abs((deviation**3).mean()) > SKEWED * np.sqrt(len(values)) * spread**3)


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
