"""The laws of track_fusion/rules/contract.py over every rule of ours; a rule added is tested without further ado."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from rules.examples import COUNTER_EXAMPLES, covariances, joint_covariances

from track_fusion.params import ParameterError, Params, from_dict, specs
from track_fusion.rules import RULES, Example, FusedTracks, Rule, SourceTracks, get_rule
from track_fusion.rules.contract import HELD, LAWS, check
from track_fusion.rules.trials import BrokenLaw, Case

EVERY_RULE = pytest.mark.parametrize("rule", RULES.own.values(), ids=RULES.own)
BY_NAME = {law.__name__: law for law in LAWS}


def _tracks(rule: Rule, seed: int, lead: tuple[int, ...], count: int) -> SourceTracks:
    return Case(rule, rule.example, {}, count).tracks(np.random.default_rng(seed), lead)


def test_keys() -> None:
    assert set(COUNTER_EXAMPLES) <= set(RULES.own)
    assert all(key == rule.key for key, rule in RULES.own.items())


@EVERY_RULE
@pytest.mark.parametrize("seed", range(len(LAWS)), ids=BY_NAME)
def test_law(rule: Rule, seed: int) -> None:
    """Each law is kept, and none is passed over but where the descriptor claims nothing."""
    example = dataclasses.replace(rule.example, counter_example=COUNTER_EXAMPLES.get(rule.key))
    promises = [case.guarantee in HELD for v in example.params for case in [Case(rule, example, v, 2)]]
    by_default = rule.guarantee_at() in HELD
    silent = {"linearity": not rule.linear, "guarantee": not any(promises), "counter_example": by_default}
    reason = LAWS[seed](rule, example, np.random.default_rng(seed))
    assert (reason is not None) == silent.get(LAWS[seed].__name__, False), reason


@EVERY_RULE
def test_descriptor_and_docstring_say_what_a_user_needs(rule: Rule) -> None:
    assert rule.key == rule.fuse.__module__.rsplit(".", 1)[-1]
    for heading in ("Parameters\n", "Returns\n", "Raises\n", "Notes ", "References "):
        assert f"    {heading}" in (rule.fuse.__doc__ or "")


@pytest.mark.parametrize("key", COUNTER_EXAMPLES)
def test_counter_example_of_the_docstring(key: str) -> None:
    notes = (RULES[key].fuse.__doc__ or "").split("Notes ", 1)[1]
    assert "error" in notes.split("References", 1)[0]


# Laws catch what breaks them ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class NoParams(Params):
    """None."""


def _mean(tracks: SourceTracks, params: NoParams) -> FusedTracks:
    """Average means and covariances: conservative, linear, equivariant, of any order, idempotent."""
    return FusedTracks(tracks.mean.mean(-2), tracks.cov.mean(-3))


GOOD = Rule(
    "average", "Average", _mean, NoParams, "gaussian", "n_ary", "conservative", "a caveat", "a source", "a cost",
    linear=True, example=Example(idempotent=True),
)  # fmt: skip


def _changed(**changes: Any) -> Any:
    """A fusion like `_mean`, with changes to its result: functions of the tracks."""

    def fuse(tracks: SourceTracks, params: NoParams) -> FusedTracks:
        """Fuse."""
        fused = _mean(tracks, params)
        return dataclasses.replace(fused, **{name: make(tracks, fused) for name, make in changes.items()})

    return fuse


def _writes(tracks: SourceTracks, params: NoParams) -> FusedTracks:
    """Fuse."""
    tracks.mean[..., 0, :] += 1.0
    return _mean(tracks, params)


def _claiming(**changes: Any) -> Rule:
    """The good rule under another descriptor."""
    return dataclasses.replace(GOOD, **changes)


def _giving(**changes: Any) -> Rule:
    """The good rule with another result."""
    return _claiming(fuse=_changed(**changes))


def _showing(**changes: Any) -> Rule:
    """The good rule under another example."""
    return _claiming(example=Example(**changes))


TILT = np.triu(np.full((4, 4), 0.1))
BROKEN: dict[str, tuple[str, Rule]] = {
    "a key in capitals": ("described", _claiming(key="Average")),
    "no caveat": ("described", _claiming(caveat="")),
    "a text without example": ("described", _claiming(affine_equivariant="not in feet")),
    "no parameters": ("described", _showing(params=())),
    "a shape": ("sound", _giving(mean=lambda t, f: t.mean)),
    "weights for another": ("sound", _giving(weights=lambda t, f: f.mean)),
    "not symmetric": ("sound", _giving(cov=lambda t, f: f.cov + TILT)),
    "not definite": ("sound", _giving(cov=lambda t, f: -f.cov)),
    "not finite": ("sound", _giving(mean=lambda t, f: f.mean * np.inf)),
    "not converged": ("sound", _giving(info=lambda t, f: {"converged": np.zeros(f.mean.shape[:-1], bool)})),
    "writes to the tracks": ("sound", _claiming(fuse=_writes)),
    "fails": ("sound", _claiming(needs=("a_map",))),
    "looks at its batch": ("batch_equals_loop", _giving(cov=lambda t, f: f.cov * f.cov.ndim)),
    "inflates": ("copies_of_a_track", _giving(cov=lambda t, f: 2.0 * f.cov)),
    "denies that it is idempotent": ("copies_of_a_track", _showing(idempotent=False)),
    "takes the first": ("order_of_sources", _giving(mean=lambda t, f: t.mean[..., 0, :])),
    "claims that the order matters": ("order_of_sources", _claiming(order_matters=True)),
    "adds a metre": ("affine_equivariance", _giving(mean=lambda t, f: f.mean + 1.0)),
    "claims to depend on units": ("affine_equivariance", _claiming(affine_equivariant=False)),
    "looks at the origin": ("axes_that_wrap", _giving(mean=lambda t, f: 1.01 * f.mean)),
    "claims too little": ("guarantee", _giving(cov=lambda t, f: 0.9 * f.cov)),
    "claims far too much": ("guarantee", _giving(cov=lambda t, f: 2.0 * f.cov)),
    "promises for a mean that bends": ("guarantee", _giving(mean=lambda t, f: f.mean**3)),
    "bends": ("linearity", _giving(mean=lambda t, f: f.mean**3)),
    "spreads": ("linearity", _giving(cov=lambda t, f: f.cov * (1.0 + f.mean[..., :1, None] ** 2))),
    "shows what it denies": ("counter_example", _showing(counter_example=lambda: (2.0, 2.0))),
    "shows nothing": (
        "counter_example", _claiming(guarantee="none", example=Example(counter_example=lambda: (0.9, 0.9)))
    ),
    "shows another number": (
        "counter_example", _claiming(guarantee="none", example=Example(counter_example=lambda: (2.0, 3.0)))
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_a_rule_that_breaks_a_law_is_caught(case: str) -> None:
    name, rule = BROKEN[case]
    with pytest.raises(BrokenLaw, match="expected|ValueError: "):
        BY_NAME[name](rule, rule.example, np.random.default_rng(0))


def test_a_good_rule_breaks_none() -> None:
    verdicts = {verdict.law: verdict for verdict in check(GOOD)}
    assert list(verdicts) == list(BY_NAME)
    assert {v.outcome for name, v in verdicts.items() if name != "counter_example"} == {"passed"}
    assert verdicts["counter_example"].outcome == "skipped"


def test_what_the_example_does_not_state_is_passed_over() -> None:
    plain = dataclasses.replace(GOOD, guarantee="none", linear=False, example=Example())
    outcomes = {verdict.law: verdict for verdict in check(plain)}
    skipped = {name for name, verdict in outcomes.items() if verdict.outcome == "skipped"}
    assert skipped == {"copies_of_a_track", "guarantee", "linearity", "counter_example"}
    assert outcomes["counter_example"].text == "None is stated (Example.counter_example)."


def test_the_samples_would_catch_a_rule_that_is_not_conservative() -> None:
    rng, naive = np.random.default_rng(6), get_rule("naive")
    assert max(Case(naive, naive.example, {}, 2).worst_error(rng) for _ in range(5)) > 1.5


def test_extras_of_ones_own_reach_the_rule() -> None:
    def fuse(tracks: SourceTracks, params: NoParams) -> FusedTracks:
        """Fuse with a map."""
        assert tracks.extras["a_map"].shape == tracks.mean.shape
        return _mean(tracks, params)

    def extras(tracks: SourceTracks) -> Mapping[str, Any]:
        return {"a_map": np.zeros(tracks.mean.shape)}

    rule = dataclasses.replace(GOOD, fuse=fuse, needs=("a_map",), example=Example(idempotent=True, extras=extras))
    assert {v.outcome for v in check(rule)} == {"passed", "skipped"}


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
    tracks = _tracks(rule, 7, (2,), 3)

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
    good = _tracks(rule, 8, (3,), 2)
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
    assert fail(periods=(6.0, -1.0, np.inf, np.inf)) == (
        "The 'periods' of source tracks must be 4 numbers > 0, infinite where an axis does not wrap. "
        "Got (6.0, -1.0, inf, inf)."
    )
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
