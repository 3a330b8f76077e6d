"""track-fusion demo: what it refuses, and what it plans; the runs themselves: test/nodes/test_scenarios_over_ros.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from cli.runner import refusal, run

from track_fusion.demo import demo as demonstration
from track_fusion.demo.figures import figures
from track_fusion.demo.plan import demo_of
from track_fusion.demo.wiring import bringups
from track_fusion.metrics.accuracy import Estimate
from track_fusion.scenarios import SCENARIOS


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ("li2022-nonlinea",),
            "Unknown parameter file of a scenario 'li2022-nonlinea'. Did you mean 'li2022-nonlinear'?",
        ),
        (("li2022-linear", "--rules", "naiv"), "Unknown rule 'naiv'. Did you mean 'naive'?"),
        (
            ("li2022-linear", "--rules", "covariance_intersection@unifrm"),
            "Did you mean 'covariance_intersection@uniform'?",
        ),
    ],
)
def test_wrong_names_are_refused_with_the_nearest(words: tuple[str, ...], text: str) -> None:
    assert text in refusal(run("demo", *words))


def test_a_scenario_of_the_library_alone_says_so() -> None:
    result = run("demo", "sharma-gaussians")
    assert result.exit_code == 1
    assert "runs in the library only: track-fusion reproduce sharma-gaussians" in result.stderr


@pytest.mark.parametrize("foreign", ["thesis.tex", ".git"])
def test_a_folder_with_something_else_in_it_is_not_cleared(foreign: str, tmp_path: Path) -> None:
    for name in ("figures.json", foreign):
        (tmp_path / name).write_text("")
    result = run("demo", "li2022-linear", "--out", str(tmp_path))
    assert result.exit_code == 1
    assert f"holds {foreign}, which is no result of a demonstration" in result.stderr
    assert {p.name for p in tmp_path.iterdir()} == {"figures.json", foreign}


def test_earlier_results_are_cleared(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    for name in ("figures.json", "tracks.png", "nodes_naive.log", "evaluation_alone.json", "bag/bag_0.mcap"):
        (tmp_path / name).write_text("")
    demonstration.clear(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", bringups())
def test_each_demonstration_has_the_rows_of_its_scenario(name: str, tmp_path: Path) -> None:
    planned = demo_of(name, tmp_path, 0, None)
    assert planned.rules
    assert {r.partition("@")[0] for r in planned.rules} <= {c.key for c in planned.scenario.rules}
    published = {key.partition("-")[0] for key in planned.scenario.published}
    assert planned.many_targets or planned.row in published


def test_the_default_demonstration_is_the_linear_scenario_with_many_runs(tmp_path: Path) -> None:
    planned = demo_of("li2022-linear", tmp_path, 0, None)
    assert planned.rules == ("naive", "covariance_intersection", "arithmetic_average")
    assert planned.library_runs == 1000


def test_every_scenario_that_can_run_over_ros_has_a_parameter_file() -> None:
    assert {s.key for s in SCENARIOS.values() if s.over_ros} == set(bringups().values())


def test_the_table_sets_ros_beside_the_library_and_the_paper(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without processes: what a variant of a rule is called, and a rule that the scenario does not know."""
    rules = ("covariance_intersection@uniform", "harmonic_mean")
    monkeypatch.setattr(demonstration, "over_ros", lambda demo, rule, progress: {"position_armse_m": 21.5})
    monkeypatch.setattr(demonstration, "picture", lambda demo: None)
    result = run("demo", "--rules", ",".join(rules), "--runs", "2", "--out", str(tmp_path / "out"))
    assert result.exit_code == 0, result.output
    (alone,), (variant,), (unknown,) = (
        [line for line in result.stdout.splitlines() if line.strip().startswith(name)]
        for name in ("sensor 1 alone", *rules)
    )
    assert alone.split()[3] == variant.split()[1] == "21.5000"
    assert "19.95" in alone
    assert unknown.split() == ["harmonic_mean", "21.5000"]


def test_figures_name_the_path_the_row_and_the_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    planned = demo_of("li2022-linear", tmp_path, 0, 5, ("covariance_intersection@uniform",))
    name = "kf-covariance_intersection@uniform/position_armse_m"
    measured: Any = {name: Estimate(20.0, 0.5, 5)}
    over_ros = {"covariance_intersection@uniform": {"position_armse_m": 21.0}}
    result = figures(planned, over_ros, {name: Estimate(21.0, float("nan"), 1)}, measured)
    assert [(f["name"], f["value"]) for f in result["figures"]] == [
        (f"ros/{name}", 21.0),
        (f"library/{name}", 21.0),
        ("library/kf-covariance_intersection@uniform,5-runs/position_armse_m", 20.0),
    ]
