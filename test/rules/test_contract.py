"""The laws that every registered rule keeps; a rule added to RULES is tested here without further ado."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from rules.examples import (
    EACH,
    EXAMPLES,
    Example,
    Values,
    arrays_of,
    build,
    covariances,
    example_of,
    joint_covariances,
    select,
    tolerance_of,
    tracks_for,
    with_extras,
)

from track_fusion.linalg import Array
from track_fusion.params import ParameterError, from_dict, specs
from track_fusion.rules import RULES, FusedTracks, Rule, SourceTracks, get_rule

EVERY_RULE = pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())


def _each(values: str) -> Any:
    """Parametrise over every rule and each of its examples' parameters of this kind."""
    cases = [(rule, v) for rule in RULES.values() for v in getattr(EXAMPLES.get(rule.key, Example()), values)]
    names = [f"{rule.key}-{'-'.join(map(str, v.values())) or 'default'}" for rule, v in cases]
    return pytest.mark.parametrize(("rule", "values"), cases, ids=names)


EVERY_CASE = _each("params")
SOURCES = pytest.mark.parametrize("count", [1, 2, 3, 5])


def _assert_same(got: FusedTracks, wanted: FusedTracks, tolerance: float | Array = 1e-9) -> None:
    """Compare moments in units of the wanted standard deviations."""
    sigma = np.sqrt(np.diagonal(wanted.cov, axis1=-2, axis2=-1))
    assert (np.abs((got.mean - wanted.mean) / sigma).max(-1, initial=0.0) <= tolerance).all()
    unit = sigma[..., :, None] * sigma[..., None, :]
    assert (np.abs((got.cov - wanted.cov) / unit).max((-2, -1), initial=0.0) <= tolerance).all()


def test_every_example_belongs_to_a_rule() -> None:
    assert set(EXAMPLES) <= set(RULES)
    assert all(key == rule.key for key, rule in RULES.items())


@EVERY_RULE
def test_descriptor_and_docstring_say_what_a_user_needs(rule: Rule) -> None:
    assert rule.key == rule.key.lower() == rule.fuse.__module__.rsplit(".", 1)[-1]
    assert rule.title
    assert rule.caveat
    assert rule.source
    assert rule.cost
    assert all(spec.doc for spec, _ in specs(rule.params).values())
    for heading in ("Parameters\n", "Returns\n", "Raises\n", "Notes ", "References "):
        assert f"    {heading}" in (rule.fuse.__doc__ or "")


@EVERY_CASE
@SOURCES
@pytest.mark.parametrize("lead", [(), (1,), (3, 4), (0,)], ids=str)
def test_shapes_symmetry_and_definiteness(rule: Rule, values: Values, count: int, lead: tuple[int, ...]) -> None:
    tracks = tracks_for(rule, np.random.default_rng(1), lead, count)
    before = [a.copy() for a in arrays_of(tracks)]
    fused = rule(tracks, build(rule, values, count))
    assert fused.mean.shape == (*lead, 4)
    assert fused.cov.shape == (*lead, 4, 4)
    np.testing.assert_array_equal(fused.cov, np.swapaxes(fused.cov, -1, -2))
    assert (np.linalg.eigvalsh(fused.cov) > 0).all()
    assert np.isfinite(fused.mean).all()
    if fused.weights is not None:
        assert fused.weights.shape == (*lead, count)
    if fused.mixture is not None:
        parts = fused.mixture.weight.shape[-1]
        assert fused.mixture.mean.shape == (*lead, parts, 4)
        assert fused.mixture.cov.shape == (*lead, parts, 4, 4)
    for name in ("converged", "iterations"):
        if name in fused.info:
            assert np.shape(fused.info[name]) == lead
            assert np.all(fused.info["converged"])
    for now, then in zip(arrays_of(tracks), before, strict=True):
        np.testing.assert_array_equal(now, then)


@EVERY_CASE
@SOURCES
def test_batch_equals_loop(rule: Rule, values: Values, count: int) -> None:
    tracks = tracks_for(rule, np.random.default_rng(2), (3, 4), count)
    params = build(rule, values, count)
    whole = rule(tracks, params)
    for i in np.ndindex(3, 4):
        alone = rule(select(tracks, i), params)
        _assert_same(alone, FusedTracks(whole.mean[i], whole.cov[i]))
        if whole.weights is not None:
            assert alone.weights is not None
            np.testing.assert_allclose(alone.weights, whole.weights[i], rtol=0, atol=1e-8)


@EVERY_CASE
@SOURCES
def test_one_track_seen_several_times(rule: Rule, values: Values, count: int) -> None:
    """A rule that claims it gives the track back; one that does not must be caught at it."""
    rng = np.random.default_rng(3)
    one = tracks_for(rule, rng, (5,), 1)
    same = with_extras(rule, rng, select(dataclasses.replace(one, extras={}), (slice(None), np.zeros(count, int))))
    fused = rule(same, build(rule, values, count))
    wanted = FusedTracks(one.mean[:, 0], one.cov[:, 0])
    if example_of(rule).idempotent or count == 1:
        _assert_same(fused, wanted, tolerance_of(rule, values, fused, 1e-9))
    else:
        with pytest.raises(AssertionError):
            _assert_same(fused, wanted, 1e-3)


@EVERY_CASE
@pytest.mark.parametrize("count", [2, 3, 5])
def test_order_of_the_sources(rule: Rule, values: Values, count: int) -> None:
    tracks = tracks_for(rule, np.random.default_rng(4), (20,), count)
    params = build(rule, values, count)
    order = np.roll(np.arange(count), 1)
    turned = select(tracks, (slice(None), order))
    given = {"weights": tuple(params.weights[i] for i in order)} if values.get("weights") is EACH else {}
    first, second = rule(tracks, params), rule(turned, dataclasses.replace(params, **given))
    if rule.order_matters and count > 2:
        with pytest.raises(AssertionError):
            _assert_same(second, first, 1e-6)
    else:
        _assert_same(second, first, tolerance_of(rule, values, first, 1e-8))


def _moved(rule: Rule, values: Values, count: int) -> tuple[FusedTracks, FusedTracks]:
    """Fuse tracks in other coordinates y = A x + b; return that and the fusion moved there."""
    rng = np.random.default_rng(5)
    tracks = tracks_for(rule, rng, (20,), count)
    matrix, shift = np.diag([1e-3, 1.0, 30.0, 1e3]) @ rng.normal(size=(4, 4)), rng.normal(size=4)

    def move(mean: Array, cov: Array) -> tuple[Array, Array]:
        cov = matrix @ cov @ matrix.T
        return mean @ matrix.T + shift, 0.5 * (cov + np.swapaxes(cov, -1, -2))

    mean, cov = move(tracks.mean, tracks.cov)
    mixture = tracks.mixture
    if mixture is not None:
        part = move(mixture.mean, mixture.cov)
        mixture = dataclasses.replace(mixture, mean=part[0], cov=part[1])
    there = with_extras(rule, rng, SourceTracks(mean, cov, tracks.dof, mixture))
    params = build(rule, values, count)
    here = rule(tracks, params)
    return rule(there, params), FusedTracks(*move(here.mean, here.cov))


@EVERY_CASE
@pytest.mark.parametrize("count", [2, 3, 5])
def test_affine_equivariance(rule: Rule, values: Values, count: int) -> None:
    example = example_of(rule)
    assert isinstance(rule.affine_equivariant, str) == bool(example.not_equivariant)
    there, moved = _moved(rule, values, count)
    if rule.affine_equivariant is False or values in example.not_equivariant:
        with pytest.raises(AssertionError):
            _assert_same(there, moved, 1e-3)
    else:
        _assert_same(there, moved, tolerance_of(rule, values, there, 1e-7))


# Guarantees ---------------------------------------------------------------------------------------------------------


def _gain(rule: Rule, params: Any, tracks: SourceTracks) -> tuple[Array, Array]:
    """Read the linear estimator x = G (x_1, ..., x_K) off the rule, and what it claims when all means agree.

    Fails where the fused mean is not linear in the means, for which a guarantee says nothing.
    """
    sources, n = tracks.mean.shape
    probes = np.concatenate([np.zeros((1, sources * n)), np.eye(sources * n)]).reshape(-1, sources, n)
    trial = np.random.default_rng(0).normal(size=(1, sources, n))
    means = np.concatenate([probes, trial])
    fused = rule.fuse(_at(tracks, means), params)
    gain = fused.mean[1:-1].T - fused.mean[0][:, None]
    np.testing.assert_allclose(gain @ trial.reshape(-1), fused.mean[-1], atol=1e-7)
    return gain, fused.cov[0]


def _at(tracks: SourceTracks, means: Array) -> SourceTracks:
    """Move tracks (K, n) to means (B, K, n), their components with them."""

    def repeat(array: Array) -> Array:
        return np.broadcast_to(array, (len(means), *array.shape))

    mixture = tracks.mixture
    if mixture is not None:
        moved = mixture.mean + (means - tracks.mean)[:, :, None]
        mixture = dataclasses.replace(mixture, weight=repeat(mixture.weight), mean=moved, cov=repeat(mixture.cov))
    extras = {k: repeat(v) for k, v in tracks.extras.items() if hasattr(v, "shape")}
    return dataclasses.replace(tracks, mean=means, cov=repeat(tracks.cov), mixture=mixture, extras=extras)


def _worst(rule: Rule, values: Values, sources: int, rng: np.random.Generator, joints: int) -> float:
    """Largest eigenvalue of the true error covariance relative to the claimed one, over admissible joints."""
    tracks = tracks_for(rule, rng, (), sources, n=2)
    gain, claimed = _gain(rule, build(rule, values, sources), tracks)
    sample = example_of(rule).joint
    joint = joint_covariances(rng, tracks.cov, joints) if sample is None else sample(rng, tracks, joints)
    white = np.linalg.inv(np.linalg.cholesky(claimed)) @ gain
    return float(np.linalg.eigvalsh(white @ joint @ white.T).max())


@_each("guaranteed")
@pytest.mark.parametrize("sources", [2, 3])
def test_conservative_for_every_cross_covariance(rule: Rule, values: Values, sources: int) -> None:
    if rule.guarantee not in ("conservative", "exact"):
        assert example_of(rule).counter_example is not None, f"'{rule.key}' promises less: show by how much."
        return
    rng = np.random.default_rng(6)
    worst = max(_worst(rule, values, sources, rng, 100) for _ in range(25))
    assert worst <= 1.0 + 1e-9
    assert worst > 0.7  # the samples come near the bound, else they would test nothing


def test_the_samples_would_catch_a_rule_that_is_not_conservative() -> None:
    rng = np.random.default_rng(6)
    assert max(_worst(get_rule("naive"), {}, 2, rng, 100) for _ in range(5)) > 1.5


@EVERY_RULE
def test_counter_example_of_the_docstring(rule: Rule) -> None:
    example = example_of(rule)
    if rule.guarantee in ("none", "structural"):
        assert example.counter_example is not None, f"examples.py lacks a counter-example for '{rule.key}'."
        ratio, stated = example.counter_example()
        assert ratio == pytest.approx(stated, rel=1e-2)
        assert stated > 1.0
        notes = (rule.fuse.__doc__ or "").split("Notes ", 1)[1]
        assert "error" in notes.split("References", 1)[0]
    else:
        assert example.counter_example is None


# Errors -------------------------------------------------------------------------------------------------------------


def _fail(call: Any, *args: Any) -> str:
    with pytest.raises(ValueError) as caught:
        call(*args)
    return str(caught.value)


@EVERY_RULE
def test_unknown_parameter_names_the_nearest(rule: Rule) -> None:
    for name in specs(rule.params):
        wrong = name[:-1] + "q" if len(name) > 3 else name + "q"
        with pytest.raises(ParameterError, match=re.escape(f"Unknown parameter '{wrong}'. Did you mean '{name}'?")):
            from_dict(rule.params, {wrong: 1})
    valid = ", ".join(sorted(specs(rule.params))) or "none"
    text = _fail(from_dict, rule.params, {"zzzzzzzz": 1})
    assert text == f"Unknown parameter 'zzzzzzzz'. Valid: {valid}."


@EVERY_RULE
def test_given_weights_that_do_not_fit(rule: Rule) -> None:
    found = specs(rule.params)
    if "weights" not in found or "given" not in found["criterion"][0].choices:
        return
    tracks = tracks_for(rule, np.random.default_rng(7), (2,), 3)

    def given(*weights: float) -> str:
        params = rule.params(criterion="given", weights=weights)  # type: ignore[call-arg]
        return _fail(rule, tracks, params)

    assert given(0.5, 0.5) == "The 'weights' parameter must hold one weight a source, 3. Got 2."
    assert given() == "The 'weights' parameter must hold one weight a source, 3. Got 0."
    assert given(0.5, 0.25, 0.5) == "The 'weights' parameter must be non-negative and sum to 1. Got (0.5, 0.25, 0.5)."
    text = _fail(lambda: rule.params(criterion="given", weights=(1.5, -0.5, 0.0)))  # type: ignore[call-arg]
    assert text == "The 'weights' parameter must be a list of numbers >= 0 and <= 1. Got (1.5, -0.5, 0.0)."
    default = found["criterion"][1]
    text = _fail(rule, tracks, rule.params(weights=(0.5, 0.25, 0.25)))  # type: ignore[call-arg]
    assert text == f"The 'weights' parameter needs criterion 'given'. Got criterion '{default}'."


@EVERY_RULE
def test_malformed_tracks(rule: Rule) -> None:
    good = tracks_for(rule, np.random.default_rng(8), (3,), 2)
    mean, cov = good.mean.copy(), good.cov.copy()

    def fail(**change: Any) -> str:
        return _fail(rule, dataclasses.replace(good, **change))

    mean[1, 0, 2] = np.nan
    assert fail(mean=mean) == "The 'mean' of source tracks must be finite."
    cov[1, 0, 2, 2] = np.inf
    assert fail(cov=cov) == "The 'cov' of source tracks must be finite."
    assert fail(cov=good.cov[..., :3]) == ("The 'cov' of source tracks must have shape (3, 2, 4, 4). Got (3, 2, 4, 3).")
    assert fail(mean=good.mean[0, 0]) == (
        "The 'mean' of source tracks must have shape (..., K >= 1, n >= 1). Got (4,)."
    )
    assert fail(mean=good.mean[:, :0]) == (
        "The 'mean' of source tracks must have shape (..., K >= 1, n >= 1). Got (3, 0, 4)."
    )
    cov = good.cov.copy()
    cov[2, 1] = np.diag([1.0, 2.0, -3.0, 4.0])
    assert fail(cov=cov) == (
        "The 'cov' of source tracks must be positive definite: 1 of 6 are not. Smallest eigenvalue: -3."
    )
    cov = good.cov.copy()
    cov[0, 0, 0, 1] += 0.1
    assert fail(cov=cov) == "The 'cov' of source tracks must be symmetric."
    assert fail(dof=np.full((3, 2), 2.0)) == "The 'dof' of source tracks must exceed 2. Got 2.0."
    assert fail(dof=np.full(3, 5.0)) == "The 'dof' of source tracks must have shape (3, 2). Got (3,)."
    for name in rule.needs:
        assert fail(extras={}) == f"The rule '{rule.key}' needs '{name}' beside the tracks. Got none."
        break
    for name, parameter, value in rule.needs_when:
        params = from_dict(rule.params, {parameter: value})
        assert rule.needed(params) == (*rule.needs, name)
        text = _fail(rule, dataclasses.replace(good, extras={}), params)
        assert text == f"The rule '{rule.key}' needs '{name}' beside the tracks. Got none."


def test_misspelt_rule() -> None:
    text = _fail(get_rule, "covariance_intersecton")
    assert text.startswith("Unknown rule 'covariance_intersecton'. Did you mean 'covariance_intersection'? Valid: ")


def test_covariances_of_the_examples_are_what_they_claim() -> None:
    """The marginals of the sampled joints are the tracks' covariances, and the joints are covariances."""
    rng = np.random.default_rng(9)
    cov = covariances(rng, 3, n=2)
    joint = joint_covariances(rng, cov, 50)
    for k in range(3):
        block = joint[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        np.testing.assert_allclose(block, np.broadcast_to(cov[k], block.shape), rtol=1e-10, atol=1e-12)
    assert np.linalg.eigvalsh(joint).min() > -1e-10
