"""The launch files, against stand-ins that record what they describe: everything they name must exist."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from package import launch_stand_in

ROOT = Path(__file__).resolve().parents[2]
SCENARIO, DEMO = (ROOT / "launch" / f"{name}.launch.py" for name in ("scenario", "demo"))
LAUNCHES = [(SCENARIO, {}), (SCENARIO, {"rule": "naive", "seed": "7", "pace": "realtime", "rate": "2"}), (DEMO, {})]

pytestmark = pytest.mark.colcon


@pytest.fixture(params=LAUNCHES, ids=lambda launch: f"{launch[0].name}:{len(launch[1])}")
def recorded(request: pytest.FixtureRequest) -> launch_stand_in.Recorded:
    path, arguments = request.param
    return launch_stand_in.load(path, ROOT, **arguments)


def test_every_launch_file_is_tested() -> None:
    assert {path for path, _ in LAUNCHES} == set(ROOT.glob("launch/*.launch.py"))


def test_replay_two_trackers_centre_and_evaluator_are_started(recorded: launch_stand_in.Recorded) -> None:
    assert {node.name: node.executable for node in recorded.nodes} == {
        "sensor_1": "sensor_tracker",
        "sensor_2": "sensor_tracker",
        "fusion_centre": "fusion_centre",
        "evaluator": "evaluator",
        "replay": "replay",
    }
    assert [node.name for node in recorded.nodes if node.ends_launch] == ["replay"]


def test_every_executable_is_an_entry_point(recorded: launch_stand_in.Recorded, executables: dict[str, str]) -> None:
    for node in recorded.nodes:
        assert node.package == "track_fusion"
        assert node.executable in executables


def test_every_parameter_file_names_its_node(recorded: launch_stand_in.Recorded) -> None:
    for node in recorded.nodes:
        assert len(node.parameter_files) == 1
        contents = yaml.safe_load(node.parameter_files[0].read_text())
        assert set(contents[node.name]) == {"ros__parameters"}


def test_no_parameter_file_has_a_wildcard_section() -> None:
    # rcl lets a named section win over "/**" wherever it stands, once the first file has a "/**", and what is given
    # on the command line or by a launch argument counts as "/**": it would be ignored.
    for path in ROOT.glob("config/*.yaml"):
        assert not any("*" in name for name in yaml.safe_load(path.read_text())), path.name


def test_every_argument_says_what_it_is(recorded: launch_stand_in.Recorded) -> None:
    assert recorded.arguments
    assert all(argument.description for argument in recorded.arguments.values())


def test_topics_connect(recorded: launch_stand_in.Recorded) -> None:
    """What one node reads under another's name is what that other node publishes."""
    published = {"/replay/truth", "/fusion_centre/tracks"}
    for sensor in ("sensor_1", "sensor_2"):
        published |= {f"/replay/{sensor}/detections", f"/{sensor}/tracks"}
    for node in recorded.nodes:
        assert set(node.remappings.values()) <= published
        assert all(source.startswith("~/") for source in node.remappings)


def test_arguments_reach_the_nodes_that_own_them_with_their_types() -> None:
    given = {"rule": "naive", "seed": "7", "pace": "realtime", "rate": "2"}
    parameters = {node.name: node.parameters for node in launch_stand_in.load(SCENARIO, ROOT, **given).nodes}
    assert parameters["fusion_centre"] == {"state_fusion": "naive"}
    assert parameters["replay"] == {"seed": 7, "pace": "realtime", "rate": 2.0}
    assert isinstance(parameters["replay"]["rate"], float)  # an integer would be refused: the parameter is a double
    assert parameters["sensor_1"] == parameters["evaluator"] == {}


def test_without_arguments_the_parameter_file_decides() -> None:
    assert all(node.parameters == {} for node in launch_stand_in.load(SCENARIO, ROOT).nodes)


def test_the_demo_runs_in_lockstep_with_the_rule_asked_for() -> None:
    nodes = {node.name: node for node in launch_stand_in.load(DEMO, ROOT, rule="arithmetic_average").nodes}
    assert nodes["replay"].parameters == {"pace": "lockstep"}
    assert nodes["fusion_centre"].parameters == {"state_fusion": "arithmetic_average"}
    assert nodes["replay"].parameter_files == [ROOT / "config" / "li2022-linear.yaml"]


def test_an_unknown_scenario_is_refused_with_those_there_are() -> None:
    with pytest.raises(RuntimeError, match=r"^There is no scenario 'li'\. There are: .*\bli2022-linear\b.*\.$"):
        launch_stand_in.load(SCENARIO, ROOT, scenario="li")
