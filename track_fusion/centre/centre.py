"""The fusion centre: predict, associate, fuse, manage. doc/fusion-centre.md states each step; no ROS here."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.assignment import assign, nearest_neighbour
from track_fusion.association.gate import gate
from track_fusion.centre.track_manager import Bools, Changes, TrackManager, TrackManagerParams
from track_fusion.filters.base import Gaussian
from track_fusion.filters.extended import Extended
from track_fusion.linalg import RIDGE, Array, is_well_conditioned
from track_fusion.models.base import Motion
from track_fusion.params import ParameterError, Params, param
from track_fusion.random_streams import RandomParams
from track_fusion.rules import RULES, FusedTracks, Mixture, Rule, SourceTracks
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import COASTED, CONFIRMED, SECOND_NS, TrackBatch

#: Added to variances that may be zero, as those of particles that coincide; SI units squared.
LEAST_VARIANCE = 1e-24

Rows = NDArray[np.intp]


@dataclasses.dataclass(frozen=True)
class FusionCentreParams(Params):
    """What takes part in a fusion and how it is associated."""

    state_fusion: str = param("covariance_intersection", "the fusion rule", choices=tuple(RULES))
    association: str = param(
        "nearest",
        "nearest: global nearest neighbour within the gate; single_target: all sources are known to track one and the "
        "same target, so that the first track of each is taken without a gate",
        choices=("nearest", "single_target"),
    )
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
    memory: bool = param(
        False,
        "fuse the central track's own prediction, too, before the sources' tracks, and each scan only once; what is "
        "published stays conservative only by a rule that is so for every cross-correlation",
    )
    publish_tentative: bool = param(False, "publish central tracks before they are confirmed, too")
    particle_variances: tuple[float, ...] = param(
        (),
        "added to the variances of particles taken as one Gaussian, one number an axis, SI units squared: particles "
        "that have collapsed onto a few points have a singular covariance",
        low=0.0,
        kind=float,
    )


@dataclasses.dataclass(frozen=True)
class StepInfo:
    """What happened in a step.

    Attributes
    ----------
    members : (S,) int          source tracks that took part, by source
    changes : Changes           births, confirmations, deletions
    shared_provenance : int     members that already hold another one's information: source tracks that say so, and
                                with memory each central track that was fused with new ones
    unconverged : int           fusions whose weights did not converge
    unsound : int               fusions whose result was no density, so that a single member was taken instead
    """

    members: Rows
    changes: Changes
    shared_provenance: int
    unconverged: int
    unsound: int = 0


class FusionCentre:
    """Fuses the tracks of S sources into central tracks.

    Parameters
    ----------
    sources : int
    motion : Motion                    predicts source and central tracks; its layout is the centre's
    frame_id : str
    params : FusionCentreParams
    rule_params : Params               of the rule `params.state_fusion`; None = its defaults
    manager_params : TrackManagerParams
    rule : Rule                        in place of the one that `params` names: one that the registry learned later
    random : RandomParams              what rules that sample draw from, step after step

    Raises
    ------
    ParameterError    the rule needs what source tracks do not bring, such as their cross-covariance; weights are given
                      that do not fit the sources; not one number an axis in `particle_variances`
    """

    def __init__(
        self,
        sources: int,
        motion: Motion,
        frame_id: str,
        params: FusionCentreParams,
        rule_params: Params | None = None,
        manager_params: TrackManagerParams | None = None,
        rule: Rule | None = None,
        random: RandomParams | None = None,
    ) -> None:
        self.params = params
        self.layout, self.frame_id, self._motion = motion.layout, frame_id, motion
        self.rule = RULES[params.state_fusion] if rule is None else rule
        self._rule_params = self.rule.params() if rule_params is None else rule_params
        needed = sorted(set(self.rule.needed(self._rule_params)) - {"seed"})
        if needed:
            raise ParameterError(
                f"The 'state_fusion' parameter must be a rule that needs only tracks. Got '{self.rule.key}', "
                f"which at these parameters needs {', '.join(needed)}: use it in the library or by track-fusion fuse."
            )
        if len(params.particle_variances) not in (0, self.layout.size):
            raise ParameterError(
                f"The 'particle_variances' parameter must hold {self.layout.size} numbers, one an axis, or none. "
                f"Got {len(params.particle_variances)}."
            )
        self._floor = np.diag(params.particle_variances or np.zeros(self.layout.size))
        self._random = random or RandomParams(role="fusion_centre")
        self._manager_params = manager_params or TrackManagerParams()
        self._gamma = chi_square_quantile(params.gate_probability, self.layout.size)
        self._sources = sources
        self._weights = np.array(getattr(self._rule_params, "weights", ()))
        if len(self._weights) or getattr(self._rule_params, "criterion", "") == "given":
            self._try_weights()
        self.reset()

    def _try_weights(self) -> None:
        """Refuse weights that the rule would refuse when every source has a track: see it on equal ones."""
        count, n = self._sources + self.params.memory, self.layout.size
        if count == 1:
            return
        equal = SourceTracks(np.zeros((1, count, n)), np.tile(np.eye(n), (1, count, 1, 1)))
        try:
            self.rule.fuse(equal, self._rule_params)
        except ValueError as error:
            what = "one a source, the central track first" if self.params.memory else "one a source"
            raise ParameterError(
                f"The parameters of the rule '{self.rule.key}' do not fit {count} tracks, {what}: {error}"
            ) from None

    def reset(self) -> None:
        """Forget all tracks and scans."""
        self._manager = TrackManager(self._sources, self.layout, self.frame_id, self._manager_params)
        self._newest: dict[int, TrackBatch] = {}
        draws = "seed" in (*self.rule.needed(self._rule_params), *self.rule.optional)
        self._extras = {"seed": self._random.stream()} if draws else {}

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
        for scan in scans.values():
            self._check(scan, time_ns)
        fresh = np.zeros(self._sources, bool)
        fresh[list(scans)] = True
        self._newest.update({k: self._selected(scan) for k, scan in scans.items()})
        taking_part = {k: s for k, s in sorted(self._newest.items()) if self._takes_part(k, s, fresh, time_ns)}
        pool = _Pool.of(taking_part, self._manager.tracks, time_ns, self._motion, self._floor)
        sole = self.params.association == "single_target"
        target, births = _sole_target(pool, fresh) if sole else self._associate(pool, fresh)
        members = np.flatnonzero(target >= 0)
        target, source = target[members], pool.source[members]
        remembered = np.unique(target[target < len(self._manager.tracks)]) if self.params.memory else target[:0]
        fused, failed = self._fuse(pool, members, target, births, remembered)
        member = np.zeros((len(fused), self._sources), bool)
        member[target, source] = True
        supported = np.full(len(fused), -1, np.int64)
        np.maximum.at(supported, target, pool.stamp_ns[members])
        changes = self._manager.commit(fused, member, fresh, supported)
        published = self._manager.tracks
        if not (self.params.publish_tentative or published.is_confirmed.all()):
            published = published[published.is_confirmed]
        foreign = np.count_nonzero(pool.tracks.source[members] & ~pool.bit[members]) + len(remembered)
        taken = np.bincount(source, minlength=self._sources)
        return published, StepInfo(taken, changes, int(foreign), *failed)

    def _check(self, scan: TrackBatch, time_ns: int) -> None:
        """Refuse a scan before it changes anything."""
        if (scan.layout, scan.frame_id, scan.phd) != (self.layout, self.frame_id, False):
            kind = " as un-normalised mixtures (PHD)" if scan.phd else ""
            raise ValueError(
                f"A scan must hold {', '.join(self.layout.axes)} in '{self.frame_id}', its mixtures normalised. "
                f"Got {', '.join(scan.layout.axes)} in '{scan.frame_id}'{kind}."
            )
        if len(scan) and scan.time_ns.max() > time_ns:
            raise ValueError(f"A scan must not be later than the fusion time {time_ns} ns. Got {scan.time_ns.max()}.")

    def _selected(self, scan: TrackBatch) -> TrackBatch:
        """Leave out source tracks that the parameters exclude, and identities: a central track's is its own."""
        decisive = CONFIRMED * self.params.fuse_confirmed_only | COASTED * (not self.params.fuse_coasted)
        keep = scan.status & decisive == CONFIRMED & decisive
        scan = scan.replace(uuid=None)
        return scan if keep.all() else scan[keep]

    def _takes_part(self, source: int, scan: TrackBatch, fresh: Bools, time_ns: int) -> bool:
        """Tell whether a source's newest scan does; with memory an older one is in the central tracks already."""
        if self.params.memory and not fresh[source]:
            return False
        return len(scan) == 0 or time_ns - int(scan.time_ns.min()) <= self.params.max_scan_age_s * SECOND_NS

    def _associate(self, pool: _Pool, fresh: Bools) -> tuple[Rows, int]:
        """Say for each source track to which central track or newborn it belongs (-1: none); count the newborn."""
        mean, cov, central_mean, central_cov = pool.split()
        count, gamma, position = len(central_mean), self._gamma, self.layout.position
        found = gate(mean, cov, central_mean, central_cov, gamma, position)
        # One to one within each source, all sources at once: to each its own copy of the central tracks.
        own = dataclasses.replace(found, col=found.col + count * pool.source[found.row])
        target = assign(own, len(mean), count * self._sources, gamma)
        target[target >= 0] %= count
        starters = np.zeros(0, np.intp)  # the track that started each group
        leftover = np.flatnonzero((target < 0) & fresh[pool.source])
        for k in np.unique(pool.source[leftover]):
            left = leftover[pool.source[leftover] == k]
            joined = nearest_neighbour(mean[left], cov[left], mean[starters], cov[starters], gamma, position)
            starts = joined < 0
            joined[starts] = len(starters) + np.arange(starts.sum())
            target[left] = count + joined
            starters = np.append(starters, left[starts])
        return target, len(starters)

    def _fuse(self, pool: _Pool, members: Rows, target: Rows, births: int, remembered: Rows) -> tuple[TrackBatch, Rows]:
        """Fuse the members of each target, those of `remembered` with their own prediction before all.

        Tracks without members keep their predicted state. Tell also how many fusions were unconverged and unsound.
        """
        members = np.concatenate([len(pool.source) + remembered, members])
        target = np.concatenate([remembered, target])
        order = members[np.argsort(target, kind="stable")]  # the pool is in source order: members stay so
        old = len(pool.tracks) - len(pool.source)
        counts = np.bincount(target, minlength=old + births)
        first = np.cumsum(counts) - counts
        parts: list[tuple[Rows, TrackBatch]] = []
        coasting = np.flatnonzero(counts == 0)
        if len(coasting):
            kept = pool.tracks[len(pool.source) + coasting]
            parts.append((coasting, kept.replace(source=np.zeros(len(coasting), np.uint32))))
        failed = np.zeros(2, np.intp)
        for size in sorted(set(counts.tolist()) - {0}):
            rows = np.flatnonzero(counts == size)
            at = order[first[rows][:, None] + np.arange(size)]
            for some, params in self._weighed(pool, at):
                batch, counts_of = self._apply(pool, at[some], params)
                parts.append((rows[some], batch))
                failed += counts_of
        if not parts:
            return pool.tracks, failed
        if len(parts) == 1:
            return parts[0][1], failed
        joined = TrackBatch.concatenate([b for _, b in parts])
        return joined[np.argsort(np.concatenate([r for r, _ in parts]), kind="stable")], failed

    def _weighed(self, pool: _Pool, at: Rows) -> Iterator[tuple[Rows | slice, Params]]:
        """Split members (M, K) by their sources where weights are given: rows, and the rule's parameters for them.

        Of fewer members than weights, the weights keep their proportions; where all are zero, they are equal.
        """
        count = at.shape[1]
        if count == 1 or count >= len(self._weights):
            yield slice(None), self._rule_params
            return
        central = at >= len(pool.source)
        place = np.where(central, 0, pool.source[np.where(central, 0, at)] + self.params.memory)
        kinds, kind = np.unique(place, axis=0, return_inverse=True)
        for k, own in enumerate(kinds):
            total = self._weights[own].sum()
            share = self._weights[own] / total if total else np.full(count, 1.0 / count)
            given: dict[str, Any] = {"weights": tuple(share)}
            yield np.flatnonzero(kind.ravel() == k), dataclasses.replace(self._rule_params, **given)

    def _apply(self, pool: _Pool, at: Rows, params: Params) -> tuple[TrackBatch, tuple[int, int]]:
        """Put members, (M, K) rows of the pool, through the rule; a single one is taken as it is.

        So is the last member of a target whose fusion gives no density: its numbers must not harm the other targets.
        """
        first = _joined(pool, at)
        if at.shape[1] == 1:
            return first, (0, 0)
        try:
            fused = self.rule.fuse(pool.gather(at, self._extras, self.rule.takes_particles), params)
        except np.linalg.LinAlgError:
            return self._apply_each(pool, at, params)
        unconverged = int(np.count_nonzero(~np.asarray(fused.info.get("converged", True))))
        weight, mean, cov = _components(fused)
        dof = np.full(len(at), np.inf) if fused.dof is None else fused.dof
        result = first.replace(weight=weight, mean=mean, cov=cov, dof=dof)
        sound = result.sound
        if sound.all():
            return result, (unconverged, 0)
        order = np.argsort(np.concatenate([np.flatnonzero(sound), np.flatnonzero(~sound)]))
        kept = TrackBatch.concatenate([result[sound], _joined(pool, at[~sound, -1:])])
        return kept[order], (unconverged, int(np.count_nonzero(~sound)))

    def _apply_each(self, pool: _Pool, at: Rows, params: Params) -> tuple[TrackBatch, tuple[int, int]]:
        """Do the same target by target, after the rule could not invert a matrix of one."""
        if len(at) == 1:
            return _joined(pool, at[:, -1:]), (0, 1)
        batches, failed = zip(*(self._apply(pool, at[k : k + 1], params) for k in range(len(at))), strict=True)
        unconverged, unsound = np.sum(failed, 0).tolist()
        return TrackBatch.concatenate(batches), (unconverged, unsound)


@dataclasses.dataclass(frozen=True)
class _Pool:
    """All tracks of a step, predicted to its time: those of the sources, in source order, then the central ones.

    Attributes
    ----------
    tracks : TrackBatch    P source tracks, T central tracks
    mean, cov              moments of each, (P + T, n) and (P + T, n, n), fit to be inverted
    source, stamp_ns       source and own stamp of each source track, (P,)
    bit                    provenance that each brings to a fusion, (P + T,): its source's bit, none for a central one
    particles              which came as particles, (P + T,); predicted over a time they have covariances
    """

    tracks: TrackBatch
    mean: Array
    cov: Array
    source: Rows
    stamp_ns: NDArray[np.int64]
    bit: NDArray[np.uint32]
    particles: Bools

    @classmethod
    def of(
        cls, scans: Mapping[int, TrackBatch], central: TrackBatch, time_ns: int, motion: Motion, floor: Array
    ) -> _Pool:
        batches = [*scans.values(), central]
        tracks = TrackBatch.concatenate([predicted_to(b, time_ns, motion) for b in batches])
        mean, cov = tracks.moments
        if tracks.components == 1:
            particles, sound = np.zeros(len(tracks), bool), conditioned(cov)
            tracks = tracks.replace(cov=sound[:, None])
        else:
            particles, bare = np.concatenate([_bare(b) for b in batches]), _bare(tracks)
            sound = conditioned(np.where(bare[:, None, None], cov + floor, cov))
            tracks = tracks.replace(cov=_conditioned_components(tracks.cov, ~bare))
        source = np.repeat(np.fromiter(scans, np.intp), [len(s) for s in scans.values()])
        stamp_ns = np.concatenate([b.time_ns for b in batches])[: len(source)]
        bit = np.zeros(len(tracks), np.uint32)
        bit[: len(source)] = np.left_shift(np.uint32(1), source.astype(np.uint32))
        return cls(tracks, mean, sound, source, stamp_ns, bit, particles)

    def split(self) -> tuple[Array, Array, Array, Array]:
        """Moments of the source tracks, then of the central ones."""
        count = len(self.source)
        return self.mean[:count], self.cov[:count], self.mean[count:], self.cov[count:]

    def gather(self, at: Rows, extras: Mapping[str, Any], take_particles: bool) -> SourceTracks:
        """Stack members (M, K) for a rule; particles stay such for one that takes them, and among themselves."""
        dof = self.tracks.dof[at]
        mixture = None
        if self.tracks.components > 1:
            bare = _bare(self.tracks)[at]
            merge = bare & ~bare.all(1, keepdims=True) if take_particles else self.particles[at]
            mixture = self._mixtures(at, merge)
        return SourceTracks(self.mean[at], self.cov[at], None if np.isinf(dof).all() else dof, mixture, extras)

    def _mixtures(self, at: Rows, merge: Bools) -> Mixture:
        """Mixtures of members (M, K); those of `merge`, (M, K), by their Gaussians."""
        sole = np.arange(self.tracks.components) == 0
        weight = np.where(merge[..., None], sole, self.tracks.weight[at])
        mean = np.where(merge[..., None, None], self.mean[at][:, :, None], self.tracks.mean[at])
        cov = np.where(merge[..., None, None, None], self.cov[at][:, :, None], self.tracks.cov[at])
        used = int(np.flatnonzero(weight.any((0, 1)))[-1]) + 1  # the rest pads, say for a central track
        return Mixture(weight[..., :used], mean[:, :, :used], cov[:, :, :used])


def _bare(tracks: TrackBatch) -> Bools:
    """Tell which tracks are particles, components without covariance, (N,)."""
    return np.asarray(~tracks.cov.any((1, 2, 3)))


def _conditioned_components(cov: Array, which: Bools) -> Array:
    """Components' covariances (N, C, n, n) of some tracks fit to be inverted: noise of prediction may be singular."""
    if which.any():
        cov = cov.copy()
        cov[which] = conditioned(cov[which].reshape(-1, *cov.shape[2:])).reshape(-1, *cov.shape[1:])
    return cov


def _sole_target(pool: _Pool, fresh: Bools) -> tuple[Rows, int]:
    """Associate the first track of each source with the one target, which a new scan starts."""
    target = np.full(len(pool.source), -1, np.intp)
    births = int(len(pool.tracks) == len(pool.source) and bool(fresh[pool.source].any()))
    if births or len(pool.tracks) > len(pool.source):
        target[np.unique(pool.source, return_index=True)[1]] = 0
    return target, births


def _joined(pool: _Pool, at: Rows) -> TrackBatch:
    """Return the first of the members, (M, K), with the provenance and existence of all."""
    bit = pool.bit[at]
    existence = np.where(bit > 0, pool.tracks.existence[at], 0.0).max(1)
    return pool.tracks[at[:, 0]].replace(source=np.bitwise_or.reduce(bit, axis=1), existence=existence)


def _components(fused: FusedTracks) -> tuple[Array, Array, Array]:
    """Fused result as weight (M, C), mean (M, C, n), cov (M, C, n, n)."""
    if fused.mixture is not None:
        return fused.mixture.weight, fused.mixture.mean, fused.mixture.cov
    return np.ones((len(fused.mean), 1)), fused.mean[:, None], fused.cov[:, None]


def conditioned(cov: Array) -> Array:
    """Inflate the covariances that are singular to working precision, so that they can be inverted, (N, n, n).

    A covariance sound in itself may turn so by prediction over a long time. Others are returned as they are.
    """
    weak = ~is_well_conditioned(cov)
    if not weak.any():
        return cov
    eye = np.eye(cov.shape[-1])
    return np.where(weak[:, None, None], cov * (1.0 + RIDGE * eye) + LEAST_VARIANCE * eye, cov)


def predicted_to(batch: TrackBatch, time_ns: int, motion: Motion) -> TrackBatch:
    """Predict every track and component to one time, with process noise, linearised where the motion is not linear.

    Raises
    ------
    ValueError    a track is later than `time_ns`
    """
    stamps = np.unique(batch.time_ns)
    if not len(batch) or (len(stamps) == 1 and stamps[0] == time_ns):
        return batch
    mean, cov = np.empty_like(batch.mean), np.empty_like(batch.cov)
    for stamp in stamps:
        at = batch.time_ns == stamp
        transition = motion.over((time_ns - int(stamp)) / SECOND_NS)
        mean[at], cov[at] = Extended().predict(Gaussian(batch.mean[at], batch.cov[at]), transition).moments
    return batch.replace(mean=mean, cov=cov, time_ns=np.full(len(batch), time_ns))
