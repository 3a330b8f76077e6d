"""Root-mean-square errors over Monte Carlo runs, with their Monte Carlo error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from track_fusion.linalg import Array

#: What a run that goes another way than all runs seen has at most as its probability, when they are unanimous: the
#: complement of this is the confidence that it is not more frequent.
UNSEEN = 5e-4


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A figure measured by Monte Carlo.

    Attributes
    ----------
    value : float
    standard_error : float    NaN for one run, 0 where nothing random goes in
    runs : int
    left_out : (R,) or None   the figure without each of the runs in turn, in the order of the runs: figures of the same
                              runs pair up run by run. None: nothing random goes in, or it is not known
    unseen : float            how far the figure may be from the truth although all runs have the same: that of a share
                              of 0 or 1; positive upwards
    """

    value: float
    standard_error: float
    runs: int
    left_out: Array | None = dataclasses.field(default=None, compare=False, repr=False)
    unseen: float = 0.0

    @classmethod
    def exact(cls, value: float) -> Estimate:
        """Make a figure that nothing random goes into."""
        return cls(float(value), 0.0, 1)

    @classmethod
    def mean(cls, values: Array) -> Estimate:
        """Average over runs, (R,); where all runs have the same value, that value without rounding."""
        values = np.asarray(values, float)
        runs = len(values)
        if runs > 1 and (values == values[0]).all():
            return cls(float(values[0]), 0.0, runs, values)
        if runs < 2:
            return cls(float(values.mean()), float("nan"), runs)
        error = values.std(ddof=1) / np.sqrt(runs)
        return cls(float(values.mean()), float(error), runs, (values.sum() - values) / (runs - 1))

    @classmethod
    def share(cls, values: Array) -> Estimate:
        """Average over runs of something between 0 and 1, (R,), a share or whether something happened.

        When all runs say 0, or all 1, it may still happen sometimes: with a probability of up to 1 - UNSEEN^(1/R).
        """
        of_runs = cls.mean(values)
        if of_runs.standard_error != 0.0 or of_runs.value not in (0.0, 1.0):
            return of_runs
        doubt = 1.0 - UNSEEN ** (1.0 / of_runs.runs)
        return dataclasses.replace(of_runs, unseen=doubt * (1.0 - 2.0 * of_runs.value))

    @classmethod
    def median(cls, values: Array) -> Estimate:
        """Median over runs, (R,); standard error: half the distance of the order statistics one binomial sd away.

        To leave a run out moves the middle by one order statistic whichever run it is, so that the jackknife fails.
        `left_out` is what the influence function of the median gives: each run moves it by the same amount, up or down
        by the side on which it lies, the amount being that which goes with the standard error.
        """
        values = np.asarray(values, float)
        runs, middle = len(values), float(np.median(values))
        if runs < 2:
            return cls(middle, float("nan"), runs)
        ranks = np.clip([(runs - 1 - np.sqrt(runs)) / 2, (runs - 1 + np.sqrt(runs)) / 2], 0, runs - 1)
        low, high = np.interp(ranks, np.arange(runs), np.sort(values))
        error = float(0.5 * (high - low))
        return cls(middle, error, runs, middle - np.sign(values - middle) * error * np.sqrt(runs) / (runs - 1))

    @classmethod
    def of_averages(cls, values: Array, statistic: Callable[[Array], Array]) -> Estimate:
        """Estimate a smooth function of averages over runs, standard error by the jackknife.

        Parameters
        ----------
        values : (R, ...)       what is averaged, run by run
        statistic : callable    averages (L, ...) -> (L,)
        """
        values, runs = np.asarray(values, float), len(values)
        value = float(statistic(values.mean(0)[None])[0])
        if runs < 2:
            return cls(value, float("nan"), runs)
        left_out = np.asarray(statistic((values.sum(0) - values) / (runs - 1)))
        variance = (runs - 1) / runs * ((left_out - left_out.mean()) ** 2).sum()
        return cls(value, float(np.sqrt(variance)), runs, left_out)

    @classmethod
    def ratio(cls, numerator: Array, denominator: Array) -> Estimate:
        """Ratio of two averages over the same runs, (R,) each."""
        return cls.of_averages(np.stack([numerator, denominator], -1), lambda mean: mean[:, 0] / mean[:, 1])

    def spread(self, runs: int) -> float:
        """Standard deviation that the figure would have in a study of so many runs."""
        return float(self.standard_error * np.sqrt(self.runs / runs))


def rmse(squared_error: Array) -> Array:
    """Root-mean-square over runs at each step: (R, T) -> (T,)."""
    return np.asarray(np.sqrt(squared_error.mean(0)))


def armse(squared_error: Array) -> Estimate:
    """Average over the steps of the root-mean-square over runs, standard error by the jackknife.

    Parameters
    ----------
    squared_error : (R, T)    squared norm of the error, run by step
    """
    # Leaving a run out may round a sum of squares to just below zero.
    return Estimate.of_averages(squared_error, lambda mean: np.sqrt(mean.clip(0)).mean(-1))
