"""A sensor's own tracker: one target, one filter; what the tracker node carries messages to."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from track_fusion.angles import difference, wrap
from track_fusion.densities.log_domain import log_of
from track_fusion.filters.base import Density, Gaussian, TrackState
from track_fusion.filters.particle import Particles
from track_fusion.linalg import Array, is_well_conditioned, mahalanobis_squared, transpose
from track_fusion.models.base import Motion, Sensor
from track_fusion.models.choices import SENSORS, MotionChoice, square_matrix
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.params import ParameterError, Params, param
from track_fusion.trackers.filters import FILTERS, OneTargetFilter
from track_fusion.tracks import COASTED, CONFIRMED, SECOND_NS, StateLayout, TrackBatch

#: The tracker of any number of targets in clutter, many_targets.py.
MULTI_TARGET = "pda"


@dataclasses.dataclass(frozen=True)
class TrackerChoice(MotionChoice):
    """What a tracker consists of; each choice has parameters of its own."""

    sensor: str = param(
        "position",
        "what a detection holds: position = the position axes, range_bearing = range and bearing, "
        "linear = the axes of the state that sensor_axes names",
        choices=tuple(SENSORS),
    )
    filter: str = param(
        "kalman",
        "the filter of the one target; or pda: any number of targets in clutter, by probabilistic data association",
        choices=(*FILTERS, MULTI_TARGET),
    )


@dataclasses.dataclass(frozen=True)
class SensorTrackerParams(Params):
    """Initial state of a single-target tracker (every filter but pda)."""

    initial_mean: tuple[float, ...] = param(
        (), "state at initial_stamp_s in the order of the axes; empty: start from the first detection", kind=float
    )
    initial_cov: tuple[float, ...] = param((), "its covariance: n variances, or n x n row by row", kind=float)
    initial_stamp_s: float = param(0.0, "time of the initial state", unit="s", low=0.0)
    initial_speed_sd: float = param(
        10.0,
        "standard deviation of the unknown velocity when starting from a detection",
        unit="m/s",
        low=0.0,
        strict=True,
    )
    initial_turn_rate_sd: float = param(
        0.1,
        "standard deviation of the unknown turn rate, and of any further axis, when starting from a detection",
        unit="rad/s",
        low=0.0,
        strict=True,
    )
    track_id: int = param(1, "identifier of the track", low=0, high=0xFFFFFFFF)


class LostTrackError(ValueError):
    """A scan left a tracker without a track: `reason` is cannot_start or lost_track."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclasses.dataclass(frozen=True)
class _OfDetection:
    """A sensor with the noise that a detection brought."""

    sensor: Sensor
    noise: Array

    def __getattr__(self, name: str) -> Any:
        """All else is the sensor's."""
        return getattr(self.sensor, name)


class SensorTracker:
    """Tracks one target with a filter.

    Parameters
    ----------
    motion : Motion           its layout is the tracker's
    sensor : Sensor           of that layout
    track_filter : OneTargetFilter
    frame_id : str
    params : SensorTrackerParams

    Raises
    ------
    ParameterError    the initial state does not fit the layout, or its covariance is not positive definite; there is
                      none, and the sensor does not see positions, or there is a covariance alone
    """

    def __init__(
        self, motion: Motion, sensor: Sensor, track_filter: OneTargetFilter, frame_id: str, params: SensorTrackerParams
    ) -> None:
        self.motion, self.sensor, self.filter = motion, sensor, track_filter
        self.layout, self.frame_id, self.params = motion.layout, frame_id, params
        if params.initial_cov and not params.initial_mean:
            raise ParameterError("The 'initial_mean' parameter must be given with an initial_cov. Got none.")
        if not params.initial_mean and not _sees_position(sensor, self.layout):
            raise ParameterError(
                "The 'initial_mean' parameter must be given: from detections of "
                f"{', '.join(sensor.axes)} alone no track can start."
            )
        self.reset()

    def reset(self) -> None:
        """Go back to the initial state."""
        self._state: TrackState | None = None
        self._time_ns, self._provenance = -1, np.uint32(0)
        if self.params.initial_mean:
            self._begin_given()

    def _begin_given(self) -> None:
        n, mean = self.layout.size, np.array(self.params.initial_mean)
        if mean.shape != (n,):
            raise ParameterError(f"The 'initial_mean' parameter must hold {n} numbers, one an axis. Got {len(mean)}.")
        square = square_matrix("initial_cov", self.params.initial_cov, n)
        try:
            self._begin(mean, square, round(self.params.initial_stamp_s * SECOND_NS))
        except ValueError as error:
            raise ParameterError(f"The 'initial_cov' parameter does not fit: {error}") from None

    def _begin(self, mean: Array, cov: Array, time_ns: int) -> None:
        """Begin a track, if it is one: else a ValueError."""
        self._blank = TrackBatch.gaussian(
            self.layout, self.frame_id, mean[None], cov[None], track_id=np.array([self.params.track_id])
        )
        self._state, self._time_ns = self.filter.begin(self._blank.mean[0, 0], self._blank.cov[0, 0]), time_ns

    def _shown(self, state: TrackState, time_ns: int, status: int = CONFIRMED) -> TrackBatch:
        parts = state.components
        return self._blank.replace(
            weight=parts.weight[None], mean=wrap(parts.mean[None], self.layout.periods), cov=parts.cov[None],
            dof=np.array([state.dof]), time_ns=np.array([time_ns]), status=np.array([status], np.uint8),
            source=np.array([self._provenance]),
        )  # fmt: skip

    @property
    def time_ns(self) -> int:
        """Time of the current state; -1 before there is one."""
        return self._time_ns

    def step(self, time_ns: int, values: Array, covs: Array | None) -> TrackBatch:
        """Predict to a scan and update with its detection.

        Parameters
        ----------
        time_ns : int          not before the last one
        values : (D, m)        detections; with several, the statistically nearest is taken
        covs : (D, m, m)       their covariances, or None for the sensor's own

        Returns
        -------
        TrackBatch    one track, coasted when there is no detection; none before the first detection

        Raises
        ------
        LostTrackError    a detection far off or of a wild covariance was too much for the numbers; the tracker goes on
                          with the next scan
        """
        if self._state is None:
            return self._started(time_ns, values, covs)
        try:
            state = self._updated(self._state, (time_ns - self._time_ns) / SECOND_NS, values, covs)
            track = self._shown(state, time_ns, CONFIRMED if len(values) else CONFIRMED | COASTED)
            faults = ", ".join(track.faults)
        except np.linalg.LinAlgError as error:
            faults = str(error)
        if faults:
            self.reset()
            if _sees_position(self.sensor, self.layout):
                self._state, self._time_ns = None, -1  # a detection tells more than a state of long ago
            raise LostTrackError("lost_track", f"The state is no density any more ({faults}): the track starts anew.")
        self._state, self._time_ns = state, time_ns
        return track

    def _updated(self, state: TrackState, dt_s: float, values: Array, covs: Array | None) -> TrackState:
        state = self.filter.predict(state, self.motion.over(dt_s))
        if not len(values):
            return state
        noises = np.broadcast_to(self.sensor.noise, (len(values), *self.sensor.noise.shape)) if covs is None else covs
        at = self._nearest(state, values, noises) if len(values) > 1 else 0
        sensor = self.sensor if covs is None else _OfDetection(self.sensor, noises[at])
        updated: TrackState = self.filter.update(state, values[at], sensor)[0]
        return updated

    def _started(self, time_ns: int, values: Array, covs: Array | None) -> TrackBatch:
        if not len(values):
            return TrackBatch.empty(self.layout, self.frame_id)
        noise = self.sensor.noise if covs is None else covs[0]
        mean, cov = np.zeros(self.layout.size), self.params.initial_turn_rate_sd**2 * np.eye(self.layout.size)
        cov[self.layout.velocity, self.layout.velocity] = self.params.initial_speed_sd**2
        at, mean[at], cov[np.ix_(at, at)] = _seen(self.sensor, self.layout, values[0], noise)
        if not is_well_conditioned(cov):
            raise LostTrackError("cannot_start", "No track can start from the detection: it does not tell a position.")
        try:
            self._begin(mean, cov, time_ns)
        except ValueError as error:
            raise LostTrackError("cannot_start", f"No track can start from the detection: {error}") from None
        assert self._state is not None
        return self._shown(self._state, time_ns)

    def _nearest(self, state: Density, values: Array, noises: Array) -> int:
        mean, cov = state.moments
        slope = self.sensor.jacobian(mean)
        residual = self.sensor.residual(values, self.sensor.observe(mean))
        return int(np.argmin(mahalanobis_squared(residual, slope @ cov @ transpose(slope) + noises)))

    def feed_back(self, fused: TrackBatch) -> bool:
        """Take the fused posterior of the current time for one's own; tell whether there was one.

        Of several fused tracks the statistically nearest is taken; the filter brings it into its own form.
        """
        if self._state is None or not len(fused) or int(fused.time_ns[0]) != self._time_ns:
            return False
        fused, at = fused.to_axes(self.layout), 0
        if len(fused) > 1:
            own_mean, own_cov = self._state.moments
            mean, cov = fused.moments
            at = int(np.argmin(mahalanobis_squared(difference(mean, own_mean, self.layout.periods), cov + own_cov)))
        self._provenance |= fused.source[at]
        self._state = self.filter.adopt(self._state, _density(fused[at : at + 1]))
        return True


def _density(track: TrackBatch) -> Density:
    """Return a track as its particles if it consists of them, else as its merged Gaussian."""
    if track.components > 1 and not track.cov.any():
        return Particles(track.mean[0], log_of(track.weight[0]), periods=track.layout.periods)
    (mean,), (cov,) = track.moments
    return Gaussian(mean, cov)


def _sees_position(sensor: Sensor, layout: StateLayout) -> bool:
    names = {layout.axes[i] for i in layout.position}
    return isinstance(sensor, RangeBearingSensor) or names <= set(sensor.axes) <= set(layout.axes)


def _seen(sensor: Sensor, layout: StateLayout, z: Array, noise: Array) -> tuple[list[int], Array, Array]:
    """Tell which axes of the state a detection tells of, d of them, with their values (d,) and covariance (d, d)."""
    if isinstance(sensor, RangeBearingSensor):
        return list(layout.indices(("x", "y"))), *sensor.positions(z, noise)
    return list(layout.indices(sensor.axes)), z, noise
