"""Which of several methods is better, when all of them met the same noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import combinations

import numpy as np

from track_fusion.linalg import Array

#: A difference in one run that is a smaller share of the scores is rounding, and counts as none.
ROUNDING = 1e-9
#: A difference is called significant when its adjusted p-value is below this.
SIGNIFICANCE = 0.05


@dataclasses.dataclass(frozen=True)
class Difference:
    """Scores of one method minus those of another over paired runs.

    Attributes
    ----------
    first, second : str       names; first has the smaller mean
    mean : float              mean of second minus first, not negative
    standard_error : float    of that mean; NaN for one run
    p_value : float           two-sided, paired t-test, adjusted by Holm for all pairs; NaN for one run
    """

    first: str
    second: str
    mean: float
    standard_error: float
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether chance alone is an unlikely explanation."""
        return self.p_value < SIGNIFICANCE


def paired_differences(scores: Mapping[str, Array]) -> list[Difference]:
    """Compare every pair of methods.

    Parameters
    ----------
    scores : mapping name -> (R,)    one number a run, smaller is better; run r of all met the same noise

    Returns
    -------
    list of Difference, the best method's first
    """
    order = sorted(scores, key=lambda name: float(scores[name].mean()))
    pairs = [(a, b, _gap(scores[a], scores[b])) for a, b in combinations(order, 2)]
    adjusted = _holm([_p_value(gap) for _, _, gap in pairs])
    return [
        Difference(a, b, float(gap.mean()), _standard_error(gap), p)
        for (a, b, gap), p in zip(pairs, adjusted, strict=True)
    ]


def _gap(first: Array, second: Array) -> Array:
    gap = np.asarray(second - first, float)
    return np.where(np.abs(gap) <= ROUNDING * np.maximum(np.abs(first), np.abs(second)), 0.0, gap)


def _standard_error(gap: Array) -> float:
    return float(gap.std(ddof=1) / np.sqrt(len(gap))) if len(gap) > 1 else float("nan")


def _p_value(gap: Array) -> float:
    """Two-sided p-value of the paired t-test; 1 when there is no difference in any run."""
    from scipy.special import stdtr

    error = _standard_error(gap)
    if error == 0.0 or np.isnan(error):
        return float("nan") if np.isnan(error) else float(gap.mean() == 0.0)
    return float(2.0 * stdtr(len(gap) - 1, -abs(gap.mean()) / error))


def _holm(p_values: list[float]) -> list[float]:
    """Adjust p-values for their number (S. Holm 1979)."""
    adjusted, largest = [float("nan")] * len(p_values), 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = largest if not np.isnan(p_values[i]) else float("nan")
    return adjusted
