"""A sensor's own tracker: one target, one filter; what the tracker node carries messages to."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.filters.kalman import predict, update
from track_fusion.linalg import Array, mahalanobis_squared
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import NearlyConstantVelocity
from track_fusion.params import ParameterError, Params, param
from track_fusion.tracks import COASTED, CONFIRMED, TrackBatch

SECOND_NS = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class SensorTrackerParams(Params):
    """Filter, sensor and initial state of a single-target tracker."""

    filter: str = param("kalman", "the filter", choices=("kalman",))
    sensor: str = param(
        "position", "what a detection holds: position = the position axes, in metres", choices=("position",)
    )
    sensor_sd: float = param(
        1.0, "standard deviation of a detection that brings no covariance", unit="m", low=0.0, strict=True
    )
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
    track_id: int = param(1, "identifier of the track", low=0, high=0xFFFFFFFF)


class SensorTracker:
    """Tracks one target with a Kalman filter.

    Parameters
    ----------
    motion : NearlyConstantVelocity    its layout is the tracker's
    frame_id : str
    params : SensorTrackerParams

    Raises
    ------
    ParameterError    the initial state does not fit the layout, or its covariance is not positive definite
    """

    def __init__(self, motion: NearlyConstantVelocity, frame_id: str, params: SensorTrackerParams) -> None:
        self.motion, self.layout, self.frame_id, self.params = motion, motion.layout, frame_id, params
        self.sensor = LinearSensor.position(motion.layout, params.sensor_sd)
        self.reset()

    def reset(self) -> None:
        """Go back to the initial state."""
        self._track = self._initial() if self.params.initial_mean else None
        self._provenance = np.uint32(0)

    def _initial(self) -> TrackBatch:
        n, mean, cov = self.layout.size, np.array(self.params.initial_mean), np.array(self.params.initial_cov)
        if mean.shape != (n,):
            raise ParameterError(f"The 'initial_mean' parameter must hold {n} numbers, one an axis. Got {len(mean)}.")
        if cov.size not in (n, n * n):
            raise ParameterError(f"The 'initial_cov' parameter must hold {n} or {n * n} numbers. Got {cov.size}.")
        square = np.diag(cov) if cov.size == n else cov.reshape(n, n)
        try:
            return self._batch(mean, square, round(self.params.initial_stamp_s * SECOND_NS), CONFIRMED)
        except ValueError as error:
            raise ParameterError(f"The 'initial_cov' parameter does not fit: {error}") from None

    def _batch(self, mean: Array, cov: Array, time_ns: int, status: int) -> TrackBatch:
        return TrackBatch.gaussian(
            self.layout, self.frame_id, mean[None], cov[None],
            time_ns=time_ns, track_id=np.array([self.params.track_id]), status=status,
        )  # fmt: skip

    @property
    def time_ns(self) -> int:
        """Time of the current state; -1 before there is one."""
        return -1 if self._track is None else int(self._track.time_ns[0])

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
        """
        if self._track is None:
            self._track = self._started(time_ns, values, covs)
            return self._track if self._track is not None else TrackBatch.empty(self.layout, self.frame_id)
        transition, noise = self.motion.matrices((time_ns - self.time_ns) / SECOND_NS)
        mean, cov = predict(self._track.mean[0, 0], self._track.cov[0, 0], transition, noise)
        if len(values):
            noises = (
                np.broadcast_to(self.sensor.noise, (len(values), *self.sensor.noise.shape)) if covs is None else covs
            )
            at = self._nearest(mean, cov, values, noises) if len(values) > 1 else 0
            mean, cov, _ = update(mean, cov, values[at], self.sensor.matrix, noises[at])
        self._track = self._track.replace(
            mean=mean[None, None],
            cov=cov[None, None],
            time_ns=np.array([time_ns]),
            status=np.array([CONFIRMED if len(values) else CONFIRMED | COASTED], np.uint8),
            source=np.array([self._provenance]),
        )
        return self._track

    def _started(self, time_ns: int, values: Array, covs: Array | None) -> TrackBatch | None:
        if not len(values):
            return None
        mean = values[0] @ self.sensor.matrix
        cov = np.eye(self.layout.size) * self.params.initial_speed_sd**2
        at = np.array(self.layout.position)
        cov[at[:, None], at] = self.sensor.noise if covs is None else covs[0]
        return self._batch(mean, cov, time_ns, CONFIRMED)

    def _nearest(self, mean: Array, cov: Array, values: Array, noises: Array) -> int:
        matrix = self.sensor.matrix
        return int(np.argmin(mahalanobis_squared(values - matrix @ mean, matrix @ cov @ matrix.T + noises)))

    def feed_back(self, fused: TrackBatch) -> bool:
        """Take the fused posterior of the current time for one's own; tell whether there was one.

        Of several fused tracks the statistically nearest is taken; a mixture is merged.
        """
        if self._track is None or not len(fused) or int(fused.time_ns[0]) != self.time_ns:
            return False
        mean, cov = fused.to_axes(self.layout).moments
        at = 0
        if len(mean) > 1:
            at = int(np.argmin(mahalanobis_squared(mean - self._track.mean[0, 0], cov + self._track.cov[0, 0])))
        self._provenance |= fused.source[at]
        self._track = self._track.replace(mean=mean[at][None, None], cov=cov[at][None, None])
        return True
