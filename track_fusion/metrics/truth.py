"""The true states of targets, held for a while, and between their stamps by interpolation."""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.angles import wrap
from track_fusion.linalg import Array
from track_fusion.tracks import SECOND_NS, StateLayout

#: The axis that is the derivative of another.
_RATES = {"x": "vx", "y": "vy", "z": "vz", "vx": "ax", "vy": "ay", "vz": "az", "yaw": "turn_rate"}


class Known(NamedTuple):
    """What is known of one time: N targets and their states, and how many more there may have been.

    Attributes
    ----------
    targets : (N,) int64
    states : (N, n)
    unknown : int    targets with truth before, but none near enough after
    exact : bool     nothing is interpolated or unknown
    """

    targets: NDArray[np.int64]
    states: Array
    unknown: int
    exact: bool


class Truth:
    """Steps of the truth by stamp, in any order.

    Parameters
    ----------
    layout : StateLayout    n axes
    max_gap_ns : int        states farther apart are not interpolated
    whole : bool            a step comes as one table, so that who is not in it is not there; else piece by piece, some
                            of which may be lost
    """

    def __init__(self, layout: StateLayout, max_gap_ns: int, whole: bool) -> None:
        self._layout, self._max_gap_ns, self._whole = layout, max_gap_ns, whole
        self._steps: dict[int, dict[int, Array]] = {}
        self._stamps: list[int] = []  # of the steps, in order

    @property
    def stamps(self) -> tuple[int, ...]:
        """Stamps of the steps held, in order, ns."""
        return tuple(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """The last of them."""
        return self._stamps[-1] if self._stamps else None

    def has(self, stamp_ns: int) -> bool:
        """Tell whether there is a step at a time."""
        return stamp_ns in self._steps

    def add(self, stamp_ns: int, targets: Iterable[int], states: Array) -> None:
        """Take a step, or more of it; a target that was there already is replaced."""
        if stamp_ns not in self._steps:
            self._steps[stamp_ns] = {}
            bisect.insort(self._stamps, stamp_ns)
        self._steps[stamp_ns].update(zip(targets, states, strict=True))

    def forget(self, before_ns: int, most: int) -> list[int]:
        """Drop the steps before a time, and the oldest of more than so many; return their stamps."""
        count = max(bisect.bisect_left(self._stamps, before_ns), len(self._stamps) - most)
        dropped, self._stamps = self._stamps[:count], self._stamps[count:]
        for stamp in dropped:
            del self._steps[stamp]
        return dropped

    def at(self, stamp_ns: int) -> Known | None:
        """Return the states at a time; None where it lies beyond the truth or in too large a gap of it."""
        near = self._near(stamp_ns)
        if not near:
            return None
        states, unknown, exact = {}, 0, True
        for target in sorted({target for stamp in near for target in self._steps[stamp]}):
            of_target = [stamp for stamp in near if target in self._steps[stamp]]
            before = max((s for s in of_target if s <= stamp_ns), default=None)
            after = min((s for s in of_target if s >= stamp_ns), default=None)
            if before is None:  # not yet there
                continue
            if after is None or after - before > self._max_gap_ns:
                unknown += 1
                continue
            exact = exact and before == after
            states[target] = self._between(before, after, stamp_ns, target)
        rows = np.array(list(states.values())).reshape(-1, self._layout.size)
        return Known(np.array(list(states), np.int64), rows, unknown, exact and not unknown and stamp_ns in self._steps)

    def _near(self, stamp_ns: int) -> list[int]:
        """Stamps that tell of a time: its own or those around it, of pieces all that are near; empty: it is unknown."""
        at = bisect.bisect_left(self._stamps, stamp_ns)
        known = stamp_ns in self._steps
        around = [stamp_ns] if known else self._stamps[max(at - 1, 0) : at + 1]
        outside = at in (0, len(self._stamps)) or around[-1] - around[0] > self._max_gap_ns
        if not known and outside:
            return []
        if self._whole:
            return around
        first = bisect.bisect_left(self._stamps, stamp_ns - self._max_gap_ns)
        return self._stamps[first : bisect.bisect_right(self._stamps, stamp_ns + self._max_gap_ns)]

    def _between(self, before: int, after: int, stamp_ns: int, target: int) -> Array:
        start, end = self._steps[before][target], self._steps[after][target]
        if before == after:
            return start
        gap = after - before
        return interpolated(self._layout, start, end, gap / SECOND_NS, (stamp_ns - before) / gap)


def interpolated(layout: StateLayout, start: Array, end: Array, gap_s: float, share: float) -> Array:
    """Return the state a share of the way from one to the next.

    An axis whose derivative is an axis, too, follows the cubic Hermite polynomial of both, and that derivative, unless
    it has one itself, the polynomial's; any other axis a straight line. Angles go the short way round, or, where the
    turn rate is known, the way nearest to it.

    Parameters
    ----------
    start, end : (n,)    SI units
    gap_s : float        from one to the other, > 0
    share : float        0 to 1

    Returns
    -------
    (n,)
    """
    s, index = share, {name: k for k, name in enumerate(layout.axes)}
    pairs = [(k, index[_RATES[name]]) for name, k in index.items() if _RATES.get(name) in index]
    span, turned = end - start, np.zeros(layout.size)
    for axis, rate in pairs:
        turned[axis] = 0.5 * gap_s * (start[rate] + end[rate]) if layout.angular[axis] else 0.0
    span = turned + wrap(span - turned, layout.periods)
    state = start + s * span
    followed = {axis for axis, _ in pairs}
    for axis, rate in pairs:
        at_start, at_end = start[rate], end[rate]
        state[axis] = start[axis] + span[axis] * s**2 * (3 - 2 * s)
        state[axis] += gap_s * s * (s - 1) * ((s - 1) * at_start + s * at_end)
        if rate not in followed:
            state[rate] = 6 * s * (1 - s) * span[axis] / gap_s
            state[rate] += (s - 1) * (3 * s - 1) * at_start + s * (3 * s - 2) * at_end
    return wrap(state, layout.periods)
