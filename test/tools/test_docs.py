"""make docs: the files on disk are what it writes, and nodes and YAML readers take them as they are."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from cli.runner import ROOT
from click.testing import CliRunner, Result

from tools.docs import Section, docs, fusion_centre_sections, sensor_tracker_sections, yaml_value
from track_fusion.demo.wiring import bringups
from track_fusion.params import specs
from track_fusion.rules import RULES
from track_fusion.scenarios import SCENARIOS

NODES = ("fusion_centre", "sensor_tracker")
#: What rclpy declares by itself, and QoS overrides, which come with each topic.
BUILT_IN = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")


def run(*arguments: str) -> Result:
    return CliRunner().invoke(docs, arguments)


def sections_of(node: str) -> list[Section]:
    return {"fusion_centre": fusion_centre_sections, "sensor_tracker": sensor_tracker_sections}[node]()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Copy what the command needs of the source tree."""
    shutil.copy(ROOT / "package.xml", tmp_path)
    return tmp_path


def test_the_files_on_disk_are_up_to_date() -> None:
    result = run("--check")
    assert result.exit_code == 0, result.stderr


def test_check_names_what_differs_and_writes_nothing(tree: Path) -> None:
    result = run("--check", "--root", str(tree))
    assert result.exit_code == 1
    named = (
        "doc/rules.md, doc/choosing-a-rule.md, doc/scenarios.md, doc/architecture.md, "
        "config/fusion_centre.yaml, config/sensor_tracker.yaml"
    )
    assert result.stderr == f"Out of date: {named}. Run: make docs\n"
    assert [p.name for p in tree.iterdir()] == ["package.xml"]
    assert run("--root", str(tree)).exit_code == 0
    assert run("--check", "--root", str(tree)).stdout == "All generated files are up to date.\n"
    (tree / "doc" / "rules.md").write_text("old")
    assert run("--check", "--root", str(tree)).stderr == "Out of date: doc/rules.md. Run: make docs\n"


def test_the_picture_shows_every_rule_that_two_tracks_are_enough_for(tree: Path) -> None:
    pytest.importorskip("matplotlib")
    result = run("--picture", "--root", str(tree))
    assert result.exit_code == 0, result.stderr
    enough = [rule for rule in RULES.values() if not rule.needed(rule.params())]
    assert f"Drew {len(enough)} rules in doc/rules.png" in result.stdout
    assert (tree / "doc" / "rules.png").read_bytes().startswith(b"\x89PNG")


def test_the_guide_names_rules_that_exist_and_tells_of_each_its_promise() -> None:
    page = (ROOT / "doc" / "choosing-a-rule.md").read_text()
    advice, _, table = page.partition("<!-- begin")
    first_columns = re.findall(r"^\|[^|]*\| (`[^|]*) \|", advice, re.MULTILINE)
    advised = {name for cell in first_columns for name in re.findall(r"`([a-z_]+)`(?! < 1)", cell)}
    options = {name for rule in RULES.values() for name in specs(rule.params)}
    assert advised - options <= set(RULES)
    for rule in RULES.values():
        assert f"| [`{rule.key}`](rules.md#{rule.key}) | {rule.promise} |" in table


def test_elsewhere_than_in_a_source_tree_it_is_refused(tmp_path: Path) -> None:
    result = run("--root", str(tmp_path))
    assert result.exit_code == 2
    assert "has no package.xml" in result.stderr


def test_the_page_has_every_rule_and_parameter() -> None:
    page = (ROOT / "doc" / "rules.md").read_text()
    for rule in RULES.values():
        assert f"\n## {rule.key}\n" in page
        assert f"| [`{rule.key}`](#{rule.key}) |" in page
        for name, (spec, _) in specs(rule.params).items():
            assert f"| `{name}` |" in page
            assert spec.doc.replace("|", "\\|") in page


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_is_there_at_its_default(node: str) -> None:
    text = (ROOT / "config" / f"{node}.yaml").read_text()
    values = yaml.safe_load(text)[node]["ros__parameters"]
    assert values.pop("use_sim_time") is False
    for section in sections_of(node):
        for name, (spec, default) in specs(section.params).items():
            full = section.prefix + name
            if default == () or not section.declared:
                assert f"    # {full}: {'unset' if default == () else yaml_value(default)}\n" in text
                continue
            got = values.pop(full)
            assert got == (list(default) if isinstance(default, tuple) else default)
            assert {type(v) for v in (got if spec.sequence else [got])} == {spec.kind}
    assert values == {}


def started(node: str, context: Any, *arguments: str) -> Any:
    """Start a node of this name in this process."""
    from track_fusion.nodes.fusion_centre import FusionCentreNode
    from track_fusion.nodes.sensor_tracker import SensorTrackerNode

    kind = {"fusion_centre": FusionCentreNode, "sensor_tracker": SensorTrackerNode}[node]
    return kind(node, context=context, cli_args=["--ros-args", *arguments], use_global_arguments=False)


@pytest.mark.parametrize("node", NODES)
def test_a_node_starts_with_its_file_and_declares_what_it_holds(node: str, ros_context: Any) -> None:
    path = ROOT / "config" / f"{node}.yaml"
    running = started(node, ros_context, "--params-file", str(path))
    try:
        assert running.active
        overrides = set(running._parameter_overrides)
        declared = {name for name in running._parameters if not BUILT_IN.fullmatch(name)}
    finally:
        running.destroy_node()
    assert declared == {s.prefix + name for s in sections_of(node) if s.declared for name in specs(s.params)}
    # The file was read: all that it sets came as overrides of this node.
    assert overrides == set(yaml.safe_load(path.read_text())[node]["ros__parameters"])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1.0"), (-0.5, "-0.5"), (1e-12, "1.0e-12"), (1e300, "1.0e+300"), (1.5e-9, "1.5e-09"), (3, "3"),
        (float("inf"), ".inf"), (True, "true"), ("y", '"y"'), ("", '""'), (("x", "y"), '["x", "y"]'),
        ((1.0, 2.0), "[1.0, 2.0]"),
    ],
)  # fmt: skip
def test_yaml_values_come_back_as_they_were(value: Any, text: str) -> None:
    assert yaml_value(value) == text
    back = yaml.safe_load(text)
    assert back == (list(value) if isinstance(value, tuple) else value)
    assert type(back) is (list if isinstance(value, tuple) else type(value))


def test_the_page_of_scenarios_has_each_with_its_claims_and_assumptions() -> None:
    page = (ROOT / "doc" / "scenarios.md").read_text()
    for scenario in SCENARIOS.values():
        section = page.split(f"\n## {scenario.key}\n")[1].split("\n## ")[0]
        assert all(claim.text in section for claim in scenario.claims)
        assert section.count("* Assumed: ") == len(scenario.assumptions)
        assert (f"`track-fusion demo {scenario.key}`" in section) == (scenario.key in bringups().values())
