"""The fusion centre: predict, associate, fuse, manage. doc/fusion-centre.md states each step; no ROS here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.assignment import nearest_neighbour
from track_fusion.chi_square import chi_square_quantile
from track_fusion.filters.kalman import predict
from track_fusion.linalg import Array
from track_fusion.models.motion import NearlyConstantVelocity
from track_fusion.params import Params, param
from track_fusion.rules import RULES, FusedTracks, Mixture, Rule, SourceTracks
from track_fusion.track_manager import Bools, Changes, TrackManager, TrackManagerParams
from track_fusion.tracks import TrackBatch

SECOND_NS = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class FusionCentreParams(Params):
    """What takes part in a fusion and how it is associated."""

    state_fusion: str = param("covariance_intersection", "the fusion rule", choices=tuple(RULES))
    gate_probability: float = param(
        0.99,
        "share of true pairs of tracks inside the gate (chi-square over all axes)",
        low=0.0,
        high=1.0 - 1e-12,
        strict=True,
    )
    max_scan_age_s: float = param(
        0.5, "a source's newest scan takes part, predicted, until it is older than this", unit="s", low=0.0
    )
    fuse_confirmed_only: bool = param(True, "leave tentative source tracks out")
    fuse_coasted: bool = param(True, "let coasted source tracks take part")
    publish_tentative: bool = param(False, "publish central tracks before they are confirmed, too")


@dataclasses.dataclass(frozen=True)
class StepInfo:
    """What happened in a step.

    Attributes
    ----------
    members : (S,) int          source tracks that took part, by source
    changes : Changes           births, confirmations, deletions
    shared_provenance : int     source tracks that already hold another source's information
    unconverged : int           fusions whose weights did not converge
    """

    members: NDArray[np.intp]
    changes: Changes
    shared_provenance: int
    unconverged: int


class FusionCentre:
    """Fuses the tracks of S sources into central tracks.

    Parameters
    ----------
    sources : int
    motion : NearlyConstantVelocity    predicts source and central tracks; its layout is the centre's
    frame_id : str
    params : FusionCentreParams
    rule_params : Params               of the rule `params.state_fusion`; None = its defaults
    manager_params : TrackManagerParams
    """

    def __init__(
        self,
        sources: int,
        motion: NearlyConstantVelocity,
        frame_id: str,
        params: FusionCentreParams,
        rule_params: Params | None = None,
        manager_params: TrackManagerParams | None = None,
    ) -> None:
        self.params = params
        self.layout, self.frame_id, self._motion = motion.layout, frame_id, motion
        self.rule: Rule = RULES[params.state_fusion]
        self._rule_params = self.rule.params() if rule_params is None else rule_params
        self._manager_params = manager_params or TrackManagerParams()
        self._gamma = chi_square_quantile(params.gate_probability, self.layout.size)
        self._sources = sources
        self.reset()

    def reset(self) -> None:
        """Forget all tracks and scans."""
        self._manager = TrackManager(self._sources, self.layout, self.frame_id, self._manager_params)
        self._newest: dict[int, TrackBatch] = {}

    @property
    def tracks(self) -> TrackBatch:
        """All living central tracks, tentative ones included."""
        return self._manager.tracks

    def step(self, time_ns: int, scans: Mapping[int, TrackBatch]) -> tuple[TrackBatch, StepInfo]:
        """Fuse at one time.

        Parameters
        ----------
        time_ns : int                        fusion time, not before the last one
        scans : {source: TrackBatch}         new scans, stamped at or before `time_ns`, in the centre's layout and frame

        Returns
        -------
        TrackBatch    the tracks to publish, all at `time_ns`
        StepInfo
        """
        fresh = np.zeros(self._sources, bool)
        fresh[list(scans)] = True
        self._newest.update({k: self._selected(scan) for k, scan in scans.items()})
        taking_part = {k: s for k, s in sorted(self._newest.items()) if self._is_young(s, time_ns)}
        predicted = {k: predicted_to(s, time_ns, self._motion) for k, s in taking_part.items()}
        central = predicted_to(self._manager.tracks, time_ns, self._motion)
        pool = _Pool.of(taking_part, predicted, central[:0])
        target, births = self._associate(central, predicted, fresh)
        pool, target = pool.select(target >= 0), target[target >= 0]
        fused, unconverged = self._fuse(central, pool, target, births, time_ns)
        member = np.zeros((len(fused), self._sources), bool)
        member[target, pool.source] = True
        supported = np.full(len(fused), -1, np.int64)
        np.maximum.at(supported, target, pool.stamp_ns)
        changes = self._manager.commit(fused, member, fresh, supported)
        everything = self._manager.tracks
        published = everything if self.params.publish_tentative else everything[everything.is_confirmed]
        members = np.bincount(pool.source, minlength=self._sources)
        return published, StepInfo(members, changes, pool.shared_provenance(), unconverged)

    def _selected(self, scan: TrackBatch) -> TrackBatch:
        """Leave out source tracks that the parameters exclude."""
        keep = np.ones(len(scan), bool)
        if self.params.fuse_confirmed_only:
            keep &= scan.is_confirmed
        if not self.params.fuse_coasted:
            keep &= ~scan.is_coasted
        return scan if keep.all() else scan[keep]

    def _is_young(self, scan: TrackBatch, time_ns: int) -> bool:
        return len(scan) == 0 or time_ns - int(scan.time_ns.min()) <= self.params.max_scan_age_s * SECOND_NS

    def _associate(
        self, central: TrackBatch, predicted: Mapping[int, TrackBatch], fresh: Bools
    ) -> tuple[NDArray[np.intp], int]:
        """Say for each source track, sources in order, to which central track or newborn it belongs (-1: none)."""
        position = self.layout.position
        targets: list[NDArray[np.intp]] = []
        newborn: list[TrackBatch] = []
        births = 0
        for k, scan in predicted.items():
            target = nearest_neighbour(*scan.moments, *central.moments, self._gamma, position)
            left = np.flatnonzero(target < 0) if fresh[k] else np.zeros(0, np.intp)
            if len(left):
                leftover = scan[left]
                joined = np.full(len(left), -1, np.intp)
                if newborn:
                    groups = TrackBatch.concatenate(newborn)
                    joined = nearest_neighbour(*leftover.moments, *groups.moments, self._gamma, position)
                starts = joined < 0
                joined[starts] = births + np.arange(starts.sum())
                target[left] = len(central) + joined
                if starts.any():
                    newborn.append(leftover[starts])
                    births += int(starts.sum())
            targets.append(target)
        return (np.concatenate(targets) if targets else np.zeros(0, np.intp)), births

    def _fuse(
        self, central: TrackBatch, pool: _Pool, target: NDArray[np.intp], births: int, time_ns: int
    ) -> tuple[TrackBatch, int]:
        """Fuse the members of each target; tracks without members keep their predicted state."""
        order = np.argsort(target, kind="stable")  # the pool is in source order: members stay so
        counts = np.bincount(target, minlength=len(central) + births)
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        parts: list[tuple[NDArray[np.intp], TrackBatch]] = []
        coasting = np.flatnonzero(counts[: len(central)] == 0)
        if len(coasting):
            parts.append((coasting, central[coasting].replace(source=np.zeros(len(coasting), np.uint32))))
        unconverged = 0
        for size in np.unique(counts[counts > 0]):
            rows = np.flatnonzero(counts == size)
            at = order[first[rows][:, None] + np.arange(size)]
            batch, failed = self._apply(pool, at, time_ns)
            parts.append((rows, batch))
            unconverged += failed
        if not parts:
            return central, 0
        joined = TrackBatch.concatenate([b for _, b in parts])
        return joined[np.argsort(np.concatenate([r for r, _ in parts]), kind="stable")], unconverged

    def _apply(self, pool: _Pool, at: NDArray[np.intp], time_ns: int) -> tuple[TrackBatch, int]:
        """Put members, (M, K) rows of the pool, through the rule; a single one is taken as it is."""
        tracks = pool.tracks
        size = at.shape[1]
        bits = np.bitwise_or.reduce(np.uint32(1) << pool.source[at].astype(np.uint32), axis=1)
        existence = tracks.existence[at].max(1)
        if size == 1:
            return tracks[at[:, 0]].replace(source=bits, existence=existence), 0
        fused = self.rule.fuse(pool.gather(at), self._rule_params)
        unconverged = int((~np.asarray(fused.info.get("converged", True))).sum())
        weight, mean, cov = _components(fused)
        batch = tracks.replace(
            weight=weight, mean=mean, cov=cov,
            time_ns=np.full(len(at), time_ns), track_id=np.zeros(len(at), np.int64), source=bits,
            status=np.zeros(len(at), np.uint8), existence=existence,
            dof=np.full(len(at), np.inf) if fused.dof is None else fused.dof,
        )  # fmt: skip
        return batch, unconverged


@dataclasses.dataclass(frozen=True)
class _Pool:
    """The predicted tracks of all sources, in source order, with their source (P,) and own stamp (P,)."""

    tracks: TrackBatch
    source: NDArray[np.intp]
    stamp_ns: NDArray[np.int64]

    @classmethod
    def of(cls, scans: Mapping[int, TrackBatch], predicted: Mapping[int, TrackBatch], empty: TrackBatch) -> _Pool:
        if not scans:
            return cls(empty, np.zeros(0, np.intp), np.zeros(0, np.int64))
        source = np.repeat(np.fromiter(scans, np.intp), [len(s) for s in scans.values()])
        stamp = np.concatenate([s.time_ns for s in scans.values()])
        return cls(TrackBatch.concatenate(list(predicted.values())), source, stamp)

    def select(self, keep: Bools) -> _Pool:
        if keep.all():
            return self
        return _Pool(self.tracks[keep], self.source[keep], self.stamp_ns[keep])

    def gather(self, at: NDArray[np.intp]) -> SourceTracks:
        """Stack members (M, K) for a rule."""
        mean, cov = self.tracks.moments
        dof = self.tracks.dof[at]
        mixture = None
        if self.tracks.components > 1:
            mixture = Mixture(self.tracks.weight[at], self.tracks.mean[at], self.tracks.cov[at])
        return SourceTracks(mean[at], cov[at], None if np.isinf(dof).all() else dof, mixture)

    def shared_provenance(self) -> int:
        """Count tracks whose provenance names a source other than their own."""
        own = np.uint32(1) << self.source.astype(np.uint32)
        return int(((self.tracks.source & ~own) > 0).sum())


def _components(fused: FusedTracks) -> tuple[Array, Array, Array]:
    """Fused result as weight (M, C), mean (M, C, n), cov (M, C, n, n)."""
    if fused.mixture is not None:
        return fused.mixture.weight, fused.mixture.mean, fused.mixture.cov
    return np.ones((len(fused.mean), 1)), fused.mean[:, None], fused.cov[:, None]


def predicted_to(batch: TrackBatch, time_ns: int, motion: NearlyConstantVelocity) -> TrackBatch:
    """Predict every track and component to one time, with process noise.

    Raises
    ------
    ValueError    a track is later than `time_ns`
    """
    if not len(batch) or (batch.time_ns == time_ns).all():
        return batch
    if (batch.time_ns == batch.time_ns[0]).all():
        transition, noise = motion.matrices((time_ns - int(batch.time_ns[0])) / SECOND_NS)
    else:
        steps = motion.batch((time_ns - batch.time_ns) / SECOND_NS)
        transition, noise = steps[0][:, None], steps[1][:, None]
    mean, cov = predict(batch.mean, batch.cov, transition, noise)
    return batch.replace(mean=mean, cov=cov, time_ns=np.full(len(batch), time_ns))
