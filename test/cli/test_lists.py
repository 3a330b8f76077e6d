"""track-fusion rules and scenarios: all that the registries hold, as tables and as JSON."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from cli.runner import run, strict_json
from rich.console import Console

from track_fusion.cli import output
from track_fusion.params import from_dict, specs
from track_fusion.rules import RULES
from track_fusion.scenarios import SCENARIOS


def test_rules_as_json_say_what_the_registry_says() -> None:
    listed = strict_json(run("rules", "--json").stdout)
    assert [r["key"] for r in listed] == list(RULES)
    for said, rule in zip(listed, RULES.values(), strict=True):
        assert said["guarantee"] == rule.promise
        for name in ("title", "family", "arity", "caveat", "source", "cost", "affine_equivariant"):
            assert said[name] == getattr(rule, name)
        assert said["needs"] == list(rule.needs)
        assert [p["name"] for p in said["parameters"]] == list(specs(rule.params))
        assert from_dict(rule.params, {p["name"]: p["default"] for p in said["parameters"]}) == rule.params()
        for p in said["parameters"]:
            spec, _ = specs(rule.params)[p["name"]]
            assert (p["doc"], p["unit"], p["choices"]) == (spec.doc, spec.unit, list(spec.choices))
            assert p["type"] == ("list of " if spec.sequence else "") + spec.kind.__name__


def test_unbounded_ranges_are_null() -> None:
    listed = {r["key"]: r for r in strict_json(run("rules", "--json").stdout)}
    criterion = listed["covariance_intersection"]["parameters"][0]
    assert criterion["low"] is criterion["high"] is None


def test_the_table_of_rules_names_every_rule_and_parameter() -> None:
    result = run("rules")
    assert result.exit_code == 0
    for rule in RULES.values():
        assert rule.key in result.stdout
        assert all(name in result.stdout for name in specs(rule.params))
    assert re.search(r"Guarantee +conservative: if every track is; for every cross-correlation", result.stdout)


@pytest.mark.parametrize("columns", [80, 200])
@pytest.mark.parametrize("words", [("rules",), ("scenarios",), ("reproduce", "li2022-target-fit")])
def test_tables_fit_the_terminal_without_losing_text(
    words: tuple[str, ...], columns: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def narrow(*, stderr: bool = False) -> Console:
        return Console(stderr=stderr, width=columns)

    monkeypatch.setattr(output, "console", narrow)
    monkeypatch.chdir(tmp_path)  # where results go
    text = run(*words).stdout
    assert max(map(len, text.splitlines())) <= columns
    assert "…" not in text


def test_scenarios_as_json() -> None:
    listed = strict_json(run("scenarios", "--json").stdout)
    assert [s["key"] for s in listed] == list(SCENARIOS)
    first = listed[0]
    assert first["key"] == "li2022-linear"
    assert first["over_ros"] is True
    assert first["demos"] == ["li2022-linear", "li2022-linear-sir"]
    assert first["default_runs"] == SCENARIOS["li2022-linear"].default_runs
    assert {"title", "paper", "shows", "assumptions", "published_runs"} <= set(first)


def test_the_table_of_scenarios_names_each() -> None:
    result = run("scenarios")
    for key, scenario in SCENARIOS.items():
        assert key in result.stdout
        assert scenario.title in result.stdout
