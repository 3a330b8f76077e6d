"""A scenario over real processes, by its parameter file: the fused tables, and what the evaluator says of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from nodes.support import START_S, STEP_S
from ros_helpers import Probe
from sensor_msgs.msg import PointCloud2

from track_fusion.demo.bringup import local_environment, running, start_scenario
from track_fusion.demo.wiring import Bringup
from track_fusion.scenarios import get_scenario
from track_fusion.study.one_target import Row

RADARS, RADAR_STEPS = "sharma-radars", 40
SEED, RUN = 5, 2
RUN_S = 300.0  # a run takes 5 s on two idle cores; tests of others may be running


class Case(NamedTuple):
    """A run over ROS: parameter file, rule (None: the first sensor alone), beginning of the scenario's row."""

    name: str
    rule: str | None
    row: str
    library: Row
    parameters: dict[str, Any] = {}
    steps: int = 0  # 0: all

    def __str__(self) -> str:
        return f"{self.name}:{self.rule or 'alone'}"


def run(case: Case, context: Any, domain: int, folder: Path) -> tuple[list[PointCloud2], dict[str, Any]]:
    """Run all steps of a scenario; return the fused tables and what the evaluator says."""
    log, judged = folder / "nodes.log", folder / "judged.json"
    bringup, fused = Bringup(case.name), "/fusion_centre/tracks" if case.rule else "/sensor_1/tracks"
    trackers = bringup.trackers if case.rule else bringup.trackers[:1]
    patient = {"subscribers_deadline_s": START_S}
    overrides: dict[str, dict[str, Any]] = {name: {**patient, "feedback_timeout_s": RUN_S} for name in trackers}
    overrides["fusion_centre"] = {**patient, **case.parameters}
    overrides["replay"] = {"seed": SEED, "run": RUN, "deadline_s": START_S}
    overrides["evaluator"] = {"output": str(judged)}
    publisher = "fusion_centre" if case.rule else trackers[0]
    readers = bringup.sections["fusion_centre"]["expected_subscribers"] if case.rule else 2
    overrides[publisher]["expected_subscribers"] = readers + 1  # this test
    steps = case.steps or get_scenario(bringup.scenario).played().steps
    results = steps // bringup.result_every
    overrides["replay"]["steps"], overrides["evaluator"]["steps"] = steps, results
    messages: list[PointCloud2] = []
    with Probe(context) as probe, running(local_environment(domain), log) as nodes:
        messages = probe.listen(fused, PointCloud2, 1000)
        start_scenario(nodes, case.name, case.rule, overrides)

        def done() -> bool:
            assert nodes.failed() is None, f"{nodes.failed()} failed: {log.read_text()}"
            return len(messages) >= results

        probe.wait_for(done, RUN_S, "all steps")
        for name in ("replay", "evaluator"):
            assert nodes.processes[name].wait(STEP_S) == 0, log.read_text()
    return messages, json.loads(judged.read_text())
