"""How often a source sends, told from the stamps of its scans."""

from __future__ import annotations

#: So many stamps of a source tell its period: the median of their differences bears a few lost or doubled scans.
STAMPS_KEPT = 9

#: The newest stamps of a source in nanoseconds, ascending.
Stamps = tuple[int, ...]


def noted(stamps: Stamps, stamp_ns: int) -> Stamps:
    """Add the stamp of a scan; one that does not advance tells nothing of the period."""
    return stamps if stamps and stamp_ns <= stamps[-1] else (*stamps, stamp_ns)[-STAMPS_KEPT:]


def period_ns(stamps: Stamps) -> int:
    """Return the period, the median of the differences; of an even number of them the upper one; 0 = unknown yet."""
    gaps = sorted(later - earlier for earlier, later in zip(stamps, stamps[1:], strict=False))
    return gaps[len(gaps) // 2] if gaps else 0
