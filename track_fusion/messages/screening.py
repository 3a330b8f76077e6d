"""The frame and axes of a node's states, and the screening of what arrives in them."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from msg_adapters.arrays import DetectionArrays, MessageError, TrackArrays
from track_fusion.angles import KNOWN_PERIODS, named_period, periods_of
from track_fusion.linalg import Array, is_positive_definite, symmetrise
from track_fusion.messages.counts import Rejects
from track_fusion.params import ParameterError, Params, param
from track_fusion.tracks import ABSURD, SECOND_NS, StateLayout, TrackBatch


@dataclasses.dataclass(frozen=True)
class FrameParams(Params):
    """In which frame and axes a node works."""

    frame_id: str = param("map", "frame of every state; messages in another frame are rejected")
    axes: tuple[str, ...] = param(("x", "y", "vx", "vy"), "axes of the state, in order")
    angular: tuple[str, ...] = param(
        (),
        "further axes that are angles in radians and wrap at pi, beside those of known names: "
        + ", ".join(KNOWN_PERIODS)
        + "; 'yaw:pi' where the sign is unknown, as of a box: period pi",
        kind=str,
    )
    max_future_s: float = param(
        0.5, "reject messages stamped further ahead of the node's clock than this", unit="s", low=0.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [named_period(spelt)[0] for spelt in self.angular]
        for k, (name, spelt) in enumerate(zip(names, self.angular, strict=True)):
            if name not in self.axes:
                axes = ", ".join(self.axes)
                raise ParameterError(f"The 'angular' parameter must name axes of {axes}. Got {spelt!r}.")
            if name in names[:k]:
                raise ParameterError(
                    f"The 'angular' parameter must name an axis once. Got {spelt!r} after another {name!r}."
                )

    @property
    def layout(self) -> StateLayout:
        """The axes, and which of them wrap."""
        return StateLayout(self.axes, periods_of(self.axes, dict(map(named_period, self.angular))))

    @property
    def max_future_ns(self) -> int:
        """The same in nanoseconds."""
        return round(self.max_future_s * SECOND_NS)


def screened_tracks(counts: Rejects, arrays: TrackArrays, layout: StateLayout) -> TrackBatch:
    """Turn decoded arrays into a checked batch in the node's layout; bad tracks are left out and counted.

    Raises
    ------
    MessageError    `missing_axis`: the message lacks an axis of the layout; `phd_mixture`: it holds un-normalised
                    mixtures, which say how many targets there are and not where one is
    """
    if arrays.phd:
        raise MessageError("phd_mixture", "The rows are un-normalised (PHD) mixtures; this node takes one target each.")
    batch, rejected = TrackBatch.screened(layout=StateLayout(arrays.axes), **arrays.columns)
    if rejected:
        ids = sorted(set(arrays.track_id.tolist()) - set(batch.track_id.tolist()))[:5]
        counts.reject(rejected, f"in a scan of {len(arrays.track_id)} tracks, track {', '.join(map(str, ids))}")
    try:
        return batch.to_axes(layout)
    except ValueError as error:
        raise MessageError("missing_axis", str(error)) from None


def screened_detections(counts: Rejects, scan: DetectionArrays) -> tuple[Array, Array | None]:
    """Return the usable detections, (D, m) and (D, m, m) or None; bad ones are left out and counted by reason."""
    good, cov = np.ones(len(scan.value), bool), scan.cov
    for reason, bad in _bad_detections(scan).items():
        counts.reject({reason: int((bad & good).sum())})
        good &= ~bad
    if cov is None:
        return scan.value[good], None
    value, cov = scan.value[good], symmetrise(cov[good])
    definite = is_positive_definite(cov)
    counts.reject({"not_positive_definite": int((~definite).sum())})
    return value[definite], cov[definite]


def _bad_detections(scan: DetectionArrays) -> dict[str, NDArray[np.bool_]]:
    """Tell by reason which detections are bad, in the order in which reasons are reported."""
    finite = np.asarray(np.isfinite(scan.value).all(1))
    size = np.zeros(len(finite)) if scan.cov is None else np.sqrt(np.abs(scan.cov).max((1, 2), initial=0.0))
    finite &= np.isfinite(size)
    reasons = {
        "not_finite": ~finite,
        "absurd_value": (np.abs(scan.value).max(1, initial=0.0) > ABSURD) | (size > ABSURD),
    }
    if "range" in scan.axes:
        reasons["negative_range"] = scan.value[:, scan.axes.index("range")] < 0.0
    return reasons
