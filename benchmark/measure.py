"""How a job is timed, and what a benchmark reports."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

#: A timing repeats its job for at least this long, so that the clock's grain does not matter.
SHORTEST_S = 0.05
ROUNDS = 5


@dataclasses.dataclass(frozen=True)
class Result:
    """One line of the table: a job's time, and its ratio to another job's, with the target of that ratio.

    `ratio` is better when large if `at_least` is given, when small if `at_most` is given. `figure` replaces
    the time where a benchmark measures something else.
    """

    job: str
    seconds: float | None = None
    against: str = ""
    ratio: float | None = None
    at_least: float | None = None
    at_most: float | None = None
    figure: str = ""

    @property
    def passed(self) -> bool | None:
        """Whether the ratio meets its target; None = it has none."""
        if self.ratio is None or (self.at_least is None and self.at_most is None):
            return None
        return (self.at_least is None or self.ratio >= self.at_least) and (
            self.at_most is None or self.ratio <= self.at_most
        )


def race(*jobs: Callable[[], object]) -> list[float]:
    """Time jobs in turns, several rounds, and return the least seconds of each.

    Turns, so that a busy machine slows all alike; processor time, so that waiting does not count (every job
    runs in one thread); the least, because noise only adds.
    """
    repeats = [_repeats(job) for job in jobs]
    best = [float("inf")] * len(jobs)
    for _ in range(ROUNDS):
        for i, (job, repeat) in enumerate(zip(jobs, repeats, strict=True)):
            best[i] = min(best[i], _time(job, repeat))
    return best


def _repeats(job: Callable[[], object]) -> int:
    job()  # warm up
    repeat = 1
    while (took := _time(job, repeat) * repeat) < SHORTEST_S:
        repeat *= 2 if took > SHORTEST_S / 8 else 8
    return repeat


def _time(job: Callable[[], object], repeat: int) -> float:
    start = time.process_time()
    for _ in range(repeat):
        job()
    return (time.process_time() - start) / repeat
