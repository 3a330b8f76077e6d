"""What papers print and claim."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from track_fusion.metrics.accuracy import Estimate


class Printed(float):
    """A published value by its print, where that ends in a zero, which a float forgets: Printed("10.70")."""

    def __new__(cls, text: str) -> Printed:
        """Read the print and keep it."""
        value = super().__new__(cls, text)
        value.text = text
        return value

    text: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """Something a paper claims that is no single figure, and how it is judged.

    Attributes
    ----------
    text, source : str      the claim in our words; where it stands
    needs : tuple of str    names of the figures that decide it
    holds : callable        their Estimates, in this order -> whether the claim is true of them
    """

    text: str
    source: str
    needs: tuple[str, ...]
    holds: Callable[..., bool]

    @classmethod
    def order(cls, text: str, source: str, *needs: str) -> Claim:
        """Claim that the figures ascend strictly."""

        def holds(*estimates: Estimate) -> bool:
            values = [e.value for e in estimates]
            return all(a < b for a, b in zip(values, values[1:], strict=False))

        return cls(text, source, needs, holds)

    @classmethod
    def least(cls, text: str, source: str, figure: str, others: Sequence[str]) -> Claim:
        """Claim that a figure is less than each of some others."""
        return cls(text, source, (figure, *others), lambda first, *rest: all(first.value < e.value for e in rest))

    @classmethod
    def greatest(cls, text: str, source: str, figure: str, others: Sequence[str], times: float = 1.0) -> Claim:
        """Claim that a figure exceeds so many times each of some others."""

        def holds(first: Estimate, *rest: Estimate) -> bool:
            return all(first.value > times * e.value for e in rest)

        return cls(text, source, (figure, *others), holds)
