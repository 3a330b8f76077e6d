"""track-fusion reproduce: the figures, their verdicts, and that a seed decides them."""

from __future__ import annotations

import dataclasses
import os
import pty
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from cli.runner import DEADLINE_S, ROOT, refusal, run, strict_json

from track_fusion.metrics.accuracy import Estimate
from track_fusion.scenarios import SCENARIOS, Samples, Scenario

VERDICTS = {"agrees", "ordering only", "does not reproduce", "not given"}
NAME = re.compile(r"^[a-z0-9]+-[a-z0-9_]+(@[a-z0-9_]+)?/[a-z0-9_]+_[a-z0-9]+$")


@pytest.fixture
def coin(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Register two scenarios that take no time, and return the list of (runs, seed) they were asked for."""
    asked: list[tuple[int, int]] = []

    def sample(runs: Sequence[int], seed: int, progress: Callable[[float], None], only: str = "") -> Samples:
        asked.append((len(runs), seed))
        progress(1.0)
        return {"runs": np.zeros(len(runs))}

    def figures(samples: Samples) -> dict[str, Estimate]:
        runs = len(samples["runs"])
        return {
            "kf-alone/error_m": Estimate(1.0, 0.01, runs),
            "kf-ic/error_m": Estimate(9.0, 0.01, runs),
            "kf-naive/error_m": Estimate(2.0, float("nan"), runs),
        }

    scenario = Scenario("coin", "A coin", "Nobody", "nothing", {"kf-alone/error_m": 1.01, "kf-ic/error_m": 0.5}, 10, 30,
                        30, ("it is fair",), sample, figures, lambda samples: [])  # fmt: skip
    monkeypatch.setitem(SCENARIOS, "coin", scenario)
    monkeypatch.setitem(SCENARIOS, "dice", dataclasses.replace(scenario, key="dice", default_runs=60))
    return asked


def reproduced(*words: str) -> Any:
    result = run("reproduce", *words, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    return strict_json(result.stdout)


def test_the_linear_scenario_as_json() -> None:
    answer = reproduced("li2022-linear", "--runs", "20", "--seed", "3")
    assert list(answer) == ["scenario", "runs", "seed", "figures"]
    assert (answer["scenario"], answer["runs"], answer["seed"]) == ("li2022-linear", 20, 3)
    figures = {f["name"]: f for f in answer["figures"]}
    for row in ("alone", "ic", "naive", "arithmetic_average", "covariance_intersection"):
        for quantity in ("position_armse_m", "velocity_armse_mps"):
            assert figures[f"kf-{row}/{quantity}"]["published"] > 0
    for name, figure in figures.items():
        assert NAME.match(name), name
        assert list(figure) == ["name", "value", "standard_error", "published", "verdict"]
        assert figure["verdict"] in VERDICTS
        assert 0 < figure["standard_error"] < 0.2 * figure["value"]
        assert (figure["verdict"] == "not given") == (figure["published"] is None)
    assert figures["kf-alone/position_armse_m"]["verdict"] == "agrees"
    assert figures["kf-ic/position_armse_m"]["verdict"] == "agrees"


def test_a_seed_decides_the_figures() -> None:
    first, again, other = (reproduced("li2022-linear", "--runs", "2", "--seed", s) for s in ("5", "5", "6"))
    assert first == again
    assert first["figures"][0]["value"] != other["figures"][0]["value"]


def test_of_one_run_the_error_is_not_known() -> None:
    answer = reproduced("li2022-linear", "--runs", "1")
    assert {f["standard_error"] for f in answer["figures"]} == {None}
    assert {f["verdict"] for f in answer["figures"]} == {"not given"}


def test_without_runs_the_scenario_decides(coin: list[tuple[int, int]]) -> None:
    assert reproduced("coin")["runs"] == 30
    assert coin == [(30, 0)]


def test_several_names_give_a_list_each_once(coin: list[tuple[int, int]]) -> None:
    answer = reproduced("dice", "coin", "dice", "--seed", "1")
    assert [a["scenario"] for a in answer] == ["dice", "coin"]
    assert coin == [(60, 1), (30, 1)]


def test_the_table_shows_error_published_and_verdict(coin: list[tuple[int, int]]) -> None:
    result = run("reproduce", "coin")
    assert result.exit_code == 0
    assert "error_m, ± standard error" in result.stdout
    rows = [re.split(r" {2,}", line.rstrip()) for line in result.stdout.splitlines()]
    assert ["kf-alone", "1.000 ± 0.010", "1.01", "agrees"] in rows
    assert ["kf-ic", "9.000 ± 0.010", "0.5", "does not reproduce"] in rows
    assert ["kf-naive", "2", "not given"] in rows
    assert "30, seed 0" in result.stdout
    assert re.search(r"Assumed +it is fair", result.stdout)


def test_an_unknown_name_is_refused_before_anything_runs(coin: list[tuple[int, int]]) -> None:
    line = refusal(run("reproduce", "coin", "li2022-liner"))
    assert line.startswith("Unknown scenario 'li2022-liner'. Did you mean 'li2022-linear'? Valid: ")
    assert coin == []


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), "Missing argument 'NAME...'. See: track-fusion reproduce --help"),
        (("coin", "--runs", "0"), "Invalid value for '--runs': 0 is not in the range x>=1."),
        (("coin", "--runs", "many"), "Invalid value for '--runs': 'many' is not a valid integer"),
        (("coin", "--seed", "-1"), "Invalid value for '--seed': -1 is not in the range x>=0."),
    ],
)
def test_wrong_options_are_refused(words: tuple[str, ...], line: str, coin: list[tuple[int, int]]) -> None:
    assert refusal(run("reproduce", *words)).startswith(line)
    assert coin == []


def test_progress_with_time_left_is_shown_on_a_terminal_only() -> None:
    ours, theirs = pty.openpty()
    shown: list[bytes] = []

    def read() -> None:
        try:
            while piece := os.read(ours, 4096):
                shown.append(piece)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    command = [sys.executable, "-m", "track_fusion.cli", "reproduce", "li2022-linear", "--runs", "2", "--json"]
    try:
        env = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
        done = subprocess.run(
            command, cwd=ROOT, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=theirs,
            timeout=DEADLINE_S,
        )  # fmt: skip
    finally:
        os.close(theirs)
        reader.join(DEADLINE_S)
        os.close(ours)
    text = b"".join(shown).decode()
    assert done.returncode == 0, text
    assert strict_json(done.stdout.decode())["runs"] == 2
    assert "li2022-linear, 2 runs" in text
    assert re.search(r"-:--:--|0:00:0\d", text)
