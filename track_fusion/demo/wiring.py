"""Which nodes run a scenario, with what parameters and topics: data for launch files and the demonstration alike."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from track_fusion.params import unknown_name_error

#: Parameters by node and name, on top of a parameter file.
Overrides = Mapping[str, Mapping[str, Any]]

TRUTH, FUSED = "/replay/truth", "/fusion_centre/tracks"
#: Nodes of a scenario that are no trackers.
OTHERS = ("replay", "fusion_centre", "evaluator")
#: Parameters that name the draw: those of the replay go to all who draw.
_DRAW = ("seed", "run")
_SCENARIO = re.compile(r"^replay:\n  ros__parameters:\n    scenario: (\S+)$", re.MULTILINE)


def share_file(*parts: str) -> Path:
    """Find an installed or source-tree file such as config/li2022-linear.yaml.

    Raises
    ------
    FileNotFoundError    it is in neither place
    """
    roots = [Path(p) / "share" / "track_fusion" for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    roots += [Path(__file__).parents[2], Path(sys.prefix) / "share" / "track_fusion"]
    for root in roots:
        if (path := root.joinpath(*parts)).exists():
            return path
    raise FileNotFoundError(f"There is no {'/'.join(parts)} in {', '.join(map(str, roots))}.")


@dataclasses.dataclass(frozen=True)
class NodeSpec:
    """One node, however it is started: `params` stand on top of what the parameter file says of it."""

    executable: str
    name: str
    parameter_file: Path
    params: Mapping[str, Any]
    remaps: Mapping[str, str]


class Bringup:
    """What a parameter file config/<name>.yaml describes: replay, trackers, fusion centre and evaluator of a scenario.

    Parameters
    ----------
    name : str               of the file: a scenario's key, or key and filter, as li2022-nonlinear-sir
    folder : Path or None    where the parameter files are, if not where this package has them

    Raises
    ------
    ParameterError    there is none; the message lists those there are

    Attributes
    ----------
    path : Path
    scenario : str              key of the scenario
    trackers : tuple of str     names of the tracker nodes, those of the scenario's sensors
    filter : str                of the trackers
    result_every : int          the centre fuses at every so many steps
    sections : mapping          parameters of each node by name, as the file gives them
    of_rule : mapping           what the file gives the fusion centre besides, by the rule it fuses by: the sections
                                fusion_centre/<rule>
    """

    def __init__(self, name: str, folder: Path | None = None) -> None:
        import yaml  # type: ignore[import-untyped]  # comes with rclpy

        folder = folder or share_file("config")
        known = bringups(folder)
        if name not in known:
            raise unknown_name_error(name, known, "parameter file of a scenario")
        self.path = folder / f"{name}.yaml"
        content = yaml.safe_load(self.path.read_text())
        sections = {node: section["ros__parameters"] for node, section in content.items()}
        self.sections = {node: section for node, section in sections.items() if "/" not in node}
        self.of_rule = {node.partition("/")[2]: section for node, section in sections.items() if "/" in node}
        self.scenario = str(self.sections["replay"]["scenario"])
        self.trackers = tuple(node for node in self.sections if node not in OTHERS)
        self.filter = str(self.sections[self.trackers[0]].get("filter", "kalman"))
        self.result_every = int(self.sections["replay"].get("result_every", 1))

    def nodes(self, overrides: Overrides, fused: bool = True, evaluator: bool = True) -> list[NodeSpec]:
        """List the nodes in the order in which to start them: the replay last, when the others are starting already.

        Parameters
        ----------
        overrides : Overrides    seed and run of the replay go to all who draw
        fused : bool             False: no fusion, the first sensor's tracker alone
        evaluator : bool         whether to have that one, too
        """
        sensors = self.trackers if fused else self.trackers[:1]
        result = FUSED if fused else f"/{sensors[0]}/tracks"
        remaps = {s: {"~/detections": f"/replay/{s}/detections", "~/feedback": result} for s in sensors}
        if fused:
            remaps["fusion_centre"] = {f"~/sources/{s}/tracks": f"/{s}/tracks" for s in sensors}
        if evaluator:
            remaps["evaluator"] = {"~/truth": TRUTH, "~/tracks": result}
        remaps["replay"] = {"~/fused": result}
        alone: Overrides = {} if fused else {"replay": {"sensors": list(sensors)}, sensors[0]: {"feedback": "none"}}
        centre = {**self.sections["fusion_centre"], **overrides.get("fusion_centre", {})}
        given = {"fusion_centre": self.of_rule.get(centre.get("state_fusion"), {}), **alone}
        draw = {key: value for key, value in overrides.get("replay", {}).items() if key in _DRAW}

        def spec(name: str) -> NodeSpec:
            params = {**(draw if self._draws(name) else {}), **given.get(name, {}), **overrides.get(name, {})}
            return NodeSpec(name if name in OTHERS else "sensor_tracker", name, self.path, params, remaps[name])

        return [spec(name) for name in remaps]

    def _draws(self, name: str) -> bool:
        return name in ("replay", "fusion_centre") or self.sections[name].get("filter") == "particle"


def bringups(folder: Path | None = None) -> dict[str, str]:
    """List the parameter files that describe a scenario: name -> key of the scenario. Needs no YAML reader."""
    matches = {p.stem: _SCENARIO.search(p.read_text()) for p in (folder or share_file("config")).glob("*.yaml")}
    return {name: match[1] for name, match in sorted(matches.items()) if match}


def demos_of(scenario: str) -> list[str]:
    """Names of the parameter files with which a scenario runs over ROS."""
    return [name for name, key in bringups().items() if key == scenario]
