"""tools/run_tests.py: every test runs once with each pair of versions, and the last line counts all that ran."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from tools import run_tests
from tools.run_tests import Counts, StageFailure, StageSkipped

JUNIT = '<testsuites><testsuite tests="{}" failures="{}" errors="0" skipped="{}"/></testsuites>'


@pytest.mark.parametrize("slow", [False, True])
@pytest.mark.parametrize("once", [False, True])
def test_a_test_runs_in_one_stage_with_the_newest_versions_and_in_one_with_the_oldest(
    slow: bool, once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen: dict[str, list[str]] = {"newest": [], "oldest": []}

    def pytest_run(name: str, counts: list[Counts], *words: Any, python: Any = "newest", **_: Any) -> None:
        if eval(words[words.index("-m") + 1], {"slow": slow, "once": once}):
            chosen[python].append(name)

    monkeypatch.setattr(run_tests, "pytest", pytest_run)
    monkeypatch.setattr(run_tests, "floor_python", lambda: "oldest")
    for name in ("suite", "slow", "floor", "floor-rest"):
        run_tests.STAGES[name]([])
    assert [len(names) for names in chosen.values()] == [1, 1]
    quick = not slow, not slow and not once
    assert tuple(chosen[v][0] in run_tests.TEST for v in ("newest", "oldest")) == quick


def run_with(
    monkeypatch: pytest.MonkeyPatch, folder: Path, stages: dict[str, Any], rest: dict[str, Any], *words: str
) -> int:
    """Run the command on stages that are given."""
    for name, value in {"TEST": stages, "REST": rest, "STAGES": stages | rest, "RESULTS": folder}.items():
        monkeypatch.setattr(run_tests, name, value)
    monkeypatch.setattr(sys, "argv", ["run_tests.py", *words])
    monkeypatch.setattr(run_tests.signal, "signal", lambda *_: None)
    return run_tests.main()


def stage(*counts: int, error: Exception | None = None) -> Any:
    def work(total: list[Counts]) -> None:
        """Count."""
        total.append(Counts(*counts))
        if error is not None:
            raise error

    return work


def test_the_second_half_counts_what_the_first_has_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "suite.xml").write_text(JUNIT.format(10, 1, 2))
    (tmp_path / "slow.xml").write_text(JUNIT.format(99, 0, 0))  # of an earlier day
    stages, rest = {"lint": stage(), "suite": stage(8, 1, 2)}, {"slow": stage(3, 0, 0)}
    assert run_with(monkeypatch, tmp_path, stages, rest, "--rest") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "tests: 10 passed, 1 failed, 2 skipped"
    assert run_with(monkeypatch, tmp_path, stages, rest) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "tests: 8 passed, 1 failed, 2 skipped"


def test_a_stage_that_fails_stops_no_other_and_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stages = {"lint": stage(error=StageFailure("ruff found something")), "suite": stage(1, 0, 0)}
    rest = {"bare": stage(error=StageSkipped("a ROS is sourced"))}
    assert run_with(monkeypatch, tmp_path, stages, rest, "lint", "suite", "bare") == 1
    said = capsys.readouterr().out
    for text in ("FAILED: ruff found something", "skipped: a ROS is sourced", "tests: 1 passed, 0 failed, 0 skipped"):
        assert text in said
    assert said.splitlines()[-1] == "FAILED: lint"


def test_an_unknown_stage_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run_with(monkeypatch, tmp_path, {"lint": stage()}, {}, "lnt")
    assert "no stage lnt; there are lint" in capsys.readouterr().err
