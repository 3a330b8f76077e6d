"""Stage 1 and 2 of a step: which tracks take part, predicted once, to its time."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.angles import wrap
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.declared import as_declared, bare
from track_fusion.centre.links import key_of
from track_fusion.centre.state import Bools, CentralTracks
from track_fusion.filters.base import Gaussian
from track_fusion.filters.extended import Extended
from track_fusion.linalg import RIDGE, Array, is_well_conditioned
from track_fusion.models.base import Motion
from track_fusion.rules import Mixture, SourceTracks
from track_fusion.tracks import COASTED, CONFIRMED, SECOND_NS, TrackBatch

#: Added to variances that may be zero, as those of particles that coincide; SI units squared.
LEAST_VARIANCE = 1e-24

Rows = NDArray[np.intp]


def admitted(
    config: CentreConfig, newest: Sequence[TrackBatch | None], time_ns: int, scans: Mapping[int, TrackBatch]
) -> tuple[TrackBatch | None, ...]:
    """Take new scans into the newest of each source, (S,), brought into the centre's axes and frame, angles wrapped.

    Left out are source tracks that the parameters exclude, and identities: a central track's is its own.

    Raises
    ------
    ValueError    a scan is in other axes or another frame than its source's, of un-normalised mixtures, or late
    """
    held = list(newest)
    for source, scan in scans.items():
        _check(config, source, scan, time_ns)
        keep = _kept(config, scan)
        scan = scan if keep.all() else scan[keep]
        transform = config.sources[source].transform
        brought = scan if transform is None else transform(scan, config.layout, config.frame_id)
        own = brought.replace(uuid=None, mean=wrap(brought.mean, config.layout.periods))
        held[source] = as_declared(config, source, own).owned()
    return tuple(held)


def _check(config: CentreConfig, source: int, scan: TrackBatch, time_ns: int) -> None:
    own = config.sources[source].transform or config
    if (scan.layout, scan.frame_id, scan.phd) != (own.layout, own.frame_id, False):
        kind = " as un-normalised mixtures (PHD)" if scan.phd else ""
        raise ValueError(
            f"A scan must hold {', '.join(own.layout.axes)} in '{own.frame_id}', its mixtures normalised. "
            f"Got {', '.join(scan.layout.axes)} in '{scan.frame_id}'{kind}."
        )
    if len(scan) and scan.time_ns.max() > time_ns:
        raise ValueError(f"A scan must not be later than the fusion time {time_ns} ns. Got {scan.time_ns.max()}.")


def _kept(config: CentreConfig, scan: TrackBatch) -> Bools:
    params = config.params
    decisive = CONFIRMED * params.fuse_confirmed_only | COASTED * (not params.fuse_coasted)
    return np.asarray(scan.status & decisive == CONFIRMED & decisive)


@dataclasses.dataclass(frozen=True, eq=False)
class Pool:
    """All tracks of a step, predicted to its time: P of the sources, in source order, then T central ones.

    Attributes
    ----------
    tracks : TrackBatch    P + T
    mean, cov              moments of each, (P + T, n) and (P + T, n, n), fit to be inverted
    has                    which axes each really has, (P + T, n)
    source, stamp_ns       source and own stamp of each source track, (P,)
    bit                    provenance that each brings to a fusion, (P + T,): its source's bit, none for a central one
    particles              which came as particles, (P + T,); predicted over a time they have covariances
    """

    tracks: TrackBatch
    mean: Array
    cov: Array
    has: Bools
    source: Rows
    stamp_ns: NDArray[np.int64]
    bit: NDArray[np.uint32]
    particles: Bools

    @classmethod
    def of(
        cls, config: CentreConfig, newest: Sequence[TrackBatch | None], central: CentralTracks, fresh: Bools,
        time_ns: int,
    ) -> Pool:  # fmt: skip
        """Predict the newest scans that take part, and the central tracks.

        Parameters
        ----------
        newest : (S,)    newest scan of each source
        fresh : (S,)     whether it is new
        """
        scans = {
            k: scan for k, scan in enumerate(newest)
            if scan is not None and (fresh[k] or not config.params.memory) and _is_young(config, scan, time_ns)
        }  # fmt: skip
        before = [*scans.values(), central.tracks.replace(uuid=None)]  # an identity takes no part in a fusion
        after = [predicted_to(batch, time_ns, config.motion) for batch in before]
        tracks = TrackBatch.concatenate(after)
        mean, cov = tracks.moments
        if tracks.components == 1:
            particles = np.zeros(len(tracks), bool)
            sound = conditioned(cov, np.concatenate([batch.well_conditioned[:, 0] for batch in after]))
            tracks = tracks.replace(cov=sound[:, None])
        else:
            particles, point = np.concatenate([bare(batch) for batch in before]), bare(tracks)
            cov = np.where(point[:, None, None], cov + config.floor, cov)
            sound = conditioned(cov, is_well_conditioned(cov))
            tracks = tracks.replace(cov=conditioned(tracks.cov, tracks.well_conditioned | point[:, None]))
        source = np.repeat(np.fromiter(scans, np.intp), [len(scan) for scan in scans.values()])
        stamp_ns = np.concatenate([batch.time_ns for batch in before])[: len(source)]
        bit = np.zeros(len(tracks), np.uint32)
        bit[: len(source)] = np.left_shift(np.uint32(1), source.astype(np.uint32))
        has = np.concatenate([config.brings[source], central.has])
        return cls(tracks, mean, sound, has, source, stamp_ns, bit, particles)

    @property
    def key(self) -> NDArray[np.int64]:
        """Which source track each is, by source and its own identifier, (P,)."""
        return key_of(self.source, self.tracks.track_id[: len(self.source)])

    def split(self) -> tuple[Array, Array, Array, Array]:
        """Moments of the source tracks, then of the central ones."""
        count = len(self.source)
        return self.mean[:count], self.cov[:count], self.mean[count:], self.cov[count:]

    def gather(self, at: Rows, extras: Mapping[str, Any], take_particles: bool) -> SourceTracks:
        """Stack members (M, K) for a rule; particles stay such for one that takes them, and among themselves."""
        dof = self.tracks.dof[at]
        mixture = None
        if self.tracks.components > 1:
            point = bare(self.tracks)[at]
            merge = point & ~point.all(1, keepdims=True) if take_particles else self.particles[at]
            mixture = self._mixtures(at, merge)
        dof_or_none = None if np.isinf(dof).all() else dof
        return SourceTracks(self.mean[at], self.cov[at], dof_or_none, mixture, extras, self.tracks.layout.periods)

    def _mixtures(self, at: Rows, merge: Bools) -> Mixture:
        """Mixtures of members (M, K); those of `merge`, (M, K), by their Gaussians."""
        sole = np.arange(self.tracks.components) == 0
        weight = np.where(merge[..., None], sole, self.tracks.weight[at])
        mean = np.where(merge[..., None, None], self.mean[at][:, :, None], self.tracks.mean[at])
        cov = np.where(merge[..., None, None, None], self.cov[at][:, :, None], self.tracks.cov[at])
        used = int(np.flatnonzero(weight.any((0, 1)))[-1]) + 1  # the rest pads, say for a central track
        return Mixture(weight[..., :used], mean[:, :, :used], cov[:, :, :used])


def _is_young(config: CentreConfig, scan: TrackBatch, time_ns: int) -> bool:
    return len(scan) == 0 or time_ns - int(scan.time_ns.min()) <= config.params.max_scan_age_s * SECOND_NS


def conditioned(cov: Array, fit: Bools) -> Array:
    """Inflate the covariances, (..., n, n), that are singular to working precision, so that they can be inverted.

    A covariance sound in itself may turn so by prediction over a long time; the noise of prediction may be singular.
    Those that are `fit`, (...), are returned as they are.
    """
    if fit.all():
        return cov
    eye = np.eye(cov.shape[-1])
    return np.where(fit[..., None, None], cov, cov * (1.0 + RIDGE * eye) + LEAST_VARIANCE * eye)


def predicted_to(batch: TrackBatch, time_ns: int, motion: Motion) -> TrackBatch:
    """Predict every track and component to one time, with process noise, linearised where the motion is not linear.

    Raises
    ------
    ValueError    a track is later than `time_ns`
    """
    if (batch.time_ns == time_ns).all():
        return batch
    mean, cov = np.empty_like(batch.mean), np.empty_like(batch.cov)
    alike = bool((batch.time_ns == batch.time_ns[0]).all())
    for stamp in batch.time_ns[:1] if alike else np.unique(batch.time_ns):
        at = ... if alike else batch.time_ns == stamp
        transition = motion.over((time_ns - int(stamp)) / SECOND_NS)
        mean[at], cov[at] = Extended().predict(Gaussian(batch.mean[at], batch.cov[at]), transition).moments
    return batch.replace(mean=wrap(mean, batch.layout.periods), cov=cov, time_ns=np.full(len(batch), time_ns))
