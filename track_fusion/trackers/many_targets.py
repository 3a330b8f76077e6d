"""A radar's own tracker: any number of targets in clutter, by probabilistic data association with existence.

Tracks start from pairs of detections in successive scans that no track claims, are confirmed and deleted by their
probability of existence, and merged when they have become one.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, triu

from track_fusion.angles import TURN, difference, wrap
from track_fusion.association.boxes import points_in_boxes
from track_fusion.filters.base import Gaussian
from track_fusion.filters.extended import Extended
from track_fusion.filters.probabilistic_data_association import (
    Candidate,
    ClutterParams,
    ProbabilisticDataAssociation,
    Scan,
)
from track_fusion.linalg import Array, mahalanobis_squared
from track_fusion.models.base import Motion
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.params import param
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import CONFIRMED, SECOND_NS, TrackBatch

#: Detections are searched in boxes around the gates, wider by this share of themselves.
ROUNDING = 1e-9
#: A detection counts as claimed when it is a track's with at least this probability.
CLAIMED = 0.1
#: A detection that could begin more tracks than this lies in a crowd, and begins the likeliest alone. Clutter of
#: thousands, spread as clutter is, stays below.
CROWD = 64

Indices = NDArray[np.intp]


@dataclasses.dataclass(frozen=True)
class PdaTrackerParams(ClutterParams):
    """When tracks begin, count and end."""

    birth_existence: float = param(0.1, "existence probability of a track begun from two detections", low=0.0, high=1.0)
    confirmation_existence: float = param(0.99, "a track counts from this probability on", low=0.0, high=1.0)
    deletion_existence: float = param(0.01, "a track ends below this probability", low=0.0, high=1.0)
    speed_sd: float = param(150.0, "standard deviation of each axis of an unknown velocity", unit="m/s", low=0.0,
                            strict=True)  # fmt: skip
    merge_probability: float = param(
        0.5, "two tracks are one when their distance lies within this quantile of chi-square", low=0.0, high=1.0
    )
    max_tentative_tracks: int = param(
        20_000, "keep at most so many tracks that do not count yet; the oldest are dropped and counted", low=1
    )


@dataclasses.dataclass(frozen=True)
class PdaTracks(Candidate):
    """What a tracker carries from scan to scan: N candidates.

    Attributes
    ----------
    confirmed : (N,) bool        once true, until deletion
    track_id : (N,)              ascending
    leftover : (D, m)            detections of the last scan that no track claimed
    next_id : int
    dropped : int                how many were dropped so far, being too many tentative ones
    """

    confirmed: NDArray[np.bool_]
    track_id: NDArray[np.int64]
    leftover: Array
    next_id: int
    dropped: int = 0

    @classmethod
    def none(cls, axes: int, measured: int) -> PdaTracks:
        """No tracks, of `axes` axes, and no detections of `measured`."""
        empty = np.zeros((0, axes))
        ids, flags = np.zeros(0, np.int64), np.zeros(0, bool)
        return cls(empty, np.zeros((0, axes, axes)), np.zeros(0), flags, ids, np.zeros((0, measured)), 1)

    def __getitem__(self, key: Indices | NDArray[np.bool_]) -> PdaTracks:
        """Return some of the tracks."""
        names = ("mean", "cov", "existence", "confirmed", "track_id")
        return dataclasses.replace(self, **{name: getattr(self, name)[key] for name in names})

    def with_rows(self, at: Indices, rows: Candidate) -> PdaTracks:
        """Return the tracks with other densities and existence at some rows."""
        changed = {name: getattr(self, name).copy() for name in ("mean", "cov", "existence")}
        for name, values in changed.items():
            values[at] = getattr(rows, name)
        return dataclasses.replace(self, **changed)


class PdaTracker:
    """Tracks every target that one range-bearing sensor sees.

    Parameters
    ----------
    motion : Motion                 its layout is the tracker's
    sensor : RangeBearingSensor     of that layout
    frame_id : str
    params : PdaTrackerParams

    References     Sharma 6.4 (PDA); D. Musicki et al. 1994 (existence).
    """

    def __init__(self, motion: Motion, sensor: RangeBearingSensor, frame_id: str, params: PdaTrackerParams) -> None:
        self.motion, self.sensor, self.frame_id, self.params = motion, sensor, frame_id, params
        self.layout, self._filter = motion.layout, ProbabilisticDataAssociation(params)
        self._gamma = chi_square_quantile(params.gate_probability, len(sensor.noise))
        self.reset()

    def reset(self) -> None:
        """Forget all."""
        self.tracks = PdaTracks.none(self.motion.layout.size, len(self.sensor.noise))
        self.time_ns = -1

    def step(self, time_ns: int, values: Array, covs: Array | None = None) -> TrackBatch:
        """Predict to a scan and update with it.

        Parameters
        ----------
        time_ns : int      not before the last one
        values : (D, 2)    range and bearing of all detections; none is a scan too
        covs : (D, 2, 2)   not used: the sensor's noise is that of every detection

        Returns
        -------
        TrackBatch    the confirmed tracks
        """
        dt_s = 0.0 if self.time_ns < 0 else (time_ns - self.time_ns) / SECOND_NS
        self.time_ns = time_ns
        values = wrap(values, self.sensor.periods)
        tracks, claimed = self._updated(self._filter.predict(self.tracks, self.motion.over(dt_s)), values)
        free = values[~claimed]
        self.tracks = dataclasses.replace(self._capped(self._begun(tracks, free, dt_s)), leftover=free)
        return self._batch(self.tracks[self.tracks.confirmed])

    def _updated(self, tracks: PdaTracks, values: Array) -> tuple[PdaTracks, NDArray[np.bool_]]:
        """Associate the scan with every track, end and merge tracks; tell also which detections tracks claim."""
        row, col = self._near(tracks.mean, tracks.cov, values)
        used, row = np.unique(row, return_inverse=True)  # the others miss: their states stay
        candidate, present = _padded(row, col, len(used))
        claimed, after = np.zeros(len(values), bool), self._filter.missed(tracks)
        if len(used):
            part, learned = self._filter.update(tracks[used], Scan(values[candidate], present), self.sensor)
            after = after.with_rows(used, part)
            claimed[candidate[learned.gated & (learned.weight[..., :-1] >= CLAIMED)]] = True
            present = learned.gated
        tracks = dataclasses.replace(
            after, confirmed=tracks.confirmed | (after.existence >= self.params.confirmation_existence)
        )
        stays = tracks.existence >= self.params.deletion_existence
        track, place = np.nonzero(present & stays[used, None])
        stays[self._doubled(tracks, used[track], candidate[track, place])] = False
        return tracks[stays], claimed

    def _near(self, mean: Array, cov: Array, values: Array) -> tuple[Indices, Indices]:
        """Pairs of track and detection: all that lie in the gate, and some outside; ordered by track."""
        slope = self.sensor.jacobian(mean)
        variance = ((slope @ cov) * slope).sum(-1) + np.diagonal(self.sensor.noise)
        reach = np.sqrt(self._gamma * variance) * (1.0 + ROUNDING)
        reach[:, 1] = np.minimum(reach[:, 1], 0.5 * TURN)
        expected = self.sensor.observe(mean)
        return points_in_boxes(values, expected - reach, expected + reach, TURN)

    def _doubled(self, tracks: PdaTracks, row: Indices, col: Indices) -> Indices:
        """Tracks that have come to be another; of two the confirmed one stays, else the older.

        Only tracks that have a detection in common, by the pairs of track and detection given, can come to be one.
        """
        shape = len(tracks.mean), int(col.max(initial=0)) + 1
        owner = coo_array((np.ones(len(row), np.int32), (row, col)), shape=shape).tocsr()
        pairs = triu(owner @ owner.T, 1).tocoo()
        old, new = pairs.row.astype(np.intp), pairs.col.astype(np.intp)
        gap = difference(tracks.mean[old], tracks.mean[new], self.layout.periods)
        distance = mahalanobis_squared(gap, tracks.cov[old] + tracks.cov[new])
        same = distance <= chi_square_quantile(self.params.merge_probability, self.motion.layout.size)
        newer_stays = tracks.confirmed[new] & ~tracks.confirmed[old]
        return np.where(newer_stays, old, new)[same]

    def _begun(self, tracks: PdaTracks, free: Array, dt_s: float) -> PdaTracks:
        """Begin a track from each pair of unclaimed detections of the last scan and this that may be one target."""
        layout = self.motion.layout
        first, first_cov = self.sensor.positions(tracks.leftover)
        mean, cov = np.zeros((len(first), layout.size)), np.zeros((len(first), layout.size, layout.size))
        at, rate = np.array(layout.position), np.array(layout.velocity)
        mean[:, at], cov[:, at[:, None], at] = first, first_cov
        cov[:, rate, rate] = self.params.speed_sd**2
        start = Extended().predict(Gaussian(mean, cov), self.motion.over(dt_s))
        row, col = self._near(start.mean, start.cov, free)
        begun, learned = Extended().update(Gaussian(start.mean[row], start.cov[row]), free[col], self.sensor)
        gated = np.flatnonzero(learned.nis <= self._gamma)
        gated = gated[_thinned(col[gated], learned.nis[gated])]
        mean, cov = begun.mean[gated], begun.cov[gated]
        count = len(mean)
        return PdaTracks(
            np.concatenate([tracks.mean, mean]),
            np.concatenate([tracks.cov, cov]),
            np.concatenate([tracks.existence, np.full(count, self.params.birth_existence)]),
            np.concatenate([tracks.confirmed, np.zeros(count, bool)]),
            np.concatenate([tracks.track_id, tracks.next_id + np.arange(count)]),
            tracks.leftover,
            tracks.next_id + count,
            tracks.dropped,
        )

    def _capped(self, tracks: PdaTracks) -> PdaTracks:
        """Drop the oldest tentative tracks that are too many."""
        tentative = ~tracks.confirmed
        surplus = int(np.count_nonzero(tentative)) - self.params.max_tentative_tracks
        if surplus <= 0:
            return tracks
        kept = tracks[~tentative | (np.cumsum(tentative) > surplus)]
        return dataclasses.replace(kept, dropped=tracks.dropped + surplus)

    def _batch(self, tracks: PdaTracks) -> TrackBatch:
        if not len(tracks.mean):
            return TrackBatch.empty(self.motion.layout, self.frame_id)
        return TrackBatch.gaussian(
            self.layout, self.frame_id, wrap(tracks.mean, self.layout.periods), tracks.cov,
            time_ns=self.time_ns, track_id=tracks.track_id, existence=tracks.existence, status=CONFIRMED,
        )  # fmt: skip


def _thinned(col: Indices, nis: Array) -> NDArray[np.bool_]:
    """Tell which of the tracks begun, (B,), are kept: of a detection in a crowd the likeliest alone."""
    crowded = np.bincount(col)[col] > CROWD
    if not crowded.any():
        return ~crowded
    order = np.lexsort((nis, col))
    kept = ~crowded
    kept[order[np.unique(col[order], return_index=True)[1]]] = True
    return kept


def _padded(row: Indices, col: Indices, rows: int) -> tuple[Indices, NDArray[np.bool_]]:
    """Turn pairs, ordered by row, into a table: for each row its columns (rows, C), and which are there (rows, C)."""
    count = np.bincount(row, minlength=rows)
    present = np.arange(int(count.max(initial=0))) < count[:, None]
    table = np.zeros(present.shape, np.intp)
    table[present] = col
    return table, present
