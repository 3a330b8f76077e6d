"""What rules are tried on: tracks of a rule's family with what it needs, and errors of every admissible correlation."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from track_fusion.linalg import Array, transpose
from track_fusion.params import Params, from_dict
from track_fusion.rules.base import EACH, Example, FusedTracks, Mixture, Rule, SourceTracks, Values

Rng = np.random.Generator

#: Axes of the tracks that are drawn.
AXES = 4


class BrokenLaw(AssertionError):
    """What a law expected of a rule, and what it got."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A rule at some parameters of its example, for so many sources."""

    rule: Rule
    example: Example
    values: Values
    count: int

    @functools.cached_property
    def params(self) -> Params:
        """The rule's parameters."""
        share = np.arange(1.0, self.count + 1.0)
        filled = {k: tuple(share / share.sum()) if v is EACH else v for k, v in self.values.items()}
        return from_dict(self.rule.params, filled)

    def fuse(self, tracks: SourceTracks) -> FusedTracks:
        """Fuse as a user would, with all checks."""
        return self.rule(tracks, self.params)

    def tracks(self, rng: Rng, lead: tuple[int, ...], n: int = AXES) -> SourceTracks:
        """Draw tracks of the rule's family with what it needs, (*lead, K, n)."""
        mean, cov = 2.0 * rng.normal(size=(*lead, self.count, n)), covariances(rng, *lead, self.count, n=n)
        dof = np.full(mean.shape[:-1], 5.0) if self.rule.family == "elliptical" else None
        mixture = None
        if self.rule.family == "mixture":
            # Two components at mean +- d of covariance P - d d' have the moments of the track.
            offset = 0.5 * np.linalg.cholesky(cov)[..., 0]
            part = np.stack([mean + offset, mean - offset], -2)
            narrow = cov - offset[..., :, None] * offset[..., None, :]
            mixture = Mixture(np.full(part.shape[:-1], 0.5), part, np.stack([narrow, narrow], -3))
        return self.equipped(rng, SourceTracks(mean, cov, dof, mixture))

    def equipped(self, rng: Rng, tracks: SourceTracks) -> SourceTracks:
        """Add what the rule needs, and make all arrays read-only, so that a rule cannot write to them."""
        needs = (*self.rule.needs, *(name for name, _, _ in self.rule.needs_when))
        extras = {name: EXTRAS[name](tracks) for name in needs if name in EXTRAS}
        own = {} if self.example.extras is None else self.example.extras(rng, tracks)
        tracks = dataclasses.replace(tracks, extras={**extras, **own})
        for array in arrays_of(tracks):
            array.flags.writeable = False
        return tracks

    def tolerance(self, fused: FusedTracks, exact: float) -> Array:
        """Tolerance for each fusion of a batch: `exact`, unless these parameters make the rule sample."""
        lead = fused.mean.shape[:-1]
        if not any("samples" in name for name in self.values):
            return np.full(lead, exact)
        effective = np.asarray(fused.info.get("ess", np.ones(lead)))
        return np.asarray(np.maximum(exact, self.example.monte_carlo / np.sqrt(effective)))


# Errors of linear estimates.


def worst_error(case: Case, rng: Rng, joints: int = 100) -> float:
    """Largest error variance relative to the claimed one, in any direction, over sampled error covariances."""
    tracks, needed = case.tracks(rng, (), n=2), case.rule.needed(case.params)
    gain, fused = linear_estimate(case, tracks)
    if "cross_cov" in needed:
        joint = _shared_joint(tracks)
    elif "independent_cov" in needed:
        joint = _split_joint(rng, tracks, joints)
    else:
        joint = joint_covariances(rng, tracks.cov, joints)
    white = np.linalg.inv(np.linalg.cholesky(fused.cov[0])) @ gain
    return float(np.linalg.eigvalsh(white @ joint @ transpose(white)).max())


def linear_estimate(case: Case, tracks: SourceTracks) -> tuple[Array, FusedTracks]:
    """Read the estimator x = G (x_1, ..., x_K), G (n, K n), off a rule.

    Returns also what it makes of the tracks' covariances when all means agree, when they differ in one axis, and at
    last when they differ in all: (K n + 2, n).

    Raises
    ------
    BrokenLaw    the fused mean is not linear in the means; a guarantee says nothing of such a rule
    """
    sources, n = tracks.mean.shape
    probes = np.concatenate([np.zeros((1, sources * n)), np.eye(sources * n)]).reshape(-1, sources, n)
    trial = np.random.default_rng(0).normal(size=(1, sources, n))
    fused = case.rule.fuse(_at(tracks, np.concatenate([probes, trial])), case.params)
    gain = fused.mean[1:-1].T - fused.mean[0][:, None]
    off = np.abs(gain @ trial.reshape(-1) - fused.mean[-1]).max()
    if not off <= 1e-7:
        raise BrokenLaw(f"mean: expected linear in the means of the tracks, got one {off:.2g} off.")
    return gain, fused


def _at(tracks: SourceTracks, means: Array) -> SourceTracks:
    """Move tracks (K, n) to means (B, K, n), their components with them."""

    def repeat(array: Array) -> Array:
        return np.broadcast_to(array, (len(means), *array.shape))

    mixture = tracks.mixture
    if mixture is not None:
        moved = mixture.mean + (means - tracks.mean)[:, :, None]
        mixture = Mixture(repeat(mixture.weight), moved, repeat(mixture.cov))
    extras = {k: repeat(v) for k, v in tracks.extras.items() if isinstance(v, np.ndarray)}
    dof = None if tracks.dof is None else repeat(tracks.dof)
    return SourceTracks(means, repeat(tracks.cov), dof, mixture, extras)


def joint_covariances(rng: Rng, cov: Array, count: int) -> Array:
    """Draw joint error covariances (count, K n, K n) with these diagonal blocks, from slack to fully dependent."""
    sources, n = cov.shape[:2]
    size = sources * n
    joint = np.empty((count, size, size))
    for i in range(count):
        rank = rng.integers(n, size + 3)  # rank n: each source's error is a function of any other's
        root = rng.normal(size=(sources, n, rank)) * 10.0 ** rng.normal(size=rank)
        # Each block of rows is made orthonormal, then coloured by its track's covariance.
        root = transpose(np.linalg.qr(transpose(root))[0])
        coloured = (np.linalg.cholesky(cov) @ root).reshape(size, rank)
        joint[i] = coloured @ coloured.T
    return joint


def _shared_joint(tracks: SourceTracks) -> Array:
    """The one joint covariance that given cross-covariances leave."""
    cross, (sources, n) = np.array(tracks.extras["cross_cov"]), tracks.mean.shape
    cross[np.arange(sources), np.arange(sources)] = tracks.cov
    return cross.swapaxes(-3, -2).reshape(sources * n, sources * n)


def _split_joint(rng: Rng, tracks: SourceTracks, count: int) -> Array:
    """Joint covariances whose independent parts are independent, and whose other parts are correlated in any way."""
    alone = tracks.extras["independent_cov"]
    joint, n = joint_covariances(rng, tracks.cov - alone, count), tracks.mean.shape[-1]
    for k, part in enumerate(alone):
        joint[:, k * n : (k + 1) * n, k * n : (k + 1) * n] += part
    return joint


# Tracks, and what rules need beyond them.


def covariances(rng: Rng, *shape: int, n: int = AXES) -> Array:
    """Draw well-conditioned covariances, (*shape, n, n)."""
    root = rng.normal(size=(*shape, n, n + 3)) * rng.uniform(0.5, 2.0, size=(*shape, 1, 1))
    return np.asarray(root @ transpose(root))


def shared_cross_cov(tracks: SourceTracks) -> Array:
    """Cross-covariances P_i C^-1 P_j of tracks that share a part of covariance C = sum of all P, (..., K, K, n, n)."""
    common = np.linalg.inv(tracks.cov.sum(-3))[..., None, None, :, :]
    return tracks.cov[..., :, None, :, :] @ common @ tracks.cov[..., None, :, :, :]


def _independent_parts(tracks: SourceTracks) -> Array:
    """A part of each track that is not a multiple of it."""
    cov, total = tracks.cov, tracks.cov.sum(-3, keepdims=True)
    return 0.1 * cov + 0.5 * cov @ np.linalg.inv(total) @ cov


def _vague_common(tracks: SourceTracks) -> Mixture:
    """Common information vaguer than every track."""
    mean, cov = tracks.mean.mean(-2), tracks.cov.sum(-3)
    return Mixture(np.full((*mean.shape[:-1], 2), 0.5), np.stack([mean, mean], -2), np.stack([cov, 2.0 * cov], -3))


def _target(tracks: SourceTracks) -> Mixture:
    mean = np.stack([tracks.mean.mean(-2), tracks.mean[..., -1, :]], -2)
    return Mixture(np.full(mean.shape[:-1], 0.5), mean, np.stack([tracks.cov.mean(-3)] * 2, -3))


def _likelihood(tracks: SourceTracks) -> Array:
    size = np.linalg.slogdet(tracks.cov)[1]
    return np.asarray(np.exp(0.1 * (size - size.mean(-1, keepdims=True))))


#: What rules may need beyond the tracks, each made of these so that it moves with them under affine maps.
EXTRAS: Mapping[str, Callable[[SourceTracks], Any]] = {
    "common": _vague_common,
    "cross_cov": shared_cross_cov,
    "independent_cov": _independent_parts,
    "likelihood": _likelihood,
    "seed": lambda tracks: 0,
    "target": _target,
}


def arrays_of(tracks: SourceTracks) -> list[Array]:
    """List all arrays of the tracks."""
    arrays = [array for array in (tracks.mean, tracks.cov, tracks.dof) if array is not None]
    for part in (tracks.mixture, *tracks.extras.values()):
        arrays += vars(part).values() if isinstance(part, Mixture) else [part] if isinstance(part, np.ndarray) else []
    return arrays


def select(tracks: SourceTracks, index: Any) -> SourceTracks:
    """Index every array of the tracks alike: by batch axes, or (..., order) by source."""
    index = index if isinstance(index, tuple) else (index,)
    batch = index[: len(tracks.batch)]

    def pick(name: str, extra: Any) -> Any:
        if isinstance(extra, Mixture):  # of all sources together
            return extra.at(batch)
        if not isinstance(extra, np.ndarray):
            return extra
        if name == "cross_cov" and len(index) > len(batch):  # both sources of a block
            return extra[index][(*(slice(None),) * len(batch), slice(None), index[-1])]
        return extra[index]

    mixture = tracks.mixture and tracks.mixture.at(index)
    dof = None if tracks.dof is None else tracks.dof[index]
    extras = {name: pick(name, extra) for name, extra in tracks.extras.items()}
    return SourceTracks(tracks.mean[index], tracks.cov[index], dof, mixture, extras)
