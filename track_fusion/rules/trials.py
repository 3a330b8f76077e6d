"""What the laws of fusion rules try a rule on: tracks, mixtures, extras, and errors of every admissible correlation."""

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
#: Of each draw of tracks so many joint error covariances are tried.
JOINTS = 100


class BrokenLaw(AssertionError):
    """What a law expected of a rule, and what it got."""


def require(good: Any, text: str) -> None:
    """Raise BrokenLaw unless `good`."""
    if not good:
        raise BrokenLaw(text)


def _shared_cross_cov(tracks: SourceTracks) -> Array:
    """Cross-covariances P_i C^-1 P_j of tracks that share a part of covariance C = sum of all P, (..., K, K, n, n)."""
    common = np.linalg.inv(tracks.cov.sum(-3))[..., None, None, :, :]
    return tracks.cov[..., :, None, :, :] @ common @ tracks.cov[..., None, :, :, :]


def _independent_parts(tracks: SourceTracks) -> Array:
    """A part of each track that is not a multiple of it."""
    return 0.1 * tracks.cov + 0.5 * tracks.cov @ np.linalg.inv(tracks.cov.sum(-3, keepdims=True)) @ tracks.cov


def _vague_common(tracks: SourceTracks) -> Mixture:
    """Common information vaguer than every track."""
    mean, cov = tracks.mean.mean(-2), tracks.cov.sum(-3)
    return Mixture(np.full((*mean.shape[:-1], 2), 0.5), np.stack([mean, mean], -2), np.stack([cov, 2.0 * cov], -3))


def _likelihood(tracks: SourceTracks) -> Array:
    size = np.linalg.slogdet(tracks.cov)[1]
    return np.asarray(np.exp(0.1 * (size - size.mean(-1, keepdims=True))))


#: What rules may need beyond the tracks, made of them so that it moves with them, in any order and any axes.
EXTRAS: Mapping[str, Callable[[SourceTracks], Any]] = {
    "common": _vague_common,
    "cross_cov": _shared_cross_cov,
    "independent_cov": _independent_parts,
    "likelihood": _likelihood,
    "seed": lambda tracks: 0,
    "target": _vague_common,
}


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

    @property
    def guarantee(self) -> str:
        """What the rule guarantees at these parameters."""
        return self.rule.guarantee_at(self.params)

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
        return self.equipped(SourceTracks(mean, cov, dof, mixture))

    def mixed(self, rng: Rng, lead: tuple[int, ...]) -> SourceTracks:
        """Draw tracks of three components each, the third light, and twice as wide as the track."""
        plain = self.tracks(rng, lead)
        offset = 0.5 * np.linalg.cholesky(plain.cov)[..., 0]
        mean = np.stack([plain.mean + offset, plain.mean - offset, plain.mean], -2)
        cov = np.stack([0.75 * plain.cov, 0.75 * plain.cov, 4.0 * plain.cov], -3)
        mixture = Mixture(np.broadcast_to([0.5, 0.45, 0.05], mean.shape[:-1]).copy(), mean, cov)
        return self.equipped(dataclasses.replace(SourceTracks.of(mixture), dof=plain.dof))

    def cloud(self, rng: Rng, lead: tuple[int, ...], count: int = 12) -> SourceTracks:
        """Draw tracks of particles: components without covariance."""
        plain = self.tracks(rng, lead)
        spread = np.linalg.cholesky(plain.cov) @ rng.normal(size=(*plain.mean.shape, count))
        mean = plain.mean[..., None, :] + transpose(spread)
        mixture = Mixture(rng.uniform(size=mean.shape[:-1]), mean, np.zeros((*mean.shape, AXES))).normalised
        return self.equipped(dataclasses.replace(SourceTracks.of(mixture), dof=plain.dof))

    def picked(self, tracks: SourceTracks, index: Any) -> SourceTracks:
        """Index tracks by batch axes, or (..., order) by source."""
        dof = None if tracks.dof is None else tracks.dof[index]
        mixture = tracks.mixture and tracks.mixture.at(index)
        return self.equipped(SourceTracks(tracks.mean[index], tracks.cov[index], dof, mixture))

    def equipped(self, tracks: SourceTracks) -> SourceTracks:
        """Add what the rule needs, and make all arrays read-only: a rule that writes to them fails."""
        needs = (*self.rule.needs, *(name for name, _, _ in self.rule.needs_when))
        extras = {name: EXTRAS[name](tracks) for name in needs if name in EXTRAS}
        extras |= {} if self.example.extras is None else self.example.extras(tracks)
        for part in (tracks.mean, tracks.cov, tracks.dof, tracks.mixture, *extras.values()):
            for array in vars(part).values() if isinstance(part, Mixture) else (part,):
                if isinstance(array, np.ndarray):
                    array.flags.writeable = False
        return dataclasses.replace(tracks, extras=extras)

    def tolerance(self, fused: FusedTracks, exact: float) -> Array:
        """Tolerance for each fusion of a batch: `exact`, unless these parameters make the rule sample."""
        lead = fused.mean.shape[:-1]
        if not any("samples" in name for name in self.values):
            return np.full(lead, exact)
        effective = np.asarray(fused.info.get("ess", np.ones(lead)))
        return np.asarray(np.maximum(exact, self.example.monte_carlo / np.sqrt(effective)))

    def estimate(self, tracks: SourceTracks) -> tuple[Array, FusedTracks]:
        """Read the estimator x = G (x_1, ..., x_K), G (n, K n), off the rule; a guarantee says nothing of others.

        Returns also the fusions it is read off: first all means zero, then each axis one in turn, at last any.
        """
        sources, n = tracks.mean.shape
        probes = np.concatenate([np.zeros((1, sources * n)), np.eye(sources * n)]).reshape(-1, sources, n)
        trial = np.random.default_rng(0).normal(size=(1, sources, n))
        means = np.concatenate([probes, trial])
        mixture = tracks.mixture
        if mixture is not None:
            moved = mixture.mean + (means - tracks.mean)[:, :, None]
            mixture = dataclasses.replace(mixture.broadcast((len(means), sources)), mean=moved)
        cov = np.broadcast_to(tracks.cov, (len(means), *tracks.cov.shape))
        dof = None if tracks.dof is None else np.broadcast_to(tracks.dof, means.shape[:-1])
        fused = self.rule.apply(self.equipped(SourceTracks(means, cov, dof, mixture)), self.params)
        gain = fused.mean[1:-1].T - fused.mean[0][:, None]
        off = np.abs(gain @ trial.reshape(-1) - fused.mean[-1]).max()
        require(off <= 1e-7, f"mean: expected linear in the means of the tracks, got one {off:.2g} off.")
        return gain, fused

    def worst_error(self, rng: Rng) -> float:
        """Largest error variance relative to the claimed one, in any direction, over sampled error covariances."""
        tracks, needed = self.tracks(rng, (), n=2), self.rule.needed(self.params)
        gain, fused = self.estimate(tracks)
        if "cross_cov" in needed:  # which leave one joint covariance
            blocks = np.where(np.eye(self.count)[..., None, None], tracks.cov[:, None], tracks.extras["cross_cov"])
            joint = blocks.swapaxes(1, 2).reshape(1, gain.shape[1], -1)
        else:
            alone = tracks.extras["independent_cov"] if "independent_cov" in needed else np.zeros_like(tracks.cov)
            joint = joint_covariances(rng, tracks.cov - alone, JOINTS)
            for k, part in enumerate(alone):
                joint[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += part
        white = np.linalg.inv(np.linalg.cholesky(fused.cov[0])) @ gain
        return float(np.linalg.eigvalsh(white @ joint @ transpose(white)).max())


def covariances(rng: Rng, *shape: int, n: int = AXES) -> Array:
    """Draw well-conditioned covariances, (*shape, n, n)."""
    root = rng.normal(size=(*shape, n, n + 3)) * rng.uniform(0.5, 2.0, size=(*shape, 1, 1))
    return np.asarray(root @ transpose(root))


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
