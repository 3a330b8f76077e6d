"""Lockstep steps a second of the demo's chain, against the same processes with empty callbacks."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
from pathlib import Path

STEPS = 1000
REPEATS = 3
#: A step of the real chain may cost so many steps of the empty one.
TARGET = 2.0


class _Modules:
    """Starts the empty chain's trackers and centre instead of the real ones."""

    def __init__(self, nodes):
        self._nodes = nodes

    def __getattr__(self, name):
        return getattr(self._nodes, name)

    def start(self, executable, name, arguments):
        if executable in ("sensor_tracker", "fusion_centre"):
            module, arguments = "benchmark.empty_chain", [executable, *arguments]
        else:
            module = f"track_fusion.nodes.{executable}"
        self._nodes.start_module(module, name, arguments)


def seconds_a_step(empty: bool, rule: str = "covariance_intersection") -> float:
    """Run the chain once; wall seconds a step as the replay node counts them."""
    from track_fusion.nodes.bringup import local_environment, running, start_scenario

    overrides = {"replay": {"steps": STEPS, "expected_truth_subscribers": 0}}
    overrides["fusion_centre"] = {"expected_subscribers": 3}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        with running(local_environment((os.getpid() + empty) % 100), log) as nodes:
            start_scenario(_Modules(nodes) if empty else nodes, "li2022-linear", rule, overrides, evaluator=False)
            replay, deadline = nodes.processes["replay"], time.monotonic() + 120
            while replay.poll() is None and nodes.failed() is None and time.monotonic() < deadline:
                time.sleep(0.05)
        found = re.search(r"Replayed (\d+) steps in ([\d.]+) s", log.read_text())
        if not found:
            sys.exit(f"The chain did not finish:\n{log.read_text()}")
        return float(found[2]) / int(found[1])


def measure() -> None:
    """Print both chains, in turn, and their ratio."""
    real, empty = [], []
    for _ in range(REPEATS):
        empty.append(seconds_a_step(empty=True))
        real.append(seconds_a_step(empty=False))
    ratio = sorted(r / e for r, e in zip(real, empty))[REPEATS // 2]
    print(f"empty chain {1e3 * min(empty):.2f} ms a step, real chain {1e3 * min(real):.2f} ms "
          f"({1 / min(real):.0f} steps/s), ratio {ratio:.2f} (target <= {TARGET})")


if __name__ == "__main__":
    measure()
