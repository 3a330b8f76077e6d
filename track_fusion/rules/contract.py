"""The laws that every fusion rule keeps: for our tests, and by `track-fusion rules --check` for a rule of anybody's.

A law returns nothing where a rule keeps it, or the reason for which it does not apply, and raises :class:`BrokenLaw`.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from track_fusion import angles
from track_fusion.densities.mixture.mixture import moments, padded
from track_fusion.linalg import Array, symmetrise, transpose
from track_fusion.params import specs
from track_fusion.rules.base import EACH, Example, FusedTracks, Mixture, Rule, SourceTracks
from track_fusion.rules.trials import AXES, BrokenLaw, Case, Rng, require

Law = Callable[[Rule, Example, Rng], str | None]

#: By how many standard deviations that must differ of which it is claimed.
DIFFERENT = 1e-3
#: Of so many draws of tracks, each with many joint error covariances, the worst is held against the claim, and must
#: reach this share of it, or it shows nothing.
DRAWS, TELLING = 25, 0.7
#: What a covariance is held to.
HELD = ("conservative", "exact")
#: Periods of the axes where the last is a direction; such tracks are drawn with this share of their spread along it.
PERIODS, NARROW = (*(np.inf,) * (AXES - 1), angles.TURN), 0.1


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


# How a law is stated.


def _in_each_case(counts: Sequence[int]) -> Callable[[Callable[[Case, Rng], str | None]], Law]:
    """Make a law of what holds in a case: for these numbers of sources, at each of the example's parameters.

    Each case draws the same numbers, so that none depends on those before it.
    """

    def make(holds: Callable[[Case, Rng], str | None]) -> Law:
        @functools.wraps(holds)
        def law(rule: Rule, example: Example, rng: Rng) -> str | None:
            reason = None
            for case in (Case(rule, example, v, count) for v in example.params for count in counts):
                try:
                    reason = holds(case, copy.deepcopy(rng)) or reason
                except Exception as error:  # a rule that fails breaks the law, too
                    text = str(error) if isinstance(error, BrokenLaw) else f"{type(error).__name__}: {error}"
                    raise BrokenLaw(f"{case.count} tracks, parameters {dict(case.values)}: {text}") from error
            return reason

        return law

    return make


def _apart(got: FusedTracks, wanted: FusedTracks) -> Array:
    """Largest difference of the moments, (...), in the wanted standard deviations."""
    sigma = np.sqrt(np.diagonal(wanted.cov, axis1=-2, axis2=-1))
    mean = np.abs((got.mean - wanted.mean) / sigma).max(-1, initial=0.0)
    unit = sigma[..., :, None] * sigma[..., None, :]
    return np.asarray(np.maximum(mean, np.abs((got.cov - wanted.cov) / unit).max((-2, -1), initial=0.0)))


def _same(what: str, got: FusedTracks, wanted: FusedTracks, tolerance: float | Array) -> None:
    apart, most = _apart(got, wanted), np.max(tolerance, initial=0.0)
    text = f"{what}: expected the same within {most:.2g} standard deviations, got {apart.max(initial=0.0):.2g}."
    require((apart <= tolerance).all(), text)


def _different(what: str, got: FusedTracks, wanted: FusedTracks, least: float = DIFFERENT) -> None:
    apart = _apart(got, wanted).max(initial=0.0)
    require(not apart <= least, f"{what}: expected another result, as is claimed, got one {apart:.2g} away.")


# The laws.


def described(rule: Rule, example: Example, rng: Rng) -> str | None:
    """The descriptor says what a user needs: key, title, caveat, source, cost, the meaning of each parameter."""
    require(rule.key.isidentifier() and rule.key.islower(), f"key: expected lower_case, got '{rule.key}'.")
    texts = {name: getattr(rule, name) for name in ("title", "caveat", "source", "cost")}
    texts |= {f"parameter '{name}'": spec.doc for name, (spec, _) in specs(rule.params).items()}
    for name, text in {**texts, "fuse": rule.fuse.__doc__}.items():
        require(text, f"{name}: expected a text that describes it, got none.")
    require(example.params, "Example.params: expected one set of parameters at least, got none.")
    for name, claim in (("not_equivariant", "affine_equivariant"), ("ordered", "order_matters")):
        said = getattr(rule, claim)
        good = isinstance(said, str) == bool(getattr(example, name))
        require(good, f"Example.{name}: expected just where {claim} is a text, got {said!r}.")
    return None


@_in_each_case((1, 2, 3, 5))
def sound(case: Case, rng: Rng) -> None:
    """Shapes fit for any leading axes, covariances are symmetric and definite, the tracks stay as they were."""
    for lead in ((), (1,), (3, 4), (0,)):
        fused = case.fuse(case.tracks(rng, lead))
        for name, array, wanted in _shapes(fused, lead, case.count):
            require(np.shape(array) == wanted, f"{name}: expected the shape {wanted}, got {np.shape(array)}.")
        require(np.array_equal(fused.cov, transpose(fused.cov)), "cov: expected symmetric, got others.")
        require((np.linalg.eigvalsh(fused.cov) > 0).all(), "cov: expected positive definite, got others.")
        require(np.isfinite(fused.mean).all(), "mean: expected finite, got others.")
        require(np.all(fused.info.get("converged", True)), "info converged: expected everywhere.")


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
            require(good, f"weights of member {i}: expected {whole.weights[i]}, got {alone.weights}.")


@_in_each_case((1, 2, 3, 5))
def copies_of_a_track(case: Case, rng: Rng) -> str | None:
    """One track alone comes back as it is, unless that is denied; so do copies of it, if that is claimed."""
    keeps = case.example.keeps_one if case.count == 1 else case.example.idempotent
    if keeps is None:
        return "One track comes back; of copies of one nothing is stated (Example.idempotent)."
    one = dataclasses.replace(case, count=1).tracks(rng, (5,))
    fused = case.fuse(case.picked(one, (slice(None), np.zeros(case.count, int))))
    wanted = FusedTracks(one.mean[:, 0], one.cov[:, 0])
    if keeps:
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
    matters = case.rule.order_matters is True or case.values in case.example.ordered
    if matters and case.count > 2:
        _different("sources in another order", second, first, 1e-6)
    else:
        _same("sources in another order", second, first, case.tolerance(first, 1e-8))


def _moved(tracks: SourceTracks, matrix: Array, shift: Array) -> SourceTracks:
    """Tracks in the axes x' = matrix x + shift, (n, n), (n,) or (K, n)."""
    mixture = tracks.mixture
    if mixture is not None:
        cov = symmetrise(matrix @ mixture.cov @ matrix.T)
        mixture = _shifted(Mixture(mixture.weight, mixture.mean @ matrix.T, cov), shift[..., None, :])
    return SourceTracks(tracks.mean @ matrix.T + shift, symmetrise(matrix @ tracks.cov @ matrix.T), tracks.dof, mixture)


def _shifted(densities: Mixture, shift: Array) -> Mixture:
    return dataclasses.replace(densities, mean=densities.mean + shift)


@_in_each_case((2, 3, 5))
def affine_equivariance(case: Case, rng: Rng) -> None:
    """In other axes and units the result is the same, unless that is denied, and then it is another."""
    tracks = case.tracks(rng, (20,))
    matrix, shift = np.diag([1e-3, 1.0, 30.0, 1e3]) @ rng.normal(size=(AXES, AXES)), rng.normal(size=AXES)
    here, there = case.fuse(tracks), case.fuse(case.equipped(_moved(tracks, matrix, shift)))
    moved = FusedTracks(here.mean @ matrix.T + shift, symmetrise(matrix @ here.cov @ matrix.T))
    if case.rule.affine_equivariant is False or case.values in case.example.not_equivariant:
        _different("other axes", there, moved)
    else:
        _same("other axes", there, moved, case.tolerance(there, 1e-7))


@_in_each_case((1, 2, 3, 5))
def axes_that_wrap(case: Case, rng: Rng) -> None:
    """Turning all tracks turns the result, its covariance unchanged; whole turns of some of them change nothing."""
    tracks = case.equipped(_moved(case.tracks(rng, (20,)), np.diag([*(1.0,) * (AXES - 1), NARROW]), np.zeros(AXES)))
    flat, direction = case.fuse(tracks), np.eye(AXES)[-1]
    exact = 1e-9 if {"iterations", "ess"} & set(flat.info) else 1e-12
    for name, turn in (("no turn", 0.0 * direction), ("half a turn", np.pi * direction), ("2 rad", -2.0 * direction)):
        whole = angles.TURN * np.arange(case.count)[:, None] * direction
        extras = {k: _shifted(v, turn) if isinstance(v, Mixture) else v for k, v in tracks.extras.items()}
        turned = _moved(tracks, np.eye(AXES), turn + whole)
        there = case.fuse(dataclasses.replace(turned, extras=extras, periods=PERIODS))
        back = dataclasses.replace(there, mean=angles.difference(there.mean, turn, PERIODS))
        _same(name, back, flat, exact)
        require((np.abs(there.mean[..., -1]) <= np.pi).all(), f"{name}: expected a direction in [-pi, pi].")
        require(not there.info["beyond_half_circle"].any(), f"{name}: expected no tracks beyond a half circle.")


def guarantee(rule: Rule, example: Example, rng: Rng) -> str | None:
    """The covariance is not too small for any sampled correlation of the errors, where that is guaranteed."""
    held = tuple(values for values in example.params if Case(rule, example, values, 2).guarantee in HELD)
    if not held:
        return f"Nothing to hold: the guarantee is '{rule.promise}'."
    return _held(rule, dataclasses.replace(example, params=held), rng)


@_in_each_case((2, 3))
def _held(case: Case, rng: Rng) -> None:
    worst = max(case.worst_error(rng) for _ in range(DRAWS))
    require(worst <= 1.0 + 1e-9, f"error variance over the claimed one: expected at most 1, got {worst:.6g}.")
    require(worst > TELLING, f"largest error variance over the claimed one: expected near 1, got {worst:.3g}.")


@_in_each_case((1, 2, 3))
def linearity(case: Case, rng: Rng) -> str | None:
    """The mean is linear in the means, and all else depends on the covariances alone, if that is claimed."""
    if not case.rule.linear:
        return "It is not claimed."
    _, fused = case.estimate(case.tracks(rng, (), n=2))
    for name, array in (("cov", fused.cov), ("weights", fused.weights)):
        require(array is None or np.allclose(array, array[:1], 1e-9), f"{name}: expected the same for all means.")
    return None


# Mixtures; a rule that takes none sees their moments.


@_in_each_case((2, 3))
def tails(case: Case, rng: Rng) -> None:
    """Mixtures with a light, wide component are fused soundly, in any order, whatever lies in those without weight."""
    tracks = case.mixed(rng, (4,))
    fused, mixture = case.fuse(tracks), tracks.mixture
    assert mixture is not None
    require(np.isfinite(fused.mean).all() and (np.linalg.eigvalsh(fused.cov) > 0).all(), "moments: expected sound.")
    if fused.mixture is not None:
        _same("moments of the fused mixture", FusedTracks(*moments(fused.mixture)), fused, 1e-9)
    turned = padded(mixture.take(np.broadcast_to([2, 0, 1], mixture.weight.shape)), 4)
    far = turned.mean + np.array([0.0, 0.0, 0.0, 9.0])[:, None]
    other = case.fuse(case.equipped(dataclasses.replace(tracks, mixture=dataclasses.replace(turned, mean=far))))
    _same("components in another order, and one without weight", other, fused, case.tolerance(fused, 1e-8))


@_in_each_case((2, 3))
def numbers_of_targets(case: Case, rng: Rng) -> None:
    """Weights that sum to a number of targets (PHD) are averaged, if that is claimed, and else normalised."""
    tracks = case.mixed(rng, (4,))
    number, fused = rng.uniform(0.5, 3.0, size=tracks.mean.shape[:-1]), case.fuse(tracks)
    assert tracks.mixture is not None
    phd = dataclasses.replace(tracks.mixture, weight=tracks.mixture.weight * number[..., None])
    counted = case.fuse(case.equipped(dataclasses.replace(tracks, mixture=phd)))
    total = np.ones(4)
    if case.rule.takes_phds:
        require(counted.weights is not None, "weights: expected some.")
        total = total if counted.weights is None else (counted.weights * number).sum(-1)
    else:
        _same("weights of another sum", counted, fused, case.tolerance(fused, 1e-9))
    if counted.mixture is not None:
        got = counted.mixture.weight.sum(-1)
        require(np.allclose(got, total, rtol=1e-9), f"number of targets: expected {total}, got {got}.")


@_in_each_case((1, 2, 3))
def particles(case: Case, rng: Rng) -> None:
    """Components without covariance keep their moments; a rule that claims nothing takes these alone, or refuses."""
    tracks = case.cloud(rng, (4,))
    wanted = case.fuse(dataclasses.replace(tracks, mixture=None))
    try:
        fused = case.fuse(tracks)
    except ValueError as error:
        refused = not case.rule.takes_particles and "particles" in str(error)
        require(refused, f"particles: expected to be fused, or refused as such, got: {error}")
    else:
        _same("particles", fused, wanted, 1e-9)


def counter_example(rule: Rule, example: Example, rng: Rng) -> str | None:
    """A rule that promises less shows by how much; one that is conservative has nothing to show."""
    if rule.guarantee_at() in HELD:
        require(example.counter_example is None, f"guarantee '{rule.promise}': expected no counter-example.")
        return f"Nothing to show: the guarantee is '{rule.promise}'."
    if example.counter_example is None:
        return "None is stated (Example.counter_example)."
    ratio, stated = example.counter_example()
    text = f"error variance over the claimed one: expected {stated:.4g}, as is stated, and above 1, got {ratio:.4g}."
    require(stated > 1.0 and abs(ratio - stated) <= 1e-2 * stated, text)
    return None


LAWS: tuple[Law, ...] = (
    described, sound, batch_equals_loop, copies_of_a_track, order_of_sources, affine_equivariance, axes_that_wrap,
    guarantee, linearity, counter_example, tails, numbers_of_targets, particles,
)  # fmt: skip
