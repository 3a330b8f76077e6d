"""Rows of a study: those wanted, measured one after the other, or one run after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.params import unknown_name_error

T = TypeVar("T")
#: What came of R Monte Carlo runs by name, (R, ...) each: along the first axes runs are joined.
Outcomes = dict[str, Array]
#: Is told which share is done.
Progress = Callable[[float], None]
#: A row in which nothing is random: () -> {quantity: value}.
Exact = Callable[[], Mapping[str, Any]]


def chosen(rows: Mapping[str, T], only: str) -> dict[str, T]:
    """Return the rows whose names start with `only`.

    Raises
    ------
    ParameterError    there is none; the message lists the rows
    """
    wanted = {name: row for name, row in rows.items() if name.startswith(only)}
    if not wanted:
        raise unknown_name_error(only, rows, "row")
    return wanted


def row_by_row(rows: Mapping[str, T], progress: Progress, measure: Callable[[T], Mapping[str, Array]]) -> Outcomes:
    """Measure every row: measure(row) -> {quantity: (R, ...)} gives {row/quantity: (R, ...)}."""
    outcomes: Outcomes = {}
    for done, (name, row) in enumerate(rows.items(), 1):
        outcomes |= {f"{name}/{quantity}": values for quantity, values in measure(row).items()}
        progress(done / len(rows))
    return outcomes


def run_by_run(runs: Sequence[int], progress: Progress, one: Callable[[int, Progress], Mapping[str, Any]]) -> Outcomes:
    """Work on each run by itself: one(run, progress) -> {name: (...)} gives {name: (R, ...)}."""

    def part(done: int) -> Progress:
        return lambda share: progress((done + share) / len(runs))

    each = [one(run, part(done)) for done, run in enumerate(runs)]
    return {name: np.array([outcome[name] for outcome in each]) for name in each[0]}


def exact_rows(
    rows: Mapping[str, Exact], runs: Sequence[int], seed: int, progress: Progress, only: str = ""
) -> Outcomes:
    """Work out the rows whose names start with `only`, in which nothing is random: every run has the same numbers."""

    def repeated(work_out: Exact) -> Outcomes:
        return {quantity: np.array([value] * len(runs)) for quantity, value in work_out().items()}

    return row_by_row(chosen(rows, only), progress, repeated)


def exact_figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Figures of numbers, (R,) each, in which nothing is random."""
    return {name: Estimate.exact(values[0]) for name, values in outcomes.items()}


def joined(parts: Sequence[Outcomes]) -> Outcomes:
    """Join the outcomes of successive runs."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
