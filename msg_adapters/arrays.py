"""Plain arrays on the library's side of an adapter: no ROS, no track_fusion."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
#: What stands for a position-velocity block that a message cannot carry: none, or a bound of every possible one.
CrossBlock = Literal["block_diagonal", "conservative"]


class MessageError(ValueError):
    """A message cannot be read; `reason` is the snake_case key under which it is counted."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class TrackLike(Protocol):
    """What the writers need of a batch of tracks; TrackArrays and the library's TrackBatch have it.

    Shapes as in :class:`TrackArrays`. The axes are passed beside it, since a TrackBatch keeps them in its layout.
    """

    @property
    def frame_id(self) -> str:
        """Frame of every state."""

    @property
    def weight(self) -> Floats:
        """Mixture weights (N, C)."""

    @property
    def mean(self) -> Floats:
        """Means (N, C, n)."""

    @property
    def cov(self) -> Floats:
        """Covariances (N, C, n, n)."""

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """Times of validity (N,), ns."""

    @property
    def track_id(self) -> NDArray[np.int64]:
        """Identities (N,)."""

    @property
    def source(self) -> NDArray[np.uint32]:
        """Provenance bits (N,)."""

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status bits (N,)."""

    @property
    def existence(self) -> Floats:
        """Existence probabilities (N,)."""

    @property
    def dof(self) -> Floats:
        """Degrees of freedom (N,), inf = Gaussian."""

    @property
    def uuid(self) -> NDArray[np.uint8] | None:
        """Global identities (N, 16), or None."""

    @property
    def phd(self) -> bool:
        """Whether weights need not sum to 1."""


class MergedLike(TrackLike, Protocol):
    """Tracks that know their moments, for messages that carry one Gaussian a track; the library's TrackBatch does."""

    @property
    def moments(self) -> tuple[Floats, Floats]:
        """Mean (N, n) and covariance (N, n, n) of each track, its mixture merged, angles on the circle."""


@dataclasses.dataclass(frozen=True, eq=False)
class TrackArrays:
    """N tracks of C components as decoded from a message; values are not judged here.

    Shapes as in `track_fusion.tracks.TrackBatch`, whose field names these are: weight (N, C),
    mean (N, C, n), cov (N, C, n, n), the others (N,), uuid (N, 16) or None. Components are padded
    with weight 0, repeating the first.
    """

    axes: tuple[str, ...]
    frame_id: str
    weight: Floats
    mean: Floats
    cov: Floats
    time_ns: NDArray[np.int64]
    track_id: NDArray[np.int64]
    source: NDArray[np.uint32]
    status: NDArray[np.uint8]
    existence: Floats
    dof: Floats
    uuid: NDArray[np.uint8] | None = None
    phd: bool = False

    @property
    def columns(self) -> dict[str, Any]:
        """All but the axes, by name: what a TrackBatch takes beside its layout."""
        return {name: value for name, value in vars(self).items() if name != "axes"}


class RawScan(NamedTuple):
    """The tracks of messages of one stamp and frame, in the order in which they came."""

    stamp_ns: int
    frame_id: str
    tracks: TrackArrays


class RawReading(NamedTuple):
    """Scans in the order of their first messages; errors; of how many tracks something was supplied."""

    scans: list[RawScan]
    errors: list[MessageError]
    supplied: int


def slots_of(axes: Sequence[str], slots: Mapping[str, int], message: str) -> NDArray[np.intp]:
    """Return where a message has the axes.

    Raises
    ------
    MessageError    `missing_axis`: it has no place for one, or there is none
    """
    missing = [a for a in axes if a not in slots]
    if missing or not axes:
        got = ", ".join(missing) or "none"
        raise MessageError("missing_axis", f"The axes of {message} must be of {', '.join(slots)}. Got {got}.")
    return np.array([slots[a] for a in axes])


def one_track(
    axes: tuple[str, ...], frame_id: str, mean: Floats, cov: Floats, *, time_ns: int, track_id: int, status: int
) -> TrackArrays:
    """Make the arrays of one certain Gaussian track from mean (n,) and cov (n, n)."""
    return TrackArrays(
        axes=axes, frame_id=frame_id, weight=np.ones((1, 1)), mean=mean[None, None], cov=cov[None, None],
        time_ns=np.array([time_ns], np.int64), track_id=np.array([track_id], np.int64),
        source=np.zeros(1, np.uint32), status=np.array([status], np.uint8),
        existence=np.ones(1), dof=np.full(1, np.inf),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class DetectionArrays:
    """N detections of one scan: value (N, m), cov (N, m, m) or None when the message carries none."""

    axes: tuple[str, ...]
    frame_id: str
    time_ns: int
    value: Floats
    cov: Floats | None
