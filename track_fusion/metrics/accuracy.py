"""Root-mean-square errors over Monte Carlo runs, with their Monte Carlo error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from track_fusion.linalg import Array

#: So many standard errors from a bound leave no doubt on which side a figure lies.
BEYOND_DOUBT = 3.0


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A figure measured by Monte Carlo: value, standard error (NaN for one run), number of runs."""

    value: float
    standard_error: float
    runs: int

    @classmethod
    def exact(cls, value: float) -> Estimate:
        """Make a figure that nothing random goes into."""
        return cls(float(value), 0.0, 1)

    @classmethod
    def mean(cls, values: Array) -> Estimate:
        """Average over runs, (R,); where all runs have the same value, that value without rounding."""
        values = np.asarray(values, float)
        if len(values) > 1 and (values == values[0]).all():
            return cls(float(values[0]), 0.0, len(values))
        error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
        return cls(float(values.mean()), float(error), len(values))

    @classmethod
    def median(cls, values: Array) -> Estimate:
        """Median over runs, (R,); standard error: half the distance of the order statistics one binomial sd away."""
        values, runs = np.sort(np.asarray(values, float)), len(values)
        if runs < 2:
            return cls(float(np.median(values)), float("nan"), runs)
        ranks = np.clip([(runs - 1 - np.sqrt(runs)) / 2, (runs - 1 + np.sqrt(runs)) / 2], 0, runs - 1)
        low, high = np.interp(ranks, np.arange(runs), values)
        return cls(float(np.median(values)), float(0.5 * (high - low)), runs)

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
        left_out = statistic((values.sum(0) - values) / (runs - 1))
        variance = (runs - 1) / runs * ((left_out - left_out.mean()) ** 2).sum()
        return cls(value, float(np.sqrt(variance)), runs)

    @classmethod
    def ratio(cls, numerator: Array, denominator: Array) -> Estimate:
        """Ratio of two averages over the same runs, (R,) each."""
        return cls.of_averages(np.stack([numerator, denominator], -1), lambda mean: mean[:, 0] / mean[:, 1])

    def exceeds(self, bound: float) -> bool:
        """Tell whether the figure is above a bound beyond doubt: by more than BEYOND_DOUBT standard errors."""
        return bool(self.value - BEYOND_DOUBT * np.nan_to_num(self.standard_error) > bound)

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
