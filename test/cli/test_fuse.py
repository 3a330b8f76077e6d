"""track-fusion fuse: results against plain NumPy, and each error by the line it prints."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from typing import Any

import numpy as np
import pytest
from cli.runner import refusal, run, run_process, strict_json

from track_fusion.params import Params
from track_fusion.rules import RULES, FusedTracks, Mixture, Rule, SourceTracks

FIRST: dict[str, Any] = {"mean": [0.0, 0.0], "cov": [[4.0, 1.0], [1.0, 1.0]]}
SECOND: dict[str, Any] = {"mean": [1.0, 2.0], "cov": [[1.0, 0.0], [0.0, 3.0]]}
PAIR = [FIRST, SECOND]
HALVES = [{"weight": 0.5, "mean": [0.0, 0.0], "cov": [[1.0, 0.0], [0.0, 1.0]]},
          {"weight": 0.5, "mean": [2.0, 0.0], "cov": [[1.0, 0.0], [0.0, 1.0]]}]  # fmt: skip


def fused(tracks: Any, rule: str = "naive", params: Any = None, **beside: Any) -> Any:
    """Fuse and read the answer."""
    stdin = json.dumps({"tracks": tracks, **beside})
    result = run("fuse", "--rule", rule, "--params", json.dumps(params or {}), stdin=stdin)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    return strict_json(result.stdout)


def refused(stdin: Any, *words: str, rule: str = "naive") -> str:
    """Return the line with which an input (text, or what is to be JSON) was refused."""
    text = stdin if isinstance(stdin, str | bytes) else json.dumps(stdin)
    return refusal(run("fuse", "--rule", rule, *words, stdin=text))


def refused_tracks(*tracks: Any) -> str:
    return refused({"tracks": list(tracks)})


# Results.


def test_naive_adds_information() -> None:
    infos = [np.linalg.inv(t["cov"]) for t in PAIR]
    cov = np.linalg.inv(sum(infos))
    mean = cov @ sum(i @ t["mean"] for i, t in zip(infos, PAIR, strict=True))
    answer = fused(PAIR)
    np.testing.assert_allclose(answer["mean"], mean, rtol=1e-12)
    np.testing.assert_allclose(answer["cov"], cov, rtol=1e-12)
    assert list(answer) == ["mean", "cov", "dof", "weights", "info", "components"]
    assert answer["dof"] is answer["weights"] is answer["components"] is None
    assert answer["info"] == {}


@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_covariance_intersection_minimises_its_criterion(criterion: str) -> None:
    infos = [np.linalg.inv(t["cov"]) for t in PAIR]

    def cov_at(w: float) -> Any:
        return np.linalg.inv(w * infos[0] + (1 - w) * infos[1])

    cost = np.linalg.det if criterion == "det" else np.trace
    answer = fused(PAIR, "covariance_intersection", {"criterion": criterion})
    w, other = answer["weights"]
    assert w + other == pytest.approx(1.0)
    assert cost(cov_at(w)) <= min(cost(cov_at(g)) for g in np.linspace(0, 1, 1001)) * (1 + 1e-12)
    np.testing.assert_allclose(answer["cov"], cov_at(w), rtol=1e-9)
    mean = cov_at(w) @ (w * infos[0] @ FIRST["mean"] + (1 - w) * infos[1] @ SECOND["mean"])
    np.testing.assert_allclose(answer["mean"], mean, rtol=1e-9)
    assert answer["info"]["converged"] is True
    assert isinstance(answer["info"]["iterations"], int)


def test_the_average_of_three_tracks_at_given_weights() -> None:
    tracks, weights = [*PAIR, {"mean": [-1, 0], "cov": [[2, 0], [0, 2]]}], [0.2, 0.3, 0.5]
    answer = fused(tracks, "arithmetic_average", {"criterion": "given", "weights": weights})
    mean = sum(w * np.array(t["mean"]) for w, t in zip(weights, tracks, strict=True))
    cov = sum(
        w * (np.array(t["cov"]) + np.outer(t["mean"] - mean, t["mean"] - mean))
        for w, t in zip(weights, tracks, strict=True)
    )
    np.testing.assert_allclose(answer["mean"], mean, atol=1e-12)
    np.testing.assert_allclose(answer["cov"], cov, rtol=1e-12)
    assert answer["weights"] == pytest.approx(weights)


def test_a_single_track_comes_back() -> None:
    answer = fused([FIRST])
    np.testing.assert_allclose(answer["mean"], FIRST["mean"], atol=1e-15)
    np.testing.assert_allclose(answer["cov"], FIRST["cov"], rtol=1e-12)


def test_mixtures_are_averaged_as_mixtures_and_padding_is_not_shown() -> None:
    params = {"criterion": "uniform", "output": "mixture"}
    answer = fused([{"components": HALVES}, SECOND], "arithmetic_average", params)
    assert [c["weight"] for c in answer["components"]] == pytest.approx([0.25, 0.25, 0.5])
    assert [c["mean"] for c in answer["components"]] == [[0.0, 0.0], [2.0, 0.0], [1.0, 2.0]]
    assert answer["components"][2]["cov"] == SECOND["cov"]
    np.testing.assert_allclose(answer["mean"], [1.0, 1.0], rtol=1e-12)


def test_a_rule_for_gaussians_uses_the_moments_of_a_mixture() -> None:
    assert fused([{"components": HALVES}, SECOND]) == fused([{"mean": [1, 0], "cov": [[2, 0], [0, 1]]}, SECOND])


def test_particles_are_components_without_covariance() -> None:
    corners = [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    particles = [{"weight": 0.25, "mean": c, "cov": [[0, 0], [0, 0]]} for c in corners]
    np.testing.assert_allclose(fused([{"components": particles}])["cov"], np.eye(2), atol=1e-15)


def test_the_covariance_is_the_covariance_whatever_the_dof() -> None:
    assert fused([{**FIRST, "dof": 5}, {**SECOND, "dof": None}]) == fused(PAIR)


def test_tracks_of_a_family_are_fused_as_such_and_say_their_dof() -> None:
    """The static example of Chen 2022: scatters 5 and 7 of Student-t tracks; then a shape that a parameter says."""
    tracks = [{"mean": [2.0], "cov": [[15.0]], "dof": 3}, {"mean": [4.0], "cov": [[21.0]], "dof": 3}]
    answer = fused(tracks, "mhdp_explicit")
    assert answer["dof"] == 3.0
    assert answer["info"]["converged"] is True
    unsquared = fused(tracks, "mhdp_iterative", {"criterion": "unsquared"})
    assert (unsquared["mean"], unsquared["info"]["snapped"]) == ([2.0], 0)
    shaped = fused(tracks, "mhdp_explicit", {"family": "generalized_gaussian", "beta": 0.65})
    assert shaped["dof"] is None
    assert shaped["mean"] != answer["mean"]


def test_every_rule_takes_two_plain_tracks_or_says_what_it_needs() -> None:
    for rule in RULES.values():
        if rule.needs:
            line = refused({"tracks": PAIR}, rule=rule.key)
            assert re.fullmatch(rf"(tracks\[0\]\.)?\w+: is missing; rule '{rule.key}' needs it", line)
        else:
            assert np.linalg.eigvalsh(fused(PAIR, rule.key)["cov"]).min() > 0


def test_rounding_noise_in_a_covariance_is_no_asymmetry() -> None:
    noisy = {"mean": [0, 0], "cov": [[4.0, 1.0 + 1e-9], [1.0, 1.0]]}
    np.testing.assert_allclose(fused([noisy])["cov"], FIRST["cov"], atol=1e-8)


def test_a_file_with_byte_order_mark_is_read() -> None:
    result = run("fuse", "--rule", "naive", stdin=b"\xef\xbb\xbf" + json.dumps({"tracks": PAIR}).encode())
    assert strict_json(result.stdout) == fused(PAIR)


def test_in_a_process_of_its_own() -> None:
    done = run_process("fuse", "--rule", "naive", stdin=json.dumps({"tracks": PAIR}))
    assert (done.returncode, done.stderr) == (0, "")
    assert strict_json(done.stdout) == fused(PAIR)
    done = run_process("fuse", "--rule", "naive", stdin='{"tracks": [{"mean": [0]}]}')
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "tracks[0].cov: is missing\n")


# The form of the input.


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", 'standard input: is empty; it must hold {"tracks": [{"mean": [...], "cov": [[...]]}, ...]}'),
        ('{"a"}', "standard input: is not JSON: Expecting ':' delimiter: line 1 column 5 (char 4)"),
        ("tracks", "standard input: is not JSON: Expecting value: line 1 column 1 (char 0)"),
        (b'{"\xff"}',
         "standard input: is not JSON: 'utf-8' codec can't decode byte 0xff in position 2: invalid start byte"),
        ("[" * 100_000, "standard input: is nested too deeply"),
        ("[]", "standard input: must be an object in braces; got []"),
        ("{}", "tracks: is missing"),
        ('{"tracks": []}', "tracks: must be a list of tracks; got an empty list"),
        ('{"tracks": {}}', "tracks: must be a list of tracks; got {}"),
        ('{"tracks": null}', "tracks: must be a list of tracks; got null"),
        ('{"tracks": [3]}', "tracks[0]: must be an object in braces; got 3"),
        ('{"tracks": [], "tracks": []}', "tracks: is given twice in one object"),
        ('{"trakcs": []}', "trakcs: is unknown. Did you mean 'tracks'? Valid: tracks, axes, angular"),
        ('{"tracks": [{}]}', "tracks[0].mean: is missing"),
    ],
)  # fmt: skip
def test_what_is_no_list_of_tracks_is_refused(text: str | bytes, line: str) -> None:
    assert refused(text) == line


COV = FIRST["cov"]


@pytest.mark.parametrize(
    ("track", "line"),
    [
        ({"mean": [0, 0]}, "cov: is missing"),
        ({"cov": COV}, "mean: is missing"),
        ({**FIRST, "covv": COV}, "covv: is unknown. Did you mean 'cov'? Valid: mean, cov, components, dof"),
        ({"mean": 0, "cov": COV}, "mean: must be a list of 2 numbers, one an axis of tracks[0]; got 0"),
        ({"mean": [], "cov": []}, "mean: must be a list of 2 numbers, one an axis of tracks[0]; got an empty list"),
        ({"mean": [0, 0, 0], "cov": COV}, "mean: must be a list of 2 numbers, one an axis of tracks[0]; got 3"),
        ({"mean": [0, [0]], "cov": COV}, "mean[1]: must be a number; got [0]"),
        ({"mean": [0, "0"], "cov": COV}, 'mean[1]: must be a number; got "0"'),
        ({"mean": [0, True], "cov": COV}, "mean[1]: must be a number; got true"),
        ({"mean": [0, None], "cov": COV}, "mean[1]: must be a number; got null"),
        ({"mean": [0, math.nan], "cov": COV}, "mean[1]: must be finite; got nan"),
        ({"mean": [-math.inf, 0], "cov": COV}, "mean[0]: must be finite; got -inf"),
        ({"mean": [0, 1e13], "cov": COV}, "mean[1]: must not exceed 1e+12 in size; got 10000000000000.0"),
        ({"mean": [0, 10**400], "cov": COV}, f"mean[1]: must not exceed 1e+12 in size; got 1{'0' * 56}..."),
        ({"mean": [0, 0], "cov": [4, 1]}, "cov[0]: must be a row of 2 numbers; got 4"),
        ({"mean": [0, 0], "cov": 4}, "cov: must be 2 rows of 2 numbers; got 4"),
        ({"mean": [0, 0], "cov": [[4, 1]]}, "cov: must be 2 rows of 2 numbers; got 1"),
        ({"mean": [0, 0], "cov": [[4, 1], [1]]}, "cov[1]: must be a row of 2 numbers; got 1"),
        ({"mean": [0, 0], "cov": [[4, 1], [math.nan, 1]]}, "cov[1][0]: must be finite; got nan"),
        ({"mean": [0, 0], "cov": [[4, 1], [1, 1e25]]}, "cov[1][1]: must not exceed 1e+24 in size; got 1e+25"),
        ({"mean": [0, 0], "cov": [[4, 1], [0, 1]]}, "cov: must be symmetric; [0][1] is 1, [1][0] is 0"),
        ({"mean": [0, 0], "cov": [[1, 2], [2, 1]]}, "cov: must be positive definite; smallest eigenvalue -1"),
        ({"mean": [0, 0], "cov": [[1, 0], [0, 0]]}, "cov: must be positive definite; smallest eigenvalue 0"),
        ({**FIRST, "dof": 2}, "dof: must exceed 2, or there is no covariance; got 2"),
        ({**FIRST, "dof": math.nan}, "dof: must be finite; got nan"),
        ({**FIRST, "dof": "5"}, 'dof: must be a number; got "5"'),
    ],
)  # fmt: skip
def test_a_bad_track_is_refused_by_its_field(track: dict[str, Any], line: str) -> None:
    assert refused_tracks(FIRST, track) == f"tracks[1].{line}"


def with_part(**changes: Any) -> dict[str, Any]:
    return {"components": [HALVES[0], {**HALVES[1], **changes}]}


@pytest.mark.parametrize(
    ("track", "line"),
    [
        ({"components": []}, "components: must be a list of components; got an empty list"),
        ({"components": [1]}, "components[0]: must be an object in braces; got 1"),
        ({"components": HALVES[:1]}, "components: must have weights that sum to 1; they sum to 0.5"),
        ({"components": HALVES, **FIRST}, "mean: must not be given beside 'components', whose moments it would be"),
        ({"components": [{"weight": 1, "mean": [0, 0]}]}, "components[0].cov: is missing"),
        (with_part(weight=-0.5), "components[1].weight: must not be negative; got -0.5"),
        (with_part(weight=math.nan), "components[1].weight: must be finite; got nan"),
        (with_part(mean=[1]), "components[1].mean: must be a list of 2 numbers, one an axis of tracks[0]; got 1"),
        (with_part(cov=[[1, 0], [0, 0]]), "components[1].cov: must be positive definite; smallest eigenvalue 0"),
        (with_part(dof=5), "components[1].dof: is unknown. Valid: weight, mean, cov"),
        ({"components": [{**h, "cov": [[0, 0], [0, 0]]} for h in HALVES]},
         "components: must be positive definite; smallest eigenvalue 0"),
    ],
)  # fmt: skip
def test_a_bad_mixture_is_refused_by_its_field(track: dict[str, Any], line: str) -> None:
    assert refused_tracks(track) == f"tracks[0].{line}"


# Rules and parameters.


@pytest.mark.parametrize(
    ("rule", "params", "line"),
    [
        ("naiv", "{}", "Unknown rule 'naiv'. Did you mean 'naive'? Valid: "),
        ("naive", "{", "--params: is not JSON: Expecting property name"),
        ("naive", "[]", "--params: must be a JSON object in braces; got []"),
        ("naive", '{"criterion": "det"}', "Unknown parameter 'criterion'. Valid: none."),
        ("covariance_intersection", '{"criteron": "det"}', "Unknown parameter 'criteron'. Did you mean 'criterion'?"),
        ("covariance_intersection", '{"criterion": "tracy"}', "The 'criterion' parameter must be one of 'det', "),
        ("covariance_intersection", '{"criterion": 3}', "The 'criterion' parameter must be one of 'det', "),
        ("covariance_intersection", '{"weights": 3}',
         "The 'weights' parameter must be a list of numbers >= 0 and <= 1. Got 3."),
        ("covariance_intersection", '{"weights": ["a"]}', "The 'weights' parameter must be a list of numbers >= 0"),
        ("covariance_intersection", '{"weights": [2]}', "The 'weights' parameter must be a list of numbers >= 0"),
        ("covariance_intersection", '{"weights": [NaN]}', "The 'weights' parameter must be a list of numbers >= 0"),
        ("covariance_intersection", f'{{"weights": [1{"0" * 400}]}}', ""),
        ("covariance_intersection", '{"weights": null}', "The 'weights' parameter must be a list of numbers >= 0"),
        ("covariance_intersection", '{"criterion": "given", "weights": [0.5, 0.6]}',
         "The 'weights' parameter must be non-negative and sum to 1."),
        ("covariance_intersection", '{"criterion": "given", "weights": [1.0]}',
         "The 'weights' parameter must hold one weight a source, 2. Got 1."),
        ("covariance_intersection", '{"weights": [0.5, 0.5]}', "The 'weights' parameter needs criterion 'given'."),
    ],
)  # fmt: skip
def test_a_bad_rule_or_parameter_is_refused(rule: str, params: str, line: str) -> None:
    assert refused({"tracks": PAIR}, "--params", params, rule=rule).startswith(line)


# What the registered rules need beyond the tracks.


def test_known_cross_covariances_reach_the_rule() -> None:
    """Two scalars of variance 4 and 9 with the covariance 3: the formula of Bar-Shalom and Campo."""
    tracks = [{"mean": [1], "cov": [[4]]}, {"mean": [3], "cov": [[9]]}]
    arguments = ("fuse", "--rule", "cross_covariance", "--params", '{"method": "given"}')
    result = run(*arguments, stdin=json.dumps({"tracks": tracks, "cross_cov": [[3]]}))
    assert result.exit_code == 0, result.stderr
    answer = strict_json(result.stdout)
    assert answer["cov"][0][0] == pytest.approx((36 - 9) / 7)
    assert answer["mean"][0] == pytest.approx((6 * 1 + 1 * 3) / 7)
    missing = run(*arguments, stdin=json.dumps({"tracks": tracks}))
    assert (missing.exit_code, missing.stderr) == (
        2, "cross_cov: is missing; rule 'cross_covariance' needs it\n"
    )  # fmt: skip
    useless = run("fuse", "--rule", "cross_covariance", stdin=json.dumps({"tracks": tracks, "cross_cov": [[3]]}))
    assert useless.exit_code == 2
    assert useless.stderr == "cross_cov: is nothing that rule 'cross_covariance' uses\n"


def test_independent_parts_reach_the_rule_and_come_back() -> None:
    tracks = [{**track, "independent_cov": track["cov"]} for track in PAIR]
    result = run("fuse", "--rule", "split_covariance_intersection", stdin=json.dumps({"tracks": tracks}))
    assert result.exit_code == 0, result.stderr
    answer = strict_json(result.stdout)
    np.testing.assert_allclose(answer["cov"], fused(PAIR, "naive")["cov"], rtol=1e-9)
    np.testing.assert_allclose(answer["info"]["independent_cov"], answer["cov"], rtol=1e-9)


def test_a_target_and_likelihoods_reach_the_average() -> None:
    def weights(criterion: str, data: dict[str, Any]) -> list[float]:
        params = json.dumps({"criterion": criterion})
        result = run("fuse", "--rule", "arithmetic_average", "--params", params, stdin=json.dumps(data))
        assert result.exit_code == 0, result.stderr
        given: list[float] = strict_json(result.stdout)["weights"]
        return given

    likely = [{**FIRST, "likelihood": 3}, {**SECOND, "likelihood": 1}]
    assert weights("likelihood", {"tracks": likely}) == pytest.approx([0.75, 0.25])
    target = {"mean": SECOND["mean"], "cov": SECOND["cov"]}
    assert weights("target", {"tracks": PAIR, "target": target}) == pytest.approx([0.0, 1.0], abs=1e-6)


# Tried with a rule that needs it all.


@dataclasses.dataclass(frozen=True)
class NoParams(Params):
    """None."""


NEEDS = ("common", "cross_cov", "target", "seed", "independent_cov", "likelihood")
CROSS = [[0.5, 0.1], [0.0, 0.2]]
GREEDY = {
    "tracks": [{**FIRST, "independent_cov": [[1, 0], [0, 0]], "likelihood": 2},
               {**SECOND, "independent_cov": [[0, 0], [0, 0]], "likelihood": 0.5}],
    "common": {"mean": [0, 1], "cov": [[9, 0], [0, 9]]},
    "target": {"components": HALVES},
    "cross_cov": CROSS,
    "seed": 7,
}  # fmt: skip


@pytest.fixture
def greedy(monkeypatch: pytest.MonkeyPatch) -> list[SourceTracks]:
    """Register a rule that needs every extra, and return the list of what it was given."""
    given: list[SourceTracks] = []

    def fuse(tracks: SourceTracks, params: NoParams) -> FusedTracks:
        given.append(tracks)
        info = {"gap": np.array(np.inf), "list": np.arange(2), "text": "ok"}
        return FusedTracks(tracks.mean[0], tracks.cov[0], dof=np.array(np.inf), info=info)

    rule = Rule("greedy", "Greedy", fuse, NoParams, "gaussian", "n_ary", "none", "", "", "", needs=NEEDS)
    monkeypatch.setitem(RULES.own, "greedy", rule)
    return given


def test_extras_reach_the_rule_as_arrays(greedy: list[SourceTracks]) -> None:
    result = run("fuse", "--rule", "greedy", stdin=json.dumps(GREEDY))
    answer = strict_json(result.stdout)
    assert answer["info"] == {"gap": None, "list": [0, 1], "text": "ok"}
    assert answer["dof"] is None
    extras = greedy[0].extras
    assert set(extras) == set(NEEDS)
    assert extras["seed"] == 7
    np.testing.assert_array_equal(extras["likelihood"], [2.0, 0.5])
    np.testing.assert_array_equal(extras["independent_cov"], [[[1, 0], [0, 0]], [[0, 0], [0, 0]]])
    whole = np.block([[np.array(COV), np.array(CROSS)], [np.transpose(CROSS), np.array(SECOND["cov"])]])
    np.testing.assert_array_equal(np.block([list(row) for row in extras["cross_cov"]]), whole)
    assert isinstance(extras["common"], Mixture)
    np.testing.assert_array_equal(extras["common"].weight, [1.0])
    np.testing.assert_array_equal(extras["common"].mean, [[0.0, 1.0]])
    np.testing.assert_array_equal(extras["target"].mean, [[0.0, 0.0], [2.0, 0.0]])


def test_optional_extras_may_be_left_out(monkeypatch: pytest.MonkeyPatch, greedy: list[SourceTracks]) -> None:
    modest = dataclasses.replace(RULES["greedy"], needs=(), optional=NEEDS)
    monkeypatch.setitem(RULES.own, "greedy", modest)
    for data in ({"tracks": PAIR}, {"tracks": PAIR, "seed": 3}, GREEDY):
        result = run("fuse", "--rule", "greedy", stdin=json.dumps(data))
        assert result.exit_code == 0, result.stderr
    assert [set(tracks.extras) for tracks in greedy] == [set(), {"seed"}, set(NEEDS)]


def test_cross_covariances_of_several_tracks_are_blocks(greedy: list[SourceTracks]) -> None:
    turned = np.transpose(CROSS).tolist()
    tracks = [*GREEDY["tracks"], {**SECOND, "independent_cov": [[0, 0], [0, 0]], "likelihood": 1}]  # type: ignore[misc]
    zero = [[0, 0], [0, 0]]
    blocks = [[COV, CROSS, zero], [turned, None, zero], [None, None, None]]
    result = run("fuse", "--rule", "greedy", stdin=json.dumps({**GREEDY, "tracks": tracks, "cross_cov": blocks}))
    assert result.exit_code == 0, result.stderr
    assert greedy[0].extras["cross_cov"].shape == (3, 3, 2, 2)
    np.testing.assert_array_equal(greedy[0].extras["cross_cov"][1, 0], turned)
    np.testing.assert_array_equal(greedy[0].extras["cross_cov"][2, 2], SECOND["cov"])


ONE = GREEDY["tracks"][0]  # type: ignore[index]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"seed": None}, "seed: must be an integer >= 0; got null"),
        ({"seed": -1}, "seed: must be an integer >= 0; got -1"),
        ({"seed": True}, "seed: must be an integer >= 0; got true"),
        ({"common": 3}, "common: must be an object in braces; got 3"),
        ({"common": {"mean": [0, 0]}}, "common.cov: is missing"),
        ({"common": {"mean": [0], "cov": [[1]]}},
         "common.mean: must be a list of 2 numbers, one an axis of tracks[0]; got 1"),
        ({"target": {**FIRST, "dof": 3}}, "target.dof: is unknown. Valid: mean, cov, components"),
        ({"cross_cov": 1}, "cross_cov: must be 2 rows of 2 blocks, or the one block of both tracks; got 1"),
        ({"cross_cov": [[1, 0]]}, "cross_cov: must be 2 rows of 2 numbers; got 1"),
        ({"cross_cov": [[5, 0], [0, 5]]},
         "cross_cov: is larger than the covariances admit; the joint correlation has the eigenvalue -2.02"),
        ({"cross_cov": [[None, None], [None, None]]},
         "cross_cov[0][1]: is missing: the cross-covariance of tracks 0 and 1"),
        ({"cross_cov": [[None, CROSS], [CROSS, None]]},
         "cross_cov[1][0]: must be null or the transpose of cross_cov[0][1]"),
        ({"cross_cov": [[SECOND["cov"], CROSS], [None, None]]}, "cross_cov[0][0]: must be null or tracks[0].cov"),
        ({"tracks": [{**ONE, "likelihood": -1}]}, "tracks[0].likelihood: must not be negative; got -1"),
        ({"tracks": [{**ONE, "independent_cov": [[1, 0], [0, -1]]}]},
         "tracks[0].independent_cov: must be positive semi-definite; smallest eigenvalue -1"),
        ({"tracks": [{**ONE, "independent_cov": [[5, 0], [0, 0]]}]},
         "tracks[0].independent_cov: must not exceed 'cov'; "
         "what it leaves of unit variances has the eigenvalue -0.425"),
        ({"tracks": [FIRST]}, "tracks[0].independent_cov: is missing; rule 'greedy' needs it"),
    ],
)  # fmt: skip
def test_bad_extras_are_refused(greedy: list[SourceTracks], changes: dict[str, Any], line: str) -> None:
    assert refused({**GREEDY, **changes}, rule="greedy") == line
    assert greedy == []


@pytest.mark.parametrize("name", ["common", "cross_cov", "target", "seed"])
def test_an_extra_that_is_missing_or_not_needed_is_refused(greedy: list[SourceTracks], name: str) -> None:
    lacking = {k: v for k, v in GREEDY.items() if k != name}
    assert refused(lacking, rule="greedy") == f"{name}: is missing; rule 'greedy' needs it"
    assert refused({"tracks": PAIR, name: GREEDY[name]}) == f"{name}: is nothing that rule 'naive' uses"


@pytest.mark.parametrize("name", ["independent_cov", "likelihood"])
def test_an_extra_of_a_track_that_is_not_needed_is_refused(name: str) -> None:
    assert refused_tracks(FIRST, {**SECOND, name: ONE[name]}) == f"tracks[1].{name}: is nothing that rule 'naive' uses"


def test_a_result_that_is_not_finite_is_refused(greedy: list[SourceTracks], monkeypatch: pytest.MonkeyPatch) -> None:
    def overflow(tracks: SourceTracks, params: NoParams) -> FusedTracks:
        return FusedTracks(tracks.mean[0] * np.inf, tracks.cov[0])

    monkeypatch.setitem(RULES.own, "greedy", dataclasses.replace(RULES["naive"], fuse=overflow))
    with np.errstate(invalid="ignore"):
        line = refused({"tracks": [SECOND]}, rule="greedy")
    assert line == "The fused mean or covariance is not finite: the tracks are too extreme for this rule."
