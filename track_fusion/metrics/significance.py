"""Which of several methods is better, when all of them met the same noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from itertools import combinations
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array

Group = TypeVar("Group")
#: Which runs, (R,).
Mask = NDArray[np.bool_]
#: A difference in one run that is a smaller share of the scores is rounding, and counts as none.
ROUNDING = 1e-9
#: A difference is called significant when its adjusted p-value is below this.
SIGNIFICANCE = 0.05
#: A run has diverged whose error is so many times the median of the method with the least median.
DIVERGED = 10.0
#: Share of the runs that a robust mean leaves out at either end.
TRIMMED = 0.1


@dataclasses.dataclass(frozen=True)
class Difference:
    """Scores of one method minus those of another over paired runs.

    Attributes
    ----------
    first, second : str       names; first has the smaller mean
    mean : float              mean of second minus first, not negative; not finite where a score is not
    standard_error : float    of that mean; NaN for one run
    p_value : float           two-sided, paired t-test, adjusted by Holm for all pairs of all groups; NaN where there is
                              nothing to test: one run, scores that are the same in all runs, or not finite
    diverges : bool           whether some run of first has diverged: then it is not better, whatever its mean
    """

    first: str
    second: str
    mean: float
    standard_error: float
    p_value: float
    diverges: bool = False

    @property
    def significant(self) -> bool:
        """Whether first is better, and chance alone an unlikely explanation."""
        return self.p_value < SIGNIFICANCE and not self.diverges


def paired_differences(
    groups: Mapping[Group, Mapping[str, Array]], diverged: Mapping[Group, Mapping[str, Mask]] | None = None
) -> dict[Group, list[Difference]]:
    """Compare every pair of methods in each group; p-values are adjusted for all pairs of all groups.

    Parameters
    ----------
    groups : mapping group -> mapping name -> (R,)      one number a run, smaller is better; run r of all met the same
                                                        noise
    diverged : mapping group -> mapping name -> (R,)    which runs have diverged; None: none

    Returns
    -------
    mapping group -> list of Difference, the best method's first
    """
    pairs = [
        (group, a, b, _gap(scores[a], scores[b]))
        for group, scores in groups.items()
        for a, b in combinations(sorted(scores, key=lambda name: _rank(scores[name])), 2)
    ]
    lost = {(g, name): bool(runs.any()) for g, each in (diverged or {}).items() for name, runs in each.items()}
    differences: dict[Group, list[Difference]] = {group: [] for group in groups}
    for (group, a, b, gap), p in zip(pairs, _holm([_p_value(gap) for *_, gap in pairs]), strict=True):
        mean, error = float(gap.mean()), _standard_error(gap)
        differences[group].append(Difference(a, b, mean, error, p, lost.get((group, a), False)))
    return differences


def diverged_runs(errors: Mapping[str, Array]) -> dict[str, Mask]:
    """Tell of which runs the error is not finite, or DIVERGED times what the best method's is in the median, (R,)."""
    limit = DIVERGED * min(_rank(values, np.median) for values in errors.values())
    return {name: ~np.isfinite(values) | (values > limit) for name, values in errors.items()}


def robust_mean(values: Array) -> float:
    """Mean (R,) -> without the TRIMMED lowest and the TRIMMED highest runs."""
    out = int(TRIMMED * len(values))
    return float(np.sort(values)[out : len(values) - out].mean())


def _rank(values: Array, average: Callable[[Array], np.floating[Any]] = np.mean) -> float:
    """Average by which methods are put in order: what is not finite comes last."""
    with np.errstate(invalid="ignore"):
        middle = float(average(values))
    return middle if np.isfinite(middle) else np.inf


def _gap(first: Array, second: Array) -> Array:
    """Second minus first, run by run; only once where nothing differs from run to run."""
    if (first == first[0]).all() and (second == second[0]).all():
        first, second = first[:1], second[:1]
    with np.errstate(invalid="ignore"):
        gap = np.asarray(second - first, float)
        return np.where(np.abs(gap) <= ROUNDING * np.maximum(np.abs(first), np.abs(second)), 0.0, gap)


def _standard_error(gap: Array) -> float:
    if len(gap) < 2 or not np.isfinite(gap).all():
        return float("nan")
    return float(gap.std(ddof=1) / np.sqrt(len(gap)))


def _p_value(gap: Array) -> float:
    """Two-sided p-value of the paired t-test; 1 when there is no difference in any run."""
    from scipy.special import stdtr

    error = _standard_error(gap)
    if error == 0.0 or np.isnan(error):
        return float("nan") if np.isnan(error) else float(gap.mean() == 0.0)
    return float(2.0 * stdtr(len(gap) - 1, -abs(gap.mean()) / error))


def _holm(p_values: list[float]) -> list[float]:
    """Adjust p-values for their number (S. Holm 1979); NaN is no test and does not count."""
    tests = sorted((i for i, p in enumerate(p_values) if not np.isnan(p)), key=lambda i: p_values[i])
    adjusted, largest = [float("nan")] * len(p_values), 0.0
    for rank, i in enumerate(tests):
        largest = max(largest, min(1.0, (len(tests) - rank) * p_values[i]))
        adjusted[i] = largest
    return adjusted
