"""Lockstep steps of the demo's chain (replay, two trackers, centre) against the same processes with empty callbacks."""

from __future__ import annotations

import os
import re
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmark.measure import Result
from track_fusion.demo.bringup import Nodes, local_environment, running, start_scenario

STEPS = 1000
REPEATS = 3
DEADLINE_S = 120.0


class EmptyNodes:
    """Starts trackers and centre with their work taken out, in place of the real ones."""

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes

    def start(self, executable: str, name: str, arguments: Sequence[str]) -> None:
        if executable in ("sensor_tracker", "fusion_centre"):
            self._nodes.start_module("benchmark.empty_chain", name, [executable, *arguments])
        else:
            self._nodes.start(executable, name, arguments)


def seconds_a_step(empty: bool) -> float:
    """Run the chain once; wall seconds a step as the replay node counts them."""
    overrides = {
        "replay": {"steps": STEPS, "expected_truth_subscribers": 0},
        "fusion_centre": {"expected_subscribers": 3},
    }
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        with running(local_environment(os.getpid() % 100), log) as nodes:
            chain = EmptyNodes(nodes) if empty else nodes
            start_scenario(chain, "li2022-linear", "covariance_intersection", overrides, evaluator=False)
            replay, deadline = nodes.processes["replay"], time.monotonic() + DEADLINE_S
            while replay.poll() is None and nodes.failed() is None and time.monotonic() < deadline:
                time.sleep(0.05)
        found = re.search(r"Replayed (\d+) steps in ([\d.]+) s", log.read_text())
        if not found:
            raise RuntimeError(f"The chain did not finish:\n{log.read_text()}")
        return float(found[2]) / int(found[1])


def run() -> Iterator[Result]:
    pairs = [(seconds_a_step(empty=True), seconds_a_step(empty=False)) for _ in range(REPEATS)]
    empty, real = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratio = statistics.median(r / e for e, r in pairs)
    yield Result("a step, empty callbacks", empty, figure=f"{1e3 * empty:.2f} ms, {1 / empty:.0f} steps/s")
    yield Result(
        "a step", real, "empty callbacks", ratio, at_most=2.0, figure=f"{1e3 * real:.2f} ms, {1 / real:.0f} steps/s"
    )
