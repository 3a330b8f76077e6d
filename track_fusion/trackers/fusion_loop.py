"""The loop of fusion with feedback: all predict and update, what they tell is fused, and the fused goes back to all.

The ROS nodes are the same loop with messages in place of calls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Generic, Protocol, TypeVar

from track_fusion.filters.base import Density, Filter, TrackFilter

S = TypeVar("S")
M = TypeVar("M")
Z = TypeVar("Z")
H = TypeVar("H")
T = TypeVar("T")
F = TypeVar("F")
R = TypeVar("R")
T_co = TypeVar("T_co", covariant=True)
F_contra = TypeVar("F_contra", contravariant=True)


class Participant(Protocol[T_co, F_contra]):
    """A tracker that takes part: :class:`BatchTracker`, or :class:`~track_fusion.trackers.one_target.SensorTracker`."""

    def step(self, *args: Any, **kwargs: Any) -> T_co:
        """Predict to a scan and update with it; tell the track."""

    def feed_back(self, fused: F_contra, /) -> object:
        """Take the fused track of the current time for one's own."""


def fusion_loop(
    participants: Sequence[Participant[T, F]],
    scans: Iterable[Sequence[Sequence[Any]]],
    fuse: Callable[[Sequence[T]], tuple[R, F]],
) -> Iterator[R]:
    """Yield the result of each step.

    Parameters
    ----------
    participants : K trackers
    scans : step by step, for each participant the arguments of its `step`
    fuse : callable    K tracks -> the result, and what goes back to all
    """
    for each in scans:
        result, fused = fuse([p.step(*scan) for p, scan in zip(participants, each, strict=True)])
        yield result
        for participant in participants:
            participant.feed_back(fused)


def filtered(one: Filter[S, M, Z, H, object], state: S, motion: M, scans: Iterable[Z], sensor: H) -> Iterator[S]:
    """Yield the states of a filter that predicts over equal intervals and updates with each scan; nothing is fused."""
    for z in scans:
        state, _ = one.update(one.predict(state, motion), z, sensor)
        yield state


class BatchTracker(Generic[S, M, Z, H]):
    """Tracks one target in many Monte Carlo runs at once with a filter, step by step over equal intervals.

    With several sensors it stands for as many trackers that hold one state, since each was fed the same: all update by
    themselves, from one prediction.

    Parameters
    ----------
    one : TrackFilter
    state                   at the start, of all runs
    motion                  over each interval
    sensors
    """

    def __init__(self, one: TrackFilter[S, M, Z, H, object], state: S, motion: M, sensors: Sequence[H]) -> None:
        self._filter, self._state, self._motion, self._sensors = one, state, motion, sensors

    def step(self, *zs: Z) -> list[S]:
        """Predict one interval and update with what each sensor saw in all runs, (R, m); return the state by each."""
        predicted = self._filter.predict(self._state, self._motion)
        states = [self._filter.update(predicted, z, sensor)[0] for z, sensor in zip(zs, self._sensors, strict=True)]
        self._state = states[0]  # of several, all go on from what is fed back
        return states

    def feed_back(self, fused: Density) -> None:
        """Take the fused densities for one's own."""
        self._state = self._filter.adopt(self._state, fused)
