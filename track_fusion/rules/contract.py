"""The laws that every fusion rule keeps: for our tests, and by `track-fusion rules --check` for a rule of anybody's.

A law returns nothing where a rule keeps it, or the reason for which it does not apply, and raises :class:`BrokenLaw`.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from track_fusion.linalg import Array, symmetrise, transpose
from track_fusion.params import Params, from_dict, specs
from track_fusion.rules.base import EACH, Example, FusedTracks, Mixture, Rule, SourceTracks, Values

Rng = np.random.Generator
Law = Callable[[Rule, Example, Rng], str | None]

#: Axes of the tracks that are drawn, and by how many standard deviations that must differ of which it is claimed.
AXES, DIFFERENT = 4, 1e-3
#: Of so many draws of tracks, each with so many joint error covariances, the worst is held against the claim, and must
#: reach this share of it, or it shows nothing.
DRAWS, JOINTS, TELLING = 25, 100, 0.7


class BrokenLaw(AssertionError):
    """What a law expected of a rule, and what it got."""


class Verdict(NamedTuple):
    """What became of a law: "passed", "failed" or "skipped", and what it says, or why not."""

    law: str
    outcome: str
    text: str


def check(rule: Rule) -> Iterator[Verdict]:
    """Hold a rule against each law."""
    for seed, law in enumerate(LAWS):
        try:
            reason = law(rule, rule.example, np.random.default_rng(seed))
        except BrokenLaw as error:
            yield Verdict(law.__name__, "failed", str(error))
        else:
            yield Verdict(law.__name__, "skipped" if reason else "passed", reason or law.__doc__ or "")


# What a law tries a rule on.


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
        fused = self.rule.fuse(self.equipped(SourceTracks(means, cov, dof, mixture)), self.params)
        gain = fused.mean[1:-1].T - fused.mean[0][:, None]
        off = np.abs(gain @ trial.reshape(-1) - fused.mean[-1]).max()
        _require(off <= 1e-7, f"mean: expected linear in the means of the tracks, got one {off:.2g} off.")
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


# How a law is stated.


def _in_each_case(counts: Sequence[int], values: str = "params") -> Callable[[Callable[[Case, Rng], str | None]], Law]:
    """Make a law of what holds in a case: for these numbers of sources, at each of the example's `values`.

    Each case draws the same numbers, so that none depends on those before it.
    """

    def make(holds: Callable[[Case, Rng], str | None]) -> Law:
        @functools.wraps(holds)
        def law(rule: Rule, example: Example, rng: Rng) -> str | None:
            reason = None
            for case in (Case(rule, example, v, count) for v in getattr(example, values) for count in counts):
                try:
                    reason = holds(case, copy.deepcopy(rng)) or reason
                except Exception as error:  # a rule that fails breaks the law, too
                    text = str(error) if isinstance(error, BrokenLaw) else f"{type(error).__name__}: {error}"
                    raise BrokenLaw(f"{case.count} tracks, parameters {dict(case.values)}: {text}") from error
            return reason

        return law

    return make


def _require(good: Any, text: str) -> None:
    if not good:
        raise BrokenLaw(text)


def _apart(got: FusedTracks, wanted: FusedTracks) -> Array:
    """Largest difference of the moments, (...), in the wanted standard deviations."""
    sigma = np.sqrt(np.diagonal(wanted.cov, axis1=-2, axis2=-1))
    mean = np.abs((got.mean - wanted.mean) / sigma).max(-1, initial=0.0)
    unit = sigma[..., :, None] * sigma[..., None, :]
    return np.asarray(np.maximum(mean, np.abs((got.cov - wanted.cov) / unit).max((-2, -1), initial=0.0)))


def _same(what: str, got: FusedTracks, wanted: FusedTracks, tolerance: float | Array) -> None:
    apart, most = _apart(got, wanted), np.max(tolerance, initial=0.0)
    text = f"{what}: expected the same within {most:.2g} standard deviations, got {apart.max(initial=0.0):.2g}."
    _require((apart <= tolerance).all(), text)


def _different(what: str, got: FusedTracks, wanted: FusedTracks, least: float = DIFFERENT) -> None:
    apart = _apart(got, wanted).max(initial=0.0)
    _require(not apart <= least, f"{what}: expected another result, as is claimed, got one {apart:.2g} away.")


# The laws.


def described(rule: Rule, example: Example, rng: Rng) -> str | None:
    """The descriptor says what a user needs: key, title, caveat, source, cost, the meaning of each parameter."""
    _require(rule.key.isidentifier() and rule.key.islower(), f"key: expected lower_case, got '{rule.key}'.")
    texts = {name: getattr(rule, name) for name in ("title", "caveat", "source", "cost")}
    texts |= {f"parameter '{name}'": spec.doc for name, (spec, _) in specs(rule.params).items()}
    for name, text in {**texts, "fuse": rule.fuse.__doc__}.items():
        _require(text, f"{name}: expected a text that describes it, got none.")
    for name in ("params", "guaranteed"):
        _require(getattr(example, name), f"Example.{name}: expected one set of parameters at least, got none.")
    claim = rule.affine_equivariant
    good = isinstance(claim, str) == bool(example.not_equivariant)
    _require(good, f"Example.not_equivariant: expected just where affine_equivariant is a text, got {claim!r}.")
    return None


@_in_each_case((1, 2, 3, 5))
def sound(case: Case, rng: Rng) -> None:
    """Shapes fit for any leading axes, covariances are symmetric and definite, the tracks stay as they were."""
    for lead in ((), (1,), (3, 4), (0,)):
        fused = case.fuse(case.tracks(rng, lead))
        for name, array, wanted in _shapes(fused, lead, case.count):
            _require(np.shape(array) == wanted, f"{name}: expected the shape {wanted}, got {np.shape(array)}.")
        _require(np.array_equal(fused.cov, transpose(fused.cov)), "cov: expected symmetric, got others.")
        _require((np.linalg.eigvalsh(fused.cov) > 0).all(), "cov: expected positive definite, got others.")
        _require(np.isfinite(fused.mean).all(), "mean: expected finite, got others.")
        _require(np.all(fused.info.get("converged", True)), "info converged: expected everywhere.")


def _shapes(fused: FusedTracks, lead: tuple[int, ...], count: int) -> Iterator[tuple[str, Any, tuple[int, ...]]]:
    yield "mean", fused.mean, (*lead, AXES)
    yield "cov", fused.cov, (*lead, AXES, AXES)
    if fused.weights is not None:
        yield "weights", fused.weights, (*lead, count)
    if fused.mixture is not None:
        yield "mixture.mean", fused.mixture.mean, (*lead, fused.mixture.count, AXES)
        yield "mixture.cov", fused.mixture.cov, (*lead, fused.mixture.count, AXES, AXES)
    yield from ((f"info {k}", fused.info[k], lead) for k in ("converged", "iterations") if k in fused.info)


@_in_each_case((1, 2, 3, 5))
def batch_equals_loop(case: Case, rng: Rng) -> None:
    """A batch gives what its members give one by one."""
    tracks = case.tracks(rng, (3, 4))
    whole = case.fuse(tracks)
    for i in np.ndindex(3, 4):
        alone = case.fuse(case.picked(tracks, i))
        _same(f"member {i} of a batch", alone, FusedTracks(whole.mean[i], whole.cov[i]), 1e-9)
        if whole.weights is not None:
            good = alone.weights is not None and np.allclose(alone.weights, whole.weights[i], rtol=0, atol=1e-8)
            _require(good, f"weights of member {i}: expected {whole.weights[i]}, got {alone.weights}.")


@_in_each_case((1, 2, 3, 5))
def copies_of_a_track(case: Case, rng: Rng) -> str | None:
    """One track alone comes back as it is; so do copies of it, if that is claimed, and else they do not."""
    if case.count > 1 and case.example.idempotent is None:
        return "One track comes back; of copies of one nothing is stated (Example.idempotent)."
    one = dataclasses.replace(case, count=1).tracks(rng, (5,))
    fused = case.fuse(case.picked(one, (slice(None), np.zeros(case.count, int))))
    wanted = FusedTracks(one.mean[:, 0], one.cov[:, 0])
    if case.count == 1 or case.example.idempotent:
        _same("copies of a track", fused, wanted, case.tolerance(fused, 1e-9))
    else:
        _different("copies of a track", fused, wanted)
    return None


@_in_each_case((2, 3, 5))
def order_of_sources(case: Case, rng: Rng) -> None:
    """The order of the sources does not matter, unless that is claimed, and then it does for more than two."""
    tracks, order = case.tracks(rng, (20,)), np.roll(np.arange(case.count), 1)
    turned = {k: tuple(getattr(case.params, k)[i] for i in order) for k, v in case.values.items() if v is EACH}
    first = case.fuse(tracks)
    second = case.rule(case.picked(tracks, (slice(None), order)), dataclasses.replace(case.params, **turned))
    if case.rule.order_matters and case.count > 2:
        _different("sources in another order", second, first, 1e-6)
    else:
        _same("sources in another order", second, first, case.tolerance(first, 1e-8))


@_in_each_case((2, 3, 5))
def affine_equivariance(case: Case, rng: Rng) -> None:
    """In other axes and units the result is the same, unless that is denied, and then it is another."""
    tracks = case.tracks(rng, (20,))
    matrix, shift = np.diag([1e-3, 1.0, 30.0, 1e3]) @ rng.normal(size=(AXES, AXES)), rng.normal(size=AXES)

    def move(mean: Array, cov: Array) -> tuple[Array, Array]:
        return mean @ matrix.T + shift, symmetrise(matrix @ cov @ matrix.T)

    mixture = tracks.mixture and Mixture(tracks.mixture.weight, *move(tracks.mixture.mean, tracks.mixture.cov))
    here = case.fuse(tracks)
    there = case.fuse(case.equipped(SourceTracks(*move(tracks.mean, tracks.cov), tracks.dof, mixture)))
    moved = FusedTracks(*move(here.mean, here.cov))
    if case.rule.affine_equivariant is False or case.values in case.example.not_equivariant:
        _different("other axes", there, moved)
    else:
        _same("other axes", there, moved, case.tolerance(there, 1e-7))


@_in_each_case((2, 3), "guaranteed")
def guarantee(case: Case, rng: Rng) -> str | None:
    """The covariance is not too small for any sampled correlation of the errors, if that is guaranteed."""
    if case.rule.guarantee not in ("conservative", "exact"):
        return f"Nothing to hold: the guarantee is '{case.rule.guarantee}'."
    worst = max(case.worst_error(rng) for _ in range(DRAWS))
    _require(worst <= 1.0 + 1e-9, f"error variance over the claimed one: expected at most 1, got {worst:.6g}.")
    _require(worst > TELLING, f"largest error variance over the claimed one: expected near 1, got {worst:.3g}.")
    return None


@_in_each_case((1, 2, 3))
def linearity(case: Case, rng: Rng) -> str | None:
    """The mean is linear in the means, and all else depends on the covariances alone, if that is claimed."""
    if not case.rule.linear:
        return "It is not claimed."
    _, fused = case.estimate(case.tracks(rng, (), n=2))
    for name, array in (("cov", fused.cov), ("weights", fused.weights)):
        _require(array is None or np.allclose(array, array[:1], 1e-9), f"{name}: expected the same for all means.")
    return None


def counter_example(rule: Rule, example: Example, rng: Rng) -> str | None:
    """A rule that promises less shows by how much; one that is conservative has nothing to show."""
    if rule.guarantee not in ("none", "structural"):
        _require(example.counter_example is None, f"guarantee '{rule.guarantee}': expected no counter-example.")
        return f"Nothing to show: the guarantee is '{rule.guarantee}'."
    if example.counter_example is None:
        return "None is stated (Example.counter_example)."
    ratio, stated = example.counter_example()
    text = f"error variance over the claimed one: expected {stated:.4g}, as is stated, and above 1, got {ratio:.4g}."
    _require(stated > 1.0 and abs(ratio - stated) <= 1e-2 * stated, text)
    return None


LAWS: tuple[Law, ...] = (
    described, sound, batch_equals_loop, copies_of_a_track, order_of_sources, affine_equivariance, guarantee, linearity,
    counter_example,
)  # fmt: skip
