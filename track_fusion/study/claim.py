"""What papers claim beyond single figures, as margins that are positive when the claim holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from itertools import pairwise

from track_fusion.linalg import Array

#: Figures, (L,) each, at L points -> margins, (L,) each: the claim holds where all are positive.
Margins = Callable[..., Sequence[Array]]


@dataclasses.dataclass(frozen=True)
class Claim:
    """Something a paper claims that is no single figure, and how it is judged.

    Attributes
    ----------
    text, source : str       the claim in our words; where it stands
    needs : tuple of str     names of the figures that decide it
    margins : callable       these figures, (L,) each, in this order -> what is positive where the claim holds, (L,)
                             each. Smooth in the figures; a claim that allows a tie has a margin with some slack
    by_construction : str    why no result could contradict it, being an identity or what the rule is; "" = one could
    """

    text: str
    source: str
    needs: tuple[str, ...]
    margins: Margins
    by_construction: str = ""

    @classmethod
    def order(cls, text: str, source: str, *needs: str) -> Claim:
        """Claim that the figures ascend strictly."""
        return cls(text, source, needs, ascending)

    @classmethod
    def each(
        cls,
        text: str,
        source: str,
        first: Sequence[str],
        second: Sequence[str],
        margins: Callable[[Array, Array], Sequence[Array]],
    ) -> Claim:
        """Claim that figures stand so to their counterparts, one by one."""

        def of_all(*figures: Array) -> list[Array]:
            pairs = zip(figures[: len(first)], figures[len(first) :], strict=True)
            return [margin for a, b in pairs for margin in margins(a, b)]

        return cls(text, source, (*first, *second), of_all)

    @classmethod
    def least(cls, text: str, source: str, figure: str, others: Sequence[str]) -> Claim:
        """Claim that a figure is less than each of some others."""
        return cls(text, source, (figure, *others), lambda first, *rest: [other - first for other in rest])

    @classmethod
    def greatest(cls, text: str, source: str, figure: str, others: Sequence[str], times: float = 1.0) -> Claim:
        """Claim that a figure exceeds so many times each of some others."""
        return cls(text, source, (figure, *others), lambda first, *rest: [first - times * other for other in rest])

    @classmethod
    def above(cls, text: str, source: str, bound: float, *needs: str) -> Claim:
        """Claim that figures exceed a bound."""
        return cls(text, source, needs, lambda *figures: [figure - bound for figure in figures])

    @classmethod
    def below(cls, text: str, source: str, bound: float, *needs: str) -> Claim:
        """Claim that figures are less than a bound."""
        return cls(text, source, needs, lambda *figures: [bound - figure for figure in figures])

    @classmethod
    def near(cls, text: str, source: str, value: float, tolerance: float, *needs: str) -> Claim:
        """Claim that figures lie within a tolerance of a value."""
        return cls(text, source, needs, lambda *figures: [m for f in figures for m in within(f - value, tolerance)])

    @classmethod
    def close(cls, text: str, source: str, share: float, to: str, *others: str) -> Claim:
        """Claim that figures lie within this share of another one."""

        def margins(wanted: Array, *figures: Array) -> list[Array]:
            return [margin for figure in figures for margin in within(figure - wanted, share * wanted)]

        return cls(text, source, (to, *others), margins)


def ascending(*figures: Array) -> list[Array]:
    """Margins of figures that ascend strictly."""
    return [b - a for a, b in pairwise(figures)]


def within(difference: Array, tolerance: Array | float) -> tuple[Array, Array]:
    """Margins of a difference whose size is less than the tolerance."""
    return tolerance - difference, tolerance + difference
