"""What was turned away, counted by reason, and what happened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol


class Rejects(Protocol):
    """Somebody who counts what is turned away."""

    def reject(self, reasons: Mapping[str, int], text: str = "") -> None:
        """Count rejected messages or tracks by reason; `text` says more of the first of each."""


class Counts:
    """Counts by reason what was turned away, and by name what happened.

    Parameters
    ----------
    tell : callable    is told of the first of each reason, one line

    Attributes
    ----------
    rejected, counted : Counter
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell = tell
        self.rejected: Counter[str] = Counter()
        self.counted: Counter[str] = Counter()

    def reject(self, reasons: Mapping[str, int], text: str = "") -> None:
        """Count rejected messages or tracks by reason, and tell of the first of each."""
        for reason, count in reasons.items():
            if not count:
                continue
            if not self.rejected[reason]:
                self._tell(f"Rejected ({reason}): {text or 'the counts tell how many'}")
            self.rejected[reason] += count
