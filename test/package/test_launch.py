"""The launch files, against stand-ins that record what they describe: everything they name must exist."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from package import launch_stand_in

from track_fusion.demo.wiring import Bringup, bringups
from track_fusion.scenarios import get_scenario

ROOT = Path(__file__).resolve().parents[2]
SCENARIO, DEMO = (ROOT / "launch" / f"{name}.launch.py" for name in ("scenario", "demo"))
FILES = sorted(bringups())
LAUNCHES = [
    *((SCENARIO, {"scenario": name}) for name in FILES),
    (SCENARIO, {"rule": "naive", "seed": "7", "pace": "realtime", "rate": "2"}),
    (DEMO, {}),
]

pytestmark = pytest.mark.colcon


@pytest.fixture(autouse=True)
def _temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


@pytest.fixture(params=LAUNCHES, ids=lambda launch: f"{launch[0].name}:{','.join(launch[1].values())}")
def recorded(request: pytest.FixtureRequest) -> launch_stand_in.Recorded:
    path, arguments = request.param
    return launch_stand_in.load(path, ROOT, **arguments)


def overrides(path: Path, **arguments: str) -> dict[str, dict[str, Any]]:
    """Return what the files after the scenario's own say, by node."""
    given = {}
    for node in launch_stand_in.load(path, ROOT, **arguments).nodes:
        assert node.parameter_files[0] == ROOT / "config" / f"{arguments.get('scenario', 'li2022-linear')}.yaml"
        for file in node.parameter_files[1:]:
            given[node.name] = yaml.safe_load(file.read_text())[node.name]["ros__parameters"]
    return given


def test_every_launch_file_is_tested() -> None:
    assert {path for path, _ in LAUNCHES} == set(ROOT.glob("launch/*.launch.py"))


def test_replay_trackers_centre_and_evaluator_are_started(recorded: launch_stand_in.Recorded) -> None:
    """As many trackers as the scenario has sensors; the nodes are those that `track-fusion demo` starts."""
    (file,) = {node.parameter_files[0] for node in recorded.nodes}
    bringup = Bringup(file.stem)
    trackers = dict.fromkeys(bringup.trackers, "sensor_tracker")
    others = {name: name for name in ("fusion_centre", "evaluator", "replay")}
    assert {node.name: node.executable for node in recorded.nodes} == trackers | others
    assert tuple(get_scenario(bringup.scenario).played().sensors) == bringup.trackers
    assert [node.name for node in recorded.nodes if node.ends_launch] == ["replay"]


def test_every_executable_is_an_entry_point(recorded: launch_stand_in.Recorded, executables: dict[str, str]) -> None:
    for node in recorded.nodes:
        assert node.package == "track_fusion"
        assert node.executable in executables


def test_every_parameter_file_names_its_node(recorded: launch_stand_in.Recorded) -> None:
    for node in recorded.nodes:
        assert node.parameter_files
        for path in node.parameter_files:
            assert set(yaml.safe_load(path.read_text())[node.name]) == {"ros__parameters"}


def test_every_argument_says_what_it_is(recorded: launch_stand_in.Recorded) -> None:
    assert recorded.arguments
    assert all(argument.description for argument in recorded.arguments.values())


def test_topics_connect(recorded: launch_stand_in.Recorded) -> None:
    """What one node reads under another's name is what that other node publishes."""
    published = {"/replay/truth", "/fusion_centre/tracks"}
    for sensor in (node.name for node in recorded.nodes if node.executable == "sensor_tracker"):
        published |= {f"/replay/{sensor}/detections", f"/{sensor}/tracks"}
    for node in recorded.nodes:
        assert set(node.remappings.values()) <= published
        assert all(source.startswith("~/") for source in node.remappings)


def test_arguments_reach_the_nodes_that_own_them_with_their_types() -> None:
    given = overrides(SCENARIO, rule="naive", seed="7", pace="realtime", rate="2")
    assert given == {
        "fusion_centre": {"state_fusion": "naive", "seed": 7},
        "replay": {"seed": 7, "pace": "realtime", "rate": 2.0},
    }
    assert isinstance(given["replay"]["rate"], float)  # an integer would be refused: the parameter is a double


def test_the_seed_reaches_all_who_draw() -> None:
    given = overrides(SCENARIO, scenario="li2022-nonlinear-sir", seed="7")
    seeded = {name: {"seed": 7} for name in ("replay", "sensor_1", "sensor_2")}
    own = {"arithmetic_average.criterion": "diversity", "arithmetic_average.output": "mixture"}
    assert given == {**seeded, "fusion_centre": {"seed": 7, **own}}


def test_without_arguments_the_parameter_file_decides() -> None:
    assert overrides(SCENARIO) == {"fusion_centre": {"covariance_intersection.criterion": "trace"}}


def test_the_demo_runs_in_lockstep_with_the_rule_asked_for() -> None:
    given = overrides(DEMO, rule="arithmetic_average")
    own = {"arithmetic_average.criterion": "diversity"}
    assert given == {"fusion_centre": {"state_fusion": "arithmetic_average", **own}, "replay": {"pace": "lockstep"}}


def test_an_unknown_scenario_is_refused_with_those_there_are() -> None:
    with pytest.raises(RuntimeError, match=r"^There is no scenario 'li'\. There are: .*\bli2022-linear\b.*\.$"):
        launch_stand_in.load(SCENARIO, ROOT, scenario="li")
