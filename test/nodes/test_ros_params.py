"""Parameters of nodes in this process: those of the rule that runs alone, and files that are for other nodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from track_fusion.centre.config import TRACK_RULES
from track_fusion.nodes.evaluator import EvaluatorNode
from track_fusion.nodes.fusion_centre import FusionCentreNode
from track_fusion.nodes.ros_params import unfit_files
from track_fusion.params import ParameterError, specs
from track_fusion.rules import RULES


def centre(context: Any, *arguments: str) -> FusionCentreNode:
    cli_args = ["--ros-args", *arguments]
    return FusionCentreNode("fusion_centre", context=context, cli_args=cli_args, use_global_arguments=False)


@pytest.mark.parametrize("key", TRACK_RULES)
def test_the_centre_runs_each_rule_it_offers_and_declares_the_parameters_of_that_one_alone(
    key: str, ros_context: Any
) -> None:
    node = centre(ros_context, "-p", f"state_fusion:={key}")
    try:
        declared = {name for name in node._parameters if name.partition(".")[0] in RULES}
    finally:
        node.destroy_node()
    assert declared == {f"{key}.{name}" for name in specs(RULES[key].params)}


def test_the_rules_that_it_does_not_offer_are_those_that_need_more_than_tracks() -> None:
    assert set(RULES) - set(TRACK_RULES) == {"split_covariance_intersection", "mixture_exact"}


@pytest.mark.parametrize("key", sorted(set(RULES) - {"naive"}))
def test_a_parameter_of_another_rule_is_an_error_that_says_whose_it_is(key: str, ros_context: Any) -> None:
    wanted = f"The '{key}.criterion' parameter belongs to '{key}', but state_fusion is 'naive'."
    with pytest.raises(ParameterError, match=wanted):
        centre(ros_context, "-p", "state_fusion:=naive", "-p", f"{key}.criterion:=det")


#: Sections of a file, and whether ROS gives them to /n and to /ns/n: tried on rclpy itself below.
SECTIONS = [
    ("n", True, False), ("/n", True, False), ("/**", True, True), ("/*", True, False), ("/**/n", True, True),
    ("/*/n", False, True), ("ns/n", False, True), ("/ns/n", False, True), ("'**'", True, True),
    ("ns:\n  n", False, True), ("/ns/**", False, True), ("/**/ns/n", False, True), ("m", False, False),
]  # fmt: skip


def parameter_file(folder: Path, *sections: str) -> str:
    text = ""
    for section in sections:
        indent = "    " if "\n" in section else "  "
        text += f"{section}:\n{indent}ros__parameters:\n{indent}  frame_id: odom\n"
    path = folder / "parameters.yaml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(("section", "root", "space"), SECTIONS)
@pytest.mark.parametrize("namespace", ["", "/ns"])
def test_a_file_fits_where_ros_takes_parameters_from_it(
    section: str, root: bool, space: bool, namespace: str, ros_context: Any, tmp_path: Path
) -> None:
    file = parameter_file(tmp_path, section)
    remaps = ["-r", "__node:=n", *(["-r", f"__ns:={namespace}"] if namespace else [])]
    arguments = ["--ros-args", "--params-file", file, *remaps]
    node = EvaluatorNode("evaluator", context=ros_context, cli_args=arguments, use_global_arguments=False)
    try:
        name, taken = node.get_fully_qualified_name(), "frame_id" in node._parameter_overrides
    finally:
        node.destroy_node()
    assert taken == (space if namespace else root)
    assert (file not in unfit_files(arguments, name)) == taken


@pytest.mark.parametrize(
    ("sections", "warned"), [(["evaluator"], False), (["evaluater", "/robot/centre"], True), (["/**"], False)]
)
def test_a_file_for_other_nodes_is_warned_of_with_the_names_it_holds(
    sections: Sequence[str], warned: bool, ros_context: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = parameter_file(tmp_path, *sections)
    arguments = ["--ros-args", "--params-file", file]
    EvaluatorNode("evaluator", context=ros_context, cli_args=arguments, use_global_arguments=False).destroy_node()
    text = f"The file {file} has no parameters for /evaluator. It has some for evaluater, robot/centre."
    assert (text in capfd.readouterr().err) == warned


def test_what_is_no_argument_of_ros_is_passed_over(tmp_path: Path) -> None:
    file = parameter_file(tmp_path, "m")
    assert unfit_files(["node", "--params-file", file], "/n") == {}
    assert unfit_files(["node", "--ros-args", "--", "--params-file", file], "/n") == {}
    assert unfit_files(["node", "--ros-args", "--params-file", file], "/n") == {file: ["m"]}
