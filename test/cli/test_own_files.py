"""doc/add-a-rule.md and doc/add-a-scenario.md: their examples run as the pages say, in reproduce, compare and fuse."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.runner import ROOT, refusal, run, run_process, strict_json

from track_fusion.rules import RULES


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the pages' examples under the names that the pages give them."""
    folder = tmp_path_factory.mktemp("own")
    for page in ("add-a-rule", "add-a-scenario"):
        text = (ROOT / "doc" / f"{page}.md").read_text(encoding="utf-8")
        (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        (name,) = re.findall(r"Saved as `(\w+\.py)`", text)
        (folder / name).write_text(code, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def package(examples: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the page's package of the rule, in place: its folder is what an interpreter needs to find it."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("package")
    (description,) = re.findall(r"```toml\n(.*?)```", (ROOT / "doc" / "add-a-rule.md").read_text(), re.DOTALL)
    (folder / "pyproject.toml").write_text(description, encoding="utf-8")
    (folder / "best_track.py").write_bytes((examples / "best_track.py").read_bytes())
    build = [sys.executable, "-W", "ignore", "-c", "from setuptools import setup; setup()", "-q", "egg_info"]
    subprocess.run(build, cwd=folder, check=True, timeout=60)
    return folder


@pytest.fixture(autouse=True)
def registry() -> Iterator[None]:
    """Forget the rules that files bring, for other tests."""
    before = set(RULES)
    yield
    for key in RULES.keys() - before:
        del RULES.own[key]


#: The parts of the pages before and behind this heading: with files of one's own, and with a package installed.
SHIPPED = "## Ship it as a package"
PAGES = [("add-a-rule", 0, 3), ("add-a-rule", 1, 2), ("add-a-scenario", 0, 2)]


@pytest.mark.parametrize(("page", "part", "count"), PAGES, ids=str)
def test_the_commands_of_the_page_run(
    page: str, part: int, count: int, examples: Path, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    text = (ROOT / "doc" / f"{page}.md").read_text(encoding="utf-8").split(SHIPPED)[part]
    commands = re.findall(r"^track-fusion (.*)$", text, re.MULTILINE)
    assert len(commands) == count
    installed = [str(request.getfixturevalue("package"))] if part else []
    env = {"PYTHONPATH": os.pathsep.join([*installed, os.environ.get("PYTHONPATH", "")])}
    (tmp_path / "tracks.json").write_text('{"tracks": [{"mean": [1], "cov": [[4]]}, {"mean": [2], "cov": [[1]]}]}')
    for command in commands:
        words, _, source = command.partition(" < ")
        given = words.replace("./", f"{examples}/").split()
        given += ["--runs", "40"] if given[0] in ("compare", "reproduce") else []
        given += ["--out", str(tmp_path)] if given[0] == "reproduce" else []
        done = run_process(*given, stdin=(tmp_path / source).read_text() if source else "", env=env)
        assert done.returncode == 0, (command, done.stderr)
        assert done.stdout
        if given[0] == "fuse":
            assert strict_json(done.stdout)["mean"] == [2.0]


def test_the_shipped_rule_is_listed_and_keeps_every_law(package: Path) -> None:
    env = {"PYTHONPATH": os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])}
    listed = strict_json(run_process("rules", "--json", env=env).stdout)
    assert [r["key"] for r in listed] == [*RULES, "best_track"]
    answer = strict_json(run_process("rules", "--check", "best_track:RULE", "--json", env=env).stdout)
    assert answer["rule"] == "best_track"
    outcomes = {law["law"]: law["outcome"] for law in answer["laws"]}
    assert outcomes.pop("counter_example") == "skipped"
    assert set(outcomes.values()) == {"passed"}


def test_a_rule_that_breaks_a_law_fails_the_check(examples: Path, tmp_path: Path) -> None:
    text = (examples / "best_track.py").read_text().replace("FusedTracks(mean, cov,", "FusedTracks(mean, 0.5 * cov,")
    (tmp_path / "sharp.py").write_text(text.replace('key="best_track"', 'key="sharp"'))
    result = run("rules", "--check", str(tmp_path / "sharp.py"), "--json")
    assert result.exit_code == 1
    laws = {law["law"]: law for law in strict_json(result.stdout)["laws"]}
    assert {name for name, law in laws.items() if law["outcome"] == "failed"} == {"copies_of_a_track", "guarantee"}
    assert laws["guarantee"]["text"] == (
        "2 tracks, parameters {}: error variance over the claimed one: expected at most 1, got 2."
    )
    assert re.search(r"guarantee +failed +2 tracks", run("rules", "--check", str(tmp_path / "sharp.py")).stdout)


def test_what_cannot_be_checked_is_refused() -> None:
    assert "Did you mean 'naive'" in refusal(run("rules", "--check", "niave"))
    assert "There is no 'no_such:RULE'" in refusal(run("rules", "--check", "no_such:RULE"))


def test_the_own_scenario_is_judged(examples: Path, tmp_path: Path) -> None:
    result = run("reproduce", str(examples / "two_thermometers.py"), "--runs", "4000", "--json", "--out", str(tmp_path))
    answer = strict_json(result.stdout)
    assert answer["scenario"] == "two-thermometers"
    figures = {f["name"]: f for f in answer["figures"]}
    assert figures["given-naive/mean_squared_error_k2"]["verdict"] == "agrees"
    # Variances 1 and 1.28, of which .64 is common: w = 1.28 / 2.28, claimed 1.28 / 2.28.
    assert figures["given-naive/credibility_1"]["value"] == pytest.approx(0.5614 / 0.8766, rel=0.1)
    assert figures["given-covariance_intersection/credibility_1"]["value"] == pytest.approx(1.0, rel=0.1)
    assert [c["verdict"] for c in answer["claims"]] == ["agrees", "agrees"]


def compared(*words: str) -> dict[str, Any]:
    result = run("compare", *words, "--json")
    assert result.exit_code == 0, result.stderr
    answer = strict_json(result.stdout)
    assert isinstance(answer, dict)
    return answer


def test_rules_are_compared_under_the_same_noise(examples: Path) -> None:
    scenario, rule = str(examples / "two_thermometers.py"), str(examples / "best_track.py")
    answer = compared(scenario, "--rules", f"naive,{rule},covariance_intersection", "--runs", "500", "--jobs", "2")
    (quantity,) = answer["quantities"]
    assert (quantity["filter"], quantity["quantity"]) == ("given", "error_k")
    means = {r["rule"]: r["mean"] for r in quantity["rules"]}
    assert list(means) == ["naive", "best_track", "covariance_intersection"]
    # Of two scalars, intersection takes the better one, as best_track does: equal in every run.
    assert means["best_track"] == means["covariance_intersection"] > means["naive"]
    pairs = {(d["first"], d["second"]): d for d in quantity["differences"]}
    assert len(pairs) == 3
    equal = pairs["best_track", "covariance_intersection"]
    assert (equal["mean"], equal["p_value"], equal["significant"]) == (0.0, 1.0, False)
    better = pairs["naive", "best_track"]
    assert better["mean"] == pytest.approx(means["best_track"] - means["naive"])
    assert better["significant"]


def test_parameters_are_given_by_rule(examples: Path) -> None:
    scenario, rule = str(examples / "two_thermometers.py"), str(examples / "best_track.py")
    trace = f'{{"{rule}": {{"criterion": "trace"}}, "covariance_intersection": {{"criterion": "uniform"}}}}'
    answer = compared(scenario, "--rules", f"{rule},covariance_intersection", "--params", trace, "--runs", "20")
    means = [r["mean"] for r in answer["quantities"][0]["rules"]]
    assert means[0] != means[1]


@pytest.mark.slow
def test_the_figures_depend_on_the_seed_alone(examples: Path) -> None:
    words = (str(examples / "two_thermometers.py"), "--rules", "naive", "--runs", "1100")
    assert compared(*words, "--jobs", "1") == compared(*words, "--jobs", "3")
    assert compared(*words, "--seed", "1") != compared(*words)


def test_a_table_for_people(examples: Path) -> None:
    result = run("compare", str(examples / "two_thermometers.py"), "--rules", "naive,covariance_intersection")
    assert result.exit_code == 0, result.stderr
    assert "2000 runs, seed 0, smaller is better" in result.stdout
    assert "given: error / K" in result.stdout
    assert re.search(r"naive +covariance_intersection +0\.\d+ ± 0\.\d+ +< \.0001", result.stdout)


def test_a_single_run_has_no_error_and_no_significance(examples: Path) -> None:
    result = run("compare", "chen2022-static", "--rules", "covariance_intersection,mhdp_explicit")
    assert result.exit_code == 0, result.stderr
    assert "1 run, seed 0" in result.stdout
    assert "±" not in result.stdout.replace("mean ± standard error", "")
    words = (str(examples / "two_thermometers.py"), "--rules", "naive,covariance_intersection", "--runs", "1")
    answer = compared(*words)
    assert {d["p_value"] for d in answer["quantities"][0]["differences"]} == {None}
    assert {r["standard_error"] for r in answer["quantities"][0]["rules"]} == {None}


def test_of_one_rule_there_are_no_pairs(examples: Path) -> None:
    result = run("compare", str(examples / "two_thermometers.py"), "--rules", "naive", "--runs", "20")
    assert result.exit_code == 0, result.stderr
    assert "worse" not in result.stdout


REFUSED = [
    (("--rules", "naiv"), "Did you mean 'naive'"),
    (("--rules", "naive,naive"), "The '--rules' must differ"),
    (("--rules", "naive", "--params", "{"), "The '--params' must be JSON"),
    (("--rules", "naive", "--params", '{"naive": 3}'), "must map rules to objects"),
    (("--rules", "naive", "--params", '{"nave": {}}'), "must be of a rule in '--rules'. Got 'nave'"),
    (("--rules", "naive", "--params", '{"naive": {"x": 1}}'), "Unknown parameter 'x'"),
    (("--rules", "covariance_intersection@unifrm"), "has no 'covariance_intersection@unifrm'"),
    (("--rules", "./nowhere.py"), "There is no file './nowhere.py'"),
]


@pytest.mark.parametrize(("words", "wanted"), REFUSED)
def test_wrong_rules_are_refused(words: tuple[str, ...], wanted: str, examples: Path) -> None:
    assert wanted in refusal(run("compare", str(examples / "two_thermometers.py"), *words, "--runs", "2"))


def test_a_file_that_defines_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.py").write_text("RULE = 3\n")
    assert "must define RULE, a Rule. Got 3" in refusal(run("fuse", "--rule", str(tmp_path / "empty.py"), stdin="{}"))


def test_a_rule_of_ones_own_needs_a_key_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import dataclasses\nfrom track_fusion.rules import naive\n"
                                      "RULE = dataclasses.replace(naive.RULE)\n")  # fmt: skip
    assert "must have a key of its own" in refusal(run("fuse", "--rule", str(tmp_path / "mine.py"), stdin="{}"))


def test_an_interrupted_study_goes_on(examples: Path, tmp_path: Path) -> None:
    words = ("reproduce", str(examples / "two_thermometers.py"), "--json", "--out", str(tmp_path))
    whole = run(*words, "--runs", "2000").stdout
    kept = sorted(tmp_path.glob("pieces/*/*.npz"))
    assert len(kept) == 4
    kept[0].unlink()
    with np.load(kept[1]) as arrays:
        changed = {name: arrays[name] for name in arrays.files}
    changed["outcome/given-naive"] = np.full_like(changed["outcome/given-naive"], 100.0)
    before = kept[2].stat().st_mtime_ns
    assert run(*words, "--runs", "2000").stdout == whole
    np.savez(kept[1], **changed)
    again = strict_json(run(*words, "--runs", "2000").stdout)
    assert again["figures"][0]["value"] > 20.0  # what was kept is used, not drawn again
    assert kept[2].stat().st_mtime_ns == before
